from __future__ import annotations

import functools
import json
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import TaskSpace, controllers, distances, models, systems
from ctxval._util.describe import describe, first_difference
from facts import assert_names

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.sampled_from(["", "goal", "ß"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from("abc"), inner, max_size=3),
    max_leaves=6,
)


@dataclass
class Part:
    gain: float


class Secretive(dict):  # type: ignore[type-arg]
    """A user's object with a description for another purpose."""

    def __init__(self) -> None:
        super().__init__(password="hunter2")

    def describe(self) -> dict[str, object]:
        return dict(self)


def policy(t: int, x: float) -> float:
    return x


def stored(value: object) -> object:
    return json.loads(json.dumps(describe(value)))


@given(PLAIN)
def test_a_description_is_json_and_does_not_differ_from_itself(value: object) -> None:
    assert first_difference(stored(value), stored(value)) is None


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (np.float32(0.5), 0.5),
        (np.int64(3), 3.0),
        (np.bool_(True), True),
        (np.bool_(False), False),
        (np.inf, "inf"),
        (np.nan, "nan"),
        ((1, "two"), [1, "two"]),
        (np.array([[1, 2]]), [[1, 2]]),
        (np.zeros((200, 3)), {"shape": [200, 3]}),
        ({1: None}, {"1": None}),
        (distances.FinalState(norm=2.0), {"type": "FinalState", "norm": 2.0, "components": None}),
    ],
)
def test_values_and_parts_of_this_package_are_described_by_their_settings(value: object, expected: object) -> None:
    assert stored(value) == expected


def test_users_objects_are_described_by_their_source_alone() -> None:
    def scaled(gain: float, key: str = "hunter2") -> object:
        return lambda x: gain * x + len(key)

    for value, kind in (
        (Part(2.5), {"type": "Part"}),
        (Secretive(), {"type": "Secretive"}),
        (policy, {"function": "policy"}),
        (scaled(2.5), {"function": f"{scaled.__qualname__}.<locals>.<lambda>"}),
        (functools.partial(policy, 2.5), {"function": "partial"}),
    ):
        described = stored(value)
        assert isinstance(described, dict)
        assert described == {**kind, "source": described["source"]}
        assert "2.5" not in str(described)
        assert "hunter2" not in str(described)


def test_a_users_function_in_a_part_of_this_package_is_its_source() -> None:
    described = stored(systems.Simulated(policy))
    assert isinstance(described, dict)
    assert described["type"] == "Simulated"
    assert '"source"' in json.dumps(described)


def test_methods_of_parts_with_other_settings_are_told_apart() -> None:
    one, other = models.Linear([[1]], [[1]]), models.Linear([[2]], [[1]])
    assert_names(first_difference(stored(one.step), stored(other.step)), [0], 1.0, 2.0)


def test_what_contains_itself_has_a_description() -> None:
    endless: list[object] = []
    endless.append(endless)
    assert stored(endless) == [[[[[["list"]]]]]]


@pytest.mark.parametrize("part", [TaskSpace(a=(0, 1)), controllers.ILQR([1.0], [1.0]), distances.FinalState(norm=2)])
def test_the_parts_of_a_validation_have_descriptions_that_tell_them_apart(part: object) -> None:
    changed = {
        TaskSpace: TaskSpace(a=(0, 2)),
        controllers.ILQR: controllers.ILQR([2.0], [1.0]),
        distances.FinalState: distances.FinalState(norm=1),
    }[type(part)]
    assert first_difference(stored(part), stored(part)) is None
    assert first_difference(stored(part), stored(changed)) is not None


def test_the_description_of_a_set_does_not_depend_on_its_order() -> None:
    # 0 and 8 share a slot of the hash table, as two strings do in one process and not in the next.
    one, other = {0, 8}, {8, 0}
    assert list(one) != list(other)
    assert stored(one) == stored(other)
    assert stored(frozenset({"b", "a"})) == ["a", "b"]


@pytest.mark.parametrize("one", [np.array([1.0, np.nan]), np.full(500, np.nan), np.array([np.inf])])
def test_descriptions_with_what_is_not_finite_agree_with_themselves(one: np.ndarray) -> None:
    assert first_difference(stored(one), stored(one)) is None


@pytest.mark.parametrize(
    ("one", "other", "difference"),
    [
        ({"a": 1}, {"a": 2}, "a was 1 and is now 2"),
        ({"a": {"b": [1, 2]}}, {"a": {"b": [1, 3]}}, "a.b[1] was 2 and is now 3"),
        ({"a": 1, "b": 2}, {"a": 1}, "b is missing now"),
        ({"a": 1}, {"a": 1, "b": 2}, "b is new"),
        ({"a": [1]}, {"a": [1, 2]}, "a was [1] and is now [1, 2]"),
        ({"a": "x"}, {"a": 1}, "a was 'x' and is now 1"),
        ({"a": 1.0}, {"a": 1.0 + 1e-5}, "a was 1.0 and is now 1.00001"),
        ({"a": 1.0}, {"a": float("nan")}, "a was 1.0 and is now nan"),
        ({"a": {"function": "f", "source": "1"}}, {"a": {"function": "g", "source": "1"}}, None),
        (
            {"a": {"function": "f", "source": "1"}},
            {"a": {"function": "f", "source": "2"}},
            "the source of a has changed",
        ),
    ],
)
def test_the_first_difference_is_named_with_its_place(one: object, other: object, difference: str | None) -> None:
    assert first_difference(one, other) == difference


@given(st.floats(-1e6, 1e6), st.floats(-5e-7, 5e-7))
def test_rounding_between_machines_is_no_difference(value: float, error: float) -> None:
    assert first_difference({"a": value}, {"a": value * (1 + error)}) is None


def test_long_values_are_shortened_in_a_difference() -> None:
    found = first_difference({"a": "x" * 500}, {"a": "y" * 500})
    assert found is not None
    assert len(found) < 160


def test_small_weights_are_told_apart() -> None:
    assert first_difference({"R": 1e-10}, {"R": 9e-10}) is not None


@pytest.mark.parametrize(
    "value",
    [
        range(10**9),
        b"x" * 10**7,
        1 + 2j,
        np.array([Part(1.0)], dtype=object),
        type("Answering", (), {"__getattr__": lambda self, name: lambda *a, **k: 1})(),
        type("Slotted", (), {"__slots__": ("gain",)})(),
    ],
)
def test_odd_objects_have_a_short_description_that_agrees_with_itself(value: object) -> None:
    described = stored(value)
    assert len(json.dumps(described)) < 3000
    assert first_difference(described, stored(value)) is None
    assert " at 0x" not in json.dumps(described)


def test_a_variable_without_a_value_is_left_out() -> None:
    def outer() -> object:
        def inner() -> object:
            return later

        found = stored(inner)
        later = 1
        return found, later

    assert outer()
