"""Causes in MuJoCo models, with the lines of MJCF that repair them."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import Campaign, Parameters, Task, TaskSpace, Validation, controllers, distances, models, searches, systems
from ctxval.studies.causes import CauseReport, find_causes
from hinge import mjcf
from rig_thorough import more

pytest.importorskip("mujoco")

DT = 0.02


def reach(p: Parameters) -> Task:
    return Task(np.stack([p.start, 0 * p.start], axis=-1), goal=[p.goal, 0.0], horizon=15, dt=DT)


def report(true: str, most: int = 1, **uncertain: float | str) -> CauseReport:
    validation = Validation(
        space=TaskSpace(goal=(-1.0, 1.0, "rad"), start=(-0.5, 0.5, "rad")),
        task=reach,
        system=systems.Simulated(models.MuJoCo(true, dt=DT)),
        model=models.MuJoCo(mjcf(), dt=DT, uncertain=uncertain),
        synthesizer=controllers.PID(4.0, 0.0, 0.4),
        distance=distances.MaximumDeviation(components=(0,)),
    )
    return find_causes(Campaign(validation, search=searches.by_name("random"), seed=0).run(3), most=most)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("true", "line", "says"),
    [
        (mjcf(mass=0.7), "<inertial ", "Link has a mass of 0.7 kg and not of 0.5 kg"),
        *more(
            (mjcf('frictionloss="0.2"'), '<joint name="hinge" frictionloss="0.2"/>', "Hinge sticks (0.2 N m)"),
            (mjcf('armature="0.03"'), '<joint name="hinge" armature="0.03"/>', "more inertia of the rotor"),
        ),
    ],
)
def test_the_attribute_that_differs_is_found(true: str, line: str, says: str) -> None:
    found = report(true)
    assert found.named
    assert says.lower() in found.sentence.lower()
    assert any(each.startswith(line) for each in found.mjcf)


def test_uncertain_parameters_that_differ_are_causes_with_what_is_found_beside_them() -> None:
    found = report(mjcf('frictionloss="0.1"', mass=0.7), most=2, mass="30 %", damping=0.1)
    assert found.named
    assert [type(cause).__name__ for cause in found.causes] == ["SharedAttribute", "SharedAttribute"]
    sizes = {cause.parameter: cause.sizes[0] for cause in found.causes}  # type: ignore[attr-defined]
    assert sizes == pytest.approx({"mass": 1.4, "frictionloss": 0.1}, rel=0.02)
