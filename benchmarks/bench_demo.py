"""CPU time of `make demo` from a warm installation by its parts, beside the code before `auto` was made faster.

The command line itself is run, and the methods `Campaign.run` and `Campaign.verdict` are timed in it. What comes before
them is importing and opening the store; what comes after them is the report and the pictures.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import itertools
import os
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

from landed import beside_landed, report

COMMAND = ("ctxval", "run", "pendulum")
PARTS = ("imports and start", "campaign of 25 executions", "verdict", "report and pictures")
REPEATS = 3


def parts() -> list[float]:
    """Return CPU seconds of each part of the demo, from the start of this process."""
    from ctxval import Campaign  # imported here, because its time is measured
    from ctxval.cli import main as command_line

    marks = [0.0]

    def timed(method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def wrapper(*arguments: Any, **options: Any) -> Any:
            if len(marks) == 1:
                marks.append(time.process_time())
            try:
                return method(*arguments, **options)
            finally:
                marks.append(time.process_time())

        return wrapper

    for name in ("run", "verdict"):
        setattr(Campaign, name, timed(getattr(Campaign, name)))
    sys.argv = list(COMMAND)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        with contextlib.suppress(SystemExit):
            command_line()
        os.chdir("/")
    marks.append(time.process_time())
    return [after - before for before, after in itertools.pairwise(marks)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", action="store_true", help="report the parts of one run")
    if parser.parse_args().parts:
        report(parts())
        return
    pairs = [beside_landed(__file__, "--parts") for _ in range(REPEATS)]
    earlier, now = (min(figures, key=sum) for figures in zip(*pairs, strict=True))
    rows = [*zip(PARTS, earlier, now, strict=True), ("together", sum(earlier), sum(now))]
    for part, before, after in rows:
        print(f"{part}: {before:.2f} CPU s before, {after:.2f} now, ratio {before / after:.1f}")


if __name__ == "__main__":
    main()
