"""What a process and its children do to the files of a folder, in the kernel's order, as strace sees it.

The package's own code runs with Python's own SQLite on a real file system: no layer in between changes what is written.
"""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

Kind = Literal["create", "write", "truncate", "sync", "sync folder", "unlink", "rename", "mkdir", "rmdir", "mark"]

_CALLS = (
    *("openat", "open", "creat", "pwrite64", "write", "writev", "pwritev", "pwritev2", "ftruncate", "truncate"),
    *("fallocate", "fsync", "fdatasync", "unlink", "unlinkat", "rename", "renameat", "renameat2"),
    *("mkdir", "mkdirat", "rmdir", "link", "linkat", "symlink", "symlinkat"),
)
_LINE = re.compile(r"^(\d+) +(\w+)\((.*)\) += (-?\d+|\?)", re.DOTALL)
_CUT = re.compile(r"^(\d+) +(.*) <unfinished \.\.\.>$", re.DOTALL)
_RESUMED = re.compile(r"^(\d+) +<\.\.\. \w+ resumed>(.*)$", re.DOTALL)


@dataclass(frozen=True)
class Event:
    """One thing that happened to the files.

    Attributes:
        kind: what.
        path: of the file or folder, relative to the recorded folder.
        offset: of a write; the new size for a truncation.
        data: what was written.
        target: new name.
        mark: what the campaign said there, an acknowledgement.
    """

    kind: Kind
    path: str = ""
    offset: int = 0
    data: bytes = b""
    target: str = ""
    mark: Any = None


def record(command: Sequence[str], folder: Path, marks: Path, log: Path) -> list[Event]:
    """Run a command to its end; return what it did in a folder, and what it said in the file of marks meanwhile.

    Raises:
        RuntimeError: the command failed, or did what is not modelled.
    """
    traced = ["strace", "-f", "--seccomp-bpf", "-y", "-xx", "-s", "100000000", "-e", f"trace={','.join(_CALLS)}"]
    done = subprocess.run([*traced, "-o", str(log), *command], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}: {done.stderr[-2000:]}")
    return list(events(log.read_text(), folder.resolve(), marks.resolve()))


def events(text: str, folder: Path, marks: Path) -> Iterator[Event]:
    """Read a log of strace."""
    known: dict[str, int] = {}
    for name, arguments, result in _calls(text):
        if result >= 0:
            yield from _Call(name, arguments, result, str(folder), str(marks)).events(known)


def _calls(text: str) -> Iterator[tuple[str, str, int]]:
    """Return each call when it had ended; those of several processes are interleaved."""
    begun: dict[str, str] = {}
    for line in text.splitlines():
        if cut := _CUT.match(line):
            begun[cut[1]] = cut[2]
            continue
        if resumed := _RESUMED.match(line):
            line = f"{resumed[1]} {begun.pop(resumed[1])}{resumed[2]}"
        if call := _LINE.match(line):
            yield call[2], call[3], -1 if call[4] == "?" else int(call[4])


class _Call:
    def __init__(self, name: str, arguments: str, result: int, folder: str, marks: str) -> None:
        self.name, self.arguments, self.result, self.folder, self.marks = name, arguments, result, folder, marks

    def events(self, known: dict[str, int]) -> Iterator[Event]:
        """Return what the call did inside of the folder."""
        opened = self._descriptor()
        if opened == self.marks and self.name == "write":
            yield Event("mark", mark=json.loads(self._texts()[0]))
            return
        paths = [path for text in self._texts() if (path := self._inside(text.decode("utf-8", "replace"))) is not None]
        held = self._inside(opened)
        if self.name in ("openat", "open", "creat"):
            yield from self._opened(paths, known)
        elif self.name in ("mkdir", "mkdirat", "rmdir", "unlink", "unlinkat", "rename", "renameat", "renameat2"):
            yield from self._renamed(paths, known)
        elif held is not None and not opened.endswith("(deleted)"):
            yield from self._changed(held)
        elif paths and self.name in ("truncate", "link", "linkat", "symlink", "symlinkat"):
            raise RuntimeError(f"{self.name} is not modelled: {self.arguments[:200]}")

    def _opened(self, paths: list[str], known: dict[str, int]) -> Iterator[Event]:
        # A file that was there before the recording is none of ours: each recording has a folder of its own.
        if paths and paths[0] not in known and "O_CREAT" in self.arguments:
            known[paths[0]] = 1
            yield Event("create", paths[0])
        elif paths and "O_TRUNC" in self.arguments:
            yield Event("truncate", paths[0])

    def _renamed(self, paths: list[str], known: dict[str, int]) -> Iterator[Event]:
        if not paths:
            return
        if self.name.startswith("rename"):
            known.pop(paths[0], None)
            known[paths[-1]] = 1
            yield Event("rename", paths[0], target=paths[-1])
        elif self.name.startswith("mkdir"):
            yield Event("mkdir", paths[0])
        elif self.name == "rmdir" or "AT_REMOVEDIR" in self.arguments:
            yield Event("rmdir", paths[0])
        else:
            known.pop(paths[0], None)
            yield Event("unlink", paths[0])

    def _changed(self, held: str) -> Iterator[Event]:
        numbers = [int(number) for number in re.findall(r", (\d+)", self.arguments)]
        match self.name:
            case "pwrite64":
                yield Event("write", held, numbers[-1], self._texts()[0][: self.result])
            case "write":
                yield Event("write", held, -1, self._texts()[0][: self.result])
            case "ftruncate":
                yield Event("truncate", held, numbers[-1])
            case "fsync" | "fdatasync":
                yield Event("sync folder" if self._is_folder(held) else "sync", held)
            case _:
                raise RuntimeError(f"{self.name} is not modelled: {self.arguments[:200]}")

    def _is_folder(self, held: str) -> bool:
        return (Path(self.folder) / held).is_dir()

    def _descriptor(self) -> str:
        """Return the path of the call's first descriptor."""
        found = re.match(r"\d+<((?:\\x[0-9a-f]{2})*)>(\(deleted\))?", self.arguments)
        return "" if found is None else _unescaped(found[1]).decode("utf-8", "replace") + (found[2] or "")

    def _texts(self) -> list[bytes]:
        return [_unescaped(text) for text in re.findall(r'"((?:\\x[0-9a-f]{2})*)"', self.arguments)]

    def _inside(self, path: str) -> str | None:
        if path != self.folder and not path.startswith(f"{self.folder}/"):
            return None
        return path[len(self.folder) :].strip("/")


def _unescaped(text: str) -> bytes:
    return bytes.fromhex(text.replace("\\x", ""))
