"""Uncertain parameters of MuJoCo models, found with contacts and beside attributes that no parameter is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ctxval import models
from ctxval.core.model import run_of
from ctxval.core.trajectory import Trajectory
from ctxval.learning.effects import SharedAttribute
from ctxval.learning.effects.mujoco import further_attributes
from ctxval.learning.effects.uncertain import UncertainEffects
from ctxval.learning.parameter_posterior import Known, ParameterMode, ParameterSettings, most_probable

pytest.importorskip("mujoco")

DT = 0.02
ARM = """<mujoco><option timestep="0.005" integrator="implicitfast"/>
<default><joint axis="0 1 0" damping="0.3" armature="0.02"/><geom contype="0" conaffinity="0"/></default>
<worldbody><body><joint name="upper"/><geom type="capsule" size=".03" fromto="0 0 0 0 0 -.4" mass="1"/>
<body pos="0 0 -.4"><joint name="lower"/><geom type="capsule" size=".03" fromto="0 0 0 0 0 -.3" mass=".5"/>
<body name="hand" pos="0 0 -.3"><geom size=".03" mass=".3"/></body></body></body></worldbody>
<actuator><motor joint="upper"/><motor joint="lower"/></actuator></mujoco>"""
BOX = """<mujoco><option timestep="0.005" cone="elliptic" integrator="implicitfast"/>
<worldbody><geom type="plane" size="2 2 .1" friction=".4 .005 .0001"/>
<body name="box" pos="0 0 .03"><freejoint/>
<geom type="box" size=".05 .05 .03" mass=".3" friction=".4 .005 .0001"/></body>
<body name="finger" pos="-.09 0 .03"><joint name="x" type="slide" axis="1 0 0" damping="5"/>
<geom type="sphere" size=".015" mass=".5" friction=".3 .005 .0001"/></body></worldbody>
<contact><exclude body1="finger" body2="world"/></contact><actuator><motor joint="x"/></actuator></mujoco>"""
SETTINGS = ParameterSettings()


def executed(model: Any, x: np.ndarray, inputs: np.ndarray) -> Trajectory:
    """Return an execution with given inputs ``(H, m)``."""
    step, states = run_of(model, x), [x]
    for u in inputs:
        states.append(step(states[-1], u))
    return Trajectory(DT * np.arange(len(states)), np.array(states), inputs)


def values(mode: ParameterMode) -> dict[str, float]:
    """Return the most probable parameters by their names."""
    return {each.name: float(each.at(z)) for each, z in zip(mode.model.uncertain, mode.z, strict=True)}


@pytest.mark.parametrize(("name", "true"), [("frictionloss", 0.2), ("armature", 3.0)])
def test_an_attribute_beside_the_parameters_is_found_with_them(name: str, true: float) -> None:
    model = models.MuJoCo(ARM, dt=DT, uncertain={"mass[hand]": "30 %", "damping": "30 %"})

    def change(compiled: Any) -> None:
        compiled.body("hand").mass *= 1.4
        compiled.body("hand").inertia *= 1.4
        if name == "armature":
            compiled.dof_armature[:] *= true
        else:
            compiled.dof_frictionloss[:] += true

    inputs = np.random.default_rng(0).normal(0, 1.5, (50, 2)).cumsum(axis=0) * 0.4
    run = executed(model.changed(change), np.zeros(4), inputs)
    candidates = further_attributes(model, [run])
    assert "damping" not in {each.parameters[0].name for each in candidates}  # it is a parameter of M
    mode = most_probable(model, [run], candidates, None, np.random.default_rng(0), SETTINGS)
    assert mode is not None
    assert isinstance(mode.model, UncertainEffects)
    assert values(mode) == pytest.approx({"mass[hand]": 1.4, "damping": 1.0, name: true}, rel=0.02)
    # Draws of what is found run in one batch, each as the changed model.
    (effect,) = [each.effect for each in mode.model.effects]
    assert isinstance(effect, SharedAttribute)
    drawn = mode.model.drawn(np.stack([mode.z, mode.z + 0.1]))
    x, u = np.tile(run.states[5], (2, 1, 1)), np.tile(run.inputs[5], (2, 1, 1))
    for k, z in enumerate((mode.z, mode.z + 0.1)):
        size = float(mode.model.uncertain[2].at(z[2]))
        alone = effect.with_sizes([size]).model(model).drawn(z[None, :2])  # type: ignore[attr-defined]
        np.testing.assert_allclose(drawn.step(x, u)[k], alone.step(x[:1], u[:1])[0], atol=1e-9)


def pushed(true: Any) -> list[Trajectory]:
    """Return two pushes of the box."""
    runs = []
    for angle in (-0.2, 0.3):
        x = np.zeros(15)
        x[2], x[3], x[6] = 0.03, np.cos(angle / 2), np.sin(angle / 2)
        runs.append(executed(true, x, np.full((25, 1), 3.0)))
    return runs


def test_parameters_of_contacts_are_found_from_single_steps_and_all_of_the_prior() -> None:
    model = models.MuJoCo(BOX, dt=DT, uncertain={"friction": "20 %", "mass[box]": "20 %", "damping": "20 %"})

    def change(compiled: Any) -> None:
        compiled.geom_friction[:, 0] *= 0.85
        compiled.body("box").mass *= 1.2
        compiled.body("box").inertia *= 1.2

    mode = most_probable(model, pushed(model.changed(change)), (), None, np.random.default_rng(0), SETTINGS)
    assert mode is not None
    assert mode.left < 1e-3
    assert values(mode) == pytest.approx({"friction": 0.85, "mass[box]": 1.2, "damping": 1.0}, rel=0.01)


def test_a_shift_of_a_centre_of_mass_is_found_with_the_friction_of_contacts() -> None:
    model = models.MuJoCo(BOX, dt=DT, uncertain={"friction": "20 %", "mass[box]": "20 %"})

    def change(compiled: Any) -> None:
        compiled.geom_friction[:, 0] *= 0.85
        compiled.body("box").ipos[0] += 0.012

    runs = pushed(model.changed(change))
    candidates = [each for each in further_attributes(model, runs) if each.parameters[0].name == "centre of mass"]
    assert len(candidates) == 3
    mode = most_probable(model, runs, candidates[:2], None, np.random.default_rng(0), SETTINGS)
    assert mode is not None
    assert isinstance(mode.model, UncertainEffects)
    assert [vars(each.effect)["parameter"] for each in mode.model.effects] == ["centre_x[box]"]
    assert values(mode) == pytest.approx({"friction": 0.85, "mass[box]": 1.0, "centre of mass": 0.012}, rel=0.01)


def test_what_fewer_executions_told_is_where_the_next_fit_begins() -> None:
    model = models.MuJoCo(BOX, dt=DT, uncertain={"friction": "20 %", "mass[box]": "20 %"})

    def change(compiled: Any) -> None:
        compiled.geom_friction[:, 0] *= 0.85
        compiled.body("box").mass *= 1.2
        compiled.body("box").inertia *= 1.2

    rng, known = np.random.default_rng(0), Known(np.log([0.851, 1.2]) / 0.2)
    # Nothing else is afforded, and Gauss-Newton steps from the prior's mean end elsewhere.
    runs = pushed(model.changed(change))
    alone, near = (most_probable(model, runs, (), each, rng, SETTINGS, lambda steps: False) for each in (None, known))
    assert alone is not None
    assert near is not None
    assert near.left < 1e-3 < alone.left
    assert values(near) == pytest.approx({"friction": 0.85, "mass[box]": 1.2}, rel=0.01)
