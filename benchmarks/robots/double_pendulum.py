"""A double pendulum with a motor at its shoulder (pendubot): ten repeats of one swing-up under a published controller.

The Underactuated Robotics Lab of DFKI publishes the recordings under the BSD 3-Clause License:
https://github.com/dfki-ric-underactuated-lab/double_pendulum, commit 1e8544e, folders
``leaderboard/*/real_hardware*_v2/src_data``. The models and the controller are written from the facts of that
repository. Angles: the first link from hanging down, the second one relative to the first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy.linalg import solve_continuous_are

from ctxval import Array, Experiment, Labels, Parameters, Task, TaskSuite, Validation, distances, models, systems
from ctxval.controllers import Limits
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.errors import InputError

UNDISTURBED, PERTURBED = "pendubot-ilqr_tvlqr_lqr", "pendubot-perturbed-ilqr_tvlqr_lqr"
CONDITIONS = {
    UNDISTURBED: "pendubot, TVLQR",
    PERTURBED: "pendubot, TVLQR, random torque pulses",
    "pendubot-mcpilco": "pendubot, MC-PILCO",
    "pendubot-sac_lqr": "pendubot, SAC",
    "acrobot-ilqr_tvlqr_lqr": "acrobot, TVLQR",
    "acrobot-perturbed-ilqr_tvlqr_lqr": "acrobot, TVLQR, random torque pulses",
    "acrobot-mcpilco": "acrobot, MC-PILCO",
}
"""The recorded conditions, by the names of their files."""

IN_TURN = UNDISTURBED, PERTURBED  # tasks whose repeats are executed in turn

DT = 0.0025  # s, the mean period of the recordings
REFERENCE_DT = 0.001  # s, by which the recorded reference angles are the integral of the recorded reference rates
GRAVITY, GEAR = 9.81, 6.0


@dataclass(frozen=True)
class DoublePendulum:
    """Two rigid links under gravity with friction, as a model: states are angles and rates, inputs two torques.

    One step is a Runge-Kutta step of fourth order. Attributes are in SI units, one number for each link or joint.
    """

    mass: tuple[float, float] = (0.52346023, 0.62556772)
    length: float = 0.2  # of the first link
    centre: tuple[float, float] = (0.2, 0.25569305)
    inertia: tuple[float, float] = (0.0318872, 0.05086985)
    rotor: float = 6.2872e-5
    viscous: tuple[float, float] = (0.001, 0.001)
    coulomb: tuple[float, float] = (0.16, 0.12)

    def friction(self, rates: Array) -> Array:
        """Return the friction torques ``(..., 2)`` at rates of the joints."""
        return np.asarray(np.multiply(self.viscous, rates) + np.multiply(self.coulomb, np.arctan(100 * rates)))

    def rates_of_change(self, x: Array, u: Array) -> Array:
        """Return the time derivative ``(..., 4)`` of the state."""
        (m1, m2), (r1, r2), (I1, I2), l1 = self.mass, self.centre, self.inertia, self.length
        q1, q2, v1, v2 = np.moveaxis(x, -1, 0)
        coupling = m2 * l1 * r2
        M11 = I1 + I2 + m2 * l1**2 + 2 * coupling * np.cos(q2) + (GEAR**2 + 1) * self.rotor
        M12 = I2 + coupling * np.cos(q2) - GEAR * self.rotor
        M22 = I2 + GEAR**2 * self.rotor
        weight = m2 * GRAVITY * r2 * np.sin(q1 + q2)
        torques = u - self.friction(x[..., 2:])
        F1 = torques[..., 0] + coupling * np.sin(q2) * (2 * v1 + v2) * v2 - weight
        F1 = F1 - (m1 * r1 + m2 * l1) * GRAVITY * np.sin(q1)
        F2 = torques[..., 1] - coupling * np.sin(q2) * v1**2 - weight
        det = M11 * M22 - M12**2
        return np.stack([v1, v2, (M22 * F1 - M12 * F2) / det, (M11 * F2 - M12 * F1) / det], axis=-1)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states ``(..., 4)``."""
        k1 = self.rates_of_change(x, u)
        k2 = self.rates_of_change(x + DT / 2 * k1, u)
        k3 = self.rates_of_change(x + DT / 2 * k2, u)
        k4 = self.rates_of_change(x + DT * k3, u)
        return np.asarray(x + DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4))


DESIGNED_ON = DoublePendulum()
FRICTIONLESS = replace(DESIGNED_ON, viscous=(0.0, 0.0), coulomb=(0.0, 0.0))
PUBLISHED = {
    "1.0": DESIGNED_ON,
    "1.1": replace(FRICTIONLESS, rotor=0.0),
    "3.0": DoublePendulum(
        mass=(0.8745955, 0.2204146),
        centre=(0.2, 0.3267492),
        inertia=(0.0357113, 0.01),
        rotor=5.1337e-5,
        viscous=(0.04938, 0.02004),
        coulomb=(0.03315, 0.03521),
    ),
}

COST_TO_GO = np.array(
    [
        [135.52764183, 113.10176395, 31.25315593, 19.88076506],
        [113.10176395, 96.62495943, 26.26446629, 16.80197755],
        [31.25315593, 26.26446629, 7.25472498, 4.61592773],
        [19.88076506, 16.80197755, 4.61592773, 2.952913],
    ]
)
SWITCH, TOP = 0.128479004, np.array([np.pi, 0.0, 0.0, 0.0])
LIMITS = Limits([-5.0, -0.5], [5.0, 0.5])  # the second joint gets its friction compensation alone


def jacobian(x: Array, u: Array) -> tuple[Array, Array]:
    """Return ``(..., 4, 4)`` and ``(..., 4, 2)``, the derivatives of the rates of change without friction."""
    h, at = 1e-5, FRICTIONLESS.rates_of_change
    by_x = [(at(x + h * e, u) - at(x - h * e, u)) / (2 * h) for e in np.eye(4)]
    by_u = [(at(x, u + h * e) - at(x, u - h * e)) / (2 * h) for e in np.eye(2)]
    return np.stack(by_x, axis=-1), np.stack(by_u, axis=-1)


@dataclass(frozen=True, eq=False)
class TimeVaryingLQR:
    """The published controller: feedback about a reference, then LQR at the top, with friction compensation.

    Its memory is the filtered rates, and whether it has switched to the LQR at the top.

    Attributes:
        states, inputs, gains: the reference ``(H + 1, 4)`` and ``(H + 1, 2)``, and the gains ``(H + 1, 2, 4)``.
        at_top: the gain of the LQR at the top ``(2, 4)``.
    """

    states: Array
    inputs: Array
    gains: Array
    at_top: Array

    def start(self, task: Task) -> tuple[Array, Array]:
        """Return rates of 0 before the first record."""
        return np.zeros((*task.initial_state.shape[:-1], 2)), np.zeros(task.initial_state.shape[:-1], dtype=bool)

    def step(self, t: int, x: Array, memory: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        """Return the torques ``(..., 2)`` and the new memory."""
        filtered, at_top = memory
        filtered = 0.8 * filtered + 0.2 * x[..., 2:]
        rates = np.where(np.abs(filtered) < 0.1, 0.0, filtered)
        seen = np.concatenate([x[..., :2], rates], axis=-1)
        gap = seen - TOP
        gap[..., :2] -= 2 * np.pi * np.round(gap[..., :2] / (2 * np.pi))
        at_top = at_top | (np.einsum("...i,ij,...j->...", gap, COST_TO_GO, gap) < SWITCH)
        swing_up = self.inputs[t] - (seen - self.states[t]) @ self.gains[t].T
        u = np.where(at_top[..., None], -gap @ self.at_top.T, swing_up) * (1.0, 0.0)
        return LIMITS.clip(u + DESIGNED_ON.friction(rates)), (filtered, at_top)


def designed(states: Array, inputs: Array) -> TimeVaryingLQR:
    """Return the controller about a reference, by the Riccati equation in steps of the reference.

    The files hold the first 3.02 s of the reference, and the swing-up takes 4 s. So its end has the cost I in the place
    of the published one, which is that of the top.
    """
    A, B = jacobian(states, inputs)
    A, B = np.eye(4) + DT * A, DT * B
    B[..., 1] = 0.0  # the elbow has no motor
    Q, R, S = DT * np.eye(4), DT * 2 * np.eye(2), np.eye(4)
    gains = np.empty((len(states), 2, 4))
    for t in reversed(range(len(states))):
        gains[t] = np.linalg.solve(R + B[t].T @ S @ B[t], B[t].T @ S @ A[t])
        S = Q + A[t].T @ S @ (A[t] - B[t] @ gains[t])
    A, B = jacobian(TOP, np.zeros(2))
    R = 8 * 0.82 * np.eye(1)
    S = solve_continuous_are(A, B[:, :1], np.diag([1.92, 1.92, 0.3, 0.3]), R)
    at_top = np.concatenate([np.linalg.solve(R, B[:, :1].T @ S), np.zeros((1, 4))])
    return TimeVaryingLQR(states, inputs, gains, at_top)


@cache
def runs(folder: Path, condition: str, seconds: float) -> dict[str, Trajectory]:
    """Return the repeats of a condition at equal steps, without those that a safety limit ended before."""
    file, times = np.load(folder / f"{condition}.npz"), np.arange(round(seconds / DT) + 1) * DT
    found = {}
    for name in sorted(key.removeprefix("t_") for key in file.files if key.startswith("t_")):
        if file[f"t_{name}"][-1] >= times[-1]:
            clock = file[f"t_{name}"]
            position, velocity, torque = (
                sampled(times, clock, file[f"{field}_{name}"]) for field in ("position", "velocity", "torque_command")
            )
            states = np.concatenate([position, velocity], axis=-1)
            found[f"repeat {int(name)}"] = Trajectory(times, states, torque[:-1])
    return found


@cache
def controller(folder: Path) -> TimeVaryingLQR:
    """Return the controller about the recorded reference."""
    file, times = np.load(folder / f"{UNDISTURBED}.npz"), np.arange(round(3.0 / DT) + 1) * DT
    clock = np.arange(len(file["reference_t"])) * REFERENCE_DT
    position, velocity, torque = (
        sampled(times, clock, file[f"reference_{field}"]) for field in ("position", "velocity", "torque")
    )
    return designed(np.concatenate([position, velocity], axis=-1), torque)


def sampled(times: Array, clock: Array, columns: Array) -> Array:
    """Return columns ``(N, k)`` at other times than those of a clock, interpolated."""
    return np.stack([np.interp(times, clock, column) for column in columns.T], axis=-1)


@dataclass(frozen=True)
class Published:
    """A synthesizer that gives the same controller for each task; M is not used."""

    controller: TimeVaryingLQR

    def design(self, task: Task, model: Model) -> TimeVaryingLQR:
        return self.controller


LEARNED: dict[str, Callable[[Transitions], Model]] = {
    "linear": models.Linear.fit,
    "gaussian-process": lambda data: models.GaussianProcessModel.fit(data, 300, seed=0),
    "network": lambda data: models.FeedforwardReLU.fit(data, (32, 32), seed=0, restarts=1),
}
"""How models are learned from recorded steps, by the names of their kinds."""


def learned(folder: Path, kind: str) -> Model:
    """Return a model of a kind that is learned from five perturbed runs, 3 s of each."""
    some = list(runs(folder, PERTURBED, 3.0).values())[:5]
    return LEARNED[kind](Transitions.joined([run.transitions() for run in some]))


def validation(folder: Path, model: Model, seconds: float, condition: str = UNDISTURBED) -> Validation:
    """Return the validation of a model against the repeats of a condition, by the largest deviation of both angles."""
    repeats = runs(folder, condition, seconds)
    suite = TaskSuite({name: {"number": int(name.split()[1])} for name in repeats})
    return _against(systems.Recorded(repeats), suite, folder, model, seconds)


def repeated(folder: Path, model: Model, seconds: float) -> Validation:
    """Return the validation against two tasks, undisturbed and perturbed, whose repeats are executed in turn."""
    recorded = systems.Recorded({each: list(runs(folder, each, seconds).values()) for each in IN_TURN})
    return _against(recorded, TaskSuite(recorded.names, repeats=recorded.repeats), folder, model, seconds)


def _against(recorded: systems.Recorded, suite: TaskSuite, folder: Path, model: Model, seconds: float) -> Validation:
    def task(p: Parameters) -> Task:
        return Task(np.zeros(4), goal=TOP, horizon=round(seconds / DT), dt=DT)

    return Validation(
        space=suite,
        task=task,
        system=recorded,
        model=model,
        synthesizer=Published(controller(folder)),
        distance=distances.MaximumDeviation(norm=np.inf, components=(0, 1)),
        labels=Labels(("q1 [rad]", "q2 [rad]", "v1 [rad/s]", "v2 [rad/s]"), ("u1 [N m]", "u2 [N m]"), "rad"),
    )


def experiment(
    folder: str, seed: int = 0, model: str | float = "1.0", seconds: float = 3.0, repeats: bool = False
) -> Experiment:
    """Return the validation of a published model, or of one that is learned, by its name.

    Each repeat is a task, or with ``repeats`` one of the executions of two tasks: undisturbed and perturbed.
    """
    name = str(model)  # a command line gives 1.0 as a number
    if name not in PUBLISHED and name not in LEARNED:
        raise InputError(f"model must be one of {', '.join([*PUBLISHED, *LEARNED])}, got {name!r}.")
    chosen = PUBLISHED[name] if name in PUBLISHED else learned(Path(folder), name)
    made = (repeated if repeats else validation)(Path(folder), chosen, seconds)
    return Experiment(f"double pendulum, model {name}", made, budget=20 if repeats else 10)
