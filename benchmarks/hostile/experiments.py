"""Hostile experiment files, systems and arguments."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hostile.values import NUMBERS, TEXTS, Rng, mutated, nested, number, pick, text

FILE = "experiment.toml"

_VALUES = (
    '""',
    '"x"',
    "0",
    "-1",
    "1e400",
    "nan",
    "inf",
    "-inf",
    "true",
    "[]",
    "[[]]",
    "{}",
    '{ ref = "pwned:none" }',
    '{ ref = "os:none" }',
    "1979-05-27",
    "99999999999999999999",
    "[1, 'a']",
    "'''\nx'''",
    '"\\u001b[2J"',
    '"[red]x[/]"',
    "[0.0, 0.0]",
    "[1.0, 0.0]",
    "[nan, 1.0]",
    "[0, 1e308]",
    "0.5",
    "1",
    "2",
    '"goal"',
    '"-goal[3]"',
    '"__class__"',
    "-0.0",
    '["goal", "load"]',
    '[0.5, 3.0, "m", 4]',
    "[3.0, 0.5]",
    "[[1.0, 2.0], [3.0]]",
    '"os:none"',
    '"a:b:c"',
    "[1e-320, 1e-319]",
    '["\\u202ex", 0.0]',
    "0x10",
    "1_0",
    '"1_0"',
    "[true, false]",
    '[{ ref = "x" }]',
    "1e-300",
)

_LARGE = ("1000000000", "99999999999", "4611686018427387904")
"""Values of which a user may mean it, where time goes by; elsewhere they are refused."""


def toml(rng: Rng, base: str) -> bytes:
    """Return an experiment file in which values, names or bytes are others."""
    lines = base.splitlines()
    if rng.random() < 0.15:
        # In bytes that TOML allows, mostly: others end its reader at once.
        return bytes(b & 0x7F if rng.random() < 0.99 else b for b in mutated(rng, base.encode()))
    for _ in range(int(rng.integers(1, 4))):
        places = [i for i, line in enumerate(lines) if "=" in line and not line.startswith("#")]
        if not places:
            break
        place = int(pick(rng, places))
        name = lines[place].split("=", 1)[0].strip()
        lines[place : place + 1] = _changed(rng, name, lines[place], lines)
    content = "\n".join(lines)
    if rng.random() < 0.03:
        content = f"x = {nested(rng)}\n{content}"
    return content.encode("utf-8", "surrogatepass")


def _changed(rng: Rng, name: str, line: str, lines: list[str]) -> list[str]:
    match int(rng.integers(9)):
        case 0 | 1 | 2:
            # A budget, a horizon and repeats of a thousand million are refused by patience alone.
            values = _VALUES if name in ("budget", "horizon", "repeats") or rng.random() < 0.9 else _LARGE
            return [f"{name} = {pick(rng, values)}"]
        case 3:
            return [f'{name} = "{_quoted(text(rng, 5_000))}"']
        case 4:
            return []
        case 5 if rng.random() < 0.1:
            return [line, line]
        case 6:
            return [f'"{_quoted(text(rng, 60))}" = {pick(rng, _VALUES)}', line]
        case 7:
            return [re.sub(r"[-+]?\d+\.?\d*", lambda _: str(_small(rng)), line)]
        case _ if rng.random() < 0.2:
            return [line, str(pick(rng, lines))]
        case _:
            return [f"{name} = {pick(rng, _VALUES)}"]


def _small(rng: Rng) -> Any:
    """Return a number that costs no time where it is a count."""
    found = number(rng)
    return found if not isinstance(found, int) or abs(found) < 300 else float(found) * 1e-30


def _quoted(content: str) -> str:
    return content.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


# Systems

BEHAVIOURS = (
    "raise ValueError({text})",
    "raise Exception({text} * 100)",
    "raise SystemExit({number})",
    "raise SystemExit({text})",
    "raise KeyboardInterrupt",
    "raise GeneratorExit",
    "raise StopIteration",
    "raise MemoryError",
    "raise Strange()",
    "raise RecursionError",
    "return step(x, u)",
    "raise BaseException({text})",
    "raise UnicodeDecodeError('a', b'', 0, 1, 'x')",
    "raise ValueError('x' * 50_000_000)",
    "raise ValueError({escape})",
    "raise ValueError('\\ud800\\udfff')",
    "raise ValueError(b'\\xff'.decode('utf-8', 'surrogateescape'))",
    "raise OSError(28, 'No space left on device')",
    "raise BrokenPipeError",
    "raise ImportError({text})",
    "raise ExceptionGroup('many', [ValueError(1), OSError(2)])",
    "return None",
    "return {value}",
    "return [float('nan')] * 2",
    "return [float('inf')] * 2",
    "return 'text'",
    "return [1.0]",
    "return [1.0, 2.0, 3.0]",
    "return [[1.0, 2.0]]",
    "return [1 + 2j, 0]",
    "return iter([1.0, 2.0])",
    "return Hostile()",
    "return {{'a': 1}}",
    "return [True, None]",
    "return [10**400, 0]",
    "return ['1', '2']",
    "import os; os.makedirs('elsewhere', exist_ok=True); os.chdir('elsewhere'); return good(x, u)",
    "import os; os.umask(0o777); return good(x, u)",
    "print({text} * 1000); return good(x, u)",
    "print({escape}); return good(x, u)",
    "print('\\ud800'); return good(x, u)",
    "import sys; sys.stderr.write({escape}); return good(x, u)",
    "import sys; sys.stdout = None; return good(x, u)",
    "import sys; sys.stdout.close(); return good(x, u)",
    "import os; os.close(1); return good(x, u)",
    "import sys; sys.setrecursionlimit(60); return good(x, u)",
    "import os; os._exit({small})",
    "import warnings; warnings.warn({text}); return good(x, u)",
    "import sys; sys.exit()",
    "import sys; sys.exit(0)",
    "import os, signal; os.kill(os.getpid(), signal.SIGINT); return good(x, u)",
    "x[:] = 0; u[:] = 0; return good(x, u)",
    "x.resize(5); return x",
    "import logging; logging.error({escape}); return good(x, u)",
    "del np; return good(x, u)",
    "import threading; threading.Thread(target=good, args=(x, u)).start(); return good(x, u)",
    "return np.array(1.0)",
    "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); return good(x, u)",
    "return np.zeros(0)",
    "import locale; locale.setlocale(locale.LC_ALL, 'C'); return good(x, u)",
    "return np.ma.array([1.0, 2.0], mask=[1, 0])",
    "import json; json.dumps = None; return good(x, u)",
    "import time; time.sleep(0.01); return good(x, u)",
    "return np.array(['a', 'b'], dtype=object)",
    "return np.array([Hostile(), 1], dtype=object)",
    "return good(x, u) * 1e200",
    "return np.float32(good(x, u))",
    "return good(x, u).astype('f2')",
    "return good(x, u).astype('M8[s]')",
    "return object()",
)

_MODULE = """\
import numpy as np


class Strange(Exception):
    def __str__(self):
        raise ValueError("no text")

    __repr__ = __str__


class Hostile:
    def __array__(self, *args, **kwargs):
        raise RuntimeError({text})

    def __len__(self):
        return -1

    def __iter__(self):
        raise KeyError({text})

    def __float__(self):
        raise SystemExit(0)

    def __str__(self):
        return {escape}

    __repr__ = __str__


def good(x, u):
    return np.array([x[0] + 0.05 * x[1], x[1] + 0.05 * u[0]])


calls = 0


def step(x, u):
    global calls
    calls += 1
    if calls < {after}:
        return good(x, u)
    {behaviour}
{top}
"""

_TOPS = (
    *(
        "raise ValueError({text})",
        "import sys; sys.exit(0)",
        "raise KeyboardInterrupt",
        "1 / 0",
        "x =",
        "print({escape})",
    ),
    *(
        "raise Strange()",
        "del step",
        "step = {value}",
        "step.__doc__ = 7",
        "import os; os.makedirs('elsewhere', exist_ok=True); os.chdir('elsewhere')",
        "raise BaseException",
    ),
)


def module(rng: Rng) -> tuple[str, bool]:
    """Return the code of a system, and whether it prints what it likes."""
    words = {
        "text": repr(text(rng, 2_000)),
        "escape": repr("\x1b[2J\x1b]0;x\x07"),
        "number": str(pick(rng, (0, 1, 2, 3, 77, -1, None))),
        "small": str(pick(rng, (0, 1, 3, 77))),
        "value": repr(pick(rng, (*NUMBERS[:8], *TEXTS[:8], [], {}, (1, 2), {1, 2}, b"x", ...))),
    }
    behaviour = str(pick(rng, BEHAVIOURS))
    top = str(pick(rng, _TOPS)) if rng.random() < 0.1 else ""
    code = _MODULE.format(
        after=int(pick(rng, (0, 0, 70, 150))),
        behaviour=behaviour.format(**words),
        top=top.format(**words),
        **{key: words[key] for key in ("text", "escape")},
    )
    said = ("print(", "stderr.write", "logging", "closes", "warnings.warn")
    return code, any(word in behaviour or word in top for word in said)


def run_or_check(rng: Rng) -> tuple[str, ...]:
    """Return a command line that takes an experiment file."""
    json_ = ("--json",) if rng.random() < 0.5 else ()
    run = ("run", FILE, "--budget", "2", "--search", "random", "--store", "s.sqlite")
    if rng.random() < 0.5:
        return ("check", FILE, *(("--execute",) if rng.random() < 0.5 else ()), *json_)
    more = pick(rng, ((), (), (), (), ("--workers", "2"), ("--timeout", "5")))
    return (*run, *more, *json_)


def write(folder: Path, base: Path) -> None:
    """Put the files of a sound experiment into a folder."""
    for name in (FILE, "experiment_system.py"):
        (folder / name).write_bytes((base / name).read_bytes())
