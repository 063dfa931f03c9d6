"""Limits of a process that reads a file of a stranger, because libraries in C have faults.

On Linux, Landlock also takes away all rights to open files, except those that are named, and to use the network
(https://docs.kernel.org/userspace-api/landlock.html). The limits hold for the rest of the life of the process.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterable
from pathlib import Path

MOST_MEMORY = 4 * 2**30  # bytes of a confined process; libraries reserve more than they use

_CREATE, _ADD, _RESTRICT = 444, 445, 446  # system calls, with the same numbers on all processors
_NO_NEW_PRIVILEGES = 38
_EXECUTE, _READ_FILE, _READ_FOLDER = 1 << 0, 1 << 2, 1 << 3


def limit(seconds: int) -> None:
    """Limit memory, processor time, the sizes of written files and the number of open ones, where the system can."""
    if sys.platform == "win32":
        return
    import resource

    limits = {"AS": MOST_MEMORY, "CPU": seconds, "FSIZE": 2**30, "NOFILE": 256, "CORE": 0}
    for name, most in limits.items():
        with contextlib.suppress(OSError, ValueError):  # the limit is lower already, or this system has none
            resource.setrlimit(getattr(resource, f"RLIMIT_{name}"), (most, most))


def may_confine() -> bool:
    """Return whether this system can take rights away from a process."""
    return sys.platform == "linux" and bool(_libc().syscall(_CREATE, None, 0, 1) > 0)


def read_only(paths: Iterable[Path]) -> None:
    """Let this process open nothing but these files, those in these folders and the libraries, only for reading."""
    if not may_confine():
        return
    libc, version = _libc(), _libc().syscall(_CREATE, None, 0, 1)
    every_right = (1 << 13) - 1 | (version >= 3) << 14  # from version 3 on, also to truncate
    network = 3 if version >= 4 else 0
    rules = (ctypes.c_uint64 * 2)(every_right, network)
    ruleset = libc.syscall(_CREATE, rules, 16 if network else 8, 0)
    # Python's and the system's libraries; never a folder that contains the user's home.
    system = ("/usr", "/lib", "/lib64", "/nix/store", "/etc/ld.so.cache", "/dev/null", "/dev/urandom", "/proc/cpuinfo")
    home = Path(os.path.expanduser("~")).resolve()
    libraries = (Path(name).resolve() for name in (*system, sys.prefix, sys.base_prefix, *sys.path))
    readable = (*paths, *(path for path in libraries if not home.is_relative_to(path)))
    for path in {path.resolve() for path in readable if path.exists()}:
        file = os.open(path, os.O_PATH)
        rights = _EXECUTE | _READ_FILE | (_READ_FOLDER if path.is_dir() else 0)
        rule = rights.to_bytes(8, sys.byteorder) + file.to_bytes(4, sys.byteorder)
        libc.syscall(_ADD, ruleset, 1, rule, 0)
        os.close(file)
    libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    if ruleset < 0 or libc.syscall(_RESTRICT, ruleset, 0):
        raise OSError(ctypes.get_errno(), "the rights of the process cannot be taken away")
    os.close(ruleset)


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)
