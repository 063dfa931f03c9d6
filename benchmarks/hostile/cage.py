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
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hostile import oracles

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
_FOREIGN = re.compile(r"^error: \w*(Error|Exception)\b", re.MULTILINE)
"""The sentence of an exception that is none of ours."""
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
        check: says what is wrong with the result; it gets the exit status and what was printed.
        client: sends requests to a command that serves a page, while it runs; it gets the process, the folder and the
            file of what is printed, and returns the answers. A line of them that begins with ! says what is wrong.
        places: folders of which every file may be read.
    """

    arguments: tuple[str, ...]
    code: bool = False
    prints: bool = False
    environment: Mapping[str, str] = field(default_factory=dict)
    check: Callable[[int, bytes], Sequence[str]] | None = None
    client: Callable[[int, Path, Path], bytes] | None = None
    places: tuple[str, ...] = ()


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
    environment = {**oracles.SECRETS, **case.environment}
    with Watched(folder, case.arguments) as watched:
        began = time.monotonic()
        child = os.fork()
        if child == 0:
            _inside(case, folder, environment, streams)
        answers = b"" if case.client is None else case.client(child, folder, streams[0])
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
    why = [*watched.wrong(out, err, answers), *_wrong_reads(seen), *_wrong_answers(answers)]
    why += [] if case.check is None or hung else case.check(code, out)
    said = "\n".join([*why[:20], (out[-600:] + b"\n" + err[-2500:]).decode("utf-8", "backslashreplace")])
    wrong += [one.partition(":")[0] for one in why]
    return Outcome(code, tuple(dict.fromkeys(wrong)), seconds, grown, said)


class Watched:
    """Everything around a command, before and after it: its folder, the home of its user, and what lies beside.

    Args:
        folder: the folder of the command.
        arguments: the command line.
    """

    def __init__(self, folder: Path, arguments: Sequence[str]) -> None:
        self.folder, self.arguments = folder, arguments

    def __enter__(self) -> Watched:
        oracles.write_decoys(self.folder)
        self.before = oracles.digests(self.folder.parent)
        self.heads = oracles.heads(self.folder.parent, self.before)
        self._openings = oracles.Openings([self.folder.parent / oracles.OUTSIDE, self.folder / "home" / ".aws"])
        return self

    def __exit__(self, *error: object) -> None:
        self.opened = self._openings.names()
        self.after = oracles.digests(self.folder.parent)

    def wrong(self, *said: bytes) -> list[str]:
        """Return the files that were opened or written against the rules, and where secrets turned up."""
        declared = [word for word in self.arguments if oracles.OUTSIDE in word]
        wrong = [f"read elsewhere: {name}" for name in dict.fromkeys(self.opened) if not declared]
        found = oracles.strays(self.before, self.after, self.arguments, self.heads, self.folder.parent)
        wrong += [f"files: {one}" for one in found]
        key = self.folder / "home" / "ctxval" / "key"
        known = key.read_bytes().strip() if key.is_file() else b""
        for name, content in oracles.written(self.folder.parent, self.before, self.after):
            if not name.startswith("f/home/"):
                wrong += [f"secret: {secret} in {name}" for secret in sorted(oracles.secrets_in(content, known))]
        for content in said:
            wrong += [f"secret: {secret} in what is said" for secret in sorted(oracles.secrets_in(content, known))]
        return wrong


def _wrong_reads(seen: bytes) -> list[str]:
    lines = seen.decode("utf-8", "replace").splitlines()
    return list(dict.fromkeys(f"read elsewhere: {line[6:]}" for line in lines if line.startswith("reads ")))


def _wrong_answers(answers: bytes) -> list[str]:
    """Return what is wrong with the answers of a server: its client marks them."""
    return [line[1:].decode("utf-8", "replace") for line in answers.splitlines() if line.startswith(b"!")]


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
    if code == 3 and not case.code and _FOREIGN.search(both):
        wrong.append("foreign")
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


def _inside(case: Case, folder: Path, environment: Mapping[str, str], streams: Sequence[Path]) -> None:
    """Run the command line, and leave with its exit status."""
    status = _UNCAUGHT
    try:
        os.setsid()
        os.chdir(folder)
        os.environ.update(environment)
        sys.modules["__main__"] = types.ModuleType("__main__")  # its own processes would import that of the attack
        tempfile.tempdir = None  # what the parent found out is of its own TMPDIR
        nothing = os.open(os.devnull, os.O_RDONLY)
        out, err, seen = (os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644) for path in streams)
        for there, here in ((nothing, 0), (out, 1), (err, 2)):
            os.dup2(there, here)
        # Whoever runs us, a test for example, may have put others in their places.
        sys.stdout, sys.stderr = (open(n, "w", encoding="utf-8", closefd=False) for n in (1, 2))  # noqa: SIM115
        # As Python has them when it starts.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)
        _limit()
        sys.addaudithook(_Watch(seen, folder, case))
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
    """Notes what would run code, and files that are read or written outside of the folder."""

    def __init__(self, seen: int, folder: Path, case: Case) -> None:
        self.seen, self.folder = seen, folder
        self.declared = [*declared(case.arguments, folder), *case.places]

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event in _RUNS_CODE and not _reads_recordings(arguments):
            self._note(f"runs {event} {arguments!r}")
        elif event in ("open", "sqlite3.connect") and isinstance(arguments[0], str | bytes):
            path = os.path.abspath(os.fsdecode(arguments[0]))
            flags = arguments[2] if event == "open" and isinstance(arguments[2], int) else 0
            if flags & (os.O_WRONLY | os.O_RDWR):
                if not path.startswith((f"{self.folder}/", "/dev/", "/proc/")) and "__pycache__" not in path:
                    self._note(f"writes {arguments!r}")
            elif os.path.basename(path) != ":memory:" and oracles.read_elsewhere(path, self.folder, self.declared):
                self._note(f"reads {path}")

    def _note(self, text: str) -> None:
        os.write(self.seen, f"{text[:398]!s}\n".encode("utf-8", "backslashreplace"))


def _reads_recordings(arguments: tuple[Any, ...]) -> bool:
    """Return whether a command is the package's own process that reads the files of strangers."""
    words = arguments[1] if len(arguments) > 1 and isinstance(arguments[1], list | tuple) else ()
    package = os.path.dirname(sys.modules["ctxval"].__file__ or "")
    return any(str(word).startswith(f"{package}/") and str(word).endswith("/recording_process.py") for word in words)


def declared(arguments: Sequence[str], folder: Path) -> list[str]:
    """Return the absolute paths that a command line may name."""
    words = [part for word in arguments for part in (word, word.partition("=")[2]) if 0 < len(part) < 4096]
    return [os.path.normpath(os.path.join(folder, word)) for word in words]
