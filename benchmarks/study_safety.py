"""Which environments are safe: what campaigns certify beside the truth.

``python benchmarks/study_safety.py`` writes ``benchmarks/results/safety.jsonl``, and resumes.
``benchmarks/safety_page.py`` writes the figures into ``docs/how-to/safety.md``.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ctxval import Array, Campaign, Task, TaskSpace, Validation, controllers, models, systems
from ctxval.certificates import CertificateOptions, Dynamics
from ctxval.cli.config.settings import read_settings
from ctxval.distances import MaximumDeviation, UnsafeMargin
from ctxval.specs import Ball, Box, Outside, ReachAvoid
from ctxval.studies.safety import assess, draw_tasks
from json_lines import JsonLines
from safety_systems import SYSTEMS, WALL_D_A, WALL_D_B

STORED = JsonLines(Path(__file__).parent / "results" / "safety.jsonl", ("part", "case", "seed", "asked"))

BUDGET, SEEDS, ASKED_SEEDS = 30, 3, 1
ASKED = (0.7, 1.3)
"""Margins that are asked for, as shares of the true d_b."""
TRUTH = 200_000  # tasks that the truth is of
LINEAR = 200  # random linear systems
CONFIDENCE = 0.95


def robustness(validation: Validation, points: Array) -> tuple[Array, Array, Array]:
    """Return rho_M, rho_S and the largest deviation at points ``(N, d)``."""
    distance, found = validation.distance, []
    assert isinstance(distance, UnsafeMargin)
    spec = distance.spec
    for part in np.array_split(points, max(1, len(points) // 10_000)):
        parameters = validation.space.parameters(part)
        plan = validation.plan_of(parameters, validation.task_at(parameters))
        system = validation.system.execute(plan.controller, plan.task)
        deviation = MaximumDeviation(2, spec.components)(plan.model_trajectory, system, plan.task)
        found.append([*(spec.robustness(one, plan.task) for one in (plan.model_trajectory, system)), deviation])
    of_model, of_system, moved = (np.concatenate(each) for each in zip(*found, strict=True))
    return of_model, of_system, moved


def truth(name: str) -> dict[str, Any]:
    """Return the true distances, from many tasks and from more near the worst ones, and the true shares."""
    validation = SYSTEMS[name](None)
    space, rng = validation.space, np.random.default_rng(5)
    points = space.iid(TRUTH, rng)
    of_model, of_system, moved = robustness(validation, points)
    shares = {
        "satisfied": float((of_model > 0).mean()),
        "safe": float(((of_model > 0) & (of_system > 0)).mean()),
    }
    d_a, d_b, best = float(moved.max()), 0.0, np.empty((0, space.dimension))
    for round_ in range(12):
        unsafe = (of_model > 0) & (of_system <= 0)
        if unsafe.any():
            order = np.argsort(-np.where(unsafe, of_model, -np.inf))[:50]
            if of_model[order[0]] > d_b:
                d_b, best = float(of_model[order[0]]), space.to_unit(points[order])
        if not len(best):
            break
        near = best[rng.integers(len(best), size=20_000)] + 0.05 * 0.5**round_ * rng.normal(size=(20_000, len(best[0])))
        points = space.from_unit(np.clip(near, 0, 1))
        of_model, of_system, moved = robustness(validation, points)
        d_a = max(d_a, float(moved.max()))
    every = np.concatenate([robustness(validation, space.iid(TRUTH, np.random.default_rng(5)))[0]])
    shares |= {"by_d_a": float((every > d_a).mean()), "by_d_b": float((every > d_b).mean())}
    if name == "wall":
        shares |= {"closed_form": [WALL_D_A, WALL_D_B]}
    return {"d_a": d_a, "d_b": d_b, **shares}


def campaign(name: str, seed: int, margin: float | None) -> dict[str, Any]:
    """Return what a campaign certifies, and how many of the certified tasks are unsafe."""
    options = CertificateOptions(Dynamics())
    made = Campaign(SYSTEMS[name](margin), seed=seed)
    made.run(BUDGET, margin, certificate=options, explore=False, progress=False)
    report = assess(made, options, progress=False)
    found = {key: value for key, value in report.to_json().items() if isinstance(value, float | int | str | None)}
    wrong = None
    if report.d_b_bound is not None:
        of_model, of_system, _ = robustness(made.validation, made.validation.space.iid(TRUTH, np.random.default_rng(6)))
        certified = of_model > report.d_b_bound
        wrong = float((of_system[certified] <= 0).mean()) if certified.any() else 0.0
    drawn = None
    if margin is None:
        drawn = vars(draw_tasks(made, report.d_b_bound or report.d_b, 59, progress=False))
    return {**found, "wrong": wrong, "drawn": drawn, "counterexamples": len(report.counterexamples)}


def linear(seed: int) -> dict[str, Any]:
    """Return both distances of a random linear system among sets, and whether both inclusions hold."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    A = np.eye(n) + 0.15 * rng.normal(size=(n, n))
    other = models.Linear(A + rng.uniform(0.002, 0.03) * rng.normal(size=(n, n)), 0.1 * np.eye(n))
    spec = ReachAvoid(
        avoid=[Ball("obstacle", radius=0.3), Outside(Box(low=[-3.0, -3.0], high=[3.0, 3.0]))],
        reach=Ball([1.0, 1.0], radius=0.6),
        components=(0, 1),
    )
    goal = [1.0, 1.0, *[0.0] * (n - 2)]
    validation = Validation(
        space=TaskSpace(obstacle=([-0.5, -0.5], [1.5, 1.5])),
        task=lambda p: Task([0.0] * n, goal=goal, horizon=20, dt=0.1, environment={"obstacle": p.obstacle}),
        system=systems.Simulated(other),
        model=models.Linear(A, 0.1 * np.eye(n)),
        synthesizer=controllers.LQR([1.0] * n, [0.1] * n),
        distance=UnsafeMargin(spec),
    )
    points = validation.space.iid(4000, rng)
    of_model, of_system, moved = robustness(validation, points)
    d_a, q = float(moved.max()), float(validation.distances(points).max())
    d_b = float(of_model[(of_model > 0) & (of_system <= 0)].max(initial=0.0))
    by_a, by_b, safe = of_model > d_a, of_model > d_b, of_system > 0
    return {
        "d_a": d_a,
        "d_b": d_b,
        "q": q,
        "ordered": bool(d_b <= q <= d_a + 1e-12),
        "included": bool((safe[by_b]).all() and not (by_a & ~by_b).any()),
        "by_d_a": float(by_a.mean()),
        "by_d_b": float(by_b.mean()),
        "safe": float((safe & (of_model > 0)).mean()),
    }


def files_of_page() -> dict[str, str]:
    """Return the files of ``docs/how-to/safety.md``, by name."""
    text = (Path(__file__).parents[1] / "docs" / "how-to" / "safety.md").read_text()
    return dict(re.findall(r"```(?:python|toml)\n# file: (\S+)\n(.*?)```", text, flags=re.DOTALL))


def picture() -> dict[str, Any]:
    """Return both paths of the robot of ``docs/how-to/safety.md``, and what was certified of its obstacle."""
    with tempfile.TemporaryDirectory() as folder:
        for name, content in files_of_page().items():
            (Path(folder) / name).write_text(content)
        settings = read_settings(str(Path(folder) / "robot.toml"), {})
        experiment = settings.model_copy(update={"judge": "spec"}).load()
        made = Campaign(experiment.validation, seed=0)
        options = CertificateOptions(Dynamics())
        made.run(experiment.budget, certificate=options, explore=False, progress=False)
        report, validation = assess(made, options, progress=False), made.validation
        # The obstacle changes no trajectory, so one execution serves all places.
        plan = validation.plan(validation.space.low)
        system = validation.execute(plan)
        return {
            "bound": report.d_b_bound or report.d_b,
            "ends": np.stack([validation.space.low, validation.space.high], axis=1).ravel().tolist(),
            "model": plan.model_trajectory.states[:, :2].tolist(),
            "system": system.states[:, :2].tolist(),
            "executed": [[*trial.parameters.values()] for trial in made.trials],
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", choices=SYSTEMS, default=[*SYSTEMS], help="names of systems")
    arguments = parser.parse_args()

    def store(part: str, case: str, seed: int, asked: float | None, measure: Any) -> None:
        if (part, case, seed, asked) not in STORED:
            STORED.append({"part": part, "case": case, "seed": seed, "asked": asked, **measure()})
            print(str(STORED[part, case, seed, asked])[:300], flush=True)

    store("picture", "robot", 0, None, picture)
    for seed in range(LINEAR):
        store("linear", "random", seed, None, lambda seed=seed: linear(seed))
    for name in arguments.only:
        store("truth", name, 0, None, lambda name=name: truth(name))
    for seed in range(SEEDS):
        for name in arguments.only:
            store("campaign", name, seed, None, lambda name=name, seed=seed: campaign(name, seed, None))
            for share in ASKED if seed < ASKED_SEEDS else ():
                margin = float(f"{share * STORED['truth', name, 0, None]['d_b']:.6g}")
                store("campaign", name, seed, share, lambda name=name, s=seed, c=margin: campaign(name, s, c))


if __name__ == "__main__":
    main()
