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

from landed import Ratio, add_store_option, beside_landed, report

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
    add_store_option(parser)
    options = parser.parse_args()
    if options.parts:
        report(parts())
        return
    earlier, now = beside_landed(__file__, "--parts", repeats=REPEATS)
    for k, part in enumerate(PARTS):
        tell(part, [one[k] for one in earlier], [one[k] for one in now], options.store)
    tell("together", [sum(one) for one in earlier], [sum(one) for one in now], options.store)


def tell(part: str, earlier: list[float], now: list[float], store: bool) -> None:
    """Print the CPU times of a part, and store them if it is asked for."""
    Ratio("bench_demo", f"`make demo`: {part}", earlier, now).tell(store)


if __name__ == "__main__":
    main()
