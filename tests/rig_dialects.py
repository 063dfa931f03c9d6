"""One table in many dialects of CSV, as loggers, spreadsheets and tools write it; all of them mean the same numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

Rows = Sequence[Sequence[str]]
"""The header and the rows of cells; numbers have decimal points, and the first column holds the seconds."""


def _text(rows: Rows, separator: str = ",", end: str = "\n") -> str:
    return "".join(separator.join(row) + end for row in rows)


def _german(rows: Rows) -> Rows:
    return [rows[0], *([cell.replace(".", ",") for cell in row] for row in rows[1:])]


def _units(rows: Rows) -> list[str]:
    return [{"t": "s", "angle": "rad", "speed": "rad/s", "position": "m"}.get(name, "-") for name in rows[0]]


def _named(rows: Rows, name: str, time: Callable[[float], str]) -> Rows:
    """Write the times in another form, below another name."""
    return [[name, *rows[0][1:]], *([time(float(row[0])), *row[1:]] for row in rows[1:])]


def _clock(seconds: float, start: float = 0.0) -> str:
    """Return a time of a day, whose microseconds are rounded."""
    micro = round(1e6 * (start + seconds)) % 86_400_000_000
    whole, part = divmod(micro, 1_000_000)
    return f"{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d}.{part:06d}"


def _with(rows: Rows, place: int, *lines: str) -> str:
    parts = _text(rows).splitlines(keepends=True)
    return "".join([*parts[:place], *(f"{line}\n" for line in lines), *parts[place:]])


_LABVIEW = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDate\t2024/05/01\n***End_of_Header***\t\n\t\n"
    "Channels\t3\t\nSamples\t300\t300\n***End_of_Header***\t\n"
)

DIALECTS: dict[str, tuple[str, Callable[[Rows], str | bytes]]] = {
    "plain": (".csv", _text),
    "semicolons and commas": (".csv", lambda rows: _text(_german(rows), ";")),
    "tabs": (".tsv", lambda rows: _text(rows, "\t")),
    "tabs and commas": (".txt", lambda rows: _text(_german(rows), "\t")),
    "bars": (".csv", lambda rows: _text(rows, "|")),
    "blanks": (".dat", lambda rows: _text(rows, "   ")),
    "blanks and commas": (".txt", lambda rows: "".join(f"  {'  '.join(row)} \n" for row in _german(rows))),
    "blank after comma": (".csv", lambda rows: _text(rows, ", ")),
    "quoted commas": (".csv", lambda rows: _text([[f'"{cell}"' for cell in row] for row in _german(rows)])),
    "carriage returns": (".csv", lambda rows: _text(rows, end="\r\n")),
    "comma at the end": (".csv", lambda rows: _text([rows[0], *([*row, ""] for row in rows[1:])])),
    "sep=": (".csv", lambda rows: "sep=;\r\n" + _text(_german(rows), ";", "\r\n")),
    "byte order mark": (".csv", lambda rows: b"\xef\xbb\xbf" + _text(rows).encode()),
    "UTF-16": (".csv", lambda rows: _text(rows, "\t").encode("utf-16")),
    "UTF-16 without a mark": (".txt", lambda rows: _text(rows, ";").encode("utf-16-le")),
    "cp1252": (".csv", lambda rows: _with(rows, 0, "# Temperatur 20 \xb0C").encode("cp1252")),
    "number signs": (".csv", lambda rows: _with(rows, 0, "# rig 3", "# kp = 3, ki = 0")),
    "percent signs": (".dat", lambda rows: _with(rows, 0, '% rig "3', "%")),
    "comments between rows": (".csv", lambda rows: _with(rows, 20, "# gust", "")),
    "header of numpy": (".txt", lambda rows: "# " + _text(rows, " ")),
    "rostopic": (".csv", lambda rows: "%" + _text(_named(rows, "time", lambda t: f"{round(1e9 * t) + 17 * 10**17}"))),
    "units row": (".csv", lambda rows: _with(rows, 1, ",".join(_units(rows)))),
    "units in brackets": (".csv", lambda rows: _with(rows, 1, ",".join(f"[{unit}]" for unit in _units(rows)))),
    "header again": (".csv", lambda rows: _with(rows, 20, ",".join(rows[0]))),
    "footer": (".csv", lambda rows: _text(rows) + "\nEND OF MEASUREMENT\n"),
    "preamble": (".csv", lambda rows: "Rig 3\nOperator: A, B\n\n" + _text(rows)),
    "LabVIEW": (".lvm", lambda rows: _LABVIEW + _text([["X_Value", *rows[0][1:], "Comment"], *rows[1:]], "\t")),
    "millis": (".csv", lambda rows: _text(_named(rows, "millis", lambda t: f"{1e3 * t:.6g}"))),
    "time in ms": (".csv", lambda rows: _text(_named(rows, "Time (ms)", lambda t: f"{1e3 * t:.6g}"))),
    "Zeit": (".csv", lambda rows: _text(_german(_named(rows, "Zeit", str)), ";")),
    "ISO 8601": (".csv", lambda rows: _text(_named(rows, "timestamp", lambda t: f"2024-05-01T{_clock(t)}Z"))),
    "date of a spreadsheet": (".csv", lambda rows: _text(_named(rows, "time", lambda t: f"01.05.2024 {_clock(t)}"))),
    "over midnight": (".csv", lambda rows: _text(_named(rows, "time", lambda t: _clock(t, 86399.5)))),
    "clock with commas": (".csv", lambda rows: _text(_german(_named(rows, "Uhrzeit", _clock)), ";")),
    "rows twice": (".csv", lambda rows: _text([*rows[:9], rows[8], *rows[9:20], rows[19], *rows[20:]])),
    "empty rows": (".csv", lambda rows: _text([*rows, ["nan"] * len(rows[0]), [""] * len(rows[0])])),
    "index": (".csv", lambda rows: _text([[str(k - 1) if k else "", *row] for k, row in enumerate(rows)])),
}
"""The ending of the file, and the text or the bytes of it, for each dialect."""
