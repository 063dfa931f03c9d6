"""How many executions a comparison needs, and how often its decisions are false.

``python benchmarks/study_compare.py`` writes ``benchmarks/results/compare.jsonl``, from which ``compare_page.py`` makes
the tables in docs/comparison.md. What is there already is not computed again.

- ``arm``: the paper's three models of its robotic arm. d* with the paper's distance, and the expected distance of the
  system from its target. The truths are the largest and the mean distance on a grid.
- ``cart``: two LQRs on carts with different drags, where the truths are known. Some pairs are nearly equal. The
  question ``plain`` is ``mean`` without predictions, which is cheap enough for many seeds.
- ``skewed``: independent draws of distributions whose mean is 0, as differences of distances without a largest one.
  Every decision on their sign is false.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ctxval import Task, TaskSpace, Validation, compare, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.certificates.difference import PairedDifferences, mean_difference
from ctxval.paper.cases import arm
from json_lines import JsonLines
from reproduce.jobs import AUTO, provenance

STORED = JsonLines(Path(__file__).parent / "results" / "compare.jsonl", ("case", "question", "seed"))

CONFIDENCE = 0.95
PAPER = 50
"""Executions of one campaign of the paper on the arm; three separate campaigns need three times as many."""
PLAIN = 60
"""Number of draws of the comparisons without predictions."""
BUDGETS = {("arm", "worst"): 75, ("arm", "mean"): 75, ("cart", "worst"): 40, ("cart", "mean"): 80}
_GRID = {"arm": 61, "cart": 2001}


def arm_models(seed: int, question: str) -> dict[str, Validation]:
    """Return the three models of the arm, with the distance of the question."""
    found = {model: arm.experiment(seed, model).validation for model in arm.MODELS}
    if question == "worst":
        return found
    to_target = distances.GoalError(norm=2, components=arm.END_EFFECTOR)
    return {model: validation.with_parts(distance=to_target) for model, validation in found.items()}


def carts(seed: int, question: str) -> dict[str, Validation]:
    """Return two LQRs with random weights on a cart with a random drag that its model does not have."""
    rng = np.random.default_rng([seed, 0x6361])
    drag = float(rng.uniform(0.1, 0.5))
    found = {}
    for name in ("first", "second"):
        weights = 10 ** rng.uniform(0, 2), 10 ** rng.uniform(-1, 1)
        found[name] = Validation(
            space=TaskSpace(goal=(-2.0, 2.0, "m")),
            task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=60, dt=0.05),
            system=systems.Simulated(functools.partial(_plant, drag), vectorized=True),
            model=models.Linear([[1, 0.05], [0, 1]], [[0], [0.05]]),
            synthesizer=controllers.LQR([float(weights[0]), 1.0], [float(weights[1])]),
            distance=distances.WholeTrajectory(norm=np.inf, components=[0]),
        )
    return found


def _plant(drag: float, x: Array, u: Array) -> Array:
    force = u[..., 0] - drag * x[..., 1] * np.abs(x[..., 1])
    return np.stack([x[..., 0] + 0.05 * x[..., 1], x[..., 1] + 0.05 * force], axis=-1)


CASES: dict[str, Callable[[int, str], dict[str, Validation]]] = {"arm": arm_models, "cart": carts}


def one(case: str, question: Any, seed: int) -> dict[str, Any]:
    """Return the result of one comparison with the truths."""
    candidates = CASES[case](seed, question)
    began = time.process_time()
    found = compare(
        candidates,
        question=question,
        budget=BUDGETS[case, question],
        confidence=CONFIDENCE,
        seed=seed,
        progress=False,
    )
    seconds = time.process_time() - began
    on_grid = {name: one.distances(one.space.grid(_GRID[case])) for name, one in candidates.items()}
    truths = {name: float(d.max() if question == "worst" else d.mean()) for name, d in on_grid.items()}
    decided = [pair for pair in found.pairs if pair.smaller is not None]
    false = [
        pair
        for pair in decided
        if pair.smaller != min((pair.first, pair.second), key=lambda name: truths[name])
    ]  # fmt: skip
    return {
        "case": case,
        "question": question,
        "seed": seed,
        "executions": found.executions,
        "pairs": len(found.pairs),
        "decided": len(decided),
        "false": len(false),
        "left": [[pair.first, pair.second] for pair in found.pairs if pair.smaller is None],
        "ranking": found.ranking_text(question),
        "truths": truths,
        "seconds": seconds,
    }


def without_predictions(seed: int) -> dict[str, Any]:
    """Return the decision on the expected distances of two carts from the differences alone, which costs little."""
    first, second = carts(seed, "mean").values()
    tasks = first.space.iid(PLAIN, np.random.default_rng([seed, 1]))
    differences = first.distances(tasks) - second.distances(tasks)
    found = mean_difference(PairedDifferences(differences, np.zeros(PLAIN)), 1 - CONFIDENCE)
    grid = first.space.grid(_GRID["cart"])
    true = float((first.distances(grid) - second.distances(grid)).mean())
    return {
        "case": "cart",
        "question": "plain",
        "seed": seed,
        "executions": 2 * (found.decided_after or PLAIN),
        "pairs": 1,
        "decided": int(found.sign != 0),
        "false": int(found.sign * true < 0),
        "missed": not found.low <= true <= found.high,
    }


SKEWED: dict[str, Callable[[np.random.Generator, int], Array]] = {
    "normal": lambda rng, count: rng.normal(size=count),
    "exponential": lambda rng, count: rng.exponential(size=count) - 1,
    "lognormal, sigma = 1.5": lambda rng, count: rng.lognormal(0, 1.5, count) - np.exp(1.5**2 / 2),
}
"""Draws with the mean 0."""
DRAWS, REPETITIONS = 1000, 2000


def skewed(name: str, seed: int) -> dict[str, Any]:
    """Return in how many repetitions a sign of the mean 0 was decided, after any number of draws."""
    false = 0
    for repetition in range(REPETITIONS):
        values = SKEWED[name](np.random.default_rng([seed, repetition]), DRAWS)
        differences = PairedDifferences(values, np.zeros(DRAWS))
        ends = [float(differences.log_wealth(np.array(0.0), above=above)[-1]) for above in (True, False)]
        false += int(max(ends) >= np.log(2 / (1 - CONFIDENCE)))
    about = {"case": "skewed", "question": name, "seed": seed}
    return {**about, "draws": DRAWS, "repetitions": REPETITIONS, "false": false}


def result(case: str, question: str, seed: int) -> dict[str, Any]:
    """Return the result of one seed."""
    if case == "skewed":
        return skewed(question, seed)
    return without_predictions(seed) if question == "plain" else one(case, question, seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--cases",
        nargs="+",
        default=[
            *(f"skewed:{name}:1" for name in SKEWED),
            *("cart:plain:1000", "arm:mean:5", "cart:mean:200", "arm:worst:3", "cart:worst:200"),
        ],
    )
    for text in parser.parse_args().cases:
        case, question, seeds = text.split(":")
        for seed in range(int(seeds)):
            if (case, question, seed) not in STORED:
                STORED.append({**result(case, question, seed), **provenance(AUTO)})
                print(STORED[case, question, seed], flush=True)


if __name__ == "__main__":
    main()
