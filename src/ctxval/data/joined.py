"""One recording in several tables, each with times of its own: logs of PX4 and ArduPilot, and one CSV file a topic."""

from __future__ import annotations

import io
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

import numpy as np

from ctxval._util.columns import is_unit, time_column
from ctxval._util.files import open_regular, require_regular_file
from ctxval._util.refusals import require_extra
from ctxval._util.texts import enumerated
from ctxval.data.log import Clock, Log, MemoryTable, Signal, Table, reading
from ctxval.errors import InputError


class JoinedLog(Log):
    """Tables on one clock; a field is ``topic.field``, or the field alone if only one topic has it."""

    def __init__(self, source: str, tables: Mapping[str, Table], unit: str = "") -> None:
        self.source, self._tables, self._unit = source, dict(tables), unit
        self.about: list[str] = []  #: how the tables became one log, and what is missing in it
        times = {topic: (time_column(source, table.names) or ("", ""))[0] for topic, table in tables.items()}
        of_topics = {topic: [n for n in table.names if n != times[topic]] for topic, table in tables.items()}
        counted = Counter(name for names in of_topics.values() for name in names)
        self._known = {
            name if counted[name] == 1 else f"{topic}.{name}": (topic, name)
            for topic, names in of_topics.items()
            for name in names
        }
        self._whole = {f"{topic}.{name}": (topic, name) for topic, names in of_topics.items() for name in names}

    @property
    def remarks(self) -> list[str]:  # type: ignore[override]
        """What was left out of the tables."""
        return [*self.about, *(text for table in self._tables.values() for text in table.remarks)]

    def fields(self) -> tuple[str, ...]:
        return tuple(self._known)

    def numbered_times(self, clock: Clock) -> tuple[str, str] | None:
        return next(iter(self._tables.values())).numbered_times(self._in_unit(clock))

    def signals(self, fields: Sequence[str], clock: Clock) -> dict[str, Signal]:
        located = {field: self._located(field, self._place) for field in fields}
        clock = self._in_unit(clock)
        names = {field: name if k is None else f"{name}[{k}]" for field, ((_, name), k) in located.items()}
        signals = dict[str, Signal]()
        for topic in dict.fromkeys(topic for (topic, _), _ in located.values()):
            of_topic = [field for field, ((each, _), _) in located.items() if each == topic]
            read = self._tables[topic].signals([names[field] for field in of_topic], clock)
            signals |= {field: read[names[field]] for field in of_topic}
        if self.numbered_times(clock) is None:  # dates count from midnight: tables begin within half a day
            start = signals[fields[0]].times[0]
            for field, signal in signals.items():
                days = round((signal.times[0] - start) / 86400)
                signals[field] = replace(signal, times=signal.times - 86400 * days)
        return {field: signals[field] for field in fields}

    def _in_unit(self, clock: Clock) -> Clock:
        return replace(clock, unit=clock.unit or self._unit)

    def _place(self, field: str) -> tuple[str, str] | None:
        """Return the topic and the name of a field, with or without its unit."""
        if (place := self._known.get(field) or self._whole.get(field)) is not None:
            return place
        topics = [topic for topic in self._tables if field.startswith(f"{topic}.")]
        rest = {topic: field.removeprefix(f"{topic}.") for topic in topics or self._tables}
        having = [(topic, name) for topic, name in rest.items() if self._tables[topic].has(name)]
        return having[0] if len(having) == 1 else None


def read_ulog(path: Path) -> list[Log]:
    """Return the recording in a ULog file of PX4, whose times are in microseconds; needs pyulog."""
    library = require_extra("pyulog", "logs", "ULog files need")
    with reading(path, "ULog"), open_regular(path) as file, redirect_stdout(io.StringIO()):  # pyulog prints warnings
        content = library.ULog(file)
        topics = content.data_list
        names = Counter(topic.name for topic in topics)
        tables = {}
        for topic in topics:
            name = topic.name if names[topic.name] == 1 else f"{topic.name}_{topic.multi_id}"
            columns = {field: np.asarray(values, dtype=np.float64) for field, values in topic.data.items()}
            tables[name] = MemoryTable(f"{path}, {name}", columns)
    if not tables:
        raise InputError(f"{path} has no message.")
    log = JoinedLog(str(path), tables, "us")
    log.about = [f"{path} is damaged: some of its messages are left out"] if content.file_corruption else []
    return [log]


def read_dataflash(path: Path) -> list[Log]:
    """Return the recording in a DataFlash log of ArduPilot, a file ``.bin``; needs pymavlink.

    A topic is a message such as ``ATT``, or ``IMU_0`` of the instance 0. Columns have the units that the log states.
    """
    kind = require_extra("pymavlink.DFReader", "logs", "logs of ArduPilot need").DFReader_binary
    reader = kind.__new__(kind)  # apart from __init__, because a reader that fails keeps its file open
    rows: dict[str, list[dict[str, float]]] = {}
    units: dict[str, dict[str, str]] = {}
    said = io.StringIO()
    with reading(path, "a DataFlash log"), redirect_stdout(said), redirect_stderr(said):  # pymavlink prints warnings
        require_regular_file(path)
        try:
            reader.__init__(str(path))
            while (message := reader.recv_msg()) is not None:
                about, content = message.fmt, message.to_dict()
                if "TimeUS" in content:
                    numbers = {name: value for name, value in content.items() if isinstance(value, int | float)}
                    stated = {name: about.get_unit(name) for name in numbers}
                    topic = about.name + (f"_{content[about.instance_field]}" if about.instance_field else "")
                    rows.setdefault(topic, []).append(numbers)
                    units[topic] = {name: unit for name, unit in stated.items() if unit and is_unit(unit)}
        finally:
            for opened in ("data_map", "filehandle"):
                if hasattr(reader, opened):
                    getattr(reader, opened).close()
    tables = {}
    for topic, messages in rows.items():
        names = [name for name in messages[0] if name != "TimeUS"]
        labels = {name: f"{name} [{units[topic][name]}]" if name in units[topic] else name for name in names}
        columns = {"timestamp": np.array([each["TimeUS"] for each in messages], dtype=np.float64)}
        columns |= {labels[name]: np.array([each.get(name, np.nan) for each in messages]) for name in names}
        tables[topic] = MemoryTable(f"{path}, {topic}", columns)
    if not tables:
        raise InputError(f"{path} has no message with a time.")
    log = JoinedLog(str(path), tables, "us")
    log.about = [f"{path} is damaged: some of its messages are left out"] if said.getvalue() else []
    return [log]


def joined_topics(logs: Sequence[Log]) -> list[Log]:
    """Return logs, of which files with different fields of one recording are one: ``LOG_TOPIC.csv``, for each LOG.

    PX4's tools write such files, with a column ``timestamp`` in microseconds. Other files must have no field in common
    but their times.
    """
    tables = {Path(log.source): log for log in logs if isinstance(log, Table)}
    of_px4 = all(
        list(table.names[:1]) == ["timestamp"] and re.search(r"_\d{1,2}$", path.stem) for path, table in tables.items()
    )
    kinds = {path: table.fields() for path, table in tables.items()}
    if len(tables) < len(logs) or len(set(kinds.values())) < 2:
        return list(logs)
    tokens = {path: path.stem.split("_") for path in tables}
    for count in range(min(map(len, tokens.values()))):
        groups: dict[tuple[Path, ...], list[Path]] = {}
        for path in tables:
            groups.setdefault((path.parent, *map(Path, tokens[path][:count])), []).append(path)
        if all(_are_topics([kinds[path] for path in of], of_px4) for of in groups.values()):
            return [_joined({path: tables[path] for path in of}, of_px4) for of in groups.values()]
    return list(logs)


def _are_topics(kinds: Sequence[Sequence[str]], of_px4: bool) -> bool:
    if not 1 < len(kinds) == len({tuple(kind) for kind in kinds}):
        return False
    times = [time_column("", kind) for kind in kinds]
    names = [name for kind, time in zip(kinds, times, strict=True) if time for name in kind if name != time[0]]
    return None not in times and (of_px4 or len(names) == len(set(names)))


def _joined(tables: Mapping[Path, Table], of_px4: bool) -> JoinedLog:
    stems = [path.stem.split("_") for path in tables]
    shared = next(k for k, parts in enumerate(zip_longest(*stems)) if len(set(parts)) > 1)
    topics = ["_".join(stem[shared:-1] if of_px4 and stem[-1] == "0" else stem[shared:]) for stem in stems]
    folder = next(iter(tables)).parent
    source = str(folder / "_".join(stems[0][:shared]) if shared else folder)
    log = JoinedLog(source, dict(zip(topics, tables.values(), strict=True)), "us" if of_px4 else "")
    log.about = [f"{enumerated([path.name for path in tables], 6)} are read as one recording"]
    return log
