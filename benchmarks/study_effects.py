"""Effects in pairs: does a verdict stay true, and are both effects named with their sizes?

``python benchmarks/study_effects.py`` runs what ``results/effects.jsonl`` does not have yet, and prints a table. The
plants are those of ``noise_reporting.py``. Three rules were changed after a first run of the pairs of ``DEVELOPMENT``;
those of ``REPORTING`` were run once, afterwards. For verdicts, M is linear, so it lacks a
smooth part beside the pair. For ``why``, M is the plant without the pair. d* is the largest distance of 2,000 random
tasks, all corners and tasks near the largest ones.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibrate import RESULTS, all_of
from ctxval import Campaign, Trajectory, Validation, models, searches
from ctxval._util.arrays import single_threaded
from ctxval.learning.effects import (
    Backlash,
    Coulomb,
    DeadZone,
    Delay,
    Effect,
    InputDrift,
    InputGain,
    Joint,
    Lag,
    ModelWithEffects,
    RateLimit,
    Saturation,
)
from ctxval.studies.causes import find_causes
from json_lines import JsonLines
from noise_reporting import PLANTS
from noise_systems import near_best, outcome, random_and_corners

STORED = JsonLines(RESULTS / "effects.jsonl", ("pair", "seed", "share"))
SHARES, BUDGET, EXECUTIONS = (0.95, 1.25), 25, 6


class Noisy:
    """A plant with effects whose records have noise, a function of the seed and of the number of the call."""

    batched = True

    def __init__(self, plant: ModelWithEffects, deviations: np.ndarray, seed: int) -> None:
        self.plant, self.deviations, self.seed, self._calls = plant, deviations, seed, 0

    def execute(self, controller: Any, task: Any) -> Trajectory:
        """Return the closed loop."""
        rng = np.random.default_rng([self.seed, self._calls])
        self._calls += 1
        noise = self.deviations * rng.standard_normal((task.horizon + 1, *task.initial_state.shape))
        return self.plant.execute(controller, task.starting_at(task.initial_state + noise[0]), noise)


@dataclass(frozen=True)
class Pair:
    """Two effects in a plant, and the deviation of noise as a share of the range of each state."""

    plant: str
    effects: Callable[[float], tuple[Effect, ...]]  # for a time step
    noise: float = 0.0


DEVELOPMENT = {
    "delay and dry friction": Pair(
        "maglev", lambda dt: (Delay((2.0,)), Coulomb((0.15,), Joint(1, 0, input=0), 0.1, dt))
    ),
    "backlash and payload": Pair("arm", lambda dt: (Backlash((0.2,), 0), InputGain((0.85,), 1))),
    "drift and noise": Pair("ship", lambda dt: (InputDrift((0.08,), 0, dt),), 1e-3),
    "dead zone and delay": Pair("tanks", lambda dt: (DeadZone((0.25,), 0), Delay((1.0,)))),
    "saturation and lag": Pair("crane", lambda dt: (Saturation((2.0,), 0), Lag((1.5,)))),
    "backlash and lag": Pair("chain", lambda dt: (Backlash((0.15,), 0), Lag((1.0,)))),
    "rate limit and delay": Pair("ship", lambda dt: (RateLimit((3.0,), 0, dt), Delay((2.0,)))),
    "dead zone and noise": Pair("cart-pole", lambda dt: (DeadZone((0.3,), 0),), 1e-3),
    "gain and delay": Pair("quadrotor", lambda dt: (InputGain((0.9,), 0), Delay((1.0,)))),
    "saturation and delay": Pair("maglev", lambda dt: (Saturation((4.0,), 0), Delay((1.5,)))),
}  # fmt: skip

REPORTING = {
    "dry friction and delay": Pair("arm", lambda dt: (Delay((1.0,)), Coulomb((0.25,), Joint(2, 0, input=0), 0.5, dt))),
    "gain and backlash": Pair("chain", lambda dt: (Backlash((0.1,), 0), InputGain((0.9,), 0))),
    "noise and drift": Pair("maglev", lambda dt: (InputDrift((0.6,), 0, dt),), 1e-3),
    "dead zone and lag": Pair("ship", lambda dt: (DeadZone((0.12,), 0), Lag((1.5,)))),
    "saturation of one of two inputs and delay": Pair("quadrotor", lambda dt: (Saturation((1.2,), 0), Delay((1.0,)))),
    "backlash and delay": Pair("crane", lambda dt: (Backlash((0.1,), 0), Delay((1.5,)))),
    "rate limit and lag": Pair("tanks", lambda dt: (RateLimit((8.0,), 1, dt), Lag((1.0,)))),
    "dead zone and backlash": Pair("maglev", lambda dt: (DeadZone((0.2,), 0), Backlash((0.1,), 0))),
    "gain and lag": Pair("cart-pole", lambda dt: (InputGain((0.9,), 0), Lag((0.7,)))),
    "delay and noise": Pair("chain", lambda dt: (Delay((1.0,)),), 1e-3),
}  # fmt: skip
PAIRS = {**DEVELOPMENT, **REPORTING}


def validation_of(name: str, seed: int, *, exact: bool = False) -> Validation:
    """Return the validation of a pair; with an exact M, the pair is all that M lacks."""
    pair = PAIRS[name]
    plant = PLANTS[pair.plant]
    plain = plant("none").validation
    middle = plain.task_at(plain.space.parameters(0.5 * (plain.space.low + plain.space.high)))
    inputs = plain.plan(0.5 * (plain.space.low + plain.space.high)).model_trajectory.inputs.shape[-1]
    step = models.Function(plant.step, vectorized=True)
    truth: Any = ModelWithEffects(step, pair.effects(middle.dt), inputs)
    if pair.noise:
        truth = Noisy(truth, pair.noise * np.array(plant.ranges), seed + 1)
    validation = plain.with_parts(system=truth)
    if exact:
        given = plain.synthesizer
        validation = validation.with_parts(model=step, synthesizer=_DesignedOn(given, plain.model))
    return validation


@dataclass(frozen=True)
class _DesignedOn:
    """A synthesizer that designs on another model."""

    given: Any
    model: Any
    batched: bool = True

    def design(self, task: Any, model: Any) -> Any:
        return self.given.design(task, self.model)


def truth(name: str) -> float:
    """Return d*, or the 0.9 quantile at the worst task if there is noise."""
    validation, rng, noisy = validation_of(name, 7), np.random.default_rng(5), bool(PAIRS[name].noise)

    def values(points: np.ndarray, repeats: int) -> np.ndarray:
        tasks = validation.space.from_unit(points)
        runs = [validation.distances(tasks) for _ in range(repeats if noisy else 1)]
        return np.nan_to_num(np.quantile(runs, 0.9, axis=0))

    points = random_and_corners(validation.space.dimension, rng)
    of_points = values(points, 20)
    for share in (0.1, 0.03, 0.01):
        points = near_best(points, of_points, share, 3, rng)
        of_points = values(points, 40)
    return float(values(points[np.argsort(-of_points)[:10]], 400).max())


def measured(run: tuple[str, int, float]) -> dict[str, Any]:
    """Return what is stored of a campaign, or of the causes that are named if the share is 0."""
    name, seed, share = run
    key = {"pair": name, "seed": seed, "share": share}
    true = [[type(effect).__name__, list(effect.sizes)] for effect in PAIRS[name].effects(1.0)]
    warnings.simplefilter("ignore")
    with single_threaded():
        started = time.process_time()
        if share:
            validation, largest = validation_of(name, seed), truth(name)
            started = time.process_time()
            campaign = Campaign(validation, seed=seed).run(BUDGET, share * largest, thinking=np.inf)
            verdict = campaign.verdict(share * largest)
            details = {} if verdict.certificate is None else verdict.certificate.details
            found = {each: details.get(each) for each in ("acting", "friction")}
            return {**key, "true": true, **outcome(campaign, verdict, largest, started), **found}
        validation = validation_of(name, seed, exact=True)
        campaign = Campaign(validation, search=searches.by_name("random"), seed=seed).run(EXECUTIONS)
        report = find_causes(campaign, thinking=np.inf)
        causes = [[type(cause).__name__, list(cause.sizes)] for cause in report.causes]
        seconds = round(time.process_time() - started, 1)
        return {**key, "true": true, "causes": causes, "sentence": report.sentence, "seconds": seconds}


def main() -> None:
    """Run what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--shares", nargs="*", type=float, default=[0.0, *SHARES])
    parser.add_argument("--pairs", nargs="*", default=list(PAIRS), help="development and reporting by default")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    runs = [(name, seed, share) for seed in range(options.seeds) for share in options.shares for name in options.pairs]
    for result in all_of(measured, [run for run in runs if run not in STORED], options.workers):
        STORED.append(result)
        shown = ("pair", "seed", "share", "answer", "executions", "bound", "acting", "friction", "causes", "seconds")
        print(*(result[key] for key in shown if key in result), flush=True)
    print("| pair | at 0.95 d* | at 1.25 d* (executions, bound / d*) | found by verdicts | named by `why` |")
    print("|---|---|---|---|---|")
    for name in PAIRS:
        of = {share: [line for line in STORED.select(pair=name) if line["share"] == share] for share in (0.0, *SHARES)}
        below = ", ".join(f"{line['answer']} {line['executions']}" for line in of[0.95])
        above = ", ".join(
            f"{line['answer']} {line['executions']} ({line['bound']:.2f})" if line["bound"] else line["answer"]
            for line in of[1.25]
        )
        found = {**(of[1.25][0]["acting"] or {}), **(of[1.25][0]["friction"] or {})} if of[1.25] else {}
        named = "; ".join(
            ", ".join(f"{kind} {' '.join(f'{size:.3g}' for size in sizes)}" for kind, sizes in line["causes"]) or "none"
            for line in of[0.0]
        )
        sizes = ", ".join(f"{label} {size:.3g}" for label, size in found.items())
        print(f"| {name} | {below} | {above} | {sizes} | {named} |")


if __name__ == "__main__":
    main()
