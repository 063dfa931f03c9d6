"""Units, columns and times of tables, and what stands for a missing value in them."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.texts import enumerated
from ctxval.errors import InputError

# Units. Angles have a dimension of their own here: ``pint`` converts 1 Hz to 1 rad/s, and degrees to numbers.

Powers = tuple[int, int, int, int, int]  #: powers of m, kg, s, A and rad

_UNITS: dict[str, tuple[float, Powers]] = {
    **{"1": (1.0, (0, 0, 0, 0, 0)), "m": (1.0, (1, 0, 0, 0, 0)), "kg": (1.0, (0, 1, 0, 0, 0))},
    **{"s": (1.0, (0, 0, 1, 0, 0)), "min": (60.0, (0, 0, 1, 0, 0)), "h": (3600.0, (0, 0, 1, 0, 0))},
    **{"rad": (1.0, (0, 0, 0, 0, 1)), "deg": (math.pi / 180, (0, 0, 0, 0, 1)), "rev": (2 * math.pi, (0, 0, 0, 0, 1))},
    **{"rpm": (2 * math.pi / 60, (0, 0, -1, 0, 1)), "Hz": (1.0, (0, 0, -1, 0, 0)), "g": (9.80665, (1, 0, -2, 0, 0))},
    **{"N": (1.0, (1, 1, -2, 0, 0)), "Nm": (1.0, (2, 1, -2, 0, 0)), "J": (1.0, (2, 1, -2, 0, 0))},
    **{"W": (1.0, (2, 1, -3, 0, 0)), "V": (1.0, (2, 1, -3, -1, 0)), "A": (1.0, (0, 0, 0, 1, 0))},
}
_PREFIXES = {"M": 1e6, "k": 1e3, "c": 1e-2, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}
_WITH_PREFIX = ("m", "s", "rad", "Hz", "N", "Nm", "J", "W", "V", "A")
_OTHER_NAMES = {
    **{"sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "millisecond": "ms", "usec": "us"},
    **{"milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns", "nsec": "ns", "minutes": "min"},
    **{"°": "deg", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad", "meter": "m", "meters": "m"},
    **{"metre": "m", "metres": "m", "dps": "deg/s", "mps": "m/s", "kph": "km/h", "kmh": "km/h", "N.m": "Nm"},
}
_FACTOR = re.compile(r"([A-Za-z°µμ]+|1)(?:\^?(-?[1-4]))?")

# The forms ``angle [deg]``, ``angle (deg)``, ``angle_deg`` and ``rate_deg_s``; MATLAB makes ``t__ms_`` of ``t [ms]``.
_BRACKETS = re.compile(r"(.*?)\s*(?:\[\s*(?!\d+\s*\])([^\[\]]*?)\s*\]|\(([^()]*)\))\s*")
_SUFFIX = re.compile(
    r"(.+?)_+(deg|rad|mrad|rpm|dps|mps|kmh|(?:[kcmun]?(?:m|s|N|Nm|V|A))|sec|msec|usec|nsec)(?:_(?:per_)?(s2?))?_?"
)


def conversion(recorded: str, wanted: str) -> float:
    """Return the factor from one unit to another."""
    if _plain(recorded) == _plain(wanted):
        return 1.0
    source, target = _parsed(recorded), _parsed(wanted)
    if source is None or target is None or source[1] != target[1]:
        units = f"from {recorded or 'no unit'} to {wanted or 'no unit'}"
        raise InputError(f"there is no known factor {units}: give factor = ... in a mapping, or convert the values.")
    return source[0] / target[0]


def differ(first: str, second: str) -> bool:
    """Return whether two units are different ones of the same quantity."""
    source, target = _parsed(first), _parsed(second)
    return source is not None and target is not None and source[1] == target[1] and source[0] != target[0]


def named_unit(column: str) -> tuple[str, str, bool]:
    """Return the name and the unit of a column, and whether the unit is weak: ``x_m`` may be a measured x."""
    if len(column) > 200:
        return column, "", False
    if unit := CLOCKS.get(column.strip().casefold()):
        return column.strip(), unit, False
    if (bracketed := _BRACKETS.fullmatch(column)) is not None:
        return bracketed[1], (bracketed[2] or bracketed[3] or "").strip(), False
    if (ended := _SUFFIX.fullmatch(column)) is None:
        return column.strip(), "", False
    rate = {"s": "/s", "s2": "/s^2"}.get(ended[3] or "", "")
    return ended[1], ended[2] + rate, not rate and ended[2] in ("m", "s", "N", "V", "A")


def is_unit(text: str) -> bool:
    """Return whether a text is a usual unit, also one that is not converted."""
    return text.strip().casefold() in _NOT_CONVERTED.split() or _parsed(text) is not None


_NOT_CONVERTED = "% °c degc c k °f f pa hpa kpa mpa bar mbar psi l/min count counts ticks lsb ohm"


def _parsed(unit: str) -> tuple[float, Powers] | None:
    """Return the factor to SI units and the powers of them; None if the unit is not known."""
    text = _OTHER_NAMES.get(unit.strip(), unit.strip()).replace("²", "^2").replace("³", "^3").replace("**", "^")
    numerator, *denominators = text.split("/")
    factor, powers = 1.0, [0] * 5
    for sign, part in ((1, numerator), *((-1, denominator) for denominator in denominators)):
        names = re.split(r"[\s*·.]+", part.strip())
        if sign < 0 and len(names) > 1:
            return None  # m/s kg is ambiguous
        for name in names:
            matched = _FACTOR.fullmatch(name)
            if matched is None:
                return None
            base, prefix = _OTHER_NAMES.get(matched[1], matched[1]), 1.0
            if base not in _UNITS and base[:1] in _PREFIXES and base[1:] in _WITH_PREFIX:
                base, prefix = base[1:], _PREFIXES[base[:1]]
            if base not in _UNITS:
                return None
            power = sign * int(matched[2] or 1)
            factor *= (prefix * _UNITS[base][0]) ** power
            powers = [total + power * single for total, single in zip(powers, _UNITS[base][1], strict=True)]
    return factor, tuple(powers)  # type: ignore[return-value]


def _plain(unit: str) -> str:
    return re.sub(r"[\s*·.]", "", unit).replace("°", "deg").replace("²", "^2").replace("s2", "s^2")


TIMES = ("t", "time", "times", "timestamp")
"""Names of columns of times, the first of which is taken: a state may be called ``time`` too."""

CLOCKS = {
    **dict.fromkeys(("millis", "milliseconds", "msec", "msecs"), "ms"),
    **dict.fromkeys(("micros", "microseconds", "usec", "usecs"), "us"),
    **dict.fromkeys(("seconds", "secs", "sec", "x_value"), "s"),
    **dict.fromkeys(("elapsed", "zeit", "uhrzeit", "zeitstempel", "temps", "tiempo", "tempo"), ""),
    **dict.fromkeys(("datetime", "date_time", "time_stamp", "ts"), ""),
}
"""Other names of columns of times, with the unit that each states; they are looked for after the usual ones."""

EPISODES = tuple(f"{name}{ending}" for name in ("episode", "run", "trial") for ending in ("", "_index", "_id"))
"""Names of columns that number the recordings in one table."""

FAR = 3.0  # largest ratio between the median time of two samples and a time step to which they are interpolated


def require_distinct(source: str, names: Sequence[str]) -> None:
    """Refuse a table with two columns of one name, also if they differ in their units."""
    plain = [named_unit(name)[0] if name.endswith(("]", ")")) else name for name in names if name]
    name, count = max(Counter(plain).items(), key=lambda pair: pair[1], default=("", 0))
    if count > 1:
        raise InputError(f"{source} has two columns {name[:60]!r}: each name must be there once.")


def column_of(source: str, names: Sequence[str], field: str) -> tuple[str, str] | None:
    """Return the column that a field means, and its unit; None if there is none.

    A field is a column's name with or without its unit, or with a unit in brackets that the column does not state.
    """
    plain, unit, weak = named_unit(field)
    if field in names:
        return field, "" if weak else unit
    if field.endswith(("]", ")")) and unit:
        column = column_of(source, names, plain)
        return None if column is None or column[1] not in ("", unit) else (column[0], unit)
    matching = [name for name in names if named_unit(name)[0] == field]
    if len(matching) > 1:
        raise InputError(f"{source} has several columns for {field}: {enumerated(matching, 5)}; name one of them.")
    return (matching[0], named_unit(matching[0])[1]) if matching else None


def time_column(source: str, names: Sequence[str]) -> tuple[str, str] | None:
    """Return the column of the times and its unit, empty if it states none; None if there is no such column."""
    plain = {name: named_unit(name)[0] for name in names}
    for time in (*TIMES, *CLOCKS):
        matching = [name for name, bare in plain.items() if time in (bare, bare.casefold() if time != "t" else "")]
        if time in matching or len(matching) == 1:
            column = time if time in matching else matching[0]
            return column, named_unit(column)[1]
        if matching:
            raise InputError(f"{source} has several columns of times, {enumerated(matching, 5)}; name one of them.")
    return None


def in_seconds(source: str, times: Array, unit: str) -> Array:
    """Return times in seconds; times since 1970 without a unit are recognised by their size."""
    if not unit and len(times):
        middle = float(np.median(times))
        # The smallest times after 1973, in units in which no recording has such a length.
        unit = next((name for least, name in ((1e17, "ns"), (1e14, "us"), (1e11, "ms")) if middle > least), "s")
    try:
        return np.asarray(times * conversion(unit or "s", "s"))
    except InputError:
        known = "s, ms, us, ns, min or h"
        raise InputError(f"{source}: the unit of its times must be {known}, got {unit[:40]!r}.") from None


def unit_advice(period: float, dt: float) -> str:
    """Return the sentence that times probably have another unit; empty if their period does not suggest one."""
    for factor, unit in ((1e3, "ms"), (1e6, "us"), (1e9, "ns")):
        if 1 / FAR < period / dt / factor < FAR:
            mapped = f"or give time_unit = {unit!r} in a mapping"
            return f"if the times are in {unit}, convert them to s, name their column t [{unit}], {mapped}"
        if 1 / FAR < period * factor / dt < FAR:
            return f"the times seem to be in s although they are stated in {unit}"
    return ""


def sentinels(values: Array, factor: float = 1.0) -> list[float]:
    """Return the values far outside all others that stand for a missing one, such as -999, -9999 or 1e9.

    The factor is that to the unit before a conversion of the table, which converted marks such as -999 too.
    """
    marks, rest = list[float](), np.asarray(values[np.isfinite(values)])
    while len(rest):
        low, high = float(rest.min()), float(rest.max())
        largest = low if abs(low) > abs(high) else high
        others = rest[rest != largest]
        size = abs(largest)
        powers = (float(f"1e{round(np.log10(size))}"),) if 1e6 <= size < np.inf else ()
        limits = (32767.0, -32768.0, 65535.0, 2147483647.0, -2147483648.0, 4294967295.0)
        near = size > 1e30 or any(math.isclose(largest, mark, rel_tol=1e-7) for mark in (*limits, *powers))
        if not len(others) or not (near or _all_nines(largest) or _all_nines(factor * largest)):
            break
        ranges = 2 * float(np.ptp(others))
        if min(abs(largest - float(others.min())), abs(largest - float(others.max()))) <= ranges:
            break
        marks.append(largest)
        rest = others
    return marks


def _all_nines(value: float) -> bool:
    """Return whether all digits are nines, also if the number was rounded to 32 bits or converted to another unit."""
    return abs(value) >= 99 and any(set(f"{abs(value):.{digits}g}".replace(".", "")) == {"9"} for digits in (7, 15))
