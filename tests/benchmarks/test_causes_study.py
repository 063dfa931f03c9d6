"""The study of causes: its robots do what their models do unless they have a fault, and its page counts rightly."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("gymnasium")
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import causes_page
from causes_robots import DEVELOPMENT, REPORTING
from causes_systems import Fault, faults_of, foreign_of
from ctxval.learning import effects
from rig_thorough import some
from study_causes import is_right, size_error

ROBOTS = {**DEVELOPMENT, **REPORTING}


@pytest.mark.slow
@pytest.mark.parametrize("name", some(ROBOTS, 12))
def test_a_robot_without_a_fault_does_what_its_model_does(name: str) -> None:
    validation = ROBOTS[name].experiment(Fault("none"), 0.0, 0).validation
    plan = validation.plan(0.3 * validation.space.low + 0.7 * validation.space.high)
    assert validation.measure(plan, validation.execute(plan)) < 2e-3
    faulty = ROBOTS[name].experiment(Fault("input gain", 0, (0.5,)), 0.0, 0).validation
    assert faulty.measure(plan, faulty.execute(plan)) > 3e-3


def test_faults_are_seeded_and_of_different_kinds() -> None:
    for robot in ROBOTS.values():
        kinds = [fault.kind for fault in faults_of(robot)]
        assert len(kinds) == len(set(kinds)) == 10
        assert faults_of(robot) == faults_of(robot)
        assert all(fault.foreign for fault in foreign_of(robot))


def test_a_cause_is_right_only_at_its_place() -> None:
    arm = REPORTING["arm"]
    joint = effects.Joint(rate=2, position=0, input=0)
    assert is_right(arm, Fault("Coulomb friction", 0, (1.0,)), effects.Coulomb((1.05,), joint))
    assert not is_right(arm, Fault("Coulomb friction", 1, (1.0,)), effects.Coulomb((1.05,), joint))
    assert not is_right(arm, Fault("viscous friction", 0, (1.0,)), effects.Coulomb((1.05,), joint))
    assert size_error(arm, Fault("Coulomb friction", 0, (1.0,)), effects.Coulomb((1.05,), joint)) == pytest.approx(0.05)
    assert size_error(arm, Fault("input gain", 0, (0.8,)), effects.InputGain((0.78,), 0)) == pytest.approx(0.1)


def test_a_weight_that_is_a_constant_force_is_a_bias() -> None:
    quadrotor, fault = REPORTING["quadrotor"], Fault("gravity", 1, (1.2,))
    bias = effects.Bias((-1.9,), effects.Joint(rate=4, position=1))
    assert is_right(quadrotor, fault, bias)
    assert size_error(quadrotor, fault, bias) == pytest.approx(1 - 1.9 / (0.2 * 9.81))
    assert not is_right(REPORTING["arm"], Fault("gravity", 0, (1.2,)), effects.Bias((-1.9,), effects.Joint(rate=2)))


def test_the_page_is_that_of_the_stored_results() -> None:
    assert causes_page.PAGE.read_text().partition(causes_page.MARK)[2].strip() == causes_page.section().strip()


def test_what_counts() -> None:
    known = {"foreign": False, "named": True, "in_group": True, "rank": 1, "size_error": 0.2}
    missed = {**known, "named": False, "rank": 3}
    foreign = {**known, "foreign": True, "named": False}
    assert causes_page.counts([known, missed, foreign]) == {
        "faults": 2, "first": 1, "three": 2, "sized": 0, "foreign": 1, "none": 1,
    }  # fmt: skip
