"""The dictionary: the causes that a plant's error may have, with the range and the first guesses of their sizes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.models import MuJoCo
from ctxval.studies.causes import mechanics, signals
from ctxval.studies.causes.cause import Cause, Joint, Plant


@dataclass(frozen=True)
class Candidate(ShortRepr):
    """A cause whose sizes are to be fitted."""

    cause: Cause
    low: tuple[float, ...] = ()  #: bounds of the sizes
    high: tuple[float, ...] = ()
    scales: tuple[float, ...] = ()  #: changes of the sizes that matter, for the steps of the fit
    starts: tuple[tuple[float, ...], ...] = ((),)  #: first guesses, of which the best one is refined


def _of_size(cause: Cause, low: float, high: float, scale: float, *starts: float) -> Candidate:
    return Candidate(cause, (low,), (high,), (scale,), tuple((start,) for start in starts))


def _ratio(cause: Cause) -> Candidate:
    return _of_size(cause, 0.1, 10.0, 0.1, 0.95, 1.1)


def candidates(plant: Plant, x: Array, u: Array, residuals: Array, *, outputs: bool) -> tuple[Candidate, ...]:
    """Return the dictionary of a plant for recorded states and inputs, and what M misses of next states ``(N, n)``."""
    missed = np.sqrt([(column**2).mean() for column in residuals.T])
    return (
        *_of_inputs(plant),
        *(candidate for joint in plant.ports for candidate in _forces(plant, joint, x, u, missed)),
        *(_of_mujoco(plant, missed) if isinstance(plant.model, MuJoCo) else _of_joints(plant)),
        _of_size(mechanics.TimeStep((1.0,)), 0.2, 5.0, 0.1, 0.95, 1.05),
        *(() if outputs else _of_sensors(plant, x)),  # states that are estimated have no sensors
    )


def _of_inputs(plant: Plant) -> Iterator[Candidate]:
    m = len(plant.inputs)
    for k, most in enumerate(plant.commanded.tolist()):
        yield _ratio(signals.InputGain((1.0,), k))
        yield _of_size(signals.InputOffset((0.0,), k), -2 * most, 2 * most, 0.05 * most, 0.0)
        limits = (share * most for share in (0.9, 0.7, 0.5, 0.3, 0.1, 0.03, 0.01))
        yield _of_size(signals.Saturation((most,), k), 1e-3 * most, most, 0.05 * most, *limits)
        for kind in (signals.DeadZone, signals.Backlash):
            yield _of_size(kind((0.0,), k), 0.0, most, 0.02 * most, *(share * most for share in (0.01, 0.05, 0.15)))
        yield Candidate(signals.ReversedInput((), k))
    if m > 1:
        yield _ratio(signals.InputGain((1.0,), None))
    for first, second in combinations(range(m), 2):
        yield Candidate(signals.SwappedInputs((), first, second))
    yield _of_size(signals.Delay((1.0,)), 0.0, 8.0, 0.2, 0.5, 1.5, 2.5, 4.0)
    yield _of_size(signals.Lag((1.0,)), 0.05, 10.0, 0.2, 0.5, 1.5, 4.0)


def _of_joints(plant: Plant) -> Iterator[Candidate]:
    # The joints have positions, all or none.
    rates = tuple(joint.rate for joint in plant.joints if joint.position is not None)
    together = [plant.joints] if len(plant.joints) > 1 else []
    for joints in (*((joint,) for joint in plant.joints), *together):
        yield _ratio(mechanics.Inertia((1.0,), joints, plant.dt))
        if rates:
            yield _ratio(mechanics.Gravity((1.0,), joints, rates, plant.dt))


def _forces(plant: Plant, joint: Joint, x: Array, u: Array, missed: Array) -> Iterator[Candidate]:
    """Yield the forces that may enter at a place, in sizes whose effects are as large as what M misses of its rate."""
    probe = 0.1 * float(plant.commanded[joint.input]) if joint.input is not None and joint.dof is None else 1.0
    rows = slice(None, None, max(1, len(x) // 50))
    free = np.asarray(plant.model.step(x[rows], u[rows]))
    unit = mechanics.Bias((1.0,), joint, probe, plant.dt)
    effects = unit.effect(plant.model, x[rows], u[rows], free)[:, joint.rate]
    effects = effects[np.isfinite(effects)]
    size = float(np.sqrt((effects**2).mean())) if len(effects) else 0.0
    force = float(missed[joint.rate]) / size if size > 0 else 0.0
    speed = float(np.sqrt((x[:, joint.rate] ** 2).mean()))
    if force <= 0 or speed <= 0:
        return
    where = joint, 0.1 * force, plant.dt
    most, least, slope = 20 * force, 0.1 * force, force / speed
    if joint.input is None or joint.dof is not None:  # otherwise it is an offset of the input
        yield _of_size(mechanics.Bias((0.0,), *where), -most, most, least, 0.0)
    if joint.dof is None:
        yield _of_size(mechanics.Viscous((0.0,), *where), -20 * slope, 20 * slope, 0.1 * slope, 0.0)
        yield _of_size(mechanics.Coulomb((0.0,), *where), 0.0, most, least, 0.3 * force, force)
    yield Candidate(
        mechanics.Stribeck((0.0, 0.0, 1.0), *where),
        (0.0, 0.0, 0.01 * speed),
        (most, most, 2 * speed),
        (least, least, 0.1 * speed),
        ((0.5 * force, 0.5 * force, 0.3 * speed), (0.7 * force, 0.3 * force, 0.1 * speed)),
    )
    starts = ((0.05, 0.0), (0.2, 0.3 * force))
    rates = tuple(dict.fromkeys(port.rate for port in plant.ports if port.input is not None))
    yield Candidate(mechanics.LoadFriction((0.0, 0.0), *where, rates), (0.0, 0.0), (2.0, most), (0.05, least), starts)


def _of_mujoco(plant: Plant, missed: Array) -> Iterator[Candidate]:
    import mujoco

    compiled = plant.compiled
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    inertias = np.zeros((compiled.nv, compiled.nv))
    mujoco.mj_fullM(compiled, data, inertias)
    for joint in plant.joints:
        if missed[joint.rate] <= 1e-6 * plant.changes[joint.rate]:  # the joint has no fault
            continue
        inertia = float(np.abs(inertias[joint.dof, joint.dof]))
        force = inertia * float(missed[joint.rate]) / plant.dt
        speed = max(float(plant.changes[joint.position]) / plant.dt, 1e-9)
        for attribute, size in (("damping", force / speed), ("frictionloss", force), ("armature", inertia)):
            low = -float(getattr(compiled, f"dof_{attribute}")[joint.dof])
            starts = (0.3 * size, size) if attribute == "frictionloss" else (0.0,)
            # More damping would make the integration unstable.
            most = min(20 * size, inertia / compiled.opt.timestep) if attribute == "damping" else 20 * size
            cause = mechanics.JointAttribute((0.0,), attribute, joint)
            yield _of_size(cause, low, most, 0.05 * size, *starts)
    masses = compiled.body_mass
    moved = (compiled.body_dofnum > 0) | (compiled.body_parentid > 0)
    bodies = [body for body in range(1, compiled.nbody) if masses[body] > 0 and moved[body]]
    for body in sorted(bodies, key=lambda each: -float(masses[each]))[:8]:
        yield _ratio(mechanics.BodyMass((1.0,), body))
        extent = float(np.sqrt(compiled.body_inertia[body].max() / masses[body]))
        for axis in range(3 if extent > 0 else 0):
            moved_centre = mechanics.MassCentre((0.0,), body, axis)
            yield _of_size(moved_centre, -3 * extent, 3 * extent, 0.05 * extent, 0.0)


def _of_sensors(plant: Plant, x: Array) -> Iterator[Candidate]:
    ranges = np.ptp(x, axis=0)
    groups = [(joint.rate,) if joint.position is None else (joint.position, joint.rate) for joint in plant.joints]
    for group in groups:
        size = max(float(ranges[group[0]]), 1e-9)
        yield _of_size(signals.SensorOffset((0.0,), group[0]), -size, size, 0.05 * size, 0.0)
        yield _ratio(signals.SensorScale((1.0,), group))
    moving = [group for group in groups if ranges[group[0]] > 0]
    pairs = [group for group in moving if len(group) == len(moving[0])]
    for first, second in combinations(pairs, 2):
        yield Candidate(signals.SwappedJoints((), first, second))
