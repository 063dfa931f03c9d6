"""Hostile command lines: words that fit, and words that do not."""

from __future__ import annotations

import shlex

from hostile.experiments import FILE
from hostile.values import REFERENCES, Rng, number, pick, text

_COMMANDS: dict[str, tuple[str, ...]] = {
    "run": (
        "--budget",
        "--search",
        "--threshold",
        "--confidence",
        "--resolution",
        "--seed",
        "--store",
        "--timeout",
        "--explore",
        "--json",
    ),
    "certify": (
        "--threshold",
        "--confidence",
        "--kind",
        "--volume",
        "--discard",
        "--constant",
        "--theorem",
        "--resolution",
        "--json",
    ),
    "ask": (
        "--experiment",
        "--accept-change",
        "--store",
        "--out",
        "--set",
        "--draw",
        "--again",
        "--trial",
        "--search",
        "--seed",
        "--json",
    ),
    "tell": (
        "--experiment",
        "--accept-change",
        "--trajectory",
        "--npz",
        "--distance",
        "--failed",
        "--resample",
        "--start-tolerance",
        "--json",
    ),
    "import": ("--experiment", "--accept-change", "--set", "--resample", "--start-tolerance", "--json"),
    "remeasure": ("--experiment", "--accept-change", "--json"),
    "status": ("--json",),
    "export": ("--out", "--json"),
    "check": ("--json",),
    "init": ("--json",),
    "cases": ("--json",),
}
_FLAGS = ("--explore", "--json", "--draw", "--resample", "--quick")
_PLACES = (
    "a.sqlite",
    FILE,
    "run.csv",
    "run.npz",
    "none.sqlite",
    "none.toml",
    ".",
    "/",
    "pendulum",
    "pwned:none",
    "table.csv",
)


def command_line(rng: Rng) -> tuple[str, ...]:
    """Return a command line of words that fit, and of words that do not."""
    name = str(pick(rng, (*_COMMANDS, text(rng, 20), "--help")))
    line = [name]
    options = _COMMANDS.get(name, ("--json",))
    for _ in range(int(rng.integers(0, 3))):
        line.append(_place(rng, name))
    for _ in range(int(rng.integers(0, 4))):
        option = str(pick(rng, options))
        line.append(option)
        if option not in _FLAGS or rng.random() < 0.05:
            line.append(_value(rng, option))
    if name in ("run", "ask") and "--store" not in line:
        line += ["--store", "s.sqlite"]
    if name == "run":
        line += ["--budget", "2"] if "--budget" not in line else []
        line += ["--search", "random"] if "--search" not in line else []
    return tuple(word.replace("\0", "") for word in line)


def _place(rng: Rng, name: str) -> str:
    return str(pick(rng, _PLACES)) if rng.random() < 0.8 else text(rng, 5_000)


def _value(rng: Rng, option: str) -> str:
    if option == "--budget":
        return str(pick(rng, ("0", "-1", "nan", "1.5", "x", "", "2", "3", "-99999999999999999999")))
    if option == "--out":
        return str(pick(rng, ("saved", "saved/deep", FILE, "a.sqlite", "", "x" * 300)))
    if option == "--store":
        return str(
            pick(
                rng, ("a.sqlite", "s.sqlite", FILE, ".", "", "x" * 300, "none/s.sqlite", f"{FILE}/s", "\x1b[2J.sqlite")
            )
        )
    if option == "--set":
        name = pick(rng, ("goal", "load", "goal[0]", "", "x", text(rng, 20)))
        return f"{name}{pick(rng, ('=', '=', '', '=='))}{number(rng)}"
    if option == "--theorem":
        return ",".join(str(number(rng)) for _ in range(rng.integers(1, 7)))
    kinds = (number(rng), number(rng), text(rng, 2_000), str(pick(rng, REFERENCES)), str(pick(rng, _PLACES)))
    return str(pick(rng, (*kinds, "0", "1", "0.5", "2", "random", "scenario", "posterior")))


def shown(arguments: tuple[str, ...]) -> str:
    """Return a command line for people."""
    return shlex.join(["ctxval", *(a if len(a) < 200 else f"{a[:200]}..." for a in arguments)])
