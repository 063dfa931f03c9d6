from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_worst_case import MODEL, make_planner, truth

from ctxval import Transitions
from ctxval.learning.draws import DynamicsDraws
from ctxval.learning.dynamics_posterior import DynamicsPosterior, learn_posterior
from ctxval.learning.share_search import ShareSearch, ShareSettings
from ctxval.learning.worst_case import WorstCase, WorstCaseSettings

SETTINGS = replace(WorstCaseSettings.for_dimension(2), pool=64)
NONE = np.empty((0, 2))


class Drawn:
    """A posterior of which the draws are known."""

    def __init__(self, posterior: DynamicsPosterior, count: int = 2) -> None:
        relevant = np.random.default_rng(0).uniform(-1, 1, (200, 3))
        self.posterior, self.draws = posterior, posterior.draw(relevant, np.random.default_rng(3), 1, count)

    def draw(self, *arguments: object) -> DynamicsDraws:
        return self.draws

    def __getattr__(self, name: str) -> Any:
        return getattr(self.posterior, name)


@pytest.fixture(scope="module")
def posterior() -> Any:
    rng = np.random.default_rng(1)
    x, u = rng.uniform(-2, 2, (60, 2)), rng.uniform(-1, 1, (60, 1))
    learned = learn_posterior(MODEL, Transitions(x, u, truth(x, u)), np.zeros(60, dtype=int), (0,))
    assert learned is not None
    return Drawn(learned)


def search(share: float = 0.95, **of_share: float) -> ShareSearch:
    return ShareSearch(make_planner(2), 0, share, SETTINGS, ShareSettings(**of_share))  # type: ignore[arg-type]


def found(searched: ShareSearch, posterior: Any) -> tuple[WorstCase, WorstCase]:
    of_mean = searched.on_mean(posterior, np.empty(0), NONE, np.random.default_rng(0))
    return of_mean, searched.maxima(posterior, of_mean, NONE, np.random.default_rng(0), 1)


def test_a_share_of_the_tasks_stays_below_the_quantile_of_the_mean(posterior: Any) -> None:
    searched = search()
    assert len(searched.tasks) == 600
    of_mean = searched.on_mean(posterior, np.empty(0), NONE, np.random.default_rng(0))
    assert (searched.of_mean(posterior) > of_mean.highest).sum() == 30
    assert searched.share_above(posterior, of_mean.highest) == pytest.approx(0.05)
    # The tasks to execute lie near the quantile, and not at the largest distances.
    tasks = of_mean.local_maxima
    near = searched.planner.distances(posterior.mean, searched.planner.plan(tasks), len(tasks))
    assert np.abs(near - of_mean.highest).max() < 0.1 * of_mean.highest


@pytest.mark.parametrize("top", [4.0, 0.5])
def test_the_bound_of_a_draw_is_little_more_than_its_quantile(posterior: Any, top: float) -> None:
    searched = search(top=top)
    _, worst = found(searched, posterior)
    of_all = searched.planner.distances(posterior.draws, searched.planner.plan(searched.tasks), 600)
    quantile, above = np.quantile(of_all, 0.95, axis=1), (of_all > worst.maxima[:, None]).sum(axis=1)
    assert (worst.maxima >= quantile).all()
    # With few top tasks, most of what exceeds the bound is found among the others, which stand for many.
    assert (above <= (30 if top == 4 else 40)).all()
    if top == 4:
        assert searched.above_for_bound is not None
        assert (above >= searched.above_for_bound - 2).all()
        screened = searched.screened(posterior, worst, NONE, np.random.default_rng(1))
        assert screened.maxima == pytest.approx(worst.maxima, rel=0.05)


def test_too_few_tasks_bound_no_share(posterior: Any) -> None:
    searched = search(above=3)
    assert searched.above_for_bound is None
    assert np.isinf(found(searched, posterior)[1].maxima).all()


def test_fewer_tasks_are_above_a_bound_than_are_expected() -> None:
    searched = search(0.99)
    assert searched.above == 30
    assert searched.above_for_bound == 17
