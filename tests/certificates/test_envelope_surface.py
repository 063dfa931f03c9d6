"""Upper bounds between tasks: interpolated, plus the largest error of the nearest tasks if they are left out."""

from __future__ import annotations

import numpy as np

from ctxval.certificates.envelope_surface import ENOUGH, Surfaces


def bowl(points: np.ndarray) -> np.ndarray:
    return np.stack([((points - 0.4) ** 2).sum(axis=1) * 6, points.sum(axis=1)], axis=1)


def test_a_linear_function_is_reproduced_and_a_smooth_one_bounded() -> None:
    rng = np.random.default_rng(0)
    points, others = rng.random((150, 2)), rng.random((40, 5, 2))
    surfaces = Surfaces.through(points, bowl(points))
    found, true = surfaces(others), bowl(others.reshape(-1, 2)).reshape(40, 5, 2)
    assert found.shape == (40, 5, 2)
    np.testing.assert_allclose(found[..., 1], true[..., 1], atol=1e-5)
    below = true[..., 0] <= 1
    assert (found[..., 0] >= true[..., 0] - 0.01)[below].all()
    assert np.abs(found[..., 0] - true[..., 0]).max() < 0.2
    assert surfaces(np.empty((0, 2))).shape == (0, 2)


def test_what_is_left_out_is_what_the_others_interpolate() -> None:
    points = np.random.default_rng(1).random((30, 3))
    values = bowl(points)
    surfaces = Surfaces.through(points, values)
    for k in range(0, 30, 3):
        others = np.delete(np.arange(30), k)
        fewer = Surfaces.through(points[others], values[others])
        without = fewer.__class__(fewer.centres, fewer.weights, fewer.left_out, np.zeros((29, 2)))(points[k])
        np.testing.assert_allclose(surfaces.left_out[k], without, atol=1e-6)
        errors = np.abs(np.minimum(values[k], ENOUGH) - np.minimum(without, ENOUGH))
        np.testing.assert_allclose(surfaces.errors[k], errors, atol=1e-6)


def test_next_to_a_cliff_the_error_is_large_and_elsewhere_it_is_not() -> None:
    points = np.random.default_rng(2).random((400, 2))
    surfaces = Surfaces.through(points, np.where(points[:, :1] > 0.5, 2.0, 0.2))
    across = np.column_stack([np.linspace(0.02, 0.98, 49), np.full(49, 0.5)])
    found = surfaces(across)[:, 0]
    assert (found[across[:, 0] > 0.5] > 1).all()
    assert (found[across[:, 0] < 0.35] < 1).all()


def test_points_that_are_known_to_be_above_the_limit_raise_the_errors() -> None:
    rng = np.random.default_rng(3)
    known, more = rng.random((60, 2)), rng.random((900, 2))
    waves = [0.8 + 0.4 * np.sin(40 * points[:, :1]) for points in (known, more)]
    surfaces = Surfaces.through(known, waves[0])
    inside = surfaces(more)[:, 0] <= 1
    checked, outside = int(inside.sum()), more[inside & (waves[1][:, 0] > 1)]
    assert len(outside) > 0.05 * checked
    raised = surfaces.without(outside, checked)
    assert (raised(outside) <= 1).mean() < 0.5
    np.testing.assert_allclose(surfaces.without(outside[:0], checked).errors, surfaces.errors)
