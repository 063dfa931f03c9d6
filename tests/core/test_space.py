from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctxval import TaskSpace
from ctxval.errors import InputError, ShapeError, UnknownNameError
from facts import refuses


@st.composite
def spaces(draw: st.DrawFn) -> TaskSpace:
    """Draw a space of scalar and vector parameters, no narrower than a thousandth of its magnitude."""
    bounds = {}
    for i in range(draw(st.integers(1, 3))):
        size = draw(st.sampled_from([None, 1, 2]))
        shape = () if size is None else (size,)
        low = draw(arrays(np.float64, shape, elements=st.floats(-1e3, 1e3)))
        width = draw(arrays(np.float64, shape, elements=st.floats(1, 1e3)))
        bounds[f"p{i}"] = (low, low + width, draw(st.sampled_from(["", "rad"])))
    return TaskSpace(**bounds)


@st.composite
def spaces_and_unit_points(draw: st.DrawFn) -> tuple[TaskSpace, np.ndarray]:
    space = draw(spaces())
    batch = draw(st.sampled_from([(), (1,), (4,), (2, 3)]))
    return space, draw(arrays(np.float64, (*batch, space.dimension), elements=st.floats(0, 1)))


@pytest.fixture
def space() -> TaskSpace:
    return TaskSpace(goal=(-3, 3, "rad"), offset=([0, 10], [1, 20], "m"), mass=(1, 2))


@given(spaces_and_unit_points())
def test_the_unit_cube_and_the_box_map_onto_each_other(given_: tuple[TaskSpace, np.ndarray]) -> None:
    space, unit = given_
    points = space.from_unit(unit)
    assert points.shape == unit.shape
    assert ((points >= space.low) & (points <= space.high)).all()
    np.testing.assert_allclose(space.to_unit(points), unit, rtol=0, atol=1e-11)
    np.testing.assert_allclose(space.from_unit(space.to_unit(points)), points, rtol=1e-11, atol=1e-8)


@given(spaces())
def test_the_corners_of_the_unit_cube_are_exactly_those_of_the_box(space: TaskSpace) -> None:
    np.testing.assert_array_equal(space.from_unit(np.zeros(space.dimension)), space.low)
    np.testing.assert_allclose(space.from_unit(np.ones(space.dimension)), space.high, rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(space.to_unit(space.low), 0)
    np.testing.assert_array_equal(space.to_unit(space.high), 1)


@given(spaces_and_unit_points())
def test_a_described_point_is_found_again_from_its_json(given_: tuple[TaskSpace, np.ndarray]) -> None:
    space, unit = given_
    point = space.from_unit(unit.reshape(-1, space.dimension)[0])
    np.testing.assert_array_equal(space.point(json.loads(json.dumps(space.describe_point(point)))), point)


@given(st.integers(-300, 300), st.integers(1, 600), st.integers(0, 10**9), st.sampled_from([1e-6, 1e-3, 1.0, 1e3, 1e9]))
def test_a_typed_number_comes_back_as_it_was_typed(low: int, width: int, share: int, scale: float) -> None:
    space = TaskSpace(p=(low * scale, (low + width) * scale))
    typed = float(f"{(low + width * share / 10**9) * scale:.9g}")
    if space.low[0] <= typed <= space.high[0]:
        unit = space.to_unit([typed])
        assert space.from_unit(unit)[0] == typed
        assert space.to_unit(space.from_unit(unit))[0] == unit[0]


@given(spaces_and_unit_points())
def test_a_rounded_task_is_found_again_exactly(given_: tuple[TaskSpace, np.ndarray]) -> None:
    space, unit = given_
    rounded = space.rounded(unit)
    task = space.from_unit(rounded)
    np.testing.assert_array_equal(space.rounded(rounded), rounded)
    np.testing.assert_array_equal(space.from_unit(space.to_unit(task)), task)
    assert ((space.low <= task) & (task <= space.high)).all()
    np.testing.assert_allclose(rounded, unit, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(rounded[(unit == 0) | (unit == 1)], unit[(unit == 0) | (unit == 1)])


@given(st.sampled_from([(-np.pi, np.pi), (-2.0, 2.0), (0.3, 1.8), (0.0, 1e-4), (-1e6, 1e5)]), st.floats(0.001, 0.999))
def test_nine_digits_are_the_whole_rounded_task(bounds: tuple[float, float], unit: float) -> None:
    space = TaskSpace(goal=bounds)
    task = float(space.from_unit(space.rounded([unit]))[0])
    assert float(f"{task:.9g}") == task
    assert space.point({"goal": float(f"{task:.9g}")})[0] == task


def test_a_narrow_range_far_from_zero_keeps_nine_digits_of_the_range() -> None:
    space = TaskSpace(goal=(100.0, 100.5))
    assert space.from_unit(space.rounded([1 / 3]))[0] == 100.166666667


def test_a_number_with_a_longer_neighbour_comes_back_short() -> None:
    space = TaskSpace(p=(0.0, 3.0), q=(-0.7, 0.4))
    assert space.describe_point(space.from_unit(space.to_unit([0.2, -0.0]))) == {"p": 0.2, "q": 0.0}
    assert 0.0 + (0.2 / 3.0) * 3.0 != 0.2 or 0.1 * 3.0 != 0.3  # without the short form they would not
    unit = np.random.default_rng(0).random((1000, 2))
    np.testing.assert_allclose(space.from_unit(unit), space.low + unit * (space.high - space.low), rtol=0, atol=1e-15)


def test_units_are_known_by_name() -> None:
    assert TaskSpace(goal=(0, 1, "rad"), load=([0, 0], [1, 1])).units == {"goal": "rad", "load": ""}


def test_vectors_of_lengths_are_positions() -> None:
    space = TaskSpace(
        load=(0, 1, "kg"), goal=([0, 0], [1, 1], "m"), angles=([0, 0], [1, 1], "rad"), at=([0] * 3, [9] * 3, "mm"),
        row=([0] * 4, [1] * 4, "m"), height=(0, 1, "m"),
    )  # fmt: skip
    assert space.positions == (slice(1, 3), slice(5, 8))


def test_neighbouring_numbers_that_differ_in_an_axis_are_a_position() -> None:
    ends = (0, 1, "m")
    space = TaskSpace(load=(0, 1, "kg"), start_x=ends, start_y=ends, x=ends, y=ends, z=ends, x1=ends, x2=ends)
    assert space.positions == (slice(1, 3), slice(3, 6))
    assert TaskSpace(goal=ends, start=ends).positions == ()
    assert TaskSpace(x=(0, 1), y=(0, 1)).positions == ()
    assert TaskSpace(x=ends, z=ends, goal_y=ends, goal_z=ends).positions == ()  # not on the ground
    assert TaskSpace(x=ends, y=(0, 1, "mm")).positions == ()
    assert TaskSpace(x=ends, load=(0, 1, "kg"), y=ends).positions == ()


def test_points_outside_the_unit_cube_are_clipped_to_the_box(space: TaskSpace) -> None:
    np.testing.assert_array_equal(space.from_unit([-1.0, 2.0, 0.5, 3.0]), [-3, 1, 15, 2])


def test_names_columns_and_labels_follow_the_order_of_the_keywords(space: TaskSpace) -> None:
    assert space.names == ("goal", "offset[0]", "offset[1]", "mass")
    assert space.labels == ("goal [rad]", "offset[0] [m]", "offset[1] [m]", "mass")
    assert space.dimension == 4
    assert space.columns("goal") == 0
    assert space.columns("offset") == slice(1, 3)
    assert space.columns("mass") == 3
    assert space.low.tolist() == [-3, 0, 10, 1]
    assert space.high.tolist() == [3, 1, 20, 2]


def test_a_vector_parameter_of_one_component_stays_a_vector() -> None:
    space = TaskSpace(a=([0], [1]))
    assert space.names == ("a[0]",)
    assert space.parameters(np.zeros((5, 1))).a.shape == (5, 1)


def test_parameters_are_read_by_name_in_one_task_and_in_a_batch(space: TaskSpace) -> None:
    points = np.arange(8.0).reshape(2, 4)
    one, batch = space.parameters(points[0]), space.parameters(points)
    assert one.goal == 0.0
    assert one.offset.tolist() == [1.0, 2.0]
    assert one["mass"] == 3.0
    np.testing.assert_array_equal(batch.goal, [0, 4])
    np.testing.assert_array_equal(batch.offset, [[1, 2], [5, 6]])
    np.testing.assert_array_equal(batch.points, points)


def test_parameters_show_their_values(space: TaskSpace) -> None:
    assert repr(space.parameters([1, 2, 3, 4])) == "Parameters(goal=1 rad, offset=[2, 3] m, mass=4)"
    assert repr(space.parameters(np.zeros((2, 4)))) == (
        "Parameters(goal=[0, 0] rad, offset=(2, 2) all 0 m, mass=[0, 0], batch=(2,))"
    )


def test_an_unknown_parameter_is_refused_with_the_nearest_name(space: TaskSpace) -> None:
    parameters = space.parameters(np.zeros(4))
    for ask in (lambda: parameters.gaol, lambda: parameters["gaol"], lambda: space.columns("gaol")):
        with refuses(UnknownNameError, "gaol", "goal"):
            ask()


def test_an_unknown_parameter_like_no_other_is_refused_with_all_names(space: TaskSpace) -> None:
    with refuses(UnknownNameError, "zzz"):
        space.columns("zzz")


def test_python_may_probe_parameters_for_special_methods(space: TaskSpace) -> None:
    assert not hasattr(space.parameters(np.zeros(4)), "__array_interface__")


def test_the_description_has_bounds_and_unit_by_scalar_name(space: TaskSpace) -> None:
    offset = {"offset[0]": [0.0, 1.0, "m"], "offset[1]": [10.0, 20.0, "m"]}
    expected = {"goal": [-3.0, 3.0, "rad"], **offset, "mass": [1.0, 2.0]}
    assert json.loads(json.dumps(space.describe())) == expected
    assert repr(TaskSpace(goal=(-3, 3))) == "TaskSpace(goal=(-3, 3))"


@pytest.mark.parametrize(
    ("bound", "facts"),
    [
        ((1, -1), ("goal",)),
        ((1, 1), ("goal",)),
        (([0, 1], [1, 1]), ("goal",)),
        ((np.nan, 1), ("goal", "bound")),
        ((0, np.nan), ("goal", "bound")),
        ((0, np.inf), ("goal", "bound")),
        ((None, 1), ("goal", "bound")),
        (("a", 1), ("goal", "bound")),
        ((0,), ("goal",)),
        ((0, 1, "rad", 3), ("goal",)),
        (3.0, ("goal",)),
        ((0, 1, 2), ("goal", 2)),
        (([0, 0], [1, 1, 1]), ("goal",)),
        ((0, [1, 1]), ("goal",)),
        (([], []), ("goal",)),
        (([[0]], [[1]]), ("goal",)),
    ],
)
def test_unusable_bounds_are_refused_by_name(bound: object, facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts) as caught:
        TaskSpace(goal=bound)
    assert "goal" in str(caught.value)


def test_a_space_without_parameters_is_refused() -> None:
    with refuses(InputError, "space"):
        TaskSpace()


def test_a_point_needs_every_parameter_and_no_other(space: TaskSpace) -> None:
    with refuses(InputError, "offset[0]", "offset[1]"):
        space.point({"goal": 0})
    with refuses(UnknownNameError, "mass"):
        space.point({"goal": 0, "offset": [0, 10], "mas": 1})


@pytest.mark.parametrize(("goal", "facts"), [(3.1, ("goal", 3.1, [-3, 3]))])
def test_a_point_outside_the_box_is_refused_with_its_value(
    space: TaskSpace, goal: float, facts: tuple[object, ...]
) -> None:
    with refuses(InputError, *facts):
        space.point({"goal": goal, "offset": [0, 10], "mass": 1})
    with refuses(InputError, "offset[1]", 5):
        space.point({"goal": 0, "offset": [0, 5], "mass": 1})


@pytest.mark.parametrize("goal", [np.nan, np.inf, "far"])
def test_a_point_of_no_finite_number_is_refused_by_name(space: TaskSpace, goal: object) -> None:
    with refuses(InputError, "goal"):
        space.point({"goal": goal, "offset": [0, 10], "mass": 1})


@pytest.mark.parametrize("offset", [[0, 10, 0], [0], 0.5])
def test_a_value_of_another_length_is_refused_with_both_shapes(space: TaskSpace, offset: object) -> None:
    with refuses(ShapeError, "offset", (2,)):
        space.point({"goal": 0, "offset": offset, "mass": 1})


def test_points_of_another_dimension_are_refused_with_both_shapes(space: TaskSpace) -> None:
    for convert in (space.to_unit, space.from_unit, space.parameters):
        with refuses(ShapeError, "points", (2, 3)):
            convert(np.zeros((2, 3)))


def test_iid_points_are_a_function_of_the_generator(space: TaskSpace) -> None:
    first, again = (space.iid(50, np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert first.shape == (50, 4)
    assert not np.array_equal(first, space.iid(50, np.random.default_rng(8)))


def test_iid_points_are_uniform_over_the_box(space: TaskSpace) -> None:
    unit = space.to_unit(space.iid(20_000, np.random.default_rng(0)))
    np.testing.assert_allclose(unit.mean(axis=0), 0.5, atol=0.01)
    np.testing.assert_allclose(unit.var(axis=0), 1 / 12, atol=0.003)
    np.testing.assert_allclose(np.corrcoef(unit.T), np.eye(4), atol=0.03)


def test_a_grid_has_both_ends_and_every_combination() -> None:
    grid = TaskSpace(a=(0, 2), b=(-1, 1)).grid(3)
    assert grid.tolist() == [[a, b] for a in (0.0, 1.0, 2.0) for b in (-1.0, 0.0, 1.0)]


@pytest.mark.parametrize("per_axis", [1, 0, -2])
def test_a_grid_of_fewer_than_two_points_an_axis_is_refused(space: TaskSpace, per_axis: int) -> None:
    with refuses(InputError, "per_axis", 2, per_axis):
        space.grid(per_axis)


def test_a_function_of_parameters_becomes_one_of_unit_points(space: TaskSpace) -> None:
    function = space.unit_function(lambda p: p.goal**2 + p.offset[..., 1] * p.mass)
    unit = np.random.default_rng(0).random((6, 4))
    points = space.from_unit(unit)
    np.testing.assert_allclose(function(unit), points[:, 0] ** 2 + points[:, 2] * points[:, 3], rtol=1e-14)


def test_a_constant_function_of_parameters_has_one_value_a_point(space: TaskSpace) -> None:
    np.testing.assert_array_equal(space.unit_function(lambda p: 2)(np.zeros((3, 4))), [2.0, 2.0, 2.0])


@pytest.mark.parametrize("bound", [(-1.5e308, 1.5e308), ([0.0, -1e308], [1.0, 1e308]), (-np.finfo(float).max, 1e300)])
def test_a_range_that_is_too_large_for_a_number_is_refused(bound: tuple[Any, Any]) -> None:
    with refuses(InputError, "goal"):
        TaskSpace(goal=bound)


def test_users_code_cannot_change_the_space_or_the_parameters() -> None:
    low, high = np.array([0.0, 1.0]), np.array([2.0, 3.0])
    space = TaskSpace(goal=(low, high), load=(-1, 1))
    point = np.array([1.0, 2.0, 0.5])
    p, batch = space.parameters(point), space.parameters(np.stack([space.low, space.high]))
    low += 5
    point += 5
    for array in (space.low, space.high, p.points, batch.points):
        with refuses(ValueError):
            array[...] = np.nan
    goal, loads = p.goal, batch.load
    goal *= 7  # a copy, which may be changed
    loads *= 7
    assert (space.low.tolist(), space.high.tolist()) == ([0.0, 1.0, -1.0], [2.0, 3.0, 1.0])
    assert (p.points.tolist(), p.goal.tolist(), batch.load.tolist()) == ([1.0, 2.0, 0.5], [1.0, 2.0], [-1.0, 1.0])
