from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rig_safety import D_B, SPEC, closed_form, validation

from ctxval import Campaign, TaskSuite
from ctxval.certificates.scenario import volume_bound
from ctxval.errors import InputError
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.studies.safety import draw_tasks
from ctxval.studies.safety.draws import TasksWithMargin
from facts import refuses


def test_draws_follow_the_distribution_of_tasks_with_the_margin() -> None:
    given = validation()
    points = TasksWithMargin(LoopPlanner(given), given.space, SPEC, 0.5)(np.random.default_rng(0), 2000)
    every = given.space.iid(20_000, np.random.default_rng(1))
    expected = every[closed_form(every)[0] > 0.5]
    assert closed_form(points)[0].min() > 0.5
    for share in (0.25, 0.5, 0.75):
        np.testing.assert_allclose(np.quantile(points, share, axis=0), np.quantile(expected, share, axis=0), atol=0.06)


@pytest.mark.slow
def test_unsafe_draws_are_counted_and_bound_the_share(tmp_path: Path) -> None:
    campaign = Campaign(validation(), seed=3)
    safe = draw_tasks(campaign, D_B, 40, progress=False)
    assert (safe.unsafe, safe.draws) == (0, 40)
    assert safe.share == volume_bound(40, 0, 0.05)
    some = draw_tasks(campaign, 0.0, 60, store=tmp_path / "draws.sqlite", progress=False)
    assert 10 <= some.unsafe <= 50
    assert some.share == volume_bound(60, some.unsafe, 0.05)
    assert draw_tasks(campaign, 0.0, 60, store=tmp_path / "draws.sqlite", progress=False) == some  # resumed


def test_what_cannot_be_drawn_is_refused() -> None:
    with refuses(InputError, 1.6):
        draw_tasks(Campaign(validation()), 1.6, 10)
    suite = validation().with_parts(
        space=TaskSuite({"a": {"wall": 1.0, "speed": 1.0}, "b": {"wall": 2.0, "speed": 1.2}})
    )
    with refuses(InputError, "suite"):
        draw_tasks(Campaign(suite), 0.1, 10)
