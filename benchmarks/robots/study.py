"""Campaigns on recordings of real robots: what is not stored yet is computed, and appended to ``results/robots*``.

``cd benchmarks && python -m robots.study`` does this, and ``python -m robots.page`` writes docs/robots.md. The
recordings lie in the folder that CTXVAL_DATA names, or in ``../shared/data`` from the repository. Each campaign sees
one recording at a time; the others judge it.
"""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ctxval import Campaign, Task, TaskSuite, Validation, searches
from ctxval._util.arrays import Array, single_threaded
from ctxval.certificates.automatic import WholeSuite
from ctxval.certificates.options import CertificateOptions
from ctxval.core.controller import started
from ctxval.data.recorded_system import RecordedInputsWarning
from ctxval.studies.causes import find_causes
from ctxval.studies.causes.budget import CauseSettings
from json_lines import JsonLines
from robots import double_pendulum, so101

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("CTXVAL_DATA") or ROOT.parent / "shared" / "data")
RESULTS = ROOT / "benchmarks" / "results"

SHARES = (0.9, 1.1)  # of d*, the thresholds
SEEDS = 10  # draws of the five motions
KINDS = ("linear", "physical")  # models of the arm
SECONDS = (1.5, 3.0)
SHOWN = (0.9, 0.69)  # quantiles of the executions of each task; ten repeats of two tasks show 69.2 %
CERTIFIED = 6  # undisturbed repeats whose verdict is watched, or explained; the others are held out
FALSE_ALARMS = 0.01
EXPLAINED = 8  # executions of the arm that causes are found in

CAMPAIGNS = JsonLines(RESULTS / "robots.jsonl", ("robot", "model", "about", "share"))
REPEATS = JsonLines(RESULTS / "robots_repeats.jsonl", ("condition", "seconds"))
CAUSES = JsonLines(RESULTS / "robots_causes.jsonl", ("robot", "model", "about"))
QUANTILES = JsonLines(RESULTS / "robots_quantiles.jsonl", ("model", "seconds", "quantile", "share"))
WATCHED = JsonLines(RESULTS / "robots_watched.jsonl", ("model", "seconds"))

Key = tuple[Any, ...]


def require_recordings(name: str) -> Path | None:
    """Return a folder of recordings; None, with the reason, if it is not there."""
    if (DATA / name).is_dir():
        return DATA / name
    print(f"skipped: {DATA / name} does not exist; docs/robots.md says where its recordings are published")
    return None


@cache
def of_arm(folder: Path, kind: str, seed: int) -> Validation:
    return so101.experiment(str(folder), seed, kind).validation


@cache
def of_pendulum(folder: Path, model: str, seconds: float) -> Validation:
    return double_pendulum.experiment(str(folder), 0, model, seconds).validation


@cache
def all_distances(validation: Validation) -> Array:
    """Return the distances of all tasks of a suite."""
    return validation.distances(validation.space.grid(2))


def decided(validation: Validation, share: float, seed: int, thinking: float | None = None) -> dict[str, Any]:
    """Return what is stored of one campaign that was run until it was decided."""
    distances, started = all_distances(validation), time.process_time()
    threshold = share * float(distances.max())
    campaign = Campaign(validation, seed=seed).run(len(distances), threshold, thinking=thinking)
    verdict = campaign.verdict(threshold, thinking=thinking)
    return {
        "tasks": [trial.parameters["task"] for trial in campaign.trials],
        "distances": [trial.distance for trial in campaign.trials],
        "answer": verdict.answer,
        "kind": None if verdict.certificate is None else verdict.certificate.kind,
        "largest": float(distances.max()),
        "median": float(np.median(distances)),
        "all": len(distances),
        "seconds": round(time.process_time() - started, 1),
    }


def repeated(folder: Path, condition: str, seconds: float) -> dict[str, Any]:
    """Return the largest difference between two repeats of a condition; under TVLQR, also errors of its torque."""
    repeats = list(double_pendulum.runs(folder, condition, seconds).values())
    angles = np.stack([run.states[:, :2] for run in repeats])
    found = {"count": len(repeats), "largest": float(np.ptp(angles, axis=0).max())}
    if condition != double_pendulum.UNDISTURBED:
        return found
    controller, torques = double_pendulum.controller(folder), list[Array]()
    for run in repeats:
        pi = started(controller, Task(run.states[0], horizon=run.horizon, dt=double_pendulum.DT))
        torques.append(np.stack([pi(t, run.states[t])[0] for t in range(run.horizon)]))
    recorded = np.stack([run.inputs[:, 0] for run in repeats])
    error, size = np.abs(np.stack(torques) - recorded).mean(), np.sqrt((recorded**2).mean())
    return {**found, "torque_error": float(error), "torque": float(size)}


def cause_of_joint(folder: Path, seed: int, joint: int) -> dict[str, Any]:
    """Return what ``ctxval why`` says of one joint of the linear model, and what the repair gives on other motions.

    It knows the first eight executions of the arm's campaign; of these, it takes those in which the joint is worst.
    """
    executed = CAMPAIGNS["SO-101", "linear", f"draw {seed}", 1.1]["tasks"][:EXPLAINED]
    five = so101.drawn(folder, seed)
    others = sorted(set(so101.recordings(folder)) - set(five) - set(executed))
    model = so101.linear([so101.recordings(folder)[name] for name in five], joint)
    known, unknown = (so101.validation(folder, model, motions, joint) for motions in (executed, others))
    return explained(known, unknown, seed)


def cause_of_pendulum(folder: Path, model: str, seconds: float) -> dict[str, Any]:
    """Return what ``ctxval why`` says after the first undisturbed repeats, and what the repair gives on the others."""
    whole = of_pendulum(folder, model, seconds)
    suite = whole.space
    assert isinstance(suite, TaskSuite)
    names = suite.task_names
    known, unknown = (
        whole.with_parts(space=TaskSuite({name: suite[name] for name in some}))
        for some in (names[:CERTIFIED], names[CERTIFIED:])
    )
    return explained(known, unknown, 0)


def explained(known: Validation, unknown: Validation, seed: int) -> dict[str, Any]:
    """Return the one cause that executions of one suite show, and the largest distances of another with the repair."""
    started, before = time.process_time(), all_distances(unknown)
    campaign = Campaign(known, seed=seed).run(len(all_distances(known)), 1e3, thinking=1.0)
    report = find_causes(campaign, most=1, thinking=np.inf, settings=CauseSettings(executions=4))
    found = {"named": report.named, "sentence": report.sentence, "before": float(before.max())}
    if report.repaired is not None:
        after = all_distances(unknown.with_parts(model=report.repaired))
        found |= {"after": float(after.max()), "nearer": int((after < before).sum()), "of": len(before)}
    return {**found, "seconds": round(time.process_time() - started, 1)}


def of_quantile(folder: Path, model: str, seconds: float, quantile: float, share: float) -> dict[str, Any]:
    """Return the verdict on a quantile of the executions of two tasks, each with ten recordings in turn."""
    validation = double_pendulum.repeated(folder, double_pendulum.PUBLISHED[model], seconds)
    single = [double_pendulum.validation(folder, validation.model, seconds, each) for each in double_pendulum.IN_TURN]
    largest = float(max(all_distances(each).max() for each in single))
    options = CertificateOptions(WholeSuite(quantile))
    campaign = Campaign(validation, search=searches.by_name("random")).run(20, share * largest, certificate=options)
    verdict = campaign.verdict(share * largest, certificate=options)
    found = {"answer": verdict.answer, "reason": verdict.reason, "executions": len(campaign.trials), "largest": largest}
    return {**found, "above": sum((trial.distance or 0.0) > share * largest for trial in campaign.trials)}


def watched(folder: Path, model: str, seconds: float) -> dict[str, Any]:
    """Return how a watch over a verdict on undisturbed repeats judges the others, and perturbed ones."""
    validation, started = of_pendulum(folder, model, seconds), time.process_time()
    suite = validation.space
    assert isinstance(suite, TaskSuite)
    some = TaskSuite({name: suite[name] for name in suite.task_names[:CERTIFIED]})
    threshold = 1.1 * float(all_distances(validation).max())
    campaign = Campaign(validation.with_parts(space=some)).run(CERTIFIED, threshold)
    alarms = {}
    for condition in (double_pendulum.UNDISTURBED, double_pendulum.PERTURBED):
        later = list(double_pendulum.runs(folder, condition, seconds).items())
        later = later[CERTIFIED:] if condition == double_pendulum.UNDISTURBED else later
        watch = campaign.watch(threshold, FALSE_ALARMS)
        for name, run in later:
            state = watch.update(run, name=name)
        alarms[condition] = {"runs": len(later), "alarm": state.alarm, "evidence": state.evidence}
    return {"certified": CERTIFIED, "alarms": alarms, "seconds_taken": round(time.process_time() - started, 1)}


def store(stored: JsonLines, key: Key, computed: Callable[[], dict[str, Any]]) -> None:
    """Compute and store a record that is missing."""
    if key not in stored:
        with single_threaded(), warnings.catch_warnings():
            warnings.simplefilter("ignore", RecordedInputsWarning)  # the page says how far the controller's are away
            stored.append({**dict(zip(stored.key, key, strict=True)), **computed()})
        print(*key, flush=True)


def main() -> None:
    """Compute what is missing."""
    if (folder := require_recordings("double_pendulum")) is not None:
        for condition in double_pendulum.CONDITIONS:
            for seconds in SECONDS:
                store(REPEATS, (condition, seconds), lambda c=condition, s=seconds: repeated(folder, c, s))
        for seconds in SECONDS:
            for model in (*double_pendulum.PUBLISHED, *double_pendulum.LEARNED):
                for share in SHARES:
                    validation = of_pendulum(folder, model, seconds)
                    key = "double pendulum", model, f"{seconds} s", share
                    store(CAMPAIGNS, key, lambda v=validation, share=share: decided(v, share, 0, 1.0))
        for model in double_pendulum.PUBLISHED:
            for quantile in SHOWN:
                for share in SHARES:
                    about = model, 1.5, quantile, share
                    store(QUANTILES, about, lambda about=about: of_quantile(folder, *about))
        store(WATCHED, ("1.0", 1.5), lambda: watched(folder, "1.0", 1.5))
        for model in double_pendulum.PUBLISHED:
            key = "double pendulum", model, "1.5 s"
            store(CAUSES, key, lambda model=model: cause_of_pendulum(folder, model, 1.5))
    if (folder := require_recordings("so101")) is not None:
        for seed in range(SEEDS):
            for kind in KINDS:
                for share in SHARES:
                    key = "SO-101", kind, f"draw {seed}", share
                    store(CAMPAIGNS, key, lambda k=kind, s=seed, share=share: decided(of_arm(folder, k, s), share, s))
        for joint in so101.COMPARED:
            key = "SO-101", "linear", so101.JOINTS[joint]
            store(CAUSES, key, lambda joint=joint: cause_of_joint(folder, 0, joint))


if __name__ == "__main__":
    main()
