"""Audit a model, learn it again from what the audit showed, audit it again: how often is the second verdict false?

``python benchmarks/study_retrain.py`` writes ``benchmarks/results/retrain.jsonl``, from which the calibration page is
made. Each model is exact near the tasks that it has seen, and wrong elsewhere: the hardest case for an audit.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from ctxval import Campaign, Task, TaskSpace, Validation, controllers, distances, models, searches, systems
from ctxval._util.arrays import Array
from ctxval.certificates import Audit, Sample
from ctxval.certificates.verdict import judge_by
from json_lines import JsonLines

STORED = JsonLines(Path(__file__).parent / "results" / "retrain.jsonl", ("second_audit",))

DRAWS, VOLUME, CONFIDENCE = 59, 0.05, 0.95
RADIUS = 0.06
"""Around each task that was learned from, where the model is exact: of 59 draws some 48 % of the square."""


def error_of(points: Array, rng: np.random.Generator) -> Array:
    """Return how wrong the first model is: somewhere above one, somewhere below, at random waves."""
    directions, phases = rng.normal(size=(4, 2)) * 4, rng.uniform(0, 2 * np.pi, 4)
    return np.abs(np.cos(points @ directions.T + phases).sum(axis=-1))


def validation_of(seed: int, seen: Array) -> Validation:
    """Return the validation of a model that has learned from the tasks ``(k, 2)``."""

    def errors(p: Array) -> Array:
        wrong = error_of(p, np.random.default_rng(seed))
        if len(seen):
            near = np.linalg.norm(p[..., None, :] - seen, axis=-1).min(axis=-1) < RADIUS
            wrong = np.where(near, 0.0, wrong)
        return np.asarray(wrong)

    # The state is the task and what has gone wrong; M believes that nothing does.
    def model(x: Array, u: Array) -> Array:
        gone = error_of(x[..., :2], np.random.default_rng(seed)) - errors(x[..., :2])
        return np.concatenate([x[..., :2], gone[..., None]], axis=-1)

    def system(x: Array, u: Array) -> Array:
        return np.concatenate([x[..., :2], error_of(x[..., :2], np.random.default_rng(seed))[..., None]], axis=-1)

    return Validation(
        space=TaskSpace(p=([0.0, 0.0], [1.0, 1.0])),
        task=lambda p: Task([p.p[..., 0], p.p[..., 1], np.zeros(p.p.shape[:-1])], horizon=1, dt=1.0),
        system=systems.Simulated(system, vectorized=True),
        model=models.Function(model, vectorized=True),
        synthesizer=controllers.Policy(lambda t, x, task: 0 * x[..., :1]),
        distance=distances.FinalState(components=[2]),
    )


def audited(validation: Validation) -> Campaign:
    """Return a campaign of an audit alone, with the seed that everybody has: zero."""
    return Campaign(validation, search=searches.Random(), seed=0).audit(DRAWS)


def second_verdict(seed: int, *, same_draws: bool) -> dict[str, float | bool]:
    """Return the verdict on the model that was learned again, and the volume in which it is above the threshold."""
    first = audited(validation_of(seed, np.empty((0, 2))))
    seen = np.array([trial.unit_point for trial in first.trials])
    validation = validation_of(seed, seen)
    second = audited(validation)
    points = np.random.default_rng(10_000 + seed).random((20_000, 2))
    wrong = validation.distances(points)
    threshold = float(np.quantile(wrong, 1 - 3 * VOLUME))  # in truth three times the volume is above it
    if same_draws:  # what a seed alone gave: the tasks of the first audit again
        distances_of_seen = validation.distances(seen)
        return {"validated": bool((distances_of_seen <= threshold).all()), "above": float((wrong > threshold).mean())}
    certificate = Audit().certify(Sample.of(second.trials), CONFIDENCE)
    verdict = judge_by(certificate, second.trials, threshold, volume=VOLUME)
    return {"validated": verdict.answer == "validated", "above": float((wrong > threshold).mean())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    seeds = range(parser.parse_args().seeds)
    settings = {"draws": DRAWS, "volume": VOLUME, "confidence": CONFIDENCE}
    for name, same in (("the same draws", True), ("draws that depend on the model", False)):
        verdicts = [second_verdict(seed, same_draws=same) for seed in seeds]
        false = sum(bool(one["validated"]) for one in verdicts)
        STORED.append({"second_audit": name, **settings, "false": false, "campaigns": len(verdicts)})
        print(STORED[name,])


if __name__ == "__main__":
    main()
