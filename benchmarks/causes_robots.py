"""The robots of ``study_causes.py``, each with its exact model.

Rules were chosen on the robots of ``DEVELOPMENT`` only; nothing is ever tuned on those of ``REPORTING``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from causes_systems import Acceleration, Robot
from ctxval import Array, Experiment, Parameters, Task, TaskSpace, controllers, distances, models, systems
from ctxval.core.model import Model
from dynamics_systems import experiment, path


def _analytic_model(joints: int, driven: tuple[int, ...], acceleration: Acceleration, dt: float) -> Model:
    def derivative(x: Array, u: Array) -> Array:
        # The axes of a batch stay in the opposite order until the end.
        forces = np.zeros((*np.broadcast_shapes(x.shape[:-1], u.shape[:-1]), joints))
        forces[..., list(driven)] = u
        accelerations = acceleration(x[..., :joints].T, x[..., joints:].T, forces.T, 1.0)
        return np.concatenate([x[..., joints:], accelerations.T], axis=-1)

    return models.Function(systems.rk4(derivative, dt), vectorized=True)


def _pendulum(q: Array, v: Array, forces: Array, gravity: float) -> Array:
    return (forces - gravity * 4.0 * np.sin(q) - 0.1 * v) / 0.5


def _crane(q: Array, v: Array, forces: Array, gravity: float) -> Array:
    mass, load, length = 1.0, 0.4, 0.6
    s, c = np.sin(q[1]), np.cos(q[1])
    m11, m12, m22 = mass + load, load * length * c, load * length**2
    b1 = forces[0] + load * length * v[1] ** 2 * s - 0.2 * v[0]
    b2 = forces[1] - gravity * load * 9.81 * length * s - 0.01 * v[1]
    det = m11 * m22 - m12**2
    return np.stack([(m22 * b1 - m12 * b2) / det, (m11 * b2 - m12 * b1) / det])


def _two_links(
    q: Array,
    v: Array,
    forces: Array,
    inertias: tuple[float, float, float],
    weights: tuple[float, float],
    damping: float,
) -> Array:
    a, b, d = inertias
    s, c = np.sin(q[1]), np.cos(q[1])
    m11, m12, m22 = a + 2 * b * c, d + b * c, d + 0 * c
    g2 = weights[1] * np.sin(q[0] + q[1])
    b1 = forces[0] + b * s * (2 * v[0] * v[1] + v[1] ** 2) - weights[0] * np.sin(q[0]) - g2 - damping * v[0]
    b2 = forces[1] - b * s * v[0] ** 2 - g2 - damping * v[1]
    det = m11 * m22 - m12**2
    return np.stack([(m22 * b1 - m12 * b2) / det, (m11 * b2 - m12 * b1) / det])


def _arm(q: Array, v: Array, forces: Array, gravity: float) -> Array:
    return _two_links(q, v, forces, (1.6, 0.5, 0.5), (8.0 * gravity, 3.0 * gravity), 0.2)


def _leg(q: Array, v: Array, forces: Array, gravity: float) -> Array:
    return _two_links(q, v, forces, (0.4, 0.08, 0.1), (3.0 * gravity, 0.8 * gravity), 0.05)


def _telescope(q: Array, v: Array, forces: Array, gravity: float) -> Array:
    """A boom in a vertical plane: its angle from the horizontal, and how far it is drawn out of 0.8 m."""
    mass, radius = 2.0, 0.8 + q[1]
    turned = forces[0] - 2 * mass * radius * v[0] * v[1] - gravity * mass * 9.81 * radius * np.cos(q[0]) - 0.5 * v[0]
    drawn = forces[1] + mass * radius * v[0] ** 2 - gravity * mass * 9.81 * np.sin(q[0]) - 2.0 * v[1]
    return np.stack([turned / (0.6 + mass * radius**2), drawn / mass])


def _rotary_pendulum(q: Array, v: Array, forces: Array, gravity: float) -> Array:
    """A pendulum that hangs at the end of a driven arm (Furuta): the angles of the arm and of the pendulum."""
    base, mass, arm, length = 0.05, 0.2, 0.3, 0.25
    s, c = np.sin(q[1]), np.cos(q[1])
    m11, m12, m22 = base + mass * (arm**2 + (length * s) ** 2), mass * arm * length * c, mass * length**2 + 0 * c
    turning = mass * length**2 * s * c
    b1 = forces[0] - 2 * turning * v[0] * v[1] + mass * arm * length * v[1] ** 2 * s - 0.02 * v[0]
    b2 = forces[1] + turning * v[0] ** 2 - gravity * mass * 9.81 * length * s - 0.002 * v[1]
    det = m11 * m22 - m12**2
    return np.stack([(m22 * b1 - m12 * b2) / det, (m11 * b2 - m12 * b1) / det])


def _quadrotor(q: Array, v: Array, forces: Array, gravity: float) -> Array:
    """A planar quadrotor: x, z and tilt; thrust beyond hovering and torque."""
    thrust = 9.81 + forces[1]
    return np.stack(
        [
            forces[0] - thrust * np.sin(q[2]) - 0.1 * v[0],
            thrust * np.cos(q[2]) - gravity * 9.81 - 0.1 * v[1],
            forces[2] / 0.2 - 0.1 * v[2],
        ]
    )


def _followed(
    p: Parameters, names: tuple[str, ...], horizon: int, dt: float, width: int, followed: tuple[int, ...]
) -> Task:
    """Return the task of following a path of some positions, each to a goal and with a wave; the others are at 0."""
    goals = np.stack([p[name] for name in names], axis=-1)
    reference = np.zeros((*goals.shape[:-1], horizon + 1, 2 * width))
    wave = 0.3 * np.abs(goals).max(axis=-1)
    for i, position in enumerate(followed[: len(names)]):
        goal, frequency = goals[..., i], p.frequency * (1 + 0.3 * i)
        reference[..., position], reference[..., width + position] = path(
            horizon, dt, 0.0 * goal, goal, wave, frequency
        )
    return Task(reference[..., 0, :], reference=reference, horizon=horizon, dt=dt)


def _tracking(
    gains: tuple[Any, Any], names: tuple[str, ...], reach: float, frequency: tuple[float, float], units: str,
    horizon: int, width: int, compared: tuple[int, ...], followed: tuple[int, ...],
) -> Callable[[Robot, Any], Experiment]:  # fmt: skip
    def make(robot: Robot, system: Any) -> Experiment:
        return experiment(
            robot.name,
            units,
            space=TaskSpace(**dict.fromkeys(names, (-reach, reach, units)), frequency=(*frequency, "Hz")),
            task=lambda p: _followed(p, names, horizon, robot.dt, width, followed),
            system=system,
            model=robot.model,
            synthesizer=controllers.PID(gains[0], 0.0, gains[1], components=followed),
            distance=distances.MaximumDeviation(components=compared),
            start_tolerance=1e6,
        )

    return make


def _regulated(
    weights: tuple[Any, Any], space: Callable[[], TaskSpace], ends: Callable[[Parameters], tuple[list[Any], list[Any]]],
    units: str, horizon: int, compared: tuple[int, ...],
) -> Callable[[Robot, Any], Experiment]:  # fmt: skip
    def make(robot: Robot, system: Any) -> Experiment:
        def task(p: Parameters) -> Task:
            start, goal = ends(p)
            return Task(start, goal=goal, horizon=horizon, dt=robot.dt)

        return experiment(
            robot.name,
            units,
            space=space(),
            task=task,
            system=system,
            model=robot.model,
            synthesizer=controllers.LQR(*weights),
            distance=distances.MaximumDeviation(components=compared),
            start_tolerance=1e6,
        )

    return make


def _of_gymnasium(name: str) -> Path:
    import gymnasium

    return Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / name


def _analytic(
    name: str, joints: int, driven: tuple[int, ...], acceleration: Acceleration, dt: float, **more: Any
) -> Robot:
    model = _analytic_model(joints, driven, acceleration, dt)
    return Robot(name, joints, len(driven), driven, dt, model=model, acceleration=acceleration, **more)


def _pusher(robot: Robot, system: Any) -> Experiment:
    made = _tracking(
        ([20.0, 20.0, 3.0, 10.0, 1.0, 2.0, 1.0], [4.0, 4.0, 0.3, 2.0, 0.1, 0.2, 0.1]),
        ("pan", "lift", "roll", "elbow"), 0.5, (0.2, 0.6), "rad", 100, 11, (0, 1, 2, 3), (0, 1, 2, 3, 4, 5, 6),
    )  # fmt: skip
    return made(robot, system)


DEVELOPMENT = {
    each.name: each
    for each in (
        _analytic(
            "pendulum", 1, (0,), _pendulum, 0.02,
            rates=(1.0,), efforts=(4.0,), weights=(0,),
            make=_tracking((30.0, 5.0), ("goal",), 1.2, (0.3, 0.8), "rad", 120, 1, (0,), (0,)),
        ),
        _analytic(
            "crane", 2, (0,), _crane, 0.04,
            rates=(1.0, 1.0), efforts=(3.0,), weights=(1,),
            make=_tracking((6.0, 5.0), ("goal",), 1.2, (0.2, 0.5), "m", 100, 2, (0, 1), (0,)),
        ),
        Robot(
            "double pendulum", 3, 1, (0,), 0.02, (1.0, 1.0, 1.0), (0.2,),
            models.MuJoCo(_of_gymnasium("inverted_double_pendulum.xml"), dt=0.02),
            _regulated(
                ([10.0, 20.0, 20.0, 1.0, 1.0, 1.0], [400.0]),
                lambda: TaskSpace(goal=(-0.5, 0.5, "m"), first=(-0.1, 0.1, "rad"), second=(-0.1, 0.1, "rad")),
                lambda p: ([0.0, p.first, p.second, 0.0, 0.0, 0.0], [p.goal, 0.0, 0.0, 0.0, 0.0, 0.0]),
                "m", 120, (0, 1, 2),
            ),
            mjcf=_of_gymnasium("inverted_double_pendulum.xml"), joint_efforts=(10.0, 3.0, 1.0),
        ),
        _analytic(
            "leg", 2, (0, 1), _leg, 0.02,
            rates=(1.0, 1.0), efforts=(3.0, 1.0), weights=(0, 1),
            make=_tracking(
                ([20.0, 6.0], [1.5, 0.4]), ("hip", "knee"), 1.0, (0.3, 0.8), "rad", 120, 2, (0, 1), (0, 1)
            ),
        ),
        Robot(
            "reacher", 2, 2, (0, 1), 0.02, (1.0, 1.0), (0.03, 0.03),
            models.MuJoCo(_of_gymnasium("reacher.xml"), dt=0.02),
            _tracking(
                ([0.15, 0.15], [0.02, 0.02]), ("first", "second"), 1.0, (0.3, 0.8), "rad", 100, 4, (0, 1), (0, 1)
            ),
            mjcf=_of_gymnasium("reacher.xml"), joint_efforts=(6.0, 6.0),
        ),
    )
}  # fmt: skip

REPORTING = {
    each.name: each
    for each in (
        _analytic(
            "arm", 2, (0, 1), _arm, 0.02,
            rates=(1.0, 1.0), efforts=(8.0, 3.0), weights=(0, 1),
            make=_tracking(
                ([80.0, 40.0], [20.0, 8.0]), ("first", "second"), 1.0, (0.2, 0.7), "rad", 120, 2, (0, 1), (0, 1)
            ),
        ),
        _analytic(
            "quadrotor", 3, (1, 2), _quadrotor, 0.04,
            rates=(1.0, 1.0, 1.0), efforts=(2.0, 0.3), weights=(1,),
            make=_regulated(
                ([4.0, 6.0, 2.0, 2.0, 2.0, 0.5], [0.5, 5.0]),
                lambda: TaskSpace(x=(-1.5, 1.5, "m"), z=(-1.0, 1.0, "m"), tilt=(-0.2, 0.2, "rad")),
                lambda p: ([0.0, 0.0, p.tilt, 0.0, 0.0, 0.0], [p.x, p.z, 0.0, 0.0, 0.0, 0.0]),
                "m", 100, (0, 1, 2),
            ),
        ),
        Robot(
            "pusher", 7, 7, (0, 1, 2, 3, 4, 5, 6), 0.02, (1.0,) * 7, (1.5, 1.5, 0.5, 0.8, 0.2, 0.2, 0.2),
            models.MuJoCo(_of_gymnasium("pusher_v5.xml"), dt=0.02), _pusher,
            mjcf=_of_gymnasium("pusher_v5.xml"), joint_efforts=(1.5, 1.5, 0.5, 0.8, 0.2, 0.2, 0.2),
        ),
        # What follows was written down before it was run for the first time, with the rule of then.
        Robot(
            "swimmer", 5, 2, (3, 4), 0.02, (1.0,) * 5, (0.15, 0.15),
            models.MuJoCo(_of_gymnasium("swimmer.xml"), dt=0.02),
            _tracking(
                ([1.5, 1.5], [0.3, 0.3]), ("first", "second"), 0.8, (0.2, 0.6), "rad", 120, 5, (0, 1, 2, 3, 4), (3, 4)
            ),
            mjcf=_of_gymnasium("swimmer.xml"), joint_efforts=(5.0, 5.0, 5.0, 20.0, 20.0),
        ),
        _analytic(
            "telescope", 2, (0, 1), _telescope, 0.02,
            rates=(1.0, 1.0), efforts=(15.0, 10.0), weights=(0, 1),
            make=_tracking(
                ([150.0, 200.0], [25.0, 40.0]), ("angle", "draw"), 0.5, (0.2, 0.6), "", 120, 2, (0, 1), (0, 1)
            ),
        ),
        _analytic(
            "rotary pendulum", 2, (0,), _rotary_pendulum, 0.02,
            rates=(1.0, 1.0), efforts=(0.15,), weights=(1,),
            make=_tracking((1.5, 0.3), ("turn",), 1.0, (0.2, 0.6), "rad", 150, 2, (0, 1), (0,)),
        ),
    )
}  # fmt: skip
