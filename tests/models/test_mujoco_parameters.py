"""Uncertain parameters of models of MuJoCo: draws are the models that changed fields make."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ctxval import models
from ctxval.errors import InputError
from facts import refuses

ARM = """
<mujoco>
  <option timestep="0.005" gravity="0 0 -9.81"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -0.35" friction="0.5"/>
    <body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1" armature="0.01" stiffness="2"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="1"/>
      <body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="0.05"/>
        <geom name="hand" type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.5"/></body></body>
  </worldbody>
  <actuator><position name="s" joint="shoulder" kp="20" kv="1"/><motor name="e" joint="elbow" gear="2"/></actuator>
</mujoco>"""


def _scaled(name: str, *at: Any) -> Callable[[Any, float], None]:
    def change(model: Any, z: float) -> None:
        getattr(model, name)[at] *= np.exp(0.2 * z)

    return change


def _mass(model: Any, z: float) -> None:
    model.body_mass[1] *= np.exp(0.2 * z)
    model.body_inertia[1] *= np.exp(0.2 * z)


def _gain(model: Any, z: float) -> None:
    model.actuator_gainprm[0, 0] *= np.exp(0.2 * z)
    model.actuator_biasprm[0, 1:3] *= np.exp(0.2 * z)


def _loss(model: Any, z: float) -> None:
    model.dof_frictionloss[:] = np.maximum(0.3 * z, 0.0)


def _slope(model: Any, z: float) -> None:
    model.opt.gravity[0] += 0.5 * z


@pytest.mark.parametrize(
    ("name", "deviation", "change"),
    [
        ("friction", "20 %", _scaled("geom_friction", slice(None), 0)),
        ("friction[floor]", "20 %", _scaled("geom_friction", 0, 0)),
        ("damping[el*]", "20 %", _scaled("dof_damping", 1)),
        ("armature", "20 %", _scaled("dof_armature", slice(None))),
        ("stiffness[shoulder]", "20 %", _scaled("jnt_stiffness", 0)),
        ("mass[upper]", "20 %", _mass),
        ("gain[s]", "20 %", _gain),
        ("frictionloss", 0.3, _loss),
        ("gravity_x", 0.5, _slope),
    ],
)
def test_a_draw_is_the_model_with_changed_fields(
    name: str, deviation: float | str, change: Callable[[Any, float], None]
) -> None:
    model, rng = models.MuJoCo(ARM, dt=0.02, uncertain={name: deviation}), np.random.default_rng(0)
    z, x, u = np.array([[0.0], [1.3], [-0.7]]), rng.normal(size=(3, 2, 4)), rng.normal(size=(3, 2, 2))
    drawn = model.drawn(z)
    memory = drawn.start(x)
    once, memory = drawn.advance(x, u, memory)
    twice, _ = drawn.advance(once, u, memory)
    for k, value in enumerate(z[:, 0].tolist()):
        alone = model.changed(lambda compiled, value=value: change(compiled, value))
        expected, known = alone.advance(x[k], u[k], alone.start(x[k]))
        np.testing.assert_allclose(once[k], expected, rtol=0, atol=1e-13)
        np.testing.assert_allclose(twice[k], alone.advance(expected, u[k], known)[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(drawn.step(x, u)[0], model.step(x[0], u[0]), rtol=0, atol=1e-13)
    assert np.abs(once[1] - once[0]).max() > 0 or name.startswith("friction")  # nothing may touch the floor


@pytest.mark.parametrize(
    ("uncertain", "facts"),
    [
        ({"weight": "10 %"}, ("weight",)),
        ({"mass[leg]": "10 %"}, ("mass[leg]", "upper")),
        ({"mass": 0.3}, ("mass", 0.3)),
        ({"frictionloss": "10 %"}, ("frictionloss",)),
    ],
)
def test_other_names_and_deviations_are_refused(uncertain: dict[str, float | str], facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        models.MuJoCo(ARM, uncertain=uncertain)


FREE = """<mujoco><option timestep="0.005"/><worldbody><body name="ball" pos="0 0 1"><freejoint/>
<geom type="box" size=".1 .05 .03" mass="1"/></body></worldbody></mujoco>"""


def test_the_centre_of_mass_of_a_body_that_mujoco_takes_as_simple_can_move() -> None:
    plain = models.MuJoCo(FREE)
    assert plain.compiled.body_simple[1] == 1
    heavier = plain.changed(lambda compiled: compiled.body_mass.__setitem__(1, 2.0))
    x, u = np.zeros((1, 13)), np.zeros((1, 0))
    x[0, 3], x[0, 10] = 1.0, 3.0  # turns about its axis x

    def shift(compiled: Any) -> None:
        compiled.body_ipos[1, 1] += 0.02

    moved, alone = heavier.changed(shift), plain.changed(shift)
    assert moved.compiled.body_mass[1] == 2.0
    assert moved.compiled.body_simple[1] == 0
    assert np.abs(alone.step(x, u) - plain.step(x, u)).max() > 1e-4
    drawn = models.MuJoCo(FREE, uncertain={"centre_y": 0.02}).drawn(np.ones((1, 1)))
    np.testing.assert_allclose(drawn.step(x[None], u[None])[0], alone.step(x, u), atol=1e-12)
