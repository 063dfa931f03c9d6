from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.certificates import bare_corners, covering, farthest_task, most_contested
from ctxval.certificates.covering import largest_empty_box


def test_the_farthest_task_of_an_interval_is_the_middle_of_its_largest_gap() -> None:
    X = np.array([[0.0], [0.2], [0.8], [1.0]])
    assert farthest_task(X) == pytest.approx(0.3, abs=1e-3)
    points = covering(X, 0.2, 5)
    assert points is not None
    assert points.shape == (1, 1)
    assert points[0, 0] == pytest.approx(0.5, abs=1e-3)


def test_distances_are_in_diagonals() -> None:
    assert farthest_task(np.zeros((1, 3))) == pytest.approx(1.0)
    assert farthest_task(np.full((1, 3), 0.5)) == pytest.approx(0.5)


@pytest.mark.slow
@given(st.integers(0, 10_000), st.integers(1, 3), st.floats(0.15, 0.6))
def test_executing_the_points_covers_and_none_of_them_is_needless(seed: int, d: int, resolution: float) -> None:
    X = np.random.default_rng(seed).random((3, d))
    points = covering(X, resolution, 200)
    assert points is not None
    everything = np.concatenate([X, points])
    assert farthest_task(everything) <= resolution
    assert len(bare_corners(everything, resolution)) == 0
    for k, point in enumerate(points):
        before = np.concatenate([X, points[:k]])
        is_corner = bool(np.isin(point, (0.0, 1.0)).all())
        assert np.linalg.norm(before - point, axis=1).min() / np.sqrt(d) > (resolution / 8 if is_corner else resolution)


def test_what_takes_too_many_points_is_not_begun() -> None:
    X = np.full((1, 11), 0.5)
    assert covering(X, 0.2, 50) is None
    points = covering(X, 0.6, 50)
    assert points is not None
    assert len(points) == 0


def test_a_trial_that_is_merely_near_to_a_corner_leaves_it_bare() -> None:
    X = np.array([[0.0, 0.0], [0.02, 0.99], [0.9, 0.1], [0.95, 0.95], [0.5, 0.5]])
    assert bare_corners(X, 0.125).tolist() == [[0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]
    assert bare_corners(X, 0.25).tolist() == [[1.0, 0.0], [1.0, 1.0]]
    points = covering(X, 0.9, 10)
    assert points is not None
    assert points.tolist() == []
    points = covering(X, 0.4, 10)
    assert points is not None
    assert points.tolist() == [[1.0, 0.0], [1.0, 1.0]]
    assert covering(X, 0.4, 1) is None


def test_who_trusts_the_process_everywhere_is_not_asked_for_corners_and_neither_is_who_has_too_many() -> None:
    assert len(bare_corners(np.full((1, 2), 0.5), 1.0)) == 0
    assert len(bare_corners(np.full((1, 4), 0.5), 0.5)) == 16
    assert len(bare_corners(np.full((1, 5), 0.5), 0.5)) == 0


def test_the_most_contested_point_is_where_most_are_and_no_trial_is() -> None:
    X = np.array([[0.0], [0.4], [1.0]])
    points = np.array([[0.4], [0.401], [0.41], [0.2], [0.69], [0.7], [0.71]])
    contested = most_contested(points, X, 0.125)
    assert contested is not None
    assert contested[0] == pytest.approx(0.7)
    assert most_contested(points[:3], X, 0.125) is None


def test_the_largest_empty_box_of_two_parameters_is_named() -> None:
    X = np.array([[0.5, 0.1, 0.2], [0.1, 0.6, 0.9], [0.9, 0.9, 0.4]])
    box = largest_empty_box(X)
    assert box is not None
    assert (box.parameters, box.low, box.high) == ((0, 1), (0.1, 0.1), (1.0, 0.9))
    assert box.share == pytest.approx(0.72)
    assert largest_empty_box(X[:, :1]) is None


@given(st.integers(0, 10_000), st.integers(1, 12), st.integers(2, 4))
def test_no_box_of_two_parameters_without_a_trial_is_larger(seed: int, n: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    X = rng.random((n, d))
    box = largest_empty_box(X)
    assert box is not None
    inside = (X[:, box.parameters] > box.low) & (X[:, box.parameters] < box.high)
    assert not inside.all(axis=1).any()
    ends = np.sort(rng.random((200, 2, 2)), axis=1)  # random boxes: (200, low and high, two parameters)
    pair = rng.permutation(d)[:2]
    filled = ((X[:, None, pair] > ends[:, 0]) & (X[:, None, pair] < ends[:, 1])).all(axis=2).any(axis=0)
    assert (np.diff(ends, axis=1).prod(axis=2)[:, 0][~filled] <= box.share + 1e-12).all()
