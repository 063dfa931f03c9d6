"""Every numeric argument of every public class and function is accepted, or refused with an exception of ctxval."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest

import ctxval
from conftest import make_validation
from ctxval import certificates, searches
from ctxval._util.checked import (
    FiniteFloat,
    Must,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Probability,
    Seconds,
    checked,
    require,
)
from ctxval.cli.config.parts import REGISTRIES
from ctxval.core.distance import Distance
from ctxval.core.system import Simulated, System
from ctxval.distances import FinalState
from ctxval.errors import CtxvalError, InputError, UnknownNameError
from facts import refuses

INFINITY, NAN = float("inf"), float("nan")
WRONG: tuple[Any, ...] = (None, "text", NAN, -1, -0.5, 0, INFINITY, -INFINITY, [1.0, 2.0], [], 10**400, True)

MAKERS: dict[str, dict[str, Any]] = {
    "Task": {"initial_state": [0.0], "horizon": 3, "dt": 0.1},
    "TaskSpace": {"goal": (0.0, 1.0)},
    "Normal": {"mean": 0.0, "deviation": 1.0},
    "Trajectory": {"times": [0.0, 1.0], "states": [[0.0], [1.0]], "inputs": [[0.0]]},
    "Transitions": {"x": [[0.0]], "u": [[0.0]], "x_next": [[0.0]]},
    "Linear": {"A": [[1.0]], "B": [[1.0]]},
    "Manual": {"states": {"angle": "rad"}, "inputs": {"torque": "Nm"}, "dt": 0.1},
    "Subprocess": {"command": "true", "timeout": 1.0},
    "Function": {"step": lambda x, u: x},
    "Parametric": {"step": lambda x, u, theta: x, "theta": {"a": 1.0}},
    "Simulated": {"step": lambda x, u: x},
    "ILQR": {"Q": [1.0], "R": [1.0]},
    "LQR": {"Q": [1.0], "R": [1.0]},
    "StationaryLQR": {"Q": [1.0], "R": [1.0]},
    "MPC": {"Q": [1.0], "R": [1.0], "steps": 3},
    "Policy": {"policy": lambda t, x, task: x},
    "AtTimes": {"times": [0.1]},
    "RelativeDeviation": {"least": [0.1]},
    "Labels": {},
}
"""Arguments with which a class can be made; classes without required arguments need none."""


def made_by_name() -> Iterator[tuple[str, Callable[..., Any]]]:
    registries: Sequence[Mapping[str, Any]] = (*REGISTRIES.values(), searches.REGISTRY, certificates.KINDS)
    for registry in registries:
        for name in registry.built_in:  # type: ignore[attr-defined]
            yield registry[name].__name__, registry[name]
    for name in ctxval.__all__:
        if isinstance(getattr(ctxval, name), type):
            yield name, getattr(ctxval, name)
    yield "CertificateOptions", certificates.CertificateOptions


def constructions() -> Iterator[Any]:
    for name, build in made_by_name():
        try:
            parameters = inspect.signature(build).parameters
        except (TypeError, ValueError):
            continue
        required = {
            key for key, one in parameters.items() if one.default is one.empty and one.kind is not one.VAR_KEYWORD
        }
        if required - set(MAKERS.get(name, {})):
            continue
        for key in parameters:
            yield pytest.param(build, MAKERS.get(name, {}), key, id=f"{name}-{key}")


@pytest.mark.parametrize(("build", "arguments", "key"), list(constructions()))
def test_a_wrong_value_is_accepted_or_refused_by_ctxval(
    build: Callable[..., Any], arguments: dict[str, Any], key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # a text may be the path of a new store
    for value in WRONG:
        try:
            build(**{**arguments, key: value})
        except CtxvalError:
            continue


VALIDATION = make_validation()
CAMPAIGN = ctxval.Campaign(VALIDATION)


@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        (CAMPAIGN.run, {"budget": 1}),
        (CAMPAIGN.run, {"threshold": 1.0, "budget": 1}),
        (CAMPAIGN.audit, {"draws": 1}),
        (CAMPAIGN.ask_for_verdict, {"threshold": 1.0, "budget": 1}),
        (CAMPAIGN.verdict, {"threshold": 1.0}),
        (CAMPAIGN.tell, {"opened": 0, "distance": 1.0}),
        (CAMPAIGN.add, {"parameters": {"goal": 0.5}, "distance": 1.0}),
        (ctxval.grid_truth, {"validation": VALIDATION}),
        (ctxval.search_truth, {"validation": VALIDATION}),
        (ctxval.compare, {"candidates": {}}),
        (ctxval.refine, {"campaign": CAMPAIGN, "threshold": 1.0, "budget": 1}),
        (ctxval.Validation, vars(VALIDATION)),
        (ctxval.Campaign, {"validation": VALIDATION}),
        (ctxval.Experiment, {"name": "pendulum", "validation": VALIDATION}),
        (VALIDATION.space.grid, {"per_axis": 2}),
        (VALIDATION.space.iid, {"n": 2, "rng": np.random.default_rng(0)}),
        (certificates.tail, {"n": 3, "discarded": 0, "volume": 0.1}),
        (certificates.volume_bound, {"n": 3, "discarded": 0, "beta": 0.1}),
        (certificates.samples_needed, {"volume": 0.1, "beta": 0.1}),
    ],
    ids=lambda value: getattr(value, "__qualname__", ""),
)
def test_numbers_of_functions_are_refused_before_anything_is_executed(
    function: Callable[..., Any], arguments: dict[str, Any]
) -> None:
    executed = len(CAMPAIGN.trials)
    parameters = inspect.signature(function).parameters
    kinds = ("Positive", "NonNegative", "Seconds", "Probability", "AxisPoints", "int", "float")
    numeric = [key for key, one in parameters.items() if str(one.annotation).startswith(kinds)]
    assert numeric
    for key in numeric:
        for value in ("text", float("nan"), [1.0], object()):
            with pytest.raises(CtxvalError):
                function(**{**arguments, key: value})
    assert len(CAMPAIGN.trials) == executed


@dataclass(frozen=True)
class Defined:
    count: PositiveInt = 1


@checked
@dataclass(frozen=True)
class Inherited(Defined):
    rate: PositiveFloat | None = None
    names: tuple[str, ...] = ()
    pair: tuple[float, float] = (0.0, 1.0)
    how: Literal["up", "down"] = "up"
    table: Mapping[str, float] | None = None


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        ({"count": 0}, ("count", 0)),
        ({"count": True}, ("count", "True")),
        ({"count": 2.0}, ("count", 2.0)),
        ({"rate": float("inf")}, ("rate", "inf")),
        ({"names": "ab"}, ("ab",)),
        ({"names": ("a", 1)}, ("a", ("a", 1))),
        ({"pair": (1.0,)}, ("pair", 2)),
        ({"how": 3}, ("how", "up", "down")),
        ({"table": [1]}, ("table", [1])),
        ({"table": {"a": "b"}}, ("table", {"a": "b"})),
    ],
)
def test_a_refusal_names_the_argument_what_is_right_and_the_value(
    arguments: dict[str, Any], facts: tuple[object, ...]
) -> None:
    with refuses(InputError, *facts):
        Inherited(**arguments)


def test_right_values_and_defaults_pass_as_they_are() -> None:
    made = Inherited(count=np.int64(3), rate=np.float32(0.5), names=["a"], pair=np.zeros(2), how="down")  # type: ignore[arg-type]
    assert (made.count, made.rate, made.how) == (3, 0.5, "down")
    assert Inherited() == Inherited(1, None)


def test_an_unknown_text_gets_the_nearest_known_one() -> None:
    with refuses(UnknownNameError, "down", "how"):
        Inherited(how="dwon")  # type: ignore[arg-type]


def test_missing_arguments_are_pythons_own_errors_and_signatures_stay() -> None:
    with refuses(TypeError, "nonsense", "Inherited.__init__"):
        Inherited(nonsense=1)  # type: ignore[call-arg]
    assert list(inspect.signature(Inherited).parameters) == ["count", "rate", "names", "pair", "how", "table"]


def test_an_annotation_that_cannot_be_resolved_checks_nothing() -> None:
    def function(value: Unknown, count: PositiveInt = 1) -> int:  # type: ignore[name-defined]  # noqa: F821
        return count

    assert checked(function)(None, 2) == 2
    with refuses(InputError, "count", 0):
        checked(function)(None, 0)


def test_a_value_can_be_required_by_itself() -> None:
    assert require("dt", Seconds, 0.1) == 0.1
    assert require("share", Annotated[float, Must("below 1", lambda value: value < 1)], 0.5) == 0.5
    for annotation, value in ((FiniteFloat, 10**400), (Probability, 1), (NonNegativeInt, -1), (float, float("nan"))):
        with refuses(InputError, "value"):
            require("value", annotation, value)


def test_a_class_is_no_object_of_it() -> None:
    with refuses(InputError, "ctxval.core.system.Simulated"):
        require("system", System, Simulated)
    with refuses(InputError, "model_trajectory", "system_trajectory"):
        require("distance", Distance, FinalState)


def test_an_object_that_has_the_part_is_refused_with_a_hint() -> None:
    class Case:
        def __init__(self) -> None:
            self.tau = 0.5

    with refuses(InputError, "tau"):
        require("tau", PositiveFloat, Case())
