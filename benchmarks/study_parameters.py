"""Campaigns with models whose parameters are uncertain: a planar drone, and a running robot with contacts.

``python benchmarks/study_parameters.py --seeds 2`` runs what ``results/parameters.jsonl`` does not have yet, and prints
a table. S lies in the family of M (``inside``), or differs from it by something that no parameter of M is: a motor that
follows late, a slope, another armature. d* is the largest distance of 3,000 random tasks and of 900 near the largest
ones. The policy of the robot is linear and learned by random search on M (``--train``, 2 minutes); it is kept in
``results/parameters-policy.json``. Needs the extra ``mujoco``.
"""

from __future__ import annotations

import argparse
import json
import re
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctxval import Campaign, Task, TaskSpace, Validation, distances, models, systems

RESULTS = Path(__file__).parent / "results"
ROWS, POLICY = RESULTS / "parameters.jsonl", RESULTS / "parameters-policy.json"

# A drone in a plane, with a cascaded controller that integrates errors of position

STEP, GRAVITY = 0.02, 9.81
NOMINAL = {"mass": 1.0, "inertia": 1.0, "drag": 0.0, "wind": 0.0}
UNCERTAIN: dict[str, float | str] = {"mass": "15 %", "inertia": "15 %", "drag": 0.3, "wind": 1.0}
TRUE = {"mass": 1.12, "inertia": 1.05, "drag": 0.25, "wind": 0.8}


def flown(x: np.ndarray, u: np.ndarray, theta: Any) -> np.ndarray:
    """Return the next states (x, z, tilt, rates) under a thrust over the weight and an angular acceleration."""
    mass, inertia, drag, wind = theta
    place, tilt, rate, spin = x[..., :2], x[..., 2], x[..., 3:5], x[..., 5]
    for _ in range(2):
        h = STEP / 2
        push = np.stack([np.sin(tilt), np.cos(tilt)], axis=-1) * u[..., :1] * GRAVITY
        air = rate - np.stack([wind + 0 * tilt, 0 * tilt], axis=-1)
        down = np.stack([0 * tilt, GRAVITY + 0 * tilt], axis=-1)
        rate = rate + h * (push / np.asarray(mass)[..., None] - down - np.maximum(drag, 0.0)[..., None] * air)
        spin = spin + h * u[..., 1] / inertia
        place, tilt = place + h * rate, tilt + h * spin
    return np.concatenate([place, tilt[..., None], rate, spin[..., None]], axis=-1)


@dataclass(frozen=True)
class Cascade:
    """Position, tilt and their rates, with an integral of the position's error."""

    goal: np.ndarray

    def start(self, task: Task) -> np.ndarray:
        """Return the integral at the start."""
        return np.zeros((*task.batch_shape, 2))

    def step(self, t: int, x: np.ndarray, integral: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return thrust and angular acceleration, and the integral."""
        error = np.clip(self.goal - x[..., :2], -1.0, 1.0)
        integral = np.clip(integral + STEP * error, -0.5, 0.5)
        wanted = np.clip(5 * error + 1.5 * integral - 3.5 * x[..., 3:5], -5, 5)
        tilt = np.clip(wanted[..., 0] / GRAVITY, -0.5, 0.5)
        turn = np.clip(60 * (tilt - x[..., 2]) - 14 * x[..., 5], -60, 60)
        thrust = np.clip((1 + wanted[..., 1] / GRAVITY) / np.cos(np.clip(x[..., 2], -0.8, 0.8)), 0.2, 2.0)
        return np.stack([thrust, turn], axis=-1), integral

    def __getitem__(self, index: Any) -> Cascade:
        return Cascade(self.goal[index])


class Cascades:
    """Designs cascades."""

    batched = True

    def design(self, task: Task, model: object) -> Cascade:
        """Return the cascade towards the goal of a task."""
        return Cascade(np.asarray(task.goal)[..., :2])


def drone(what: str) -> Validation:
    """Return the validation of the drone."""
    truth = models.Parametric(flown, TRUE, vectorized=True)
    system: Any = {"inside": systems.Simulated(truth), "late": systems.Imperfect(truth, lag=2.0)}[what]

    def task(p: Any) -> Task:
        x = np.zeros((*p.points.shape[:-1], 6))
        x[..., 3] = p.points[..., 2]
        return Task(
            x, goal=np.concatenate([p.points[..., :2], np.zeros_like(x[..., :4])], axis=-1), horizon=125, dt=STEP
        )

    return Validation(
        space=TaskSpace(x=(-2.0, 2.0, "m"), z=(-1.0, 1.0, "m"), rate=(-1.0, 1.0, "m/s")),
        task=task,
        system=system,
        model=models.Parametric(flown, NOMINAL, uncertain=UNCERTAIN, vectorized=True),
        synthesizer=Cascades(),
        distance=distances.MaximumDeviation(components=[0, 1]),
    )


# HalfCheetah of gymnasium with a linear policy

PERIOD = 9.0  # steps of the clock of the gait


def cheetah_mjcf(
    friction: float = 1.0, gain: float = 1.0, damping: float = 1.0, armature: float = 1.0, slope: float = 0.0
) -> str:
    """Return the model of HalfCheetah with factors of its parameters, and a horizontal part of gravity."""
    import gymnasium

    text = (Path(gymnasium.__file__).parent / "envs/mujoco/assets/half_cheetah.xml").read_text()
    for name, factor in (("gear", gain), ("damping", damping), ("armature", armature)):
        text = re.sub(rf'\b{name}="([\d.]+)"', lambda m, n=name, f=factor: f'{n}="{float(m[1]) * f:.6g}"', text)
    text = text.replace('friction=".4 .1 .1"', f'friction="{0.4 * friction:.6g} .1 .1"')
    return text.replace('gravity="0 0 -9.81"', f'gravity="{slope:.6g} 0 -9.81"')


@dataclass(frozen=True)
class Gait:
    """A linear policy of the state, a clock and the commanded speed."""

    weights: np.ndarray  # (6, 21)
    command: np.ndarray  # (...)

    def __call__(self, t: int, x: np.ndarray) -> np.ndarray:
        """Return the inputs."""
        one, phase = np.ones((*x.shape[:-1], 1)), 2 * np.pi * t / PERIOD
        command = np.broadcast_to(self.command[..., None], one.shape)
        seen = [np.sin(phase) * one, np.cos(phase) * one, x[..., 1:9], 0.2 * x[..., 9:], command, one]
        return np.tanh((self.weights @ np.concatenate(seen, axis=-1)[..., None])[..., 0])

    def __getitem__(self, index: Any) -> Gait:
        return Gait(self.weights if self.weights.ndim == 2 else self.weights[index], self.command[index])


class Gaits:
    """Designs gaits with the same weights."""

    batched = True

    def __init__(self, weights: np.ndarray) -> None:
        self.weights = weights

    def design(self, task: Task, model: object) -> Gait:
        """Return the gait with the speed of a task."""
        return Gait(self.weights, np.asarray(task.command)[..., 0])


def train(seconds: float = 120.0) -> None:
    """Learn the policy by augmented random search on M (Mania et al. 2018), and keep the best one."""
    system, rng = systems.MuJoCo(cheetah_mjcf(), substeps=5), np.random.default_rng(0)
    weights, best, begun, rounds = np.zeros((6, 21)), -np.inf, time.monotonic(), 0

    def rewards(each: np.ndarray, command: np.ndarray) -> np.ndarray:
        x = np.zeros((len(each), 18))
        x[:, 2] = rng.uniform(-0.2, 0.2, len(each))
        run = system.execute(Gait(each, command), Task(x, horizon=80, dt=0.05))
        speed = (run.states[:, 8:, 0] - run.states[:, :-8, 0]) / 0.4
        lost = np.minimum(np.abs(speed - command[:, None]), 4.0).mean(axis=1) + 0.5 * np.abs(run.states[..., 2]).mean(
            axis=1
        )
        return np.nan_to_num(-lost, nan=-50.0)

    while time.monotonic() - begun < seconds:
        moves, command = rng.normal(size=(20, 6, 21)), np.tile(rng.uniform(0.5, 2.5, 20), 2)
        up, down = np.split(rewards(np.concatenate([weights + 0.12 * moves, weights - 0.12 * moves]), command), 2)
        top = np.argsort(-np.maximum(up, down))[:12]
        scale = np.concatenate([up[top], down[top]]).std() + 1e-6
        weights = weights + 0.06 * ((up - down)[top, None, None] * moves[top]).mean(axis=0) / scale
        rounds += 1
        if (
            rounds % 20 == 0
            and (reached := rewards(np.tile(weights, (16, 1, 1)), np.linspace(0.5, 2.5, 16)).mean()) > best
        ):
            best = reached
            POLICY.write_text(json.dumps({"reward": float(best), "weights": weights.round(6).tolist()}) + "\n")
    print(f"reward {best:.3f} after {rounds} rounds")


def cheetah(what: str) -> Validation:
    """Return the validation of HalfCheetah."""
    changed: dict[str, dict[str, float]] = {
        "inside": {"friction": 0.8, "gain": 0.92, "damping": 1.15},
        "armature": {"friction": 0.8, "gain": 0.92, "armature": 1.3},
        "slope": {"friction": 0.9, "slope": 0.5},
    }

    def task(p: Any) -> Task:
        x = np.zeros((*p.points.shape[:-1], 18))
        x[..., 2], x[..., 9] = p.points[..., 1], p.points[..., 2]
        return Task(x, command=p.points[..., :1], horizon=40, dt=0.05)

    legs = "[[bf]*]"  # joints whose names begin with b or f
    uncertain: dict[str, float | str] = {
        "friction": "20 %", "mass[torso]": "20 %", f"damping{legs}": "20 %", "gain": "20 %", f"stiffness{legs}": "20 %"
    }  # fmt: skip
    return Validation(
        space=TaskSpace(speed=(0.5, 2.5, "m/s"), pitch=(-0.2, 0.2, "rad"), start=(-1.0, 1.0, "m/s")),
        task=task,
        system=systems.MuJoCo(cheetah_mjcf(**changed[what]), substeps=5),
        model=models.MuJoCo(cheetah_mjcf(), dt=0.05, uncertain=uncertain),
        synthesizer=Gaits(np.array(json.loads(POLICY.read_text())["weights"])),
        distance=distances.MaximumDeviation(components=[0]),
    )


ROBOTS: dict[str, tuple[Callable[[str], Validation], tuple[str, ...]]] = {
    "drone": (drone, ("inside", "late")),
    "cheetah": (cheetah, ("inside", "armature", "slope")),
}


def largest(validation: Validation) -> float:
    """Return d* by brute force."""
    rng, space = np.random.default_rng(99), validation.space
    points = rng.random((3000, space.dimension))
    values = validation.distances(space.from_unit(points))
    for near in (0.1, 0.04, 0.02):
        moves = near * rng.normal(size=(12, 25, space.dimension))
        more = np.clip(points[np.argsort(-values)[:12], None] + moves, 0, 1).reshape(-1, space.dimension)
        points, values = (
            np.concatenate([points, more]),
            np.concatenate([values, validation.distances(space.from_unit(more))]),
        )
    return float(np.nanmax(values))


def main() -> None:
    """Run the missing campaigns and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS))
    parser.add_argument("--train", action="store_true", help="learn the policy again")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    if options.train or not POLICY.exists():
        train()
    rows = [json.loads(line) for line in ROWS.read_text().splitlines()] if ROWS.exists() else []
    done = {(row["robot"], row["system"], row["share"], row["seed"]) for row in rows}
    for seed in range(options.seeds):
        for robot in options.robots:
            make, kinds = ROBOTS[robot]
            for what in kinds:
                for share in (0.95, 1.25):
                    if (robot, what, share, seed) in done:
                        continue
                    validation = make(what)
                    top, begun = largest(validation), time.process_time()
                    campaign = Campaign(validation, seed=seed)
                    campaign.run(25, threshold=share * top)
                    verdict = campaign.verdict(share * top)
                    n, bound = (
                        campaign.executions,
                        verdict.certificate.upper_bound / top if verdict.certificate else None,
                    )
                    row = {
                        "robot": robot, "system": what, "share": share, "seed": seed, "answer": verdict.answer,
                        "executions": n, "best": max(trial.distance or 0.0 for trial in campaign.trials) / top,
                        "bound": bound, "cpu": (time.process_time() - begun) / n,
                    }  # fmt: skip
                    rows.append(row)
                    print(row, "" if verdict.answer == "validated" else verdict.reason[:300], flush=True)
                    with ROWS.open("a") as file:
                        file.write(json.dumps(row) + "\n")
    print(
        "| robot | S | tau / d* | answers (executions) | bound / d* | CPU s per execution |\n|---|---|---|---|---|---|"
    )
    for key in dict.fromkeys((row["robot"], row["system"], row["share"]) for row in rows):
        some = [row for row in rows if (row["robot"], row["system"], row["share"]) == key]
        answers = ", ".join(f"{row['answer']} ({row['executions']})" for row in some)
        bounds = ", ".join("-" if row["bound"] is None else f"{row['bound']:.2f}" for row in some)
        print(f"| {' | '.join(map(str, key))} | {answers} | {bounds} | {np.median([row['cpu'] for row in some]):.1f} |")


if __name__ == "__main__":
    main()
