"""A real servo: what campaigns on its 16 recorded closed loops find, for each published friction model.

``python benchmarks/study_servo.py`` runs what is not stored yet. Each campaign sees one recording at a time; the
others judge it. Refinements learn from half of the recordings, and
the other half judges them. docs/servo.md is written from the results by ``servo_page.py``. The recordings lie in the
folder ``bam_xl330`` of the one that CTXVAL_DATA names, or of ``../shared/data``.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from calibrate import RESULTS, all_of
from ctxval import Campaign, Task, TaskSuite, Trajectory, Validation, refine, searches
from ctxval._util.arrays import Array, single_threaded
from ctxval.certificates import CertificateOptions, WholeSuite
from ctxval.core.model import Model
from json_lines import JsonLines

SERVO = Path(__file__).parents[1] / "examples" / "servo"
sys.path.insert(0, str(SERVO))
import servo  # noqa: E402  # the example is no package

DATA = Path(os.environ.get("CTXVAL_DATA") or Path(__file__).parents[2] / "shared" / "data") / "bam_xl330"

PAIRS = ("sin_sin-200,lift_and_drop-800", "up_and_down-400,sin_time_square-800", "sin_sin-400,lift_and_drop-400")
"""Pairs of recordings to which models are fitted; they were written down before the first fit."""

MODELS = tuple(servo.PUBLISHED)
FITTED = tuple(f"{friction} {pair}" for friction in ("m1", "m4") for pair in PAIRS)
SHOWN = (*MODELS, f"m4 {PAIRS[0]}")
SHARES, SEEDS = (1.1, 0.9), 10
REFINED, OF_EIGHT = ("m1", "m4"), 0.9  # the threshold of a refinement, as a share of the largest of the eight distances

STORED = JsonLines(RESULTS / "servo.jsonl", ("model", "share", "seed"))
DISTANCES = JsonLines(RESULTS / "servo_distances.jsonl", ("model",))
REFINED_STORED = JsonLines(RESULTS / "servo_refined.jsonl", ("model", "half"))

Run = tuple[str, float, int]


def require_recordings() -> None:
    """End with status 0 and the reason if the recordings are not there."""
    if not DATA.is_dir():
        print(f"skipped: {DATA} does not exist; docs/servo.md says where the recordings are published")
        raise SystemExit(0)


@cache
def validation(model: str) -> Validation:
    """Return the validation of a model: the name of a friction model, and the recordings that it is fitted to."""
    friction, _, pair = model.partition(" ")
    return servo.experiment(str(DATA), friction=friction, fit=pair).validation


def root_mean_square(model: Trajectory, system: Trajectory, task: Task) -> Array:
    """Return the RMS deviation of the angle over time."""
    return np.asarray(np.sqrt(((model.states - system.states) ** 2).mean(axis=(-2, -1))))


@cache
def all_distances(model: str, rms: bool = False) -> Array:
    """Return the distances of all recordings in the order of the suite: largest deviations, or RMS deviations."""
    chosen = validation(model).with_parts(distance=root_mean_square) if rms else validation(model)
    return chosen.distances(chosen.space.grid(2))


def decide(run: Run) -> dict[str, Any]:
    """Return what is stored of one campaign that was run until it was decided."""
    model, share, seed = run
    largest, started = float(all_distances(model).max()), time.process_time()
    with single_threaded():
        campaign = Campaign(validation(model), seed=seed).run(
            len(servo.PATHS) * len(servo.GAINS), share * largest, thinking=np.inf
        )
        verdict = campaign.verdict(share * largest)
    predictions = [campaign.recorder.dynamics.stored_prediction(trial) for trial in campaign.trials]
    return {
        "model": model,
        "share": share,
        "seed": seed,
        "answer": verdict.answer,
        "kind": None if verdict.certificate is None else verdict.certificate.kind,
        "bound": verdict.bound,
        "tasks": [trial.parameters["task"] for trial in campaign.trials],
        "distances": [trial.distance for trial in campaign.trials],
        "predicted": [None if each is None else each.median for each in predictions],
        "upper": [None if each is None else each.upper for each in predictions],
        "seconds": round(time.process_time() - started, 1),
    }


def of_model(model: str) -> dict[str, Any]:
    """Return the distances of all recordings from a model."""
    tasks = validation(model).space
    assert isinstance(tasks, TaskSuite)
    named = zip(tasks.task_names, all_distances(model), all_distances(model, rms=True), strict=True)
    return {"model": model, "distances": {name: [float(largest), float(rms)] for name, largest, rms in named}}


def half(number: int) -> TaskSuite:
    """Return eight of the 16 tasks, with each reference at two gains and each gain with two references."""
    suite = validation("m1").space
    assert isinstance(suite, TaskSuite)
    places = [(i, j) for j in range(len(servo.GAINS)) for i in range(len(servo.PATHS)) if (i + j) % 2 == number]
    names = [f"{servo.PATHS[i]}-{servo.GAINS[j]}" for i, j in places]
    return TaskSuite({name: suite[name] for name in names})


def refined(run: tuple[str, int]) -> dict[str, Any]:
    """Return the distances of half of the recordings from a model that was refined with the other half."""
    (model, number), started = run, time.process_time()
    given, learned_from, others = validation(model), half(number), half(1 - number)
    with single_threaded():
        campaign = Campaign(given.with_parts(space=learned_from), search=searches.by_name("random"), seed=number).run(8)
        assert campaign.worst is not None
        threshold = OF_EIGHT * (campaign.worst.distance or 0.0)
        # Its only execution is one of the other half, so the model of the first round has learned from eight.
        found = refine(
            campaign,
            threshold,
            9,
            certificate=CertificateOptions(WholeSuite()),
            open_round=lambda made, *_: Campaign(
                made.with_parts(space=others), search=searches.by_name("random"), seed=0
            ),
        )

    def distances(suite: TaskSuite, of: Model) -> dict[str, float]:
        values = given.with_parts(space=suite, model=of).distances(suite.from_unit(suite.members))
        return dict(zip(suite.task_names, values.tolist(), strict=True))

    after = found.rounds[1].model if len(found.rounds) > 1 else None
    return {
        "model": model,
        "half": number,
        "threshold": threshold,
        "ended": found.ended,
        "before": distances(others, given.model),
        "after": None if after is None else distances(others, after),
        "learned_from": None if after is None else distances(learned_from, after),
        "one_step_error": {name: list(errors) for name, errors in found.accuracy.items()},
        "seconds": round(time.process_time() - started, 1),
    }


def main() -> None:
    """Run what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    options = parser.parse_args()
    require_recordings()
    for model in (*MODELS, *FITTED):
        if (model,) not in DISTANCES:
            DISTANCES.append(of_model(model))
    runs = [(model, share, seed) for seed in range(options.seeds) for model in MODELS for share in SHARES]
    for result in all_of(decide, [run for run in runs if run not in STORED], options.workers):
        STORED.append(result)
        print(*(result[key] for key in ("model", "share", "seed", "answer")), len(result["tasks"]), result["seconds"])
    for run in [(model, number) for model in REFINED for number in (0, 1)]:
        if run not in REFINED_STORED:
            REFINED_STORED.append(refined(run))


if __name__ == "__main__":
    main()
