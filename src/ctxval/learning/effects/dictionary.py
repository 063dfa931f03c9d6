"""The dictionary of effects of a plant, with bounds of their sizes."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from ctxval._util.arrays import Array
from ctxval.learning.effects.backlash import Backlash
from ctxval.learning.effects.bias import Bias, InputOffset
from ctxval.learning.effects.dead_zone import DeadZone
from ctxval.learning.effects.effect import EffectCandidate, of_ratio, of_size
from ctxval.learning.effects.flow import Flow
from ctxval.learning.effects.friction import Coulomb, LoadFriction, Stribeck, Viscous
from ctxval.learning.effects.gain import InputGain, ReversedInput, SwappedInputs
from ctxval.learning.effects.gravity import Gravity
from ctxval.learning.effects.inertia import Inertia
from ctxval.learning.effects.mujoco import of_mujoco
from ctxval.learning.effects.plant import Joint, Plant
from ctxval.learning.effects.saturation import Saturation
from ctxval.learning.effects.sensor import of_sensors
from ctxval.learning.effects.time_step import TimeStep
from ctxval.learning.effects.transport import Delay, Lag
from ctxval.models import MuJoCo


def of_inputs(plant: Plant) -> Iterator[EffectCandidate]:
    """Yield what may be wrong with inputs."""
    m = len(plant.inputs)
    for k, most in enumerate(plant.commanded.tolist()):
        yield of_ratio(InputGain((1.0,), k))
        yield of_size(InputOffset((0.0,), k), -2 * most, 2 * most, 0.05 * most, 0.0)
        limits = (share * most for share in (0.9, 0.7, 0.5, 0.3, 0.1, 0.03, 0.01))
        yield of_size(Saturation((most,), k), 1e-3 * most, most, 0.05 * most, *limits)
        for kind in (DeadZone, Backlash):
            yield of_size(kind((0.0,), k), 0.0, most, 0.02 * most, *(share * most for share in (0.01, 0.05, 0.15)))
        yield EffectCandidate(ReversedInput((), k))
    if m > 1:
        yield of_ratio(InputGain((1.0,), None))
    for first, second in combinations(range(m), 2):
        yield EffectCandidate(SwappedInputs((), first, second))
    for held in (True, False) if plant.compiled is None else (True,):  # parts of steps of MuJoCo cost more
        yield of_size(Delay((1.0,), held), 0.0, 8.0, 0.2, 0.5, 1.5, 2.5, 4.0)
        yield of_size(Lag((1.0,), held), 0.05, 10.0, 0.2, 0.5, 1.5, 4.0)


def forces(plant: Plant, joint: Joint, x: Array, u: Array, missed: Array) -> Iterator[EffectCandidate]:
    """Yield the forces that may enter at a place, in sizes whose effects are as large as what M misses of its rate."""
    probe = 0.1 * float(plant.commanded[joint.input]) if joint.input is not None and joint.dof is None else 1.0
    rows = slice(None, None, max(1, len(x) // 50))
    effects = Bias((1.0,), joint, probe, plant.dt).drive(Flow.of(plant.model, x[rows], u[rows]))[:, joint.rate]
    effects = effects[np.isfinite(effects)]
    size = float(np.sqrt((effects**2).mean())) if len(effects) else 0.0
    force = float(missed[joint.rate]) / size if size > 0 else 0.0
    speed = float(np.sqrt((x[:, joint.rate] ** 2).mean()))
    if force <= 0 or speed <= 0:
        return
    where = joint, 0.1 * force, plant.dt
    most, least, slope = 20 * force, 0.1 * force, force / speed
    if joint.input is None or joint.dof is not None:  # otherwise it is an offset of the input
        yield of_size(Bias((0.0,), *where), -most, most, least, 0.0)
    if joint.dof is None:
        yield of_size(Viscous((0.0,), *where), -20 * slope, 20 * slope, 0.1 * slope, 0.0)
        yield of_size(Coulomb((0.0,), *where), 0.0, most, least, 0.3 * force, force)
    yield EffectCandidate(
        Stribeck((0.0, 0.0, 1.0), *where),
        (0.0, 0.0, 0.01 * speed),
        (most, most, 2 * speed),
        (least, least, 0.1 * speed),
        ((0.5 * force, 0.5 * force, 0.3 * speed), (0.7 * force, 0.3 * force, 0.1 * speed)),
    )
    starts = ((0.05, 0.0), (0.2, 0.3 * force))
    rates = tuple(dict.fromkeys(port.rate for port in plant.ports if port.input is not None))
    yield EffectCandidate(LoadFriction((0.0, 0.0), *where, rates), (0.0, 0.0), (2.0, most), (0.05, least), starts)


def of_joints(plant: Plant) -> Iterator[EffectCandidate]:
    """Yield what may be wrong with joints of a model that is not of MuJoCo."""
    # The joints have positions, all or none.
    rates = tuple(joint.rate for joint in plant.joints if joint.position is not None)
    together = [plant.joints] if len(plant.joints) > 1 else []
    for joints in (*((joint,) for joint in plant.joints), *together):
        yield of_ratio(Inertia((1.0,), joints, plant.dt))
        if rates:
            yield of_ratio(Gravity((1.0,), joints, rates, plant.dt))


def candidates(plant: Plant, x: Array, u: Array, residuals: Array, *, outputs: bool) -> tuple[EffectCandidate, ...]:
    """Return the dictionary of a plant for recorded states and inputs, and what M misses of next states ``(N, n)``."""
    missed = np.sqrt([(column**2).mean() for column in residuals.T])
    return (
        *of_inputs(plant),
        *(candidate for joint in plant.ports for candidate in forces(plant, joint, x, u, missed)),
        *(of_mujoco(plant, missed) if isinstance(plant.model, MuJoCo) else of_joints(plant)),
        of_size(TimeStep((1.0,)), 0.2, 5.0, 0.1, 0.5, 0.95, 1.05, 2.0),
        *(() if outputs else of_sensors(plant, x)),  # states that are estimated have no sensors
    )
