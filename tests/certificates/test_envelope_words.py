"""The largest boxes inside a set of tasks, in words."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import TaskSpace
from ctxval.certificates.envelope_words import Region, regions_inside

SPACE = TaskSpace(payload=(0.0, 2.0, "kg"), goal=(-1.0, 1.0, "m"), start=(-1.0, 1.0, "m"))


def found(space: TaskSpace, contains) -> tuple[Region, ...]:  # type: ignore[no-untyped-def]
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
    region = Region({"a [m]": (-0.5, 0.5), "b": (0.1, None), "c [s]": (1.0, 2.0)}, 0.2)
    assert region.text == "|a| below 0.5 m and b above 0.1 and c from 1 to 2 s"
    assert region.to_json() == {"limits": {"a [m]": [-0.5, 0.5], "b": [0.1, None], "c [s]": [1.0, 2.0]}, "share": 0.2}
