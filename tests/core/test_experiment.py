"""An experiment warns if its distance adds states of different units."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Experiment, Task, TaskSpace, distances, systems
from ctxval.core.experiment import UnitsWarning
from facts import assert_names, warns

LABELS = ("angle [rad]", "rate [rad/s]")


def test_states_of_different_units_without_weights_are_warned_of() -> None:
    with warns(UnitsWarning, "rad", "rad/s", "scales"):
        Experiment("x", make_validation(), states=LABELS)


def test_the_units_of_the_system_count_if_the_experiment_names_none() -> None:
    rig = systems.Manual(states={"angle": "rad", "rate": "rad/s"}, inputs={"torque": "N m"}, dt=0.02)
    with pytest.warns(UnitsWarning):
        Experiment("x", make_validation(system=rig))


@pytest.mark.parametrize(
    "distance",
    [
        distances.FinalState(scales=[0.05, 0.5]),
        distances.FinalState(weights=[1, 1]),
        distances.FinalState(components=[0]),
        distances.RelativeDeviation(least=[0.1, 0.1]),
        distances.CrossingTime(),
        lambda model, system, task: 0.0,
    ],
)
def test_comparable_states_give_no_warning(distance: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Experiment("x", make_validation(distance=distance), states=LABELS)


def test_a_distance_in_another_unit_than_its_states_is_warned_of() -> None:
    distance = distances.FinalState(components=[0])
    with warns(UnitsWarning, "rad", "deg"):
        Experiment("x", make_validation(distance=distance), states=LABELS, units="deg")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Experiment("x", make_validation(distance=distance), states=LABELS, units="rad")
        scaled = distances.FinalState(components=[0], scales=[0.1])
        Experiment("x", make_validation(distance=scaled), states=LABELS, units="1")


@pytest.mark.parametrize("labels", [(), ("angle", "rate"), ("a [rad]", "b [rad]"), ("a [rad]", "b")])
def test_without_different_units_there_is_no_warning(labels: tuple[str, ...]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Experiment("x", make_validation(), states=labels)


def _swing(convert: float) -> Any:
    space = TaskSpace(lean=(-30, 30, "deg"), goal=(-1, 1, "rad"))
    return make_validation().with_parts(
        space=space, task=lambda p: Task([convert * p.lean, 0], goal=[-p.goal, 0], horizon=3, dt=0.1)
    )


def test_a_parameter_that_is_taken_as_a_state_in_another_unit_is_doubted() -> None:
    distance = distances.FinalState(components=[0])
    doubted = Experiment("x", _swing(1.0).with_parts(distance=distance), states=LABELS).doubt_of_parameters
    assert doubted is not None
    assert_names(doubted, "lean", "deg", "angle", "rad")
    converted = Experiment("x", _swing(np.pi / 180).with_parts(distance=distance), states=LABELS)
    assert converted.doubt_of_parameters is None
