"""One command line in a process of its own, with a bound on its time, memory and files, and everything that it did."""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

STATUSES = {0, 1, 2, 3, 130, 141}
"""Those that the README lists."""

WALL, CPU = 60, 12
"""Seconds after which a command hangs: of the clock, as the machine may be busy, and of the processor."""

MEMORY = 700 * 2**20
"""Bytes that a command may take on top of what the interpreter and the package take."""

FILE_SIZE = 300 * 2**20
OUTPUT = 200_000
"""Bytes of output that are still something to read."""

_UNCAUGHT = 97
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
_RUNS_CODE = ("os.system", "subprocess.Popen", "os.exec", "os.posix_spawn", "os.spawn", "pty.spawn", "os.startfile")
SENTINEL = "PWNED"
"""A file that hostile code would make, if it ran."""


@dataclass(frozen=True)
class Case:
    """A command line in a folder of hostile files, and what it may do there.

    Attributes:
        arguments: of ``ctxval``.
        code: whether the input is code by right, as an experiment file's modules are.
        prints: whether users' own code prints what it likes.
        environment: variables.
    """

    arguments: tuple[str, ...]
    code: bool = False
    prints: bool = False
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Outcome:
    """How a command ended.

    Attributes:
        status: its exit status, negative for a signal.
        wrong: what must not happen and did.
        seconds: of the clock.
        megabytes: the most memory that it had.
        said: the end of its output.
    """

    status: int
    wrong: tuple[str, ...]
    seconds: float
    megabytes: float
    said: str = ""


def carry_out(case: Case, folder: Path) -> Outcome:
    """Run a command line in a fork of this process, which has imported the package; look at all that it did."""
    streams = [folder.parent / f"{folder.name}.{name}" for name in ("out", "err", "seen")]
    began = time.monotonic()
    child = os.fork()
    if child == 0:
        _inside(case, folder, streams)
    hung, status, usage = _wait(child, began)
    seconds = time.monotonic() - began
    out, err, seen = (path.read_bytes() if path.exists() else b"" for path in streams)
    for path in streams:
        path.unlink(missing_ok=True)
    code = os.waitstatus_to_exitcode(status)
    grown = usage.ru_maxrss / 1024
    wrong = [*_wrong_end(code, hung), *_wrong_output(case, code, out, err), *_wrong_acts(case, seen, folder)]
    if grown - _resting() > MEMORY / 2**20:
        wrong.append("memory")
    said = (out[-600:] + b"\n" + err[-1500:]).decode("utf-8", "backslashreplace")
    return Outcome(code, tuple(dict.fromkeys(wrong)), seconds, grown, said)


def _resting() -> float:
    """Return the megabytes that this process has now and that each of its forks has at first: not those of files."""
    resident, shared = map(int, Path("/proc/self/statm").read_text().split()[1:3])
    return (resident - shared) * resource.getpagesize() / 2**20


def _wait(child: int, began: float) -> tuple[bool, int, Any]:
    pause = 0.002
    while True:
        found, status, usage = os.wait4(child, os.WNOHANG)
        if found:
            _end_group(child)
            return os.waitstatus_to_exitcode(status) == -signal.SIGXCPU, status, usage
        if time.monotonic() - began > WALL:
            _end_group(child)
            _, status, usage = os.wait4(child, 0)
            return True, status, usage
        time.sleep(pause)
        pause = min(pause * 1.3, 0.05)


def _end_group(child: int) -> None:
    """End what a command has left behind."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(child, signal.SIGKILL)


def _wrong_end(code: int, hung: bool) -> list[str]:
    if hung:
        return ["hang"]
    if code == _UNCAUGHT:
        return ["traceback"]
    return [] if code in STATUSES else ["status"]


def _wrong_output(case: Case, code: int, out: bytes, err: bytes) -> list[str]:
    wrong = []
    both = (out + b"\n" + err).decode("utf-8", "backslashreplace")
    if "Traceback (most recent call last)" in both and not case.prints:
        wrong.append("traceback")
    if _CONTROL.search(both) and not case.prints:
        wrong.append("escape")
    if len(both) > OUTPUT and not case.prints:
        wrong.append("flood")
    if "--json" in case.arguments and code in (0, 1) and not _is_json(out):
        wrong.append("no JSON")
    if code in (2, 3) and not both.strip():
        wrong.append("silent")
    return wrong


def _is_json(out: bytes) -> bool:
    try:
        json.loads(out)
    except ValueError:
        return b"Usage:" in out  # --help beside --json
    return True


def _wrong_acts(case: Case, seen: bytes, folder: Path) -> list[str]:
    wrong = []
    if not case.code and ((folder / SENTINEL).exists() or b"runs" in seen):
        wrong.append("code")
    if not case.code and b"writes" in seen:
        wrong.append("wrote elsewhere")
    return wrong


# In the child


def _inside(case: Case, folder: Path, streams: Sequence[Path]) -> None:
    """Run the command line, and leave with its exit status."""
    status = _UNCAUGHT
    try:
        os.setsid()
        os.chdir(folder)
        os.environ.update(case.environment)
        tempfile.tempdir = None  # what the parent found out is of its own TMPDIR
        nothing = os.open(os.devnull, os.O_RDONLY)
        out, err, seen = (os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644) for path in streams)
        for there, here in ((nothing, 0), (out, 1), (err, 2)):
            os.dup2(there, here)
        # Whoever runs us, a test for example, may have put others in their places.
        sys.stdout, sys.stderr = (open(n, "w", encoding="utf-8", closefd=False) for n in (1, 2))  # noqa: SIM115
        for signal_ in (signal.SIGINT, signal.SIGTERM, signal.SIGPIPE):
            signal.signal(signal_, signal.SIG_DFL if signal_ != signal.SIGINT else signal.default_int_handler)
        _limit()
        sys.addaudithook(_Watch(seen, folder))
        status = _status_of(case)
    except BaseException:
        import traceback

        with contextlib.suppress(BaseException):
            traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):
            sys.stdout.flush()
        with contextlib.suppress(BaseException):
            sys.stderr.flush()
        os._exit(status)


def _status_of(case: Case) -> int:
    """Return the exit status that Python would give the command."""
    from ctxval.cli import main

    sys.argv = ["ctxval", *case.arguments]
    try:
        main()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except KeyboardInterrupt:
        return _UNCAUGHT
    return 0


def _limit() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + 2 * MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CPU, (CPU, CPU + 2))
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_SIZE, FILE_SIZE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


class _Watch:
    """Notes what would run code, and files that are written outside of the folder."""

    def __init__(self, seen: int, folder: Path) -> None:
        self.seen, self.folder = seen, str(folder)

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event in _RUNS_CODE:
            os.write(self.seen, f"runs {event} {arguments!r}\n".encode("utf-8", "backslashreplace")[:400])
        elif event == "open" and isinstance(arguments[0], str) and self._written_elsewhere(arguments):
            os.write(self.seen, f"writes {arguments!r}\n".encode("utf-8", "backslashreplace")[:400])

    def _written_elsewhere(self, arguments: tuple[Any, ...]) -> bool:
        flags = arguments[2] if isinstance(arguments[2], int) else 0
        if not flags & (os.O_WRONLY | os.O_RDWR):
            return False
        path = os.path.abspath(arguments[0])
        return not path.startswith((f"{self.folder}/", "/dev/", "/proc/")) and "__pycache__" not in path
