"""Names and units: those that are stated, else those of the system, else numbered ones."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from conftest import make_validation
from ctxval import Experiment, Labels, Validation, distances, systems
from ctxval.core.labels import labels_of
from ctxval.errors import InputError
from facts import refuses


def test_stated_labels_come_first_then_those_of_the_system() -> None:
    system = SimpleNamespace(states={"q": "rad", "w": "rad/s"}, inputs=["torque"])
    assert Labels().names(system, 2, 1) == ({"q": "rad", "w": "rad/s"}, {"torque": ""})
    assert Labels(("a [m]", "b"), ()).names(system, 2, 1) == ({"a": "m", "b": ""}, {"torque": ""})
    assert Labels(("a [m]",), ()).names(None, 2, 1) == ({"x0": "", "x1": ""}, {"u0": ""})
    assert labels_of({"a": "m", "b": ""}) == ("a [m]", "b")


def test_an_experiment_gives_its_labels_to_its_validation_and_takes_those_it_has() -> None:
    validation = make_validation().with_parts(distance=distances.FinalState(weights=[1, 1]))
    named = Experiment("a", validation, units="rad", states=("angle [rad]", "rate [rad/s]"))
    assert named.validation.labels == Labels(("angle [rad]", "rate [rad/s]"), (), "rad")
    assert named.names(2, 1) == ({"angle": "rad", "rate": "rad/s"}, {"u0": ""})
    again = Experiment("b", named.validation, inputs=("torque [N m]",))
    assert (again.units, again.states, again.inputs) == ("rad", named.states, ("torque [N m]",))
    assert validation.labels == Labels()


def test_labels_do_not_identify_an_experiment() -> None:
    validation = make_validation()
    assert validation.with_parts(labels=Labels(units="m")).describe() == validation.describe()


def test_other_parts_keep_the_labels() -> None:
    labels = Labels(units="m")
    validation = make_validation().with_parts(labels=labels)
    assert validation.with_parts(space=validation.space).labels is labels
    assert validation.with_parts(distance=validation.distance).labels is labels
    with refuses(InputError, "labels", "m"):
        validation.with_parts(labels="m")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("states", "inputs"),
    [
        (("t",), ()),
        (("time [s]",), ()),
        (("angle", "angle"), ()),
        (("angle [rad]", "angle [deg]"), ()),
        (("angle",), ("angle",)),
        (("",), ()),
        ((" ",), ()),
        (("[rad]",), ()),
        ((" angle",), ()),
        (("angle ",), ()),
        (("an\ngle",), ()),
        (("angle\x1b[31m",), ()),
        (("angle",), ("t",)),
    ],
)
def test_names_that_make_a_recording_unreadable_are_refused_where_they_are_declared(
    states: tuple[str, ...], inputs: tuple[str, ...]
) -> None:
    with refuses(InputError, "name"):
        Labels(states, inputs)
    named = [dict.fromkeys(names, "") for names in (states, inputs)]
    if len(named[0]) == len(states):
        with refuses(InputError, "name"):
            systems.Manual(states=named[0], inputs=named[1], dt=0.1)
        with refuses(InputError, "name"):
            systems.Subprocess("true", timeout=1.0, states=named[0], inputs=named[1])
        given = vars(make_validation())
        for kind in (list, tuple, dict):
            own = {name: kind(names) for name, names in zip(("states", "inputs"), named, strict=True)}
            system = SimpleNamespace(execute=given["system"].execute, **own)
            with refuses(InputError, "name"):
                Validation(**{**given, "system": system})
            assert Validation(**{**given, "system": system, "labels": Labels(("a",), ("b",))}).system is system


def test_an_index_is_part_of_a_name() -> None:
    system = SimpleNamespace(states=["q[1]", "q[2]", "der(q[1])"], inputs=["u[1]"])
    validation = make_validation()
    Validation(**{**vars(validation), "system": SimpleNamespace(execute=validation.system.execute, **vars(system))})
    assert Labels().names(system, 3, 1) == ({"q[1]": "", "q[2]": "", "der(q[1])": ""}, {"u[1]": ""})
    assert Labels(("q[1] [rad]", "q[2][m]")).names(None, 2, 0)[0] == {"q[1]": "rad", "q[2]": "m"}
    assert Labels(("q[1]", "q[2]")).names(None, 2, 0)[0] == {"q[1]": "", "q[2]": ""}
