"""CPU time of suggestions of `auto`, beside the code before it was made faster, as ratios in one run.

The demo is a campaign of 25 executions on the pendulum. The other cases are campaigns with many known executions, of
which four suggestions are timed: the first one learns everything from the start, as a resumed campaign does.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from ctxval import Campaign, cases, searches
from landed import Ratio, add_store_option, beside_landed, report

EXECUTIONS = 25
SUGGESTIONS = 4
REPEATS = 3
# The case, its options, the number of known executions, and the least ratio that is asked for.
CASES: dict[str, tuple[str, dict[str, int], int, float | None]] = {
    "demo": ("pendulum", {}, 0, 8.0),
    "Dubins, 20 known": ("dubins", {}, 20, 5.0),
    "Dubins, 100 known": ("dubins", {}, 100, 5.0),
    "linear 20-D, 22 known": ("linear", {"dim": 10}, 22, None),
}


def seconds(name: str) -> float:
    """Return CPU seconds of a suggestion, with the execution and the storage of its trial."""
    case, options, known, _ = CASES[name]
    validation = cases.by_name(case, 0, **options).validation
    points = validation.space.iid(known, np.random.default_rng(5))
    running = Campaign(validation, search=searches.by_name("auto"), seed=0)
    for point in points:
        running.add(validation.space.describe_point(point), trajectory=validation.outcome(point).system_trajectory)
    count = SUGGESTIONS if known else EXECUTIONS
    started = time.process_time()
    running.run(known + count)
    return (time.process_time() - started) / count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--case", choices=list(CASES), help="report the seconds of one case")
    add_store_option(parser)
    options = parser.parse_args()
    if options.case is not None:
        report(seconds(options.case))
        return
    for name, (*_, asked) in CASES.items():
        earlier, now = beside_landed(__file__, "--case", name, repeats=REPEATS)
        Ratio("bench_auto", f"a suggestion, {name}", earlier, now, least=asked).tell(options.store)


if __name__ == "__main__":
    main()
