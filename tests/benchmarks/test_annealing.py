from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from ask_and_tell import hill, run
from ctxval.searches import Random
from ctxval.testing import check_search
from rig_thorough import more

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from annealing import Annealing, reflected


@pytest.mark.parametrize("dimension", [1, 4])
def test_it_keeps_the_contract_of_a_search(dimension: int) -> None:
    check_search(Annealing(), dimension=dimension, budget=25)


@pytest.mark.parametrize("seed", [0, *more(1, 2)])
def test_it_converges_on_a_hill(seed: int) -> None:
    _, values = run(Annealing(), hill, 300, dimension=5, seed=seed)
    _, random = run(Random(), hill, 300, dimension=5, seed=seed)
    assert values.max() > -2e-3 > random.max()


def test_it_climbs_into_a_corner_and_stays_inside_the_cube() -> None:
    points, values = run(Annealing(cooling=0.97), lambda x: float(x[0] - x[1]), 200, dimension=2)
    assert ((points >= 0) & (points <= 1)).all()
    assert values.max() > 0.98


def test_moves_wider_than_the_cube_stay_inside() -> None:
    points, _ = run(Annealing(move=3.0, cooling=1.0), hill, 100, dimension=2)
    assert ((points >= 0) & (points <= 1)).all()


def test_told_any_part_of_the_history_again_it_asks_for_the_same_next_point() -> None:
    points, values = run(Annealing(), lambda x: np.nan if x[0] > 0.8 else hill(x), 60, dimension=2, seed=4)
    assert np.isnan(values).any()
    for told in range(1, len(points)):
        fresh = Annealing()
        fresh.reset(2, seed=4)
        fresh.tell(points[:told], values[:told])
        np.testing.assert_array_equal(fresh.ask(1)[0], points[told])


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_its_choices_do_not_depend_on_the_units_of_the_values(scale: float) -> None:
    points, _ = run(Annealing(), hill, 60, dimension=2)
    scaled, _ = run(Annealing(), lambda x: scale * hill(x), 60, dimension=2)
    np.testing.assert_allclose(scaled, points, atol=1e-12)


def test_while_hot_it_crosses_a_valley_that_it_does_not_when_cold() -> None:
    def two_hills(x: np.ndarray) -> float:
        return float(0.6 * np.exp(-(((x[0] - 0.2) / 0.1) ** 2)) + np.exp(-(((x[0] - 0.8) / 0.1) ** 2)))

    def summits(temperature: float) -> int:
        search = Annealing(temperature, cooling=1.0, move=0.12, restart=0.0)
        found = 0
        for seed in range(8):
            search.reset(1, seed)
            search.tell([[0.2]], [0.6])  # on the lower hill
            while len(search.points) < 100:
                point = search.ask(1)
                search.tell(point, [two_hills(point[0])])
            found += search.values.max() > 0.9
        return int(found)

    assert summits(1e-9) == 0
    assert summits(5.0) >= 6


def test_without_restarts_and_temperature_it_only_ever_moves_uphill() -> None:
    points, values = run(Annealing(1e-12, move=0.05, restart=0.0), hill, 80, dimension=2)
    for told in range(1, len(points)):
        best = points[np.argmax(values[:told])]
        assert np.abs(points[told] - best).max() < 5 * 0.05


def test_only_restarts_are_a_random_search() -> None:
    points, _ = run(Annealing(restart=1.0), hill, 400, dimension=1)
    counts, _ = np.histogram(points, bins=4, range=(0, 1))
    assert (np.abs(counts - 100) < 30).all()


def test_it_never_walks_to_a_failed_point() -> None:
    # Everything but a small ball fails: each move starts from inside it.
    def fragile(x: np.ndarray) -> float:
        return hill(x) if np.abs(x - 0.3).max() < 0.25 else np.nan

    points, values = run(Annealing(move=0.1, restart=0.0), fragile, 100, dimension=2)
    first = int(np.argmax(np.isfinite(values)))
    assert np.isnan(values[first:]).any()
    assert (np.abs(points[first + 1 :] - 0.3).max(axis=1) < 0.25 + 5 * 0.1).all()


def test_points_are_folded_at_the_faces() -> None:
    np.testing.assert_allclose(reflected(np.array([-0.2, 0.4, 1.3, 2.1, -1.5])), [0.2, 0.4, 0.7, 0.1, 0.5])
