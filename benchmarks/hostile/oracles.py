"""What a command may read, write and say: decoys that nobody may open, digests of all files, and secrets."""

from __future__ import annotations

import base64
import ctypes
import fnmatch
import hashlib
import io
import os
import re
import sqlite3
import stat
import sys
import sysconfig
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path

import numpy as np

SECRETS = {
    "AWS_SECRET_ACCESS_KEY": "wJalrXUtnFEMIK7MDENGbPxRfiCYcanary",
    "ROBOT_PASSWORD": "hunter2-of-the-robot-canary",
}
"""Secrets in the environment of every command."""

ROTATED = "hunter3-of-the-robot-canary"
"""The password of the robot after it was changed."""

GLOBAL = "a-global-of-the-module-canary"
"""Secret in a global of the module of the attacked system."""

HOME = {".netrc": "machine rig password netrc-canary-4711", ".aws/credentials": "secret = credentials-canary-0815"}
"""Files in the home folder, whose contents are secrets."""

OUTSIDE = "outside"
"""Folder beside that of the command, with decoys that every reader could read."""

_LARGEST = 2**23
"""Largest number of bytes of a file of which the content is compared and searched."""

_OURS = 0x63747876


# Secrets


def _encodings(secret: bytes) -> Iterator[bytes]:
    """Yield a secret as it is, in UTF-16, in hexadecimal and in Base64 at all three alignments."""
    yield secret
    with suppress(UnicodeDecodeError):
        text = secret.decode()
        yield from (text.encode("utf-16-le"), text.encode("utf-16-be"))
    yield from (secret.hex().encode(), secret.hex().upper().encode())
    for shift in range(3):
        whole = base64.b64encode(b"\0" * shift + secret)
        part = whole[4 * (shift > 0) : len(whole) - 4]  # what does not depend on the neighbours
        yield from (part, part.translate(bytes.maketrans(b"+/", b"-_")))


_PATTERNS = {
    pattern: name
    for name, secret in {**SECRETS, "the changed password": ROTATED, "a module's global": GLOBAL, **HOME}.items()
    for pattern in _encodings(secret.encode())
}


def secrets_in(content: bytes, key: bytes = b"") -> set[str]:
    """Return the names of the secrets in some output, also in the cells of a store and in archives.

    Args:
        content: the output or the file.
        key: the user's signing key, if there is one.
    """
    patterns = {**_PATTERNS, **(dict.fromkeys(_encodings(key), "the user's key") if len(key) > 15 else {})}
    return {name for part in _unpacked(content, 3) for pattern, name in patterns.items() if pattern in part}


def _unpacked(content: bytes, depth: int) -> Iterator[bytes]:
    yield content
    if not depth:
        return
    if content.startswith(b"SQLite format 3"):
        # SQLite splits long cells over pages.
        with suppress(sqlite3.Error, ValueError), closing(sqlite3.connect(":memory:")) as connection:
            connection.deserialize(content)
            for (table,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall():
                for row in connection.execute(f'SELECT * FROM "{table}" LIMIT 2000'):
                    for cell in row:
                        if isinstance(cell, str | bytes) and len(cell) < _LARGEST:
                            yield from _unpacked(cell.encode("utf-8", "replace") if isinstance(cell, str) else cell, 2)
    elif content.startswith(b"PK"):
        with suppress(Exception), zipfile.ZipFile(io.BytesIO(content)) as archive:
            for member in archive.infolist():
                if member.file_size < _LARGEST:
                    yield from _unpacked(archive.read(member), depth - 1)


# Decoys and digests


def write_decoys(folder: Path) -> None:
    """Write files that no command may open: in the home of a folder, and beside the folder."""
    for name, content in HOME.items():
        (folder / "home" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "home" / name).write_text(content)
    outside = folder.parent / OUTSIDE
    outside.mkdir(exist_ok=True)
    k = np.arange(61.0)
    columns = np.stack([k / 20, 0 * k, 0 * k, 0 * k], axis=1)
    rows = ["t,position,speed,force", *(",".join(map(str, row)) for row in columns.tolist())]
    (outside / "secret.csv").write_text("\n".join(rows))
    np.savez(outside / "secret.npz", times=columns[:, 0], states=columns[:, 1:3], inputs=columns[:-1, 3:])
    (outside / "secret.bin").write_bytes(np.full(4000, 0.1).tobytes())
    (outside / "secret.mat").write_bytes(b"")


Digests = dict[str, tuple[object, ...]]


def digests(place: Path) -> Digests:
    """Return kind, mode and content of every file below a folder, by path."""
    found: Digests = {}
    for folder, names, files in os.walk(place):
        for name in [*names, *files]:
            path = os.path.join(folder, name)
            with suppress(OSError):  # what goes away meanwhile is a temporary file
                found[os.path.relpath(path, place)] = _digest(path)
    return found


def _digest(path: str) -> tuple[object, ...]:
    status = os.lstat(path)
    if stat.S_ISLNK(status.st_mode):
        return "link", os.readlink(path)
    if not stat.S_ISREG(status.st_mode):
        return "other", status.st_mode
    if status.st_size > _LARGEST:
        return "large", status.st_mode, status.st_size, status.st_mtime_ns
    with open(path, "rb") as file:
        return "file", status.st_mode, hashlib.blake2b(file.read()).digest()


_OUTPUTS = ("--out", "-o", "--junit", "--markdown", "--store", "--stores", "--results")
_DEFAULTS = {
    "init": ("*.toml", "*_system.py"),
    "run": ("runs/*", "runs"),
    "compare": ("runs/*", "runs"),
}
_NEVER_MIND = ("*__pycache__*", "f/home/*", "f/PWNED", "f/elsewhere*")
"""Files of the interpreter and of libraries; the last ones are those of hostile code that may run."""
_BESIDE = ("", "-journal", "-wal", "-shm", ".lock", ".lock-journal")


def strays(
    before: Digests, after: Digests, arguments: Sequence[str], head: Mapping[str, bytes], place: Path
) -> list[str]:
    """Return what a command has changed, removed or created although it is no declared output and not its store.

    Args:
        before, after: the files below the place of the command, whose folder is ``f``.
        arguments: the command line.
        head: the first bytes of the files that were there before.
        place: the place.
    """
    words = [word.partition("=")[2] if word.startswith("--") and "=" in word else word for word in arguments]
    named = [_relative(word, place) for word in words if word and len(word) < 4096]
    # A store that is named by a link to a file that is not there is made where the link points.
    links = [(name, str(before[name][1])) for name in named if before.get(name, ("",))[0] == "link"]
    ends = [os.path.normpath(os.path.join(os.path.dirname(name), end)) for name, end in links]
    named += [end for end in ends if end not in before]
    # What lies beside a database belongs to SQLite, also if it is none.
    stores = {name + end for name in named for end in _BESIDE if end or _may_be_store(head.get(name))}
    targets = [
        _relative(value, place) for option, value in zip(arguments, words[1:], strict=False) if option in _OUTPUTS
    ]
    new = [f"f/{pattern}" for pattern in _DEFAULTS.get(arguments[0] if arguments else "", ())]
    found = []
    for path in sorted(before.keys() | after.keys()):
        if before.get(path) == after.get(path) or path in stores:
            continue
        secret = any(path == f"f/home/{name}" for name in HOME)
        if not secret and any(fnmatch.fnmatchcase(path, pattern) for pattern in _NEVER_MIND):
            continue
        if path in before:
            found.append(f"{'removed' if path not in after else 'changed'} {path}")
        elif not _declared(path, targets, named, new):
            found.append(f"created {path}")
    return found


def _relative(word: str, place: Path) -> str:
    """Return a path of the command line as the digests have it."""
    return os.path.relpath(word, place) if os.path.isabs(word) else os.path.normpath(os.path.join("f", word))


def _may_be_store(head: bytes | None) -> bool:
    """Return whether a file is a store, or may become one: it is new or empty."""
    return not head or (head.startswith(b"SQLite format 3") and head[68:72] == _OURS.to_bytes(4, "big"))


def _declared(path: str, targets: Sequence[str], named: Sequence[str], new: Sequence[str]) -> bool:
    if any(
        target in (path, ".") or path.startswith(f"{target}/") or f"{target}/".startswith(f"{path}/")
        for target in targets
    ):
        return True
    # A report, pictures or the files of trials stand beside what the command line names, with the same stem.
    stems = [os.path.splitext(name)[0] for name in (*targets, *named)]
    if any(path.startswith((f"{stem}.", f"{stem}-")) for stem in stems):
        return True
    return any(fnmatch.fnmatchcase(path, pattern) for pattern in new)


def heads(place: Path, found: Digests) -> dict[str, bytes]:
    """Return the first bytes of the regular files."""
    content = {}
    for path, digest in found.items():
        if digest[0] in ("file", "large"):
            with suppress(OSError), open(place / path, "rb") as file:
                content[path] = file.read(100)
    return content


def written(place: Path, before: Digests, after: Digests) -> Iterator[tuple[str, bytes]]:
    """Yield the files that are new or changed, with their contents."""
    for path, digest in after.items():
        if digest[0] == "file" and before.get(path) != digest and "__pycache__" not in path:
            with suppress(OSError):
                yield path, (place / path).read_bytes()


# Reads


def _python() -> tuple[str, ...]:
    """Return the folders of the interpreter, of packages and of the operating system's data."""
    here = Path(__file__).parents[2]
    folders = {sys.prefix, sys.base_prefix, *sysconfig.get_paths().values(), *filter(None, sys.path)}
    real = {os.path.realpath(folder) for folder in folders}
    system = ("/usr", "/lib", "/lib64", "/bin", "/sbin", "/proc", "/sys", "/dev", "/var/cache/fontconfig", "/opt")
    return tuple(f"{folder}/" for folder in (folders | real | {str(here), *system}) - {"/", "/tmp"})


PYTHON = _python()
_SYSTEM = re.compile(
    r"/etc/(ld\.so\.|localtime|mime\.types|nsswitch|host|resolv|fonts|ssl|gai\.conf|os-release|debian_version|machine-id"
    r"|services|protocols|apache|OpenCL|vulkan|glvnd|nginx|httpd)|/run/(nscd|systemd)|/\.dockerenv$|/var/lib/nscd"
    r"|/(usr/)?local/etc/|/etc/ncurses|/lib/terminfo|/etc/terminfo|/root/\.local/lib"
)
"""What libraries look up of the computer."""


def read_elsewhere(path: str, folder: Path, declared: Sequence[str]) -> bool:
    """Return whether a file that a command opened is none of its inputs, of its outputs and of its interpreter.

    Args:
        path: absolute path.
        folder: the folder of the command, whose ``home`` is the user's.
        declared: absolute paths of the command line.
    """
    path = os.path.normpath(path)
    if any(path == f"{folder}/home/{name}" for name in HOME):
        return True
    if f"{path}/".startswith((f"{folder}/", *PYTHON)) or _SYSTEM.match(path):
        return False
    path = re.sub(r"(-journal|-wal|-shm|\.lock)$", "", path)
    # A folder that is named contains its inputs, one that leads to a file is looked at on the way, and the files of a
    # folder are written beside it until they are complete.
    return not any(
        path == name
        or path.startswith((f"{name}/", os.path.join(os.path.dirname(name), f".{os.path.basename(name)}-")))
        or name.startswith(f"{path}/")
        for name in declared
    )


_LIBC = ctypes.CDLL(None, use_errno=True)


class Openings:
    """Notices each file in some folders that anybody opens, also by native code, while it is in use."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._descriptor = _LIBC.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        self._folders = {}
        for folder in folders:
            number = _LIBC.inotify_add_watch(self._descriptor, os.fsencode(folder), 0x20)  # IN_OPEN
            self._folders[number] = folder

    def names(self) -> list[str]:
        """Return the files that were opened, and end."""
        found, content = [], b""
        with suppress(OSError):
            content = os.read(self._descriptor, 2**20)
        os.close(self._descriptor)
        while content:
            number, length = (int.from_bytes(content[place : place + 4], sys.byteorder) for place in (0, 12))
            name = content[16 : 16 + length].rstrip(b"\0").decode("utf-8", "replace")
            if name:
                found.append(f"{self._folders[number].name}/{name}")
            content = content[16 + length :]
        return found


_OPENED = re.compile(r'^(?:\d+ +)?(openat|open|openat2|creat)\((?:AT_FDCWD|\d+(?:<[^>]*>)?)?,? ?"([^"]*)".*\) = (\d+)')


def traced(trace: str, folder: Path, declared: Sequence[str]) -> list[str]:
    """Return the files elsewhere that a trace of ``strace -f`` shows as opened."""
    found = []
    for line in trace.splitlines():
        matched = _OPENED.match(line)
        if matched is not None:
            path = os.path.join(folder, matched[2].encode().decode("unicode_escape"))
            if read_elsewhere(path, folder, declared):
                found.append(path)
    return list(dict.fromkeys(found))
