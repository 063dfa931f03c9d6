from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.certificates import covering, farthest_task


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


@given(st.integers(0, 10_000), st.integers(1, 3), st.floats(0.15, 0.6))
def test_executing_the_points_covers_and_none_of_them_is_needless(seed: int, d: int, resolution: float) -> None:
    X = np.random.default_rng(seed).random((3, d))
    points = covering(X, resolution, 200)
    assert points is not None
    assert farthest_task(np.concatenate([X, points])) <= resolution
    for k, point in enumerate(points):
        before = np.concatenate([X, points[:k]])
        assert np.linalg.norm(before - point, axis=1).min() / np.sqrt(d) > resolution


def test_what_takes_too_many_points_is_not_begun() -> None:
    X = np.full((1, 11), 0.5)
    assert covering(X, 0.2, 50) is None
    points = covering(X, 0.6, 50)
    assert points is not None
    assert len(points) == 0
