"""Distributions of tasks: against scipy's truncated distributions, and what a store knows of them."""

from __future__ import annotations

import json

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from ctxval import Normal, TaskSpace
from ctxval._util.describe import describe
from ctxval.core.space import DISTRIBUTION
from ctxval.core.task_distribution import distribution_text
from ctxval.errors import InputError, UnknownNameError
from facts import assert_names, refuses

SPACE = TaskSpace(goal=(-1.0, 3.0, "rad"), load=([0.0, 0.0], [5.0, 2.0], "kg"))
N = 20_000


def drawn(space: TaskSpace, n: int = N) -> np.ndarray:
    return space.iid(n, np.random.default_rng(1))


def test_a_normal_is_truncated_to_the_bounds_and_all_else_is_uniform() -> None:
    points = drawn(SPACE.distributed(goal=Normal(0.0, 0.7), load=Normal([1.0, 2.0], [1.0, 0.5])))
    for column, (mean, deviation) in enumerate([(0.0, 0.7), (1.0, 1.0), (2.0, 0.5)]):
        low, high = SPACE.low[column], SPACE.high[column]
        exact = stats.truncnorm((low - mean) / deviation, (high - mean) / deviation, mean, deviation)
        assert stats.kstest(points[:, column], exact.cdf).pvalue > 1e-3
    plain = drawn(SPACE.distributed(goal=Normal(0.0, 0.7)))
    assert stats.kstest(plain[:, 2], stats.uniform(0, 2).cdf).pvalue > 1e-3


def test_a_distribution_of_scipy_is_truncated_too() -> None:
    points = drawn(SPACE.distributed(load=stats.expon(scale=0.7)))
    exact = stats.expon(scale=0.7)
    for column, high in ((1, 5.0), (2, 2.0)):
        shares = exact.cdf(points[:, column]) / exact.cdf(high)
        assert stats.kstest(shares, "uniform").pvalue > 1e-3


def test_far_tails_are_drawn_from() -> None:
    for mean in (-9.0, 11.0):  # eight and more deviations outside the bounds
        points = drawn(SPACE.distributed(goal=Normal(mean, 1.5)), 2000)[:, 0]
        exact = stats.truncnorm((-1 - mean) / 1.5, (3 - mean) / 1.5, mean, 1.5)
        assert stats.kstest(points, exact.cdf).pvalue > 1e-3


def test_a_sampler_draws_whole_tasks() -> None:
    def along_a_line(rng: np.random.Generator, n: int) -> np.ndarray:
        return rng.random((n, 1)) * [1.0, 2.0, 1.0]

    points = drawn(SPACE.sampled(along_a_line), 50)
    np.testing.assert_allclose(points[:, 1], 2 * points[:, 0])
    unit = SPACE.sampled(along_a_line).unit_draws(50, np.random.default_rng(1))
    np.testing.assert_allclose(SPACE.from_unit(unit), points, atol=1e-12)


@given(st.floats(-20, 20), st.floats(0.05, 50), st.integers(0, 1000))
def test_draws_stay_in_the_unit_cube_and_repeat(mean: float, deviation: float, seed: int) -> None:
    try:
        space = SPACE.distributed(goal=Normal(mean, deviation))
    except InputError:
        return
    points = space.unit_draws(20, np.random.default_rng(seed))
    assert ((points >= 0) & (points <= 1)).all()
    np.testing.assert_array_equal(points, space.unit_draws(20, np.random.default_rng(seed)))


def test_without_a_distribution_nothing_changes() -> None:
    rng = np.random.default_rng(5)
    np.testing.assert_array_equal(SPACE.unit_draws(7, np.random.default_rng(5)), rng.random((7, 3)))
    assert SPACE.distribution is None
    assert DISTRIBUTION not in SPACE.describe()
    space = SPACE.distributed(goal=Normal(0, 1))
    assert SPACE.distribution is None  # the space itself is left alone
    assert {key: value for key, value in space.describe().items() if key != DISTRIBUTION} == SPACE.describe()


def test_a_store_and_a_person_can_tell_distributions_apart() -> None:
    def sampler(rng: np.random.Generator, n: int) -> np.ndarray:
        return np.zeros((n, 3))

    spaces = {
        "goal normal (mean 0.0, deviation 0.3), all else uniform": SPACE.distributed(goal=Normal(0.0, 0.3)),
        "load normal (mean [1.0, 2.0], deviation 0.5), all else uniform": SPACE.distributed(
            load=Normal([1.0, 2.0], 0.5)
        ),
        "load scipy.stats.expon (options {'scale': 2.0}), all else uniform": SPACE.distributed(
            load=stats.expon(scale=2.0)
        ),
    }
    for text, space in spaces.items():
        described = json.loads(json.dumps(describe(space)))[DISTRIBUTION]
        assert distribution_text(described) == text
        assert described == json.loads(json.dumps(describe(space)))[DISTRIBUTION]
    assert_names(distribution_text(SPACE.sampled(sampler).describe()[DISTRIBUTION]), "sampler")
    assert len(distribution_text({"goal": {"type": "x" * 10_000}})) < 1000
    assert distribution_text(3) == "3"


def test_what_cannot_be_a_distribution_is_refused() -> None:
    for given_, facts in (
        ({"goal": stats.poisson(3)}, ("goal", "scipy.stats.expon")),
        ({"goal": 3.0}, ("goal", "scipy.stats.expon")),
        ({"goal": Normal(1e6, 0.1)}, ("goal",)),
        ({"goal": Normal([0.0, 1.0], 1.0)}, (1, "goal")),
        ({"load": Normal([0.0, 1.0, 2.0], 1.0)}, (2, "load")),
        ({}, ("distributed",)),
    ):
        with refuses(InputError, *facts):
            SPACE.distributed(**given_)
    with refuses(UnknownNameError, "goal", "gaol"):
        SPACE.distributed(gaol=Normal(0, 1))
    for mean, deviation, fact in ((0.0, 0.0, "deviation"), (0.0, -1.0, "deviation"), (np.nan, 1.0, "mean")):
        with refuses(InputError, fact):
            Normal(mean, deviation)
    with refuses(InputError, "sampler"):
        SPACE.sampled(np.zeros(3))  # type: ignore[arg-type]
    for returned, facts in (
        (np.zeros((5, 2)), ((5, 3), "tasks")),
        (np.full((5, 3), 9.0), ("sampler",)),
        (np.full((5, 3), np.nan), ("sampler",)),
    ):
        with refuses(InputError, *facts):
            SPACE.sampled(lambda rng, n, rows=returned: rows).unit_draws(5, np.random.default_rng(0))
