"""Attributes of MuJoCo models as effects."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ctxval import models
from ctxval.learning import effects
from ctxval.learning.effects import Joint
from ctxval.learning.effects.effect import Observed
from ctxval.learning.effects.flow import Flow
from ctxval.learning.effects.plant import plant_of
from hinge import mjcf

pytest.importorskip("mujoco")

DT = 0.02


def test_a_changed_copy_leaves_the_model_as_it_is() -> None:
    model = models.MuJoCo(mjcf(), dt=DT)
    x, u = np.array([0.3, 1.0]), np.array([0.5])
    before = model.step(x, u)
    sticking = effects.JointAttribute((0.2,), "frictionloss", Joint(1, 0, 1.0, 0, 0)).model(model)
    np.testing.assert_array_equal(model.step(x, u), before)
    expected = models.MuJoCo(mjcf('frictionloss="0.2"'), dt=DT).step(x, u)
    np.testing.assert_allclose(sticking.step(x, u), expected, atol=1e-9)
    pushed = model.changed(forces=np.array([0.1])).step(x, u)
    np.testing.assert_allclose(pushed, model.step(x, np.array([0.6])), atol=1e-12)


def test_the_load_of_the_gears_is_what_the_motor_and_gravity_push_against() -> None:
    model, angles, torques = models.MuJoCo(mjcf(), dt=DT), np.array([0.4, -0.9, np.nan]), np.array([0.5, -0.2, 0.1])
    friction = effects.LoadFriction((0.5, 0.01), Joint(1, 0, 1.0, 0, 0), 0.1, DT)
    load = friction.load(Flow.of(model, np.stack([angles, 0 * angles], axis=-1), torques[:, None]))
    needed = 0.5 * 9.81 * 0.25 * np.sin(angles)  # to hold the link against gravity
    np.testing.assert_allclose(load, np.abs(torques + needed), rtol=1e-6)
    # A link at rest that friction can hold stays at rest.
    held = effects.LoadFriction((2.0, 0.0), friction.joint, 0.1, DT)
    repaired = effects.ModelWithEffects(model, (held,))
    np.testing.assert_allclose(repaired.step(np.array([0.4, 0.0]), np.array([0.5])), [0.4, 0.0], atol=1e-6)


def test_joints_and_units_are_those_of_the_model() -> None:
    rng, model = np.random.default_rng(0), models.MuJoCo(mjcf(), dt=DT)
    plant = plant_of(model, DT, {"x0": "", "x1": ""}, {"u0": ""}, rng.normal(size=(9, 2)), rng.normal(size=(9, 1)))
    (joint,) = plant.joints
    assert (joint.position, joint.rate, joint.input, joint.dof) == (0, 1, 0, 0)
    assert (plant.joint_name(joint), plant.force_unit(joint), plant.rate_unit(joint)) == ("hinge", "N m", "rad/s")
    assert effects.InputGain((0.5,), 0).repair(plant) == {"mjcf": '<motor name="motor" gear="0.5"/>'}


WALKER = """<mujoco><worldbody><geom type="plane" size="9 9 1" friction="0.5"/>
<body pos="0 0 1"><joint name="root" type="slide" axis="1 0 0"/><geom size="0.1" friction="0.8" mass="2"/>
<body><joint name="hip" axis="0 1 0" damping="0.2" armature="0.1"/><geom size="0.05" pos="0 0 -0.3" mass="1"/>
<body pos="0 0 -0.3"><joint name="knee" axis="0 1 0" damping="0.4"/><geom size="0.05" pos="0 0 -0.3" mass="1"/></body>
</body></body></worldbody>
<actuator><motor joint="hip"/><motor joint="knee"/></actuator></mujoco>"""


def test_an_attribute_of_many_elements_is_one_effect() -> None:
    rng, model = np.random.default_rng(0), models.MuJoCo(WALKER, uncertain={"damping[*]": "20 %", "mass[*]": "20 %"})
    x, u = 0.1 * rng.normal(size=(9, 6)), rng.normal(size=(9, 2))
    plant = plant_of(model, model.dt, {f"x{i}": "" for i in range(6)}, {"u0": "", "u1": ""}, x, u)
    observed = Observed(plant, x, u, np.ones(6), 1.0, False)
    shared = [each.effect for each in effects.SharedAttribute.candidates(observed)]
    found = {each.parameter: each for each in shared if isinstance(each, effects.SharedAttribute)}
    # Stiffness is 0; a mass has an effect of its own.
    wanted = {"armature", "damping", "damping[*]", "friction", "frictionloss", "gravity_x", "gravity_y"}
    assert set(found) == wanted

    def changed(name: str, size: float) -> Any:
        return found[name].with_sizes([size]).model(model).compiled  # type: ignore[attr-defined]

    assert changed("friction", 0.5).geom_friction[:2, 0].tolist() == pytest.approx([0.25, 0.4])
    assert changed("damping", 2.0).dof_damping.tolist() == pytest.approx([0, 0.4, 0.8])
    assert changed("armature", 1.3).dof_armature.tolist() == pytest.approx([0, 0.13, 0])
    # Nothing is added to the joint of the floating base.
    assert changed("frictionloss", 0.3).dof_frictionloss.tolist() == pytest.approx([0, 0.3, 0.3])
    assert changed("gravity_x", 0.7).opt.gravity.tolist() == pytest.approx([0.7, 0, -9.81])
    assert model.compiled.opt.gravity[0] == 0
    assert "4.1 degrees" in found["gravity_x"].with_sizes([0.7]).sentence(plant)
