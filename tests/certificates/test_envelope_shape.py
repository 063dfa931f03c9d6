"""The largest boxes inside a set of tasks in words, and upper bounds between tasks."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import TaskSpace
from ctxval.certificates.envelope_shape import SHAPE, Surfaces, TrustedRegion, regions_inside
from facts import assert_names

SPACE = TaskSpace(payload=(0.0, 2.0, "kg"), goal=(-1.0, 1.0, "m"), start=(-1.0, 1.0, "m"))


def found(space: TaskSpace, contains) -> tuple[TrustedRegion, ...]:  # type: ignore[no-untyped-def]
    unit = np.random.default_rng(5).random((2000, space.dimension))
    return regions_inside(space, unit, contains(unit), contains)


def test_a_half_space_is_found() -> None:
    region, *_ = found(SPACE, lambda unit: unit[:, 0] < 0.65)
    (label,) = region.limits
    low, high = region.limits[label]
    assert label == "payload [kg]"
    assert low is None
    assert high == pytest.approx(1.3, abs=0.02)
    assert high < 1.3
    assert region.text.startswith("payload below 1.2")
    assert region.text.endswith(" kg")
    assert region.share == pytest.approx(0.65, abs=0.03)


def test_a_difference_of_two_parameters_with_one_unit_is_named() -> None:
    region, *_ = found(SPACE, lambda unit: np.abs(unit[:, 2] - unit[:, 1]) < 0.3)
    assert region.limits["start - goal [m]"] == pytest.approx((-0.6, 0.6), abs=0.1)
    assert region.share > 0.35  # of 0.51


@pytest.mark.slow
def test_no_task_of_a_region_lies_outside_of_the_set() -> None:
    def contains(unit: np.ndarray) -> np.ndarray:
        return np.asarray(((unit - 0.3) ** 2).sum(axis=1) < 0.2)

    regions = found(SPACE, contains)
    assert regions
    assert list(regions) == sorted(regions, key=lambda region: -region.share)
    points = np.random.default_rng(8).random((40_000, 3))
    values = dict(zip(SPACE.labels, SPACE.from_unit(points).T, strict=True))
    values |= {"start - goal [m]": values["start [m]"] - values["goal [m]"]}
    values |= {"start + goal [m]": values["start [m]"] + values["goal [m]"]}
    for region in regions:
        held = np.ones(len(points), dtype=bool)
        for label, (low, high) in region.limits.items():
            held &= (values[label] >= (-np.inf if low is None else low)) & (
                values[label] <= (np.inf if high is None else high)
            )
        assert held.mean() == pytest.approx(region.share, abs=0.02)
        assert (held & ~contains(points)).mean() < 5e-4


def test_all_tasks_and_none() -> None:
    (region,) = found(SPACE, lambda unit: np.ones(len(unit), dtype=bool))
    assert (region.text, region.share) == ("all tasks", 1.0)
    assert found(SPACE, lambda unit: np.zeros(len(unit), dtype=bool)) == ()


def test_limits_in_words() -> None:
    region = TrustedRegion({"a [m]": (-0.5, 0.5), "b": (0.1, None), "c [s]": (1.0, 2.0)}, 0.2)
    assert_names(region.text, 0.5, "b", 0.1, 1)
    assert region.to_json() == {"limits": {"a [m]": [-0.5, 0.5], "b": [0.1, None], "c [s]": [1.0, 2.0]}, "share": 0.2}


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
        without = Surfaces.through(points[others], values[others], surfaces.scales).with_errors(0.0)(points[k])
        np.testing.assert_allclose(surfaces.left_out[k], without, atol=1e-6)
        errors = np.abs(np.minimum(values[k], SHAPE.enough) - np.minimum(without, SHAPE.enough))
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
    surfaces = Surfaces.through(known, waves[0], np.ones(2))
    inside = surfaces(more)[:, 0] <= 1
    checked, outside = int(inside.sum()), more[inside & (waves[1][:, 0] > 1)]
    assert len(outside) > 0.05 * checked
    raised = surfaces.without(outside, checked)
    assert (raised(outside) <= 1).mean() < 0.5
    np.testing.assert_allclose(surfaces.without(outside[:0], checked).errors, surfaces.errors)


def test_many_checks_show_that_errors_are_too_large() -> None:
    rng = np.random.default_rng(4)
    points, more = rng.random((150, 3)), rng.random((2000, 3))
    surfaces = Surfaces.through(points, bowl(points)[:, :1]).with_errors(10.0)
    least = surfaces.with_errors(SHAPE.multiples[0])
    checks = more[least(more)[:, 0] <= 1][: SHAPE.many]
    outside = checks[bowl(checks)[:, 0] > 1]
    lowered = surfaces.without(outside, len(checks))
    assert lowered.errors.sum() < surfaces.errors.sum()
    true = bowl(more)[:, 0] > 1
    assert ((lowered(more)[:, 0] <= 1) & true).mean() < 0.01
    assert (surfaces(more)[:, 0] <= 1).mean() <= (lowered(more)[:, 0] <= 1).mean() <= 1 - true.mean() + 0.01
    few = surfaces.without(outside[:0], SHAPE.many - 1)
    np.testing.assert_allclose(few.errors, surfaces.errors)


def test_a_parameter_without_effect_is_made_short() -> None:
    rng = np.random.default_rng(6)
    points, others = rng.random((150, 4)), rng.random((500, 4))

    def values(points: np.ndarray) -> np.ndarray:
        return np.asarray(np.sin(5 * points[:, :1]) + 0.5 * np.cos(4 * points[:, 1:2]) + 1e-3 * points[:, 2:3] ** 2)

    surfaces = Surfaces.through(points, values(points))
    assert surfaces.scales[2:].max() < 0.3 * surfaces.scales[:2].min()
    errors = [
        np.abs(each.with_errors(0.0)(others) - values(others)).mean()
        for each in (surfaces, Surfaces.through(points, values(points), np.ones(4)))
    ]
    assert errors[0] < 0.3 * errors[1]
