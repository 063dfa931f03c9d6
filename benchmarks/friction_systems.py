"""Systems with dry friction that M lacks: drives, cranes and arms, of 2 to 4 parameters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ctxval import Experiment, Task, TaskSpace, controllers, distances, models, systems
from ctxval._util.arrays import Array
from dynamics_systems import experiment, repeated
from strangers import row

GRAVITY = 9.81
DEVELOPMENT = ("geared-pendulum", "ball-screw", "loaded-gear", "frictionloss-arm")
"""Systems that the method was developed on."""
REGULAR = ("cart-pole", "gantry", "scara", "harmonic-drive", "xy-table")
"""Others whose friction is of a kind that is learned."""
OTHERS = ("worn-guide", "two-way-ratchet", "detent-rail")
"""Others whose friction changes with the place or the direction; of the last one, at rest."""
DEVELOPED_AT_REST = ("cylinder", "rotary-seal", "sealed-table")
"""Others, whose friction is larger at rest than at any rate, which only the smallest moves show.

The choice of tasks was developed on them.
"""
AT_REST = ("lip-seal", "sealed-gantry", "sealed-lift")
"""Others like these, which were written after it."""

Push = Callable[[Array, Array, Array], Array]
"""The accelerations ``(..., k)`` at positions, speeds and inputs."""


def mechanism(push: Push, dt: float, substeps: int = 1) -> models.Function:
    """Return the model of positions and speeds, by semi-implicit Euler steps."""

    def step(x: Array, u: Array) -> Array:
        k = x.shape[-1] // 2
        places, speeds = x[..., :k], x[..., k:]
        speeds = speeds + dt / substeps * push(places, speeds, u)
        return np.concatenate([places + dt / substeps * speeds, speeds], axis=-1)

    return models.Function(repeated(step, substeps), vectorized=True)


def coulomb(speed: Array, slow: float = 0.002) -> Array:
    """Return a dry friction of size 1, which is viscous at speeds far below ``slow``."""
    return np.tanh(speed / slow)


def pair(
    name: str, units: str, space: TaskSpace, system: Push | models.Function, model: Push, horizon: int, dt: float,
    Q: list[float], R: float, compared: tuple[int, ...], inputs: int = 1, substeps: int = 100,
) -> Experiment:  # fmt: skip
    """Return an experiment whose tasks begin at rest at ``start`` and end at ``goal``; other places are 0."""

    def task(p: object) -> Task:
        names = space.names
        first = [getattr(p, each) for each in names if each.startswith("start")]
        last = [getattr(p, each) for each in names if each.startswith("goal")]
        zeros = [0.0 * last[0]] * (len(Q) - len(last))
        return Task(row(*first, *zeros), goal=row(*last, *zeros), horizon=horizon, dt=dt)

    return experiment(
        name,
        units,
        space=space,
        task=task,
        system=systems.Simulated(system if isinstance(system, models.Function) else mechanism(system, dt, substeps)),
        model=mechanism(model, dt),
        synthesizer=controllers.LQR(Q, [R] * inputs),
        distance=distances.MaximumDeviation(components=compared),
    )


def geared_pendulum(load: float = 1.08, friction: float = 0.7) -> Push:
    """A pendulum with a gear; its load is 8 % heavier than that of M."""
    return lambda q, w, u: (u - 0.15 * w - load * 0.08 * GRAVITY * np.sin(q) - friction * coulomb(w)) / load


def ball_screw(rest: float, friction: float) -> Push:
    """An axis whose friction is larger at rest than in motion (Stribeck)."""
    return lambda q, w, u: u - 0.5 * w - (friction + rest * np.exp(-((w / 0.05) ** 2))) * coulomb(w)


def cart_pole(friction: float = 0.6) -> Push:
    """A pole on a cart with dry friction at its wheels."""

    def push(q: Array, w: Array, u: Array) -> Array:
        s, c = np.sin(q[..., 1]), np.cos(q[..., 1])
        force = u[..., 0] - 0.2 * w[..., 0] - friction * coulomb(w[..., 0])
        moved = (force + 0.1 * s * (0.5 * w[..., 1] ** 2 - GRAVITY * c)) / (1.0 + 0.1 * s**2)
        return np.stack([moved, (GRAVITY * s - moved * c) / 0.5 - 0.05 * w[..., 1]], axis=-1)

    return push


def gantry(friction: float = 1.0, drag: float = 0.4) -> Push:
    """A trolley with a hanging load; M takes its drag for smaller."""

    def push(q: Array, w: Array, u: Array) -> Array:
        s, c = np.sin(q[..., 1]), np.cos(q[..., 1])
        force = u[..., 0] - drag * w[..., 0] - friction * coulomb(w[..., 0])
        moved = (force + 0.5 * s * (w[..., 1] ** 2 + GRAVITY * c)) / (2.0 + 0.5 * s**2)
        return np.stack([moved, -(GRAVITY * s + moved * c) - 0.05 * w[..., 1]], axis=-1)

    return push


def scara(load: float = 0.55, friction: tuple[float, float] = (0.5, 0.2)) -> Push:
    """Two joints in a horizontal plane; the load is 10 % heavier than that of M."""

    def push(q: Array, w: Array, u: Array) -> Array:
        c, s = np.cos(q[..., 1]), np.sin(q[..., 1])
        near, far = 0.6 + load * (0.32 + 0.32 * c), load * (0.16 + 0.16 * c)
        own, bent = 0.1 + 0.16 * load, 0.16 * load * s
        first = u[..., 0] + bent * (2 * w[..., 0] * w[..., 1] + w[..., 1] ** 2)
        first = first - 0.3 * w[..., 0] - friction[0] * coulomb(w[..., 0])
        second = u[..., 1] - bent * w[..., 0] ** 2 - 0.1 * w[..., 1] - friction[1] * coulomb(w[..., 1])
        whole = near * own - far**2
        return np.stack([own * first - far * second, near * second - far * first], axis=-1) / whole[..., None]

    return push


def harmonic_drive(load: float = 1.2, sliding: float = 0.4, share: float = 0.1, excess: float = 0.3) -> Push:
    """A link on a gear whose friction grows with the torque and is larger at rest; the link of M is lighter."""

    def push(q: Array, w: Array, u: Array) -> Array:
        grip = sliding + share * np.abs(u) + excess * np.exp(-((w / 0.1) ** 2))
        return (u - 0.2 * w - 0.1 * GRAVITY * load * np.sin(q) - grip * coulomb(w)) / load

    return push


def xy_table(heavy: float = 1.6, sizes: tuple[float, float, float] = (0.5, 0.3, 0.2)) -> Push:
    """Two axes, of which one carries the other; their frictions are larger at rest. In M, the first one is lighter."""
    mass, grips = np.array([heavy, 0.9]), np.array(sizes[:2])
    return lambda q, w, u: (u - 0.6 * w - (grips + sizes[2] * np.exp(-((w / 0.08) ** 2))) * coulomb(w)) / mass


def two_way_ratchet(forward: float, back: float) -> Push:
    """An axis whose friction is larger in one direction."""
    return lambda q, w, u: u - 0.5 * w - np.where(w > 0, forward, back) * coulomb(w)


def worn_guide(worn: float, friction: float) -> Push:
    """An axis whose friction is three times as large in 6 % of its range."""
    return lambda q, w, u: u - 0.5 * w - np.where((q > 0.5) & (q < 0.74), worn, friction) * coulomb(w)


def lift(weight: float = 0.8) -> Push:
    """A platform whose weight is not balanced."""
    return lambda q, w, u: u - 0.6 * w - weight


def loaded_gear(share: float, friction: float) -> Push:
    """An axis whose friction grows with the torque that it transmits."""
    return lambda q, w, u: u - 0.5 * w - (friction + share * np.abs(u)) * coulomb(w)


def sealed(
    push: Push, sliding: Array, rest: Array, back: Array, dt: float, substeps: int = 40, detent: float | None = None
) -> models.Function:
    """Return joints that rest until a force overcomes more than they slide with; push is without friction.

    They rest against pushes above 0 up to ``rest``, and against those below 0 up to ``back``; next to a detent, up to
    three times as much.
    """

    def step(x: Array, u: Array) -> Array:
        k, h = x.shape[-1] // 2, dt / substeps
        places, speeds = x[..., :k], x[..., k:]
        free = speeds + h * push(places, speeds, u)
        grips = np.where(speeds == 0, np.where(free > 0, rest, back), sliding)
        if detent is not None:
            grips = np.where((speeds == 0) & (np.abs(places - detent) < 0.06), 3 * grips, grips)
        speeds = np.sign(free) * np.maximum(np.abs(free) - h * grips, 0.0)
        return np.concatenate([places + h * speeds, speeds], axis=-1)

    return models.Function(repeated(step, substeps), vectorized=True)


def arm_xml(friction: tuple[float, float]) -> str:
    """Return an arm of MuJoCo with two joints, with dry friction or without."""
    joint = '<joint name="{}" axis="0 0 1" damping="{}" frictionloss="{}"/>'
    return (
        '<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>'
        f"<body>{joint.format('shoulder', 0.4, friction[0])}"
        '<geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="1.2"/>'
        f'<body pos="0.4 0 0">{joint.format("elbow", 0.2, friction[1])}'
        '<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="0.8"/></body></body></worldbody>'
        '<actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator></mujoco>'
    )


def frictionloss_arm() -> Experiment:
    """Return MuJoCo's arm with ``frictionloss``; M is the same file without it."""
    return experiment(
        "frictionloss-arm",
        "rad",
        space=TaskSpace(goal_shoulder=(-1.2, 1.2, "rad"), goal_elbow=(-1.2, 1.2, "rad")),
        task=lambda p: Task(np.zeros(4), goal=[p.goal_shoulder, p.goal_elbow, 0.0, 0.0], horizon=75, dt=0.02),
        system=systems.MuJoCo(arm_xml((0.5, 0.2)), substeps=10),
        model=models.MuJoCo(arm_xml((0.0, 0.0)), dt=0.02),
        synthesizer=controllers.LQR([20.0, 20.0, 1.0, 1.0], [0.1, 0.1]),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )


def _moves(unit: str, start: float, goal: float, *, of: str = "") -> dict[str, tuple[float, float, str]]:
    return {f"start{of}": (-start, start, unit), f"goal{of}": (-goal, goal, unit)}


def with_seals(
    name: str, units: str, space: TaskSpace, push: Push, sliding: object, rest: object,
    Q: list[float], R: float, inputs: int = 1, back: object = None, detent: float | None = None,
) -> Experiment:  # fmt: skip
    """Return an experiment with friction that is larger at rest, which M lacks, and joints 5 % heavier than in M."""

    def heavier(q: Array, w: Array, u: Array) -> Array:
        return push(q, w, u) / 1.05

    dt, places = 0.04, tuple(range(inputs))
    to_rest, to_rest_back = np.asarray(rest), np.asarray(rest if back is None else back)
    joints = sealed(heavier, np.asarray(sliding), to_rest, to_rest_back, dt, detent=detent)
    return pair(name, units, space, joints, push, 60, dt, Q, R, places, inputs)


def axis(name: str, push: Callable[[float, float], Push], *sizes: float) -> Experiment:
    """Return the experiment of an axis whose friction has two sizes; they are 0 in M."""
    space = TaskSpace(**_moves("m", 1.0, 2.0))
    return pair(name, "m", space, push(*sizes), push(0.0, 0.0), 60, 0.04, [10.0, 1.0], 0.5, (0,))


SYSTEMS: dict[str, Callable[[], Experiment]] = {
    "geared-pendulum": lambda: pair(
        "geared-pendulum", "rad", TaskSpace(**_moves("rad", 1.0, 1.2)),
        geared_pendulum(), geared_pendulum(1.0, 0.0), 60, 0.03, [30.0, 3.0], 0.2, (0,),
    ),
    "ball-screw": lambda: axis("ball-screw", ball_screw, 0.25, 0.4),
    "cart-pole": lambda: pair(
        "cart-pole", "m", TaskSpace(**_moves("m", 0.5, 1.0)),
        cart_pole(), cart_pole(0.0), 100, 0.03, [20.0, 20.0, 5.0, 2.0], 0.5, (0,),
    ),
    "gantry": lambda: pair(
        "gantry", "m", TaskSpace(**_moves("m", 1.0, 2.0)),
        gantry(), gantry(0.0, 0.3), 120, 0.05, [20.0, 10.0, 5.0, 1.0], 0.2, (0, 1),
    ),
    "scara": lambda: pair(
        "scara", "rad", TaskSpace(**_moves("rad", 1.0, 1.2, of="_1"), **_moves("rad", 1.0, 1.2, of="_2")),
        scara(), scara(0.5, (0.0, 0.0)), 60, 0.03, [30.0, 30.0, 2.0, 2.0], 0.2, (0, 1), 2,
    ),
    "harmonic-drive": lambda: pair(
        "harmonic-drive", "rad", TaskSpace(**_moves("rad", 0.8, 1.4)),
        harmonic_drive(), harmonic_drive(1.1, 0.0, 0.0, 0.0), 60, 0.04, [40.0, 4.0], 0.2, (0,),
    ),
    "xy-table": lambda: pair(
        "xy-table", "m", TaskSpace(**_moves("m", 0.5, 1.0, of="_x"), **_moves("m", 0.5, 1.0, of="_y")),
        xy_table(), xy_table(1.5, (0.0, 0.0, 0.0)), 60, 0.04, [20.0, 20.0, 2.0, 2.0], 0.2, (0, 1), 2,
    ),
    "frictionloss-arm": frictionloss_arm,
    "worn-guide": lambda: axis("worn-guide", worn_guide, 1.2, 0.4),
    "loaded-gear": lambda: axis("loaded-gear", loaded_gear, 0.15, 0.2),
    "two-way-ratchet": lambda: axis("two-way-ratchet", two_way_ratchet, 0.7, 0.4),
    "cylinder": lambda: with_seals(
        "cylinder", "m", TaskSpace(**_moves("m", 1.0, 1.5)), ball_screw(0.0, 0.0), 0.5, 0.8, [12.0, 1.0], 0.6,
    ),
    "detent-rail": lambda: with_seals(
        "detent-rail", "m", TaskSpace(**_moves("m", 0.8, 1.6)),
        ball_screw(0.0, 0.0), 0.3, 0.4, [15.0, 1.5], 0.5, detent=0.5,
    ),
    "rotary-seal": lambda: with_seals(
        "rotary-seal", "rad", TaskSpace(**_moves("rad", 0.8, 1.2)),
        geared_pendulum(1.0, 0.0), 0.4, 0.7, [25.0, 3.0], 0.2,
    ),
    "sealed-table": lambda: with_seals(
        "sealed-table", "m", TaskSpace(**_moves("m", 0.4, 0.8, of="_x"), **_moves("m", 0.4, 0.8, of="_y")),
        xy_table(1.5, (0.0, 0.0, 0.0)), [0.5, 0.3], [0.7, 0.45], [20.0, 20.0, 2.0, 2.0], 0.2, 2,
    ),
    "lip-seal": lambda: with_seals(
        "lip-seal", "m", TaskSpace(**_moves("m", 0.8, 1.6)),
        ball_screw(0.0, 0.0), 0.4, 0.75, [15.0, 1.5], 0.5, back=0.5,
    ),
    "sealed-gantry": lambda: with_seals(
        "sealed-gantry", "m", TaskSpace(**_moves("m", 0.8, 1.5)),
        gantry(0.0, 0.3), [0.7, 0.0], [1.1, 0.0], [20.0, 10.0, 5.0, 1.0], 0.2,
    ),
    "sealed-lift": lambda: with_seals(
        "sealed-lift", "m", TaskSpace(**_moves("m", 0.6, 1.2)), lift(), 0.5, 0.75, [20.0, 2.0], 0.3,
    ),
}  # fmt: skip
