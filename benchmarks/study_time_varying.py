"""Does learned dynamics validate a system that changes with time? The certificate assumes that there is none.

A mass with quadratic drag is moved to a goal, and something pushes it that depends on the step of the task. Campaigns
run until they are decided, with thresholds below d*, so each `validated` is false. Nothing was chosen with these
systems. ``python benchmarks/study_time_varying.py`` runs what is not stored, and prints the table.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from calibrate import RESULTS, all_of
from ctxval import Campaign, Task, TaskSpace, Trajectory, Validation, controllers, distances, models
from ctxval._util.arrays import Array, single_threaded
from ctxval.certificates import CertificateOptions, Dynamics
from ctxval.core.controller import Controller
from ctxval.core.rollout import rollout
from json_lines import JsonLines

STEPS, DT = 30, 0.1
BUDGET, TRUTH_TASKS = 12, 4000
SHARES, SEEDS = (0.5, 0.95), 3

Push = Callable[[int, Array, Array], Array]

PUSHES: dict[str, tuple[str, Push]] = {
    "late": ("in the last four steps", lambda t, x, u: np.asarray(1.0 * (t >= 26) + 0 * x[..., 0])),
    "early": ("in the first four steps", lambda t, x, u: np.asarray(1.0 * (t < 4) + 0 * x[..., 0])),
    "ramp": ("grows with time", lambda t, x, u: np.asarray(0.05 * t + 0 * x[..., 0])),
    "tired motor": ("the input loses 2 % a step", lambda t, x, u: -0.02 * t * u[..., 0]),
    "late wall": (
        "beyond 1 m, in the last five steps",
        lambda t, x, u: np.asarray(3.0 * np.maximum(x[..., 0] - 1.0, 0.0) * (t >= 25)),
    ),
    "late gust": (
        "near 1.6 m, in the last six steps",
        lambda t, x, u: np.asarray(4.0 * np.exp(-(((x[..., 0] - 1.6) / 0.25) ** 2)) * (t >= 24)),
    ),
}
"""What pushes the mass, in m/s^2."""

DISTANCES = {
    "final state": lambda: distances.FinalState(scales=[1.0, 1.0]),
    "trajectory": lambda: distances.WholeTrajectory(norm=np.inf, components=[0]),
}

PARAMETERS = {"goal": (-2.0, 2.0, "m"), "start": (-1.0, 1.0, "m")}


@dataclass(frozen=True)
class Run:
    """One campaign, fully said by its fields."""

    push: str
    dimension: int
    distance: str
    share: float
    seed: int


class TimeVarying:
    """The mass: it knows the step of the task."""

    batched = True

    def __init__(self, push: Push) -> None:
        self._push = push

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Run the controller on the task."""
        steps = itertools.count()

        def step(x: Array, u: Array) -> Array:
            drag = 0.3 * x[..., 1] * np.abs(x[..., 1])
            acceleration = u[..., 0] - drag + self._push(next(steps), x, u)
            return np.stack([x[..., 0] + DT * x[..., 1], x[..., 1] + DT * acceleration], axis=-1)

        return rollout(step, controller, task)


def validation(one: Run) -> Validation:
    """Return the map p -> d(p) of a campaign; M has no drag and nothing that pushes."""

    def task(p: Any) -> Task:
        start = p.start if one.dimension == 2 else 0.0 * p.goal
        return Task(np.stack([start, 0 * start], -1), goal=np.stack([p.goal, 0 * p.goal], -1), horizon=STEPS, dt=DT)

    return Validation(
        space=TaskSpace(**dict(itertools.islice(PARAMETERS.items(), one.dimension))),
        task=task,
        system=TimeVarying(PUSHES[one.push][1]),
        model=models.Linear([[1, DT], [0, 1]], [[0], [DT]]),
        synthesizer=controllers.LQR([10, 1], [1.0]),
        distance=DISTANCES[one.distance](),
    )


def decide(one: Run) -> dict[str, Any]:
    """Run one campaign until it is decided; return what is stored of it."""
    parts = validation(one)
    largest = float(np.max(parts.distances(parts.space.iid(TRUTH_TASKS, np.random.default_rng(0)))))
    threshold, options = one.share * largest, CertificateOptions(Dynamics())
    with single_threaded():
        campaign = Campaign(parts, seed=one.seed)
        campaign.run(BUDGET, threshold, certificate=options, thinking=np.inf)
        verdict = campaign.verdict(threshold, certificate=options)
    bound = None if verdict.certificate is None else verdict.certificate.upper_bound / largest
    return {**asdict(one), "answer": verdict.answer, "executions": campaign.executions, "bound": bound}


STORED = JsonLines(RESULTS / "time_varying.jsonl", ("push", "dimension", "distance", "share", "seed"))
RUNS = [Run(*one) for one in itertools.product(PUSHES, (1, 2), DISTANCES, SHARES, range(SEEDS))]


def missing() -> list[Run]:
    """Return the campaigns that are not stored."""
    return [one for one in RUNS if tuple(asdict(one).values()) not in STORED]


def rows() -> list[list[str]]:
    """Return a table: the push, and how often each answer was given at each threshold."""
    found = []
    for push, (text, _) in PUSHES.items():
        of = {share: STORED.select(push=push, share=share) for share in SHARES}
        counts = [
            f"{sum(one['answer'] == answer for one in of[share])} of {len(of[share])}"
            for share in SHARES
            for answer in ("validated", "falsified")
        ]
        found.append([push, text, *counts])
    return found


def main() -> None:
    """Run what is missing, and print the table."""
    for result in all_of(decide, missing(), 1):
        STORED.append(result)
    for row in rows():
        print(*row, sep=" | ")


if __name__ == "__main__":
    main()
