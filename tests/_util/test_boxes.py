from __future__ import annotations

import numpy as np
import pytest

from ctxval._util.arrays import Array
from ctxval._util.boxes import climb, farthest_rows, moves_to_bounds, separated_rows

LOW, HIGH = np.array([0.0, -1.0]), np.array([1.0, 3.0])


def hill(points: Array) -> tuple[Array, Array]:
    away = points - [0.4, 5.0]
    return np.asarray(-(away**2).sum(axis=-1)), -2 * away


@pytest.mark.parametrize("shape", [(2,), (5, 2), (3, 4, 2)])
def test_climbs_from_all_starts_end_at_the_maximum_in_the_box(shape: tuple[int, ...]) -> None:
    starts = LOW + np.random.default_rng(0).random(shape) * (HIGH - LOW)
    points, total = climb(hill, starts, LOW, HIGH)
    assert points.shape == shape
    np.testing.assert_allclose(points, np.broadcast_to([0.4, 3.0], shape), atol=1e-4)
    assert total == pytest.approx(hill(points)[0].sum(), rel=1e-6)


def test_the_scale_changes_neither_the_points_nor_the_sum() -> None:
    starts = np.array([[0.1, 0.0], [0.9, 1.0]])
    scaled = climb(lambda x: (1e9 * hill(x)[0], 1e9 * hill(x)[1]), starts, LOW, HIGH, scale=1e9)
    np.testing.assert_allclose(scaled[0], climb(hill, starts, LOW, HIGH)[0], atol=1e-5)
    assert scaled[1] == pytest.approx(1e9 * climb(hill, starts, LOW, HIGH)[1], rel=1e-6)


def test_the_function_is_not_called_more_often_than_is_allowed() -> None:
    calls: list[Array] = []

    def counted(points: Array) -> tuple[Array, Array]:
        calls.append(points)
        return np.cos(9 * points).sum(axis=-1), -9 * np.sin(9 * points)

    climb(counted, np.full((3, 2), 0.3), LOW, HIGH, iterations=50, evaluations=4)
    assert 0 < len(calls) <= 5


def test_each_move_takes_one_coordinate_to_a_bound() -> None:
    moved = moves_to_bounds(np.array([0.5, 0.25]), LOW, HIGH)
    np.testing.assert_array_equal(moved, [[0.0, 0.25], [0.5, -1.0], [1.0, 0.25], [0.5, 3.0]])
    batch = np.random.default_rng(0).random((3, 2))
    np.testing.assert_array_equal(moves_to_bounds(batch, LOW, HIGH), [moves_to_bounds(x, LOW, HIGH) for x in batch])


def test_separated_rows_are_the_first_without_a_neighbour_before_them() -> None:
    points = np.array([[0.0], [0.05], [0.2], [0.25], [0.9], [0.5]])
    assert separated_rows(points, 0.1, 10) == [0, 2, 4, 5]
    assert separated_rows(points, 0.1, 2) == [0, 2]
    assert separated_rows(points[:0], 0.1, 2) == []


@pytest.mark.parametrize("squared", [True, False])
def test_each_row_is_farthest_from_those_before_it(squared: bool) -> None:
    points = np.random.default_rng(0).random((40, 3))
    gaps = np.linalg.norm(points - points[7], axis=1) ** (2 if squared else 1)
    gaps[7] = -np.inf
    rows = [7, *farthest_rows(points, gaps, 12, squared=squared)]
    for count in range(1, len(rows)):
        away = np.linalg.norm(points[:, None] - points[rows[:count]], axis=2).min(axis=1)
        assert away[rows[count]] == pytest.approx(away.max())
    assert len(set(rows)) == 13


def test_the_choice_ends_where_no_row_is_left() -> None:
    assert sorted(farthest_rows(np.zeros((4, 2)), np.zeros(4), 9)) == [0, 1, 2, 3]
