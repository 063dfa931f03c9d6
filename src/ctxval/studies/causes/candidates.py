"""The dictionary: the causes that a plant's error may have, with the range and the first guesses of their sizes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.models import MuJoCo
from ctxval.studies.causes.actuators import (
    Backlash,
    DeadZone,
    Delay,
    InputGain,
    InputOffset,
    Lag,
    ReversedInput,
    Saturation,
    SwappedInputs,
)
from ctxval.studies.causes.cause import Cause
from ctxval.studies.causes.mechanics import (
    Bias,
    Coulomb,
    Force,
    Gravity,
    Inertia,
    LoadFriction,
    Stribeck,
    TimeStep,
    Viscous,
)
from ctxval.studies.causes.mjcf import BodyMass, JointAttribute, MassCentre
from ctxval.studies.causes.plant import Joint, Plant
from ctxval.studies.causes.sensors import SensorOffset, SensorScale, SwappedJoints

_MOST_BODIES = 8  # bodies whose masses are tried
_NOTHING = 1e-6  # share of the changes of a rate that M misses, below which the joint has no fault


@dataclass(frozen=True)
class Candidate(ShortRepr):
    """A cause whose sizes are to be fitted.

    Attributes:
        low, high: bounds of the sizes.
        scales: changes of the sizes that matter, for the steps of the fit.
        starts: first guesses, of which the best one is refined.
    """

    cause: Cause
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    scales: tuple[float, ...] = ()
    starts: tuple[tuple[float, ...], ...] = ((),)


def candidates(plant: Plant, x: Array, u: Array, residuals: Array, *, outputs: bool) -> tuple[Candidate, ...]:
    """Return the dictionary of a plant.

    Args:
        x, u, residuals: recorded states ``(N, n)``, inputs ``(N, m)`` and what M misses of the next states ``(N, n)``.
        outputs: whether the states are estimates from outputs, so that no sensor of them can be wrong.
    """
    return (
        *_of_inputs(plant),
        *_of_joints(plant, x, u, residuals),
        *(_of_mujoco(plant, plant.model, residuals) if isinstance(plant.model, MuJoCo) else ()),
        Candidate(TimeStep((1.0,)), (0.2,), (5.0,), (0.1,), ((0.95,), (1.05,))),
        *(() if outputs else _of_sensors(plant, x)),
    )


def _ratio(cause: Cause) -> Candidate:
    return Candidate(cause.with_sizes((1.0,)), (0.1,), (10.0,), (0.1,), ((0.95,), (1.1,)))


def _of_inputs(plant: Plant) -> Iterator[Candidate]:
    m = len(plant.inputs)
    for k in range(m):
        most = float(plant.commanded[k])
        yield _ratio(InputGain((1.0,), k))
        yield Candidate(InputOffset((0.0,), k), (-2 * most,), (2 * most,), (0.05 * most,), ((0.0,),))
        limits = tuple((share * most,) for share in (0.9, 0.7, 0.5, 0.3, 0.1, 0.03, 0.01))
        yield Candidate(Saturation((most,), k), (1e-3 * most,), (most,), (0.05 * most,), limits)
        lost = tuple((share * most,) for share in (0.01, 0.05, 0.15))
        for kind in (DeadZone, Backlash):
            yield Candidate(kind((0.0,), k), (0.0,), (most,), (0.02 * most,), lost)
        yield Candidate(ReversedInput((), k))
    if m > 1:
        yield _ratio(InputGain((1.0,), None))
    for first, second in combinations(range(m), 2):
        yield Candidate(SwappedInputs((), first, second))
    yield Candidate(Delay((1.0,)), (0.0,), (8.0,), (0.2,), ((0.5,), (1.5,), (2.5,), (4.0,)))
    yield Candidate(Lag((1.0,)), (0.05,), (10.0,), (0.2,), ((0.5,), (1.5,), (4.0,)))


def _of_joints(plant: Plant, x: Array, u: Array, residuals: Array) -> Iterator[Candidate]:
    for joint in plant.ports:
        yield from _of_port(plant, joint, x, u, residuals)
    if isinstance(plant.model, MuJoCo):
        return
    rates = tuple(joint.rate for joint in plant.joints if joint.position is not None)
    for joint in plant.joints:
        yield _ratio(Inertia((1.0,), (joint,), plant.dt))
        if joint.position is not None:
            yield _ratio(Gravity((1.0,), (joint,), rates, plant.dt))
    if len(plant.joints) > 1:
        yield _ratio(Inertia((1.0,), plant.joints, plant.dt))
        if rates:
            yield _ratio(Gravity((1.0,), plant.joints, rates, plant.dt))


def _of_port(plant: Plant, joint: Joint, x: Array, u: Array, residuals: Array) -> Iterator[Candidate]:
    """Yield the forces that may enter at a place."""
    force = _typical_force(plant, joint, x, u, residuals)
    speed = float(np.sqrt((x[:, joint.rate] ** 2).mean()))
    if force <= 0 or speed <= 0:
        return

    def force_of(kind: type[Force], *sizes: float) -> Force:
        return kind(sizes, joint, 0.1 * force, plant.dt)

    most, least, slope = 20 * force, 0.1 * force, force / speed
    if joint.input is None or joint.dof is not None:  # otherwise it is an offset of the input
        yield Candidate(force_of(Bias, 0.0), (-most,), (most,), (least,), ((0.0,),))
    if joint.dof is None:
        yield Candidate(force_of(Viscous, 0.0), (-20 * slope,), (20 * slope,), (0.1 * slope,), ((0.0,),))
        yield Candidate(force_of(Coulomb, 0.0), (0.0,), (most,), (least,), ((0.3 * force,), (force,)))
    yield Candidate(
        force_of(Stribeck, 0.0, 0.0, 1.0),
        (0.0, 0.0, 0.01 * speed),
        (most, most, 2 * speed),
        (least, least, 0.1 * speed),
        ((0.5 * force, 0.5 * force, 0.3 * speed), (0.7 * force, 0.3 * force, 0.1 * speed)),
    )
    starts = ((0.05, 0.0), (0.2, 0.3 * force))
    yield Candidate(force_of(LoadFriction, 0.0, 0.0), (0.0, 0.0), (2.0, most), (0.05, least), starts)


def _typical_force(plant: Plant, joint: Joint, x: Array, u: Array, residuals: Array) -> float:
    """Return the force on a joint that has effects as large as what M misses of its rate."""
    probe = 0.1 * float(plant.commanded[joint.input]) if joint.input is not None and joint.dof is None else 1.0
    rows = slice(None, None, max(1, len(x) // 50))
    free = np.asarray(plant.model.step(x[rows], u[rows]))
    effects = Bias((1.0,), joint, probe, plant.dt).effect(plant.model, x[rows], u[rows], free)[:, joint.rate]
    effects = effects[np.isfinite(effects)]
    size = float(np.sqrt((effects**2).mean())) if len(effects) else 0.0
    return float(np.sqrt((residuals[:, joint.rate] ** 2).mean())) / size if size > 0 else 0.0


def _of_mujoco(plant: Plant, model: MuJoCo, residuals: Array) -> Iterator[Candidate]:
    compiled = model.compiled
    inertias = np.abs(np.diag(_mass_matrix(compiled)))
    for joint in plant.joints:
        if joint.dof is None:
            continue
        missed = float(np.sqrt((residuals[:, joint.rate] ** 2).mean()))
        if missed <= _NOTHING * plant.changes[joint.rate]:
            continue
        inertia = float(inertias[joint.dof])
        force = inertia * missed / plant.dt
        speed = max(float(plant.changes[joint.position or 0]) / plant.dt, 1e-9)
        for attribute, size in (("damping", force / speed), ("frictionloss", force), ("armature", inertia)):
            low = -float(getattr(compiled, f"dof_{attribute}")[joint.dof])
            starts = ((0.3 * size,), (size,)) if attribute == "frictionloss" else ((0.0,),)
            # More damping would make the integration unstable.
            most = min(20 * size, inertia / compiled.opt.timestep) if attribute == "damping" else 20 * size
            yield Candidate(JointAttribute((0.0,), attribute, joint), (low,), (most,), (0.05 * size,), starts)
    bodies = [body for body in range(1, compiled.nbody) if float(compiled.body_mass[body]) > 0]
    moved = [body for body in bodies if int(compiled.body_dofnum[body]) > 0 or int(compiled.body_parentid[body]) > 0]
    for body in sorted(moved, key=lambda each: -float(compiled.body_mass[each]))[:_MOST_BODIES]:
        yield _ratio(BodyMass((1.0,), body))
        extent = float(np.sqrt(compiled.body_inertia[body].max() / compiled.body_mass[body]))
        for axis in range(3):
            if extent > 0:
                yield Candidate(
                    MassCentre((0.0,), body, axis), (-3 * extent,), (3 * extent,), (0.05 * extent,), ((0.0,),)
                )


def _mass_matrix(compiled: object) -> Array:
    import mujoco

    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    whole = np.zeros((compiled.nv, compiled.nv))  # type: ignore[attr-defined]
    mujoco.mj_fullM(compiled, data, whole)
    return whole


def _of_sensors(plant: Plant, x: Array) -> Iterator[Candidate]:
    ranges = np.ptp(x, axis=0)
    groups = [
        (joint.rate,) if joint.position is None else (joint.position, joint.rate)
        for joint in plant.joints
        if joint.dof is None or joint.position is not None
    ]
    for group in groups:
        size = max(float(ranges[group[0]]), 1e-9)
        yield Candidate(SensorOffset((0.0,), group[0]), (-size,), (size,), (0.05 * size,), ((0.0,),))
        yield _ratio(SensorScale((1.0,), group))
    moving = [group for group in groups if ranges[group[0]] > 0]
    pairs = [group for group in moving if len(group) == len(moving[0])]
    for first, second in combinations(pairs, 2):
        yield Candidate(SwappedJoints((), first, second))
