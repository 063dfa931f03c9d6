from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from ctxval._util.arrays import (
    as_finite,
    as_floats,
    as_weight,
    require_shape,
    rows_of,
    single_threaded,
)
from ctxval.errors import InputError, ShapeError
from facts import refuses


def test_numbers_become_float64() -> None:
    array = as_floats("x", [[1, 2], [3, 4]])
    assert array.dtype == np.float64
    assert array.tolist() == [[1.0, 2.0], [3.0, 4.0]]


@pytest.mark.parametrize("value", ["goal", [1, [2, 3]], {"a": 1}, [object()]])
def test_what_is_no_number_is_refused_by_name(value: object) -> None:
    with refuses(InputError, "x"):
        as_floats("x", value)


@pytest.mark.parametrize("value", [np.nan, [1.0, np.inf], None])
def test_what_is_not_finite_is_refused_by_name_and_value(value: object) -> None:
    with refuses(InputError, "x"):
        as_finite("x", value)


@pytest.mark.parametrize("shape", [(3,), (2, 3), (4, 2, 3)])
def test_only_the_last_axes_are_required(shape: tuple[int, ...]) -> None:
    array = np.zeros(shape)
    assert require_shape("x", array, (3,)) is array


@pytest.mark.parametrize(("shape", "expected"), [((), (3,)), ((4,), (3,)), ((3,), (2, 3)), ((3, 2), (2, 3))])
def test_a_wrong_shape_is_named_beside_the_right_one(shape: tuple[int, ...], expected: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError) as caught:
        require_shape("x", np.zeros(shape), expected)
    assert str(shape) in str(caught.value)
    assert ", ".join(map(str, expected)) in str(caught.value)


def test_a_weight_is_a_diagonal_or_a_matrix() -> None:
    np.testing.assert_array_equal(as_weight("Q", [1, 2]), [[1, 0], [0, 2]])
    np.testing.assert_array_equal(as_weight("Q", [[2, 1], [1, 2]]), [[2, 1], [1, 2]])


@pytest.mark.parametrize("value", [1.0, [], [[1, 2]], np.zeros((2, 2, 2))])
def test_a_weight_of_another_shape_is_refused(value: object) -> None:
    with refuses(ShapeError, "Q"):
        as_weight("Q", value)


@pytest.mark.parametrize(
    ("value", "facts"),
    [
        ([1, np.nan], ("Q",)),
        ([[1, 2], [0, 1]], ("Q", [1.0, 2.0], [0.0, 1.0])),
        ([1, -2], ("Q", [1.0, 0.0], [0.0, -2.0])),
        ([[1, 2], [2, 1]], ("Q", [[1.0, 2.0], [2.0, 1.0]])),
    ],
)
def test_a_weight_that_is_not_positive_semidefinite_is_refused(value: object, facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        as_weight("Q", value)


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_rounding_does_not_make_a_gram_matrix_an_invalid_weight(scale: float) -> None:
    factor = np.random.default_rng(0).normal(size=(5, 2))
    gram = scale * factor @ factor.T
    np.testing.assert_array_equal(as_weight("Q", gram), gram)


@pytest.mark.parametrize("shape", [(), (1,), (5,), (2, 3), (0,)])
def test_rows_may_have_no_columns(shape: tuple[int, ...]) -> None:
    count = int(np.prod(shape))
    rows = np.arange(2.0 * count).reshape(count, 2)
    np.testing.assert_array_equal(rows_of(rows.reshape(*shape, 2)), rows)
    assert rows_of(np.empty((*shape, 0))).shape == (count, 0)


def test_algebra_is_bound_to_one_thread_and_released_again() -> None:
    def threads() -> set[int]:
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    with threadpool_limits(2, user_api="blas"):
        before = threads()
        with single_threaded():
            assert threads() == {1}
        assert threads() == before == {2}


HALF = np.ma.masked_array([1.0, 2.0], mask=[False, True])


@pytest.mark.parametrize("value", [HALF, [HALF, HALF], ([1.0], [HALF]), np.ma.masked, [1.0, np.ma.masked]])
def test_what_is_masked_is_refused_and_not_taken_from_below_the_mask(value: object) -> None:
    with refuses(InputError, "x"):
        as_floats("x", value)  # type: ignore[arg-type]


def test_a_masked_array_without_a_masked_number_is_an_array() -> None:
    assert as_floats("x", np.ma.masked_array([1.0, 2.0])).tolist() == [1, 2]
    assert type(as_floats("x", np.ma.masked_array([1.0], mask=[False]))) is np.ndarray


def test_messages_about_large_arrays_stay_short() -> None:
    large = np.zeros((300, 300))
    large[7, 3] = np.nan
    with refuses(InputError, "x", [7, 3]):
        as_finite("x", large)
    with pytest.raises(InputError) as caught:
        as_floats("x", [["one"] * 10_000] * 100)
    assert len(str(caught.value)) < 5000


NO_NUMBERS = [
    "1_0",
    b"1",
    True,
    np.True_,
    1j,
    np.ma.masked,
    ["1", "2"],
    [1.0, "2"],
    [True, 1.5],
    [[1.0, 2.0], [3.0, False]],
    (1.0, np.bool_(True)),
    [np.array([True, False]), np.array([1.0, 2.0])],
    [1.0, 2.0 + 0j],
    np.array(["1", "2"]),
    np.array([b"1"]),
    np.array([True]),
    np.array([1, "2"], dtype=object),
    np.array([True, 2.0], dtype=object),
    np.array([1 + 0j]),
    np.array([1], dtype="M8[s]"),
    np.array([1], dtype="m8[s]"),
    np.ma.masked_array([1.0, 2.0], [False, True]),
    [np.ma.masked_array([1.0, 2.0], [False, True])],
]


@pytest.mark.parametrize("value", NO_NUMBERS, ids=repr)
def test_what_numpy_would_convert_to_numbers_is_refused(value: object) -> None:
    with refuses(InputError, "x"):
        as_floats("x", value)  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [3, 2.5, np.float32(1), [1, 2.0], np.arange(3), (np.float16(1), 2), [], [[], []]])
def test_numbers_of_every_kind_are_numbers(value: object) -> None:
    np.testing.assert_array_equal(as_floats("x", value), np.array(value, dtype=np.float64))  # type: ignore[arg-type]
