"""An arm of six servos (SO-101): 50 recorded motions, models that are learned from five, and the other 45 as a suite.

The SAGE project publishes the recordings under the Apache License 2.0: https://github.com/isaac-sim2real/sage, commit
4ffd262, folder ``output/real/so101/custom``. States are the angles of the joints and their rates, differences of two
recorded angles, because the servos report rates in steps of 0.077 rad/s. Inputs are the commanded angles of a step and
of the step before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from ctxval import Array, Experiment, Labels, TaskSuite, Validation, distances, models, systems
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.data import LogMapping, read_recordings

JOINTS = ("rotation", "pitch", "elbow", "wrist pitch", "wrist roll", "jaw")
COMPARED = tuple(range(5))  # the jaw holds nothing
DT = 0.02006016142356934  # s, the mean period of the recordings


@cache
def recordings(folder: Path) -> dict[str, Trajectory]:
    """Return the motions by name: states ``(H + 1, 12)`` and inputs ``(H, 12)``."""
    fields = LogMapping(states={"angle": "position"}, inputs={"command": "command"}, lags=1, dt=DT)
    motions = {}
    for run in read_recordings([folder], fields).runs:
        whole = run.trajectory  # its states are angles, those of a step before, and commands of a step before
        rates = (whole.states[:, :6] - whole.states[:, 6:12]) / DT
        inputs = np.concatenate([whole.inputs, whole.states[:-1, 12:]], axis=-1)
        states = np.concatenate([whole.states[:, :6], rates], axis=-1)
        motions[Path(run.source).stem] = Trajectory(whole.times, states, inputs)
    return motions


def drawn(folder: Path, seed: int, count: int = 5) -> list[str]:
    """Return the motions that a model is learned from."""
    chosen = np.random.default_rng(seed).choice(sorted(recordings(folder)), count, replace=False)
    return sorted(chosen.tolist())


def of_joint(run: Trajectory, joint: int) -> Trajectory:
    """Return the angle and rate of one joint with its commands."""
    own = [joint, joint + 6]
    return Trajectory(run.times, run.states[:, own], run.inputs[:, own])


def linear(runs: Sequence[Trajectory], joint: int | None = None) -> models.Linear:
    """Return a linear model of each joint alone, or of one joint, by least squares of steps as in ``ctxval fit``."""
    if joint is not None:
        return models.Linear.fit(Transitions.joined([of_joint(run, joint).transitions() for run in runs]))
    A, B, c = np.zeros((12, 12)), np.zeros((12, 12)), np.zeros(12)
    for j in range(6):
        alone, own = linear(runs, j), [j, j + 6]
        A[np.ix_(own, own)], B[np.ix_(own, own)], c[own] = alone.A, alone.B, alone.c
    return models.Linear(A, B, c, Transitions.joined([run.transitions() for run in runs]))


@dataclass(frozen=True, eq=False)
class Arm:
    """Six servos with proportional-derivative control and dry friction, under the weight of the links, as a model.

    The links' masses, lengths and centres of mass and the rotors' inertia are those of the MJCF and the STS3215 servo
    that TheRobotStudio publishes (SO-ARM100, ``Simulation/SO101/so101_new_calib.xml``, commit 07be617). A rotor's
    inertia behind a gear of 345 is far above that of the links, so joints are coupled by weight alone. Angles are 0
    with the upper arm upright and the forearm level; positive ones lower the arm. A step is an implicit Euler step:
    servos are too stiff for an explicit one of 20 ms, and dry friction then holds a joint exactly.

    Attributes:
        stiffness, damping, friction: of each joint, N m/rad, N m s/rad and N m, ``(..., 6)``.
        offset: between the zero of a servo and that of its joint, rad, ``(..., 6)``.
    """

    stiffness: Array
    damping: Array
    friction: Array
    offset: Array

    ROTOR = 0.028  # kg m^2
    UPPER_ARM, FOREARM, HAND = 0.103, 0.104, 0.178  # kg; the hand has wrist, gripper and jaw
    HAND_MOMENT = 0.079 * 0.0386 + 0.087 * 0.0863 + 0.012 * 0.1145  # kg m, about the wrist

    def weight(self, q: Array) -> Array:
        """Return the torques of gravity ``(..., 6)``."""
        pitch, elbow, wrist = np.moveaxis(np.cumsum(q[..., 1:4], axis=-1), -1, 0)
        at_wrist = self.HAND_MOMENT * np.cos(wrist)
        beyond = self.FOREARM + self.HAND
        at_elbow = (self.FOREARM * 0.0981 + self.HAND * 0.1349) * np.cos(elbow) + at_wrist
        upright = (self.UPPER_ARM * 0.0898 + beyond * 0.1126) * np.sin(pitch)
        forward = (self.UPPER_ARM * 0.0084 + beyond * 0.0280) * np.cos(pitch)
        none = np.zeros_like(pitch)
        return 9.81 * np.stack([none, upright + forward + at_elbow, at_elbow, at_wrist, none, none], axis=-1)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states ``(..., 12)``."""
        q, v = x[..., :6], x[..., 6:]
        drive = self.ROTOR / DT * v + self.stiffness * (u[..., :6] + self.offset - q) + self.weight(q)
        moving = drive - np.clip(drive, -self.friction, self.friction)
        v = moving / (self.ROTOR / DT + self.damping + self.stiffness * DT)
        return np.concatenate([q + DT * v, v], axis=-1)


def physical(runs: Sequence[Trajectory], steps: int = 2500, every: int = 5) -> Arm:
    """Return the arm whose free runs are nearest to the first steps of recordings, by least squares of the angles."""
    steps = min(steps, *(run.horizon for run in runs))
    start = np.stack([run.states[0] for run in runs])
    inputs = np.stack([run.inputs[:steps] for run in runs], axis=1)
    angles = np.stack([run.states[1 : steps + 1, :6] for run in runs], axis=1)[every - 1 :: every]

    def arm(z: Array) -> Arm:
        k, b, f, offset = np.split(z[:, None], 4, axis=-1)
        return Arm(np.exp(k), np.exp(b), np.exp(f), offset)

    def errors(z: Array) -> Array:  # of all rows of parameters (P, 24) at once, (P, N)
        model, x, kept = arm(z), np.repeat(start[None], len(z), axis=0), []
        for t in range(steps):
            x = model.step(x, inputs[t])
            if (t + 1) % every == 0:
                kept.append(x[..., :6])
        return np.moveaxis(np.stack(kept) - angles[: len(kept), None], 1, 0).reshape(len(z), -1)

    def slopes(z: Array, size: float = 1e-4) -> Array:
        moved = errors(z + size * np.concatenate([np.zeros((1, len(z))), np.eye(len(z))]))
        return np.asarray((moved[1:] - moved[0]).T / size)

    low, high = (
        np.repeat([*np.log(ends), offset], 6) for ends, offset in (((0.5, 0.02, 1e-3), -0.2), ((2e3, 99, 9), 0.2))
    )
    first = np.repeat([*np.log([20.0, 2.0, 0.3]), 0.0], 6)
    found = least_squares(lambda z: errors(z[None])[0], first, slopes, bounds=(low, high), max_nfev=30)
    best = arm(found.x[None])
    return Arm(*(part.ravel() for part in vars(best).values()))


def learned(folder: Path, kind: str, seed: int) -> Model:
    """Return the model of a kind, linear or physical, that is learned from five motions."""
    runs = [recordings(folder)[name] for name in drawn(folder, seed)]
    return linear(runs) if kind == "linear" else physical(runs)


def extent(run: Trajectory, joints: Sequence[int]) -> dict[str, float]:
    """Return the parameters of a motion in the suite: the largest range and the largest rate of its commands."""
    commands = run.inputs[:, list(joints)]
    return {
        "range": float(np.ptp(commands, axis=0).max()),
        "rate": float(np.abs(np.diff(commands, axis=0)).max() / DT),
    }


def validation(folder: Path, model: Model, motions: Sequence[str], joint: int | None = None) -> Validation:
    """Return the validation of a model, or of that of one joint, against motions, by the largest deviation."""
    joints = COMPARED if joint is None else (0,)
    runs = {name: recordings(folder)[name] for name in motions}
    if joint is not None:
        runs = {name: of_joint(run, joint) for name, run in runs.items()}
    names = JOINTS if joint is None else (JOINTS[joint],)

    recorded = systems.Recorded(runs)  # whose commands are all that is known of the controller
    extents = {name: extent(run, joints) for name, run in runs.items()}
    return Validation(
        space=TaskSuite(extents, {"range": "rad", "rate": "rad/s"}) if joint is None else TaskSuite(list(runs)),
        task=recorded.task,
        system=recorded,
        model=model,
        synthesizer=recorded,
        distance=distances.MaximumDeviation(norm=np.inf, components=joints),
        labels=Labels(
            (*(f"{name} [rad]" for name in names), *(f"{name} rate [rad/s]" for name in names)),
            (*(f"{name} command [rad]" for name in names), *(f"{name} command before [rad]" for name in names)),
            "rad",
        ),
    )


def experiment(folder: str, seed: int = 0, model: str = "linear") -> Experiment:
    """Return the validation of a model that is learned from five motions drawn with a seed against the other 45."""
    path = Path(folder)
    others = sorted(set(recordings(path)) - set(drawn(path, seed)))
    made = validation(path, learned(path, model, seed), others)
    return Experiment(f"SO-101, {model} model", made, budget=len(others))
