"""Run what is not stored: every method on every function, seed by seed.

``python -m peers.run`` in ``benchmarks``, with the packages of one dependency group; the methods whose packages are
not installed are left to another environment. Each result is stored at once, so a stopped run goes on, and all
methods have the same seeds at any time, but for the one that is running.
"""

from __future__ import annotations

import argparse
import functools
from typing import Any

from json_lines import JsonLines
from peers.functions import CASES, SEEDS, Function, function
from peers.methods import METHODS
from peers.recorder import Finished, Maximise, Recorder
from reproduce.jobs import AUTO, provenance
from study_auto import RESULTS, results_of

STORED = JsonLines(RESULTS / "peers.jsonl", ("case", "method", "seed"))
STUDY = results_of("auto")
CLOSE = 0.99
"""Share of d* that finishes a run."""

CUT = {("dubins-basin", "botorch-log-ei"): 60, ("dubins-basin", "botorch-ucb"): 60}
"""Budgets of methods that take too long for the function's own."""

Result = dict[str, Any]


SAME = 1e-3
"""Relative difference up to which two values count as those of the same function."""


@functools.lru_cache(maxsize=1)  # because the arm's network takes longer to train than most methods to run
def the_function(case: str, seed: int) -> Function:
    """Return a function, with the maximum that the stored runs of other methods on it have.

    Raises:
        SystemExit: if the stored runs had another function. The training of the arm's network amplifies the rounding of
            linear algebra, which depends on the processor.
    """
    known = [result["maximum"] for result in STORED.select(case=case, seed=seed)]
    found = function(case, seed, maximum=max(known, default=None))
    stored = STORED.get((case, "random", seed))
    if stored is not None:
        recorder, _ = record(METHODS["random"].load(), Recorder(found, 1), seed)
        require_same(f"{case}, seed {seed}", recorder.values[0], stored["improvements"][0][1])
    return found


def require_same(name: str, here: float, stored: float) -> None:
    """End with a message if the first random task has another value here than in the stored runs."""
    if not abs(here - stored) <= SAME * abs(stored):
        raise SystemExit(
            f"{name} is another function here than in the stored runs: the first random task has the distance "
            f"{here:.6g}, and {stored:.6g} is stored. Rounding differs between processors; with "
            "OPENBLAS_CORETYPE=SkylakeX the arm is that of the stored runs."
        )


def record(maximise: Maximise, recorder: Recorder, seed: int) -> tuple[Recorder, str | None]:
    """Return what a method asked for until it was finished or ended by itself, and why it could not go on if so."""
    try:
        maximise(recorder, recorder.function.dimension, recorder.budget, seed)
    except Finished:
        pass
    except Exception as error:  # of whatever kind it is: a peer that fails has a row that says so
        return recorder, f"{type(error).__name__}: {error}"
    return recorder, None


def improvements(values: list[float]) -> list[tuple[int, float]]:
    """Return after how many executions a larger value than all before was found, and that value."""
    found: list[tuple[int, float]] = []
    for count, value in enumerate(values, 1):
        if not found or value > found[-1][1]:
            found.append((count, value))
    return found


def budget_of(case: str, method: str) -> int:
    """Return how many executions a method is allowed."""
    return CUT.get((case, method), CASES[case].budget)


def run(case: str, method: str, seed: int) -> Result:
    """Return the result of one run."""
    maximise, found = METHODS[method].load(), the_function(case, seed)
    recorder, error = record(maximise, Recorder(found, budget_of(case, method), CLOSE * found.maximum), seed)
    return {
        "case": case,
        "method": method,
        "seed": seed,
        "maximum": found.maximum,
        "executions": len(recorder.values),
        "improvements": improvements(recorder.values),
        "seconds": round(sum(recorder.seconds), 4),
        "error": error,
    }


def of_the_study(case: str, method: str, seed: int) -> Result | None:
    """Return the result of a campaign that ``study_auto`` has stored, which is the same; None if it ended earlier."""
    campaign = STUDY.get((f"{case}-no-data", seed, "auto") if method == "auto-no-data" else (case, seed, method))
    if campaign is None:
        return None
    values, maximum = [distance or 0.0 for distance in campaign["distances"]], campaign["truth"]
    if max(values) < CLOSE * maximum and len(values) < CASES[case].budget:
        return None
    others = [result["maximum"] for result in STORED.select(case=case, seed=seed)]
    if any(abs(other - maximum) > SAME * maximum for other in others):
        return None  # of another processor, where this seed has another function
    executions = next((k for k, value in enumerate(values, 1) if value >= CLOSE * maximum), CASES[case].budget)
    return {
        "case": case,
        "method": method,
        "seed": seed,
        "maximum": maximum,
        "executions": executions,
        "improvements": improvements(values[:executions]),
        "seconds": round(campaign["seconds"] * executions, 4),
        "error": None,
    }


def applies(method: str, case: str) -> bool:
    """Return whether a method can be given what it needs."""
    needed = {"vector": CASES[case].vector, "auto-no-data": CASES[case].data}
    return needed.get(method, True)


def main() -> None:
    """Run what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=list(CASES), help=f"of {', '.join(CASES)}")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    options = parser.parse_args()
    methods = [name for name in options.methods if METHODS[name].installed]
    for case in options.cases:
        for seed in options.seeds:
            for method in methods:
                if applies(method, case) and (case, method, seed) not in STORED:
                    result = of_the_study(case, method, seed) or run(case, method, seed)
                    STORED.append({**result, **provenance(AUTO)})
                    share = max((value for _, value in result["improvements"]), default=0.0) / result["maximum"]
                    print(
                        case,
                        seed,
                        method,
                        result["executions"],
                        f"{share:.4f}",
                        result["seconds"],
                        result["error"] or "",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
