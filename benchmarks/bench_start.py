"""Start: CPU seconds of ``import ctxval``, its public names and ``ctxval --help``, beside those of ``import numpy``.

A fresh interpreter each time, in turns. What is imported is compiled beforehand. The public names stand here because
``import ctxval`` imports them only when they are used.
"""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

from json_lines import JsonLines
from landed import Ratio

REPEATS = 11
NUMPY = "import numpy"
MOST = {
    "import ctxval": 2.5,
    "from ctxval import Task, TaskSpace, Validation": None,
    "from ctxval import Campaign": None,
    "from ctxval import *": None,
}
"""What is imported, and the largest ratio that is asked for."""

HELP = ("-m", "ctxval", "--help")
MOST_HELP = 0.4
"""CPU seconds of ``ctxval --help``."""


def cpu_seconds(*arguments: str) -> float:
    """Return the CPU seconds of a fresh interpreter."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    starts = {NUMPY: ("-c", NUMPY), **{code: ("-c", code) for code in MOST}, "ctxval --help": HELP}
    turns = [{name: cpu_seconds(*arguments) for name, arguments in starts.items()} for _ in range(REPEATS + 1)][1:]
    seconds = {name: [turn[name] for turn in turns] for name in starts}
    ratios = [
        Ratio("bench_start", f"`{name}` beside `{NUMPY}`", seconds[name], seconds[NUMPY], most=MOST.get(name))
        for name in starts
        if name != NUMPY
    ]
    stored = JsonLines(Path(__file__).parent / "results" / "start.jsonl", ("figure",))
    for ratio in ratios:
        print(ratio, flush=True)
        stored.append(asdict(ratio))
    slow = [ratio.figure for ratio in ratios if not ratio.met]
    if statistics.median(seconds["ctxval --help"]) > MOST_HELP:
        slow.append(f"`ctxval --help`, which may take {MOST_HELP:g} CPU s")
    if slow:
        raise SystemExit(f"too slow: {'; '.join(slow)}")


if __name__ == "__main__":
    main()
