"""A real servo that turns a pendulum: published friction models against 16 recorded closed loops.

The Rhoban team publishes the recordings under the Apache License 2.0: https://github.com/Rhoban/bam, commit af22604,
folder ``bam/data.bak/processed``, of which this example reads the 16 files with a mass of 0.49 kg at 0.1 m. They are no
part of this repository. The friction models are written from the formulas and the identified values of that repository
and of its paper (arXiv 2410.08650). A task is a reference trajectory at a gain of the firmware, so there are 16.
``ctxval run servo:experiment --option folder=FOLDER --option friction=m4`` is a campaign on the model m4.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from ctxval import Array, Experiment, Labels, Parameters, Task, TaskSuite, Validation, distances, rollout, systems
from ctxval.core.controller import Controller
from ctxval.core.model import Model
from ctxval.core.system import Outputs
from ctxval.data import LogMapping, read_recordings
from ctxval.errors import InputError

DT, HORIZON = 0.01, 599  # s, steps: the recordings have a sample every 5 ms, and the shortest one ends after 5.995 s
TURN = 4096  # counts of the encoder per turn
PATHS, GAINS = ("sin_sin", "lift_and_drop", "up_and_down", "sin_time_square"), (100, 200, 400, 800)


@dataclass(frozen=True)
class Friction:
    """Identified parameters of the servo with one of the published friction models, in SI units.

    Attributes:
        torque, resistance: the motor's torque constant and its resistance.
        armature: inertia of the rotor, as the output sees it.
        offset: the angle at which the pendulum hangs, as the encoder reads it, with the opposite sign.
        viscous, coulomb: friction in proportion to the rate, and independent of it.
        load: friction in proportion to the torque that the gears carry.
        stribeck: the part of the load's friction that vanishes at rates above ``rate``, with the exponent ``shape``.
    """

    torque: float
    resistance: float
    armature: float
    offset: float
    viscous: float
    coulomb: float
    load: float = 0.0
    stribeck: float = 0.0
    rate: float = 1.0
    shape: float = 1.0


PUBLISHED = {
    "m1": Friction(0.38670, 4.01713, 0.0018142, 0.030871, 0.0036617, 0.012833),
    "m3": Friction(0.38042, 3.38007, 0.0019178, 0.029440, 0.0043791, 0.0088817, 0.121665),
    "m4": Friction(0.38617, 3.40257, 0.0018955, 0.028072, 0.0046210, 0.0087586, 0.068034, 0.073812, 2.5577, 0.76012),
}


@dataclass(frozen=True)
class Servo:
    """The servo with its pendulum as a model: states angle and rate, inputs duty and whether the torque is on.

    Friction first is the torque that would stop the joint within a step, and then limited to what friction can do; so
    a joint that friction can hold stays at rest.
    """

    friction: Friction
    mass: float = 0.49
    length: float = 0.1
    voltage: float = 7.4
    steps: int = 5

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states ``(..., 2)``."""
        f, dt = self.friction, DT / self.steps
        inertia, weight = self.mass * self.length**2 + f.armature, 9.80665 * self.mass * self.length
        angle, rate = x[..., 0], x[..., 1]
        for _ in range(self.steps):
            volts = self.voltage * u[..., 0] - f.torque * rate
            motor = np.where(u[..., 1] > 0.5, f.torque / f.resistance * volts, 0.0)
            pendulum = -weight * np.sin(angle + f.offset)
            carried = np.abs(motor - pendulum)
            slow = np.exp(-(np.abs(rate / f.rate) ** f.shape))
            most = f.viscous * np.abs(rate) + f.coulomb + (f.load + slow * f.stribeck) * carried
            stopping = -(inertia / dt * rate + motor + pendulum)
            rate = rate + dt / inertia * (motor + pendulum + np.clip(stopping, -most, most))
            angle = angle + dt * rate
        return np.stack([angle, rate], axis=-1)


@dataclass(frozen=True, eq=False)
class Firmware:
    """The servo's firmware: the duty in proportion to the error of the encoder's angle, limited to 1.

    Attributes:
        reference: the angles to follow, ``(..., H + 1)``.
        torque: whether the torque is on in each step, ``(..., H + 1)``.
        gain: the gain as the firmware counts it, ``(...)``.
    """

    reference: Array
    torque: Array
    gain: Array

    def __call__(self, t: int, y: Array) -> Array:
        """Return duty and torque ``(..., 2)`` for the outputs ``(..., 1)``."""
        counts = np.rint(TURN / (2 * np.pi) * y[..., 0])
        error = TURN / (2 * np.pi) * self.reference[..., t] - counts
        duty = np.clip(self.gain * error / (256 * 885), -1.0, 1.0)
        return np.stack(np.broadcast_arrays(duty, self.torque[..., t]), axis=-1)


def files_in(folder: Path) -> dict[str, Path]:
    """Return the recordings of a folder by trajectory and gain, which the files state."""
    files = {}
    for path in sorted(folder.glob("*.json.gz")):
        about = json.loads(gzip.decompress(path.read_bytes()))
        files[f"{about['trajectory']}-{about['kp']}"] = path
    return files


class Recordings:
    """The suite of tasks, and what is recorded of each: reference, switch of the torque, and first angle."""

    def __init__(self, folder: Path) -> None:
        self.suite = TaskSuite({f"{path}-{gain}": {"path": path, "gain": gain} for gain in GAINS for path in PATHS})
        fields = LogMapping({"angle": "position", "goal": "goal_position", "torque": "torque_enable"}, dt=DT)
        files = files_in(folder)
        if absent := set(self.suite.task_names) - set(files):
            raise InputError(f"the folder {str(folder)!r} has no recordings of {sorted(absent)}; see docs/servo.md.")
        self.runs = {name: read_recordings([files[name]], fields).runs[0].trajectory for name in self.suite.task_names}
        self.records = {name: run.states[: HORIZON + 1] for name, run in self.runs.items()}

    def of(self, names: Any) -> Array:
        """Return the records of one or more tasks, ``(..., H + 1, 3)``: angle, reference, switch of the torque."""
        return np.stack([self.records[name] for name in np.ravel(names)]).reshape(*np.shape(names), HORIZON + 1, 3)

    def task(self, p: Parameters) -> Task:
        """Return the task: from the first recorded angle at rest along the reference."""
        records = self.of(p.task)
        start = [records[..., 0, 0], np.zeros(records.shape[:-2])]
        return Task(start, reference=records[..., 1:2], horizon=HORIZON, dt=DT)

    batched = True

    def design(self, task: Task, model: Model) -> Controller:
        """Return the firmware with the gain of the task; it does not depend on M."""
        gains = np.reshape([self.suite[name]["gain"] for name in np.ravel(task.name)], np.shape(task.name))
        return Firmware(task.reference[..., 0], self.of(task.name)[..., 2], gains)


def fitted(friction: Friction, tasks: Sequence[str], recordings: Recordings) -> Friction:
    """Return parameters for which the closed loops of M are nearest to the recordings of some tasks."""
    names = [name for name, value in vars(friction).items() if value > 0 and name not in ("offset", "rate", "shape")]
    task = recordings.task(recordings.suite.parameters(np.stack([recordings.suite.point({"task": k}) for k in tasks])))
    task = task.named(np.array(tasks))

    def errors(logarithms: Array) -> Array:
        model = Servo(replace(friction, **dict(zip(names, np.exp(logarithms), strict=True))))
        loops = rollout(model.step, outputs.seen_by(recordings.design(task, model)), task)
        return np.asarray(loops.states[..., 0] - recordings.of(task.name)[..., 0]).ravel()

    outputs = Outputs([0])
    found = least_squares(errors, np.log([getattr(friction, name) for name in names]), diff_step=1e-3)
    return replace(friction, **dict(zip(names, np.exp(found.x).tolist(), strict=True)))


def experiment(folder: str, seed: int = 0, friction: str = "m1", fit: str = "") -> Experiment:
    """Return the validation of a friction model against the recordings in a folder, by the largest deviation.

    With ``fit``, such as ``"sin_sin-400,up_and_down-100"``, its parameters are fitted to the recordings of these tasks.
    """
    recordings, parameters = Recordings(Path(folder)), PUBLISHED[friction]
    if fit:
        parameters = fitted(parameters, fit.split(","), recordings)
    validation = Validation(
        space=recordings.suite,
        task=recordings.task,
        system=systems.Recorded(
            {name: replace(run, states=run.states[:, :1]) for name, run in recordings.runs.items()}
        ),
        model=Servo(parameters),
        synthesizer=recordings,
        distance=distances.MaximumDeviation(),
        labels=Labels(("angle [rad]",), ("duty", "torque on"), "rad"),
        outputs=[0],
    )
    return Experiment(f"servo {friction}{', fitted' if fit else ''}", validation)
