"""Results of a study in one file: a JSON object a line, appended as it comes and found by its key."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ctxval.errors import InputError

Record = dict[str, Any]
Key = tuple[Any, ...]


class JsonLines(Mapping[Key, Record]):
    """The records of a file of JSON lines; of several records with one key, the last one counts.

    One process appends. If it is killed in a line, that line is ignored, and removed before the next record. The file
    is read once, when it is first asked, and made by the first record.
    """

    def __init__(self, path: Path, key: Sequence[str]) -> None:
        self.path, self.key = path, tuple(key)
        self._last = b""  # what follows the last newline of the file

    def __getitem__(self, key: Key) -> Record:
        return self._records[key]

    def __iter__(self) -> Iterator[Key]:
        return iter(self._records)

    def __len__(self) -> int:
        return len(self._records)

    def select(self, **fields: Any) -> list[Record]:
        """Return the records with these values, in the order in which their keys were first stored."""
        return [record for record in self.values() if all(record.get(name) == fields[name] for name in fields)]

    def append(self, record: Mapping[str, Any]) -> None:
        # What is read again later is what is known now: tuples are lists, for instance.
        line = json.dumps(dict(record))
        stored: Record = json.loads(line)
        key = self._key_of(stored, "the record")
        records = self._records
        self.path.parent.mkdir(parents=True, exist_ok=True)
        data, last, self._last = f"{line}\n".encode(), self._last, b""
        if last and _parsed(last) is None:  # its end was never written
            os.truncate(self.path, self.path.stat().st_size - len(last))
        elif last:  # it lacks its newline only
            data = b"\n" + data
        # Without a buffer the line is written in one call, so that readers find the whole of it or nothing.
        with self.path.open("ab", buffering=0) as file:
            if file.write(data) != len(data):
                raise OSError(f"{self.path}: the disk took a part of a record only.")
        records[key] = stored

    @functools.cached_property
    def _records(self) -> dict[Key, Record]:
        records: dict[Key, Record] = {}
        *lines, last = self.path.read_bytes().split(b"\n") if self.path.exists() else [b""]
        self._last = last
        if _parsed(last) is not None:  # otherwise its end was never written
            lines.append(last)
        for number, line in enumerate(lines, start=1):
            where = f"{self.path}, line {number}"
            if (record := _parsed(line)) is None:
                raise InputError(f"{where}: a line must be a JSON object, got {line[:40].decode(errors='replace')!r}.")
            records[self._key_of(record, where)] = record
        return records

    def _key_of(self, record: Record, where: str) -> Key:
        missing = [name for name in self.key if name not in record]
        if missing:
            raise InputError(f"{where}: the field {missing[0]!r} is missing; the key is {', '.join(self.key)}.")
        return tuple(record[name] for name in self.key)


def _parsed(line: bytes) -> Record | None:
    with suppress(ValueError):
        match json.loads(line):
            case dict() as record:
                return record
    return None
