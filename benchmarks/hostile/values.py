"""Texts, numbers and bytes that break programs."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

Rng = np.random.Generator

ESCAPES = (
    "\x1b[2J\x1b[H",
    "\x1b]0;owned\x07",
    "\x1b[31mred",
    "\x1bP1;1|\x1b\\",
    "\x9b31m",
    "\x07\x08\x08",
    "\r\rerror: none",
    "\u202etxet\u202c",
    "\u2066a\u2069",
    "\x00nul",
    "\x7f\x7f",
)

TEXTS = (
    "",
    " ",
    "\n",
    "'",
    '"',
    "\\",
    "\\[bold]",
    "[bold]x[/]",
    "[/]",
    "[red",
    "[link=file:///etc]x[/link]",
    "{0}",
    "%s%n",
    "=1+1",
    '=HYPERLINK("http://x")',
    "+1",
    "-1",
    "@SUM(A1)",
    "'; DROP TABLE trials;--",
    "../../../etc/passwd",
    "/",
    "/dev/zero",
    "a" * 300,
    "ä" * 100,
    "\U0001f4a3" * 50,
    "\ufeffx",
    "None",
    "nan",
    "null",
    "true",
    "1e400",
    "-0",
    "__class__",
    "__import__('os').system('touch PWNED')",
    "os:system",
    "subprocess:Popen",
    "pwned:x",
    "builtins:exec",
    "ctxval.cli:main",
    "٣",
    "1_000",
    "0x10",
    "١٢٣",
    *ESCAPES,
)

NUMBERS = (
    0,
    1,
    -1,
    2,
    255,
    2**31 - 1,
    2**31,
    2**53 + 1,
    2**62,
    2**63 - 1,
    -(2**63),
    0.0,
    -0.0,
    0.5,
    -0.5,
    1e-320,
    1e300,
    -1e300,
    float("inf"),
    float("-inf"),
    float("nan"),
    1e-9,
    3.141592653589793,
)

REFERENCES = (
    "os:system",
    "subprocess:Popen",
    "os:getcwd",
    "builtins:exec",
    "builtins:eval",
    "pwned:x",
    "pwned:make",
    "pty:spawn",
    "shutil:rmtree",
    "pathlib:Path",
    "ctxval.cli:main",
    "ctxval.paper.cases.pendulum:experiment",
    "importlib:import_module",
    "os.path:join",
    "pwned",
    ":",
    "a:",
    ":b",
    "a:b:c",
    ".x:y",
    "pwned.sub:x",
    "sys:exit",
    "os:_exit",
    "antigravity:x",
)

PWNED = """
import pathlib
pathlib.Path("PWNED").write_text("a module of the data ran")
x = 1


def make(*args, **kwargs):
    pathlib.Path("PWNED").write_text("a function of the data ran")
"""
"""A module that says that it ran."""


def pick(rng: Rng, options: Any) -> Any:
    """Return one of some options, as it is."""
    return options[int(rng.integers(len(options)))]


def number(rng: Rng) -> Any:
    """Return a number that is hard to take."""
    return pick(rng, NUMBERS) if rng.random() < 0.7 else float(rng.normal() * 10.0 ** rng.integers(-10, 12))


def text(rng: Rng, longest: int = 200_000) -> str:
    """Return a text that is hard to take."""
    kind = rng.integers(6)
    if kind < 4:
        return str(pick(rng, TEXTS))
    if kind == 4:
        return str(pick(rng, TEXTS)) * int(rng.integers(1, 50)) + str(pick(rng, TEXTS))
    return "x" * int(rng.integers(1, longest))


def nested(rng: Rng) -> str:
    """Return JSON that is nested deeply."""
    depth = int(pick(rng, (50, 500, 990, 5_000, 100_000)))
    return pick(rng, ("[" * depth + "]" * depth, '{"a":' * depth + "1" + "}" * depth, "[" * depth, '{"a":[' * depth))


def value(rng: Rng, depth: int = 0) -> Any:
    """Return a value of any type that JSON and TOML have."""
    kind = int(rng.integers(8 if depth < 3 else 5))
    if kind < 2:
        return number(rng)
    if kind < 4:
        return text(rng, 3_000)
    if kind == 4:
        return pick(rng, (True, False, [], {}, [[]], [1, "a"], {"ref": str(pick(rng, REFERENCES))}))
    if kind < 7:
        return [value(rng, depth + 1) for _ in range(rng.integers(4))]
    return {text(rng, 30): value(rng, depth + 1) for _ in range(rng.integers(4))}


def as_json(rng: Rng, content: Any) -> str:
    """Return JSON, which may not be quite that."""
    if rng.random() < 0.15:
        return nested(rng)
    written = json.dumps(content)
    return written if rng.random() < 0.8 else written[: int(rng.integers(len(written) + 1))]


def mutated(rng: Rng, data: bytes) -> bytes:
    """Return bytes with a few places changed, cut out, doubled or moved."""
    content = bytearray(data)
    for _ in range(int(rng.integers(1, 6))):
        if not content:
            break
        place = int(rng.integers(len(content)))
        length = int(min(len(content) - place, 2 ** rng.integers(0, 12)))
        match int(rng.integers(7)):
            case 0:
                content[place] ^= 1 << int(rng.integers(8))
            case 1:
                content[place] = int(pick(rng, (0, 1, 0x7F, 0x80, 0xFF, 0x5B, 0x22, 0x0A, 0x1B)))
            case 2:
                del content[place : place + length]
            case 3:
                content[place:place] = content[place : place + length]
            case 4:
                content[place : place + length] = rng.bytes(length)
            case 5:
                content[place : place + length] = bytes([int(pick(rng, (0, 0xFF)))]) * length
            case 6:
                del content[place:]
    return bytes(content)
