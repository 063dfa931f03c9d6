from __future__ import annotations

import sys

import numpy as np
import pytest

from ask_and_tell import hill, run
from ctxval.errors import InputError
from ctxval.searches import CMAES, Random, by_name
from ctxval.testing import check_search
from facts import refuses
from rig_thorough import more


def resumed(points: np.ndarray, values: np.ndarray, seed: int = 0) -> np.ndarray:
    fresh = CMAES()
    fresh.reset(points.shape[1], seed)
    fresh.tell(points, values)
    return fresh.ask(1)[0]


@pytest.mark.parametrize("dimension", [1, 4])
def test_it_keeps_the_contract_of_a_search(dimension: int) -> None:
    check_search(by_name("cma-es"), dimension=dimension, budget=25)


@pytest.mark.parametrize("seed", [0, *more(1, 2)])
def test_it_converges_on_a_hill(seed: int) -> None:
    _, values = run(CMAES(), hill, 250, dimension=5, seed=seed)
    _, random = run(Random(), hill, 250, dimension=5, seed=seed)
    assert values.max() > -1e-3 > random.max()


def test_it_climbs_into_a_corner_and_stays_inside_the_cube() -> None:
    points, values = run(CMAES(), lambda x: float(x[0] - x[1]), 200, dimension=2)
    assert ((points >= 0) & (points <= 1)).all()
    assert values.max() > 0.999


def test_told_any_part_of_the_history_again_it_asks_for_the_same_next_point() -> None:
    # Every sixth evaluation fails, and the budget is enough for a run that converges and its restart.
    points, values = run(CMAES(), lambda x: np.nan if int(1e6 * x[0]) % 6 == 0 else hill(x), 190, dimension=1, seed=4)
    assert np.isnan(values).any()
    assert np.abs(points[150:] - 0.3).max() > 0.2
    for told in [*range(1, 20), *range(20, 190, 7)]:
        np.testing.assert_array_equal(resumed(points[:told], values[:told], seed=4), points[told])


def test_values_that_come_late_lead_to_where_they_would_have_led_in_time() -> None:
    search = CMAES(population=6)
    search.reset(2, seed=1)
    points = search.ask(9)
    values = np.array([hill(point) for point in points])
    search.tell(points[:6][::-1], values[:6][::-1])
    search.tell(points[6:], values[6:])
    in_time = CMAES(population=6)
    in_time.reset(2, seed=1)
    in_time.tell(points, values)
    np.testing.assert_array_equal(search.ask(3), in_time.ask(3))


def test_after_convergence_it_starts_again_elsewhere() -> None:
    points, values = run(CMAES(), hill, 300, dimension=1)
    arrived = int(np.argmax(values > -1e-10))
    assert 0 < arrived < 250
    assert np.abs(points[arrived:] - 0.3).max() > 0.2


def test_it_turns_away_from_where_evaluations_fail() -> None:
    points, values = run(CMAES(), lambda x: np.nan if x[0] > 0.5 else float(x[0]), 200, dimension=2)
    assert np.nanmax(values) > 0.49
    assert (points[-60:, 0] < 0.6).mean() > 0.8


def test_generations_of_failures_teach_nothing() -> None:
    points, _ = run(CMAES(population=5), lambda x: np.nan, 40, dimension=2)
    spread = points.std(axis=0)
    assert ((spread > 0.15) & (spread < 0.35)).all()
    assert len(np.unique(points, axis=0)) == len(points)


def test_the_seed_decides() -> None:
    first, again, other = (run(CMAES(), hill, 20, dimension=3, seed=seed)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.isin(first, other).any()


@pytest.mark.parametrize("sigma", [0.0, -1.0, np.nan, np.inf])
def test_a_bad_spread_is_refused(sigma: float) -> None:
    with refuses(InputError, "sigma"):
        CMAES(sigma=sigma)


def test_a_population_too_small_is_refused() -> None:
    with refuses(InputError, "population", 4, 3):
        CMAES(population=3)


def test_without_the_package_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cmaes", None)
    with refuses(InputError, "CMA", "ES", "ctxval[searches]"):
        by_name("cma-es")
