"""Tests at tasks where nobody chose to look."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from itertools import combinations, permutations, product
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval._util.boxes import latin_hypercube
from ctxval.certificates.prediction_tests import (
    DRAWN,
    MANY,
    TESTS,
    probability_missed,
    share_missed,
    shown_by_tests,
)
from ctxval.core.trial import Origin

SPREAD: Origin = "spread"
IID: Origin = "iid"
SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS, st.integers(1, 6), st.integers(1, 12))
def test_each_part_of_each_parameter_has_a_test(seed: int, dimension: int, points: int) -> None:
    tests = latin_hypercube(points, dimension, np.random.default_rng(seed))
    parts = np.sort(np.floor(points * tests).astype(int), axis=0)
    assert (parts == np.arange(points)[:, None]).all()


def test_each_test_is_uniform() -> None:
    tests = np.array([latin_hypercube(TESTS, 2, np.random.default_rng(seed)) for seed in range(400)])
    for row in range(TESTS):
        counts, _ = np.histogram(tests[:, row], bins=5, range=(0, 1))
        assert np.abs(counts - 160).max() < 5 * np.sqrt(160)


# The bound on what tests miss


def arrangements(points: int, dimension: int) -> Iterator[list[tuple[int, ...]]]:
    """Yield the cells of each hypercube; the first parameter gives the order of the points."""
    for others in product(permutations(range(points)), repeat=dimension - 1):
        yield [(row, *(order[row] for order in others)) for row in range(points)]


def chance_of_missing(kept: np.ndarray, count: int) -> float:
    """Return the exact probability that ``count`` points of a hypercube lie in a set.

    The set is given by its share of each cell, with one axis for each parameter.
    """
    points, dimension = kept.shape[0], kept.ndim
    chances = [
        np.prod([kept[cells[row]] for row in rows])
        for cells in arrangements(points, dimension)
        for rows in combinations(range(points), count)
    ]
    return float(np.mean(chances))


@pytest.mark.parametrize(("points", "dimension"), [(2, 2), (3, 2), (2, 3)])
def test_no_set_of_cells_is_missed_more_often_than_the_bound_says(points: int, dimension: int) -> None:
    shape, worst = (points,) * dimension, 0.0
    for cells in product((0.0, 1.0), repeat=points**dimension):
        kept = np.reshape(cells, shape)
        for count in range(1, points + 1):
            bound = probability_missed(kept.mean(), dimension, points) ** count
            chance = chance_of_missing(kept, count)
            assert chance <= bound + 1e-12
            worst = max(worst, chance / bound if 0 < bound < 1 else 0.0)
    assert worst > 0.7 or dimension > 2  # the bound is no more than it must be


@given(st.sampled_from([(3, 1), (3, 2), (4, 2), (2, 3), (3, 3), (2, 4)]), SEEDS, st.floats(0.1, 10))
def test_no_set_is_missed_more_often_than_the_bound_says(size: tuple[int, int], seed: int, power: float) -> None:
    points, dimension = size
    rng = np.random.default_rng(seed)
    kept = rng.random((points,) * dimension) ** power
    kept[rng.random(kept.shape) < 0.3] = rng.integers(2)
    for count in range(1, points + 1):
        bound = probability_missed(kept.mean(), dimension, points) ** count
        assert chance_of_missing(kept, count) <= bound + 1e-12


def blocks(points: np.ndarray, halves: int) -> np.ndarray:
    """Return which points lie in blocks of cells along the diagonal, where a hypercube lies most often."""
    return np.asarray((np.floor(halves * points) == np.floor(halves * points[..., :1])).all(axis=-1))


SETS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "diagonal": lambda points: blocks(points, 2),
    "cells of the diagonal": lambda points: blocks(points, TESTS),
    "corner": lambda points: (points > 0.6).all(axis=-1),
    "bin": lambda points: (points[..., 0] > 0.3) & (points[..., 0] < 0.4),
    "comb": lambda points: ((TESTS * points) % 1 < 0.2).any(axis=-1),
}


@cache
def drawn(dimension: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the tests of 4000 campaigns, and many tasks."""
    rng = np.random.default_rng(0)
    tests = np.array([latin_hypercube(TESTS, dimension, rng) for _ in range(4000)])
    return tests, rng.random((200_000, dimension))


@pytest.mark.parametrize("dimension", [1, 2, 3])
@pytest.mark.parametrize("name", SETS)
def test_sets_are_missed_as_rarely_as_the_bound_says(name: str, dimension: int) -> None:
    tests, tasks = drawn(dimension)
    outside = SETS[name](tasks).mean()
    for inside in (True, False):
        kept = float(outside if inside else 1 - outside)
        for count in (3, TESTS):
            missed = (SETS[name](tests[:, :count]) == inside).all(axis=1).mean()
            bound = probability_missed(min(kept + 0.005, 1.0), dimension) ** count
            assert missed <= bound + 4 * np.sqrt(bound / 4000)


def test_what_is_other_in_one_of_eight_parts_is_met_with_certainty() -> None:
    rng = np.random.default_rng(1)
    tests, draws = np.array([latin_hypercube(TESTS, 3, rng) for _ in range(500)]), rng.random((4000, MANY, 3))
    for part in range(TESTS):
        assert (np.floor(TESTS * tests) == part).any(axis=1).all()
    met = (np.floor(TESTS * draws) == 2).any(axis=1).mean()
    assert met == pytest.approx(1 - (7 / 8) ** MANY, abs=0.01)
    assert met > 0.94


def test_no_design_has_a_test_in_each_part_of_two_parameters_and_the_bound_of_independent_draws() -> None:
    points = 3
    diagonal = np.eye(points)
    assert chance_of_missing(diagonal, points) == pytest.approx(1 / 6)
    assert chance_of_missing(diagonal, points) > diagonal.mean() ** points


# The sentence without assumptions


@pytest.mark.parametrize(
    ("spread", "independent", "dimension", "percent"),
    [
        (0, 8, 5, 31.2),
        (0, 22, 2, 12.7),
        (0, 59, 7, 4.95),
        (8, 0, 1, 31.2),
        (8, 0, 2, 38.0),
        (8, 0, 3, 46.2),
        (16, 0, 2, 20.9),
        (8, 14, 1, 12.7),
        (8, 14, 2, 13.6),
    ],
)
def test_the_share_that_tests_leave(spread: int, independent: int, dimension: int, percent: float) -> None:
    assert 100 * share_missed(spread, independent, dimension, 0.95) == pytest.approx(percent, abs=0.06)


@given(st.integers(0, 20), st.integers(0, 60), st.integers(1, 8), st.floats(0.5, 0.99))
def test_more_tests_leave_less(spread: int, independent: int, dimension: int, confidence: float) -> None:
    share = share_missed(spread, independent, dimension, confidence)
    assert 0 < share <= 1
    assert share_missed(spread + 1, independent, dimension, confidence) <= share
    assert share_missed(spread, independent + 1, dimension, confidence) <= share
    assert share_missed(spread, independent, dimension + 1, confidence) >= share - 1e-12


def test_what_tests_show_is_counted_by_their_origins() -> None:
    origins = [SPREAD] * 8 + [IID] * 2
    shown = shown_by_tests(origins, 2, 0.95, uniform=True)
    assert (shown["drawn"], shown["independent"], shown["spread"]) == (10, 2, 8)
    assert shown["share_missed"] == share_missed(8, 2, 2, 0.95)
    assert set(DRAWN) <= set(get_args(Origin))


def test_points_of_a_hypercube_show_nothing_of_tasks_with_a_distribution() -> None:
    assert shown_by_tests([SPREAD] * 8, 2, 0.95, uniform=False)["share_missed"] is None
    shown = shown_by_tests([SPREAD] * 8 + [IID] * 2, 2, 0.95, uniform=False)
    assert shown["share_missed"] == share_missed(0, 2, 2, 0.95)


def test_without_tests_nothing_is_shown() -> None:
    assert shown_by_tests([], 2, 0.95, uniform=True)["share_missed"] is None
