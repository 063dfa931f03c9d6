from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, searches
from ctxval._util.arrays import Array
from ctxval.errors import InputError, UnknownNameError
from ctxval.searches import (
    GPUCB,
    REGISTRY,
    BaseSearch,
    Prediction,
    Random,
    SamplingDiscarding,
    Search,
    by_name,
)
from ctxval.testing import check_search
from facts import refuses


class Stranger:
    """A search of three methods, whose other attributes are its own, whatever they are called."""

    iid = "never"
    initial = "x"
    discard = None

    def __init__(self) -> None:
        self.times: list[float] = []

    def reset(self, dimension: int, seed: int) -> None:
        self.dimension, self.seed, self.told = dimension, seed, 0

    def ask(self, n: int = 1) -> Array:
        rng = np.random.default_rng([self.seed, self.told])
        return rng.random((n, self.dimension))

    def tell(self, points: Any, values: Any) -> None:
        self.told += len(points)
        self.times.append(float(self.told))

    def use_prediction(self) -> None:
        raise AssertionError("its own method, of another meaning")

    note = remember = estimate = surrogate = use_prediction

    def describe(self) -> dict[str, object]:
        return {}


class Bare:
    """A search of three methods and nothing else."""

    def reset(self, dimension: int, seed: int) -> None:
        self.inner = Stranger()
        self.inner.reset(dimension, seed)

    def ask(self, n: int = 1) -> Array:
        return self.inner.ask(n)

    def tell(self, points: Any, values: Any) -> None:
        self.inner.tell(points, values)

    def describe(self) -> dict[str, object]:
        return {}


class Noting(BaseSearch):
    """A search that inherits the base class and has two of its methods; it asks for one point after the other."""

    iid = True

    def reset(self, dimension: int, seed: int) -> None:
        self.dimension, self.told, self.reminded = dimension, 0, list[Any]()

    def ask(self, n: int = 1) -> Array:
        return np.full((n, self.dimension), (self.told % 10) / 10)

    def tell(self, points: Any, values: Any) -> None:
        self.told += len(points)

    def note(self) -> dict[str, Any]:
        return {"told": self.told}

    def remember(self, notes: Any) -> None:
        self.reminded = list(notes)

    def describe(self) -> dict[str, object]:
        return {}


@pytest.mark.parametrize("search", [Stranger(), Bare()])
def test_a_campaign_takes_any_search_of_three_methods(search: Search, tmp_path: Any) -> None:
    campaign = Campaign(make_validation(), search=search, store=tmp_path / "a.sqlite").run(3)
    resumed = Campaign(make_validation(), search=search, store=tmp_path / "a.sqlite").run(5)
    assert campaign.search is search
    assert [trial.origin for trial in resumed.trials] == ["acquisition"] * 5
    assert all(trial.note.search is None for trial in resumed.trials)
    assert resumed.worst is not None
    assert resumed.estimate == resumed.worst.distance
    mean, _ = resumed.surrogate().predict(np.array([trial.unit_point for trial in resumed.trials]))
    np.testing.assert_allclose(mean, [trial.distance for trial in resumed.trials], atol=1e-3)


def test_what_a_subclass_has_of_its_own_reaches_the_campaign(tmp_path: Any) -> None:
    Campaign(make_validation(), search=Noting(), store=tmp_path / "a.sqlite").run(2, until=lambda _: False)
    search = Noting()
    resumed = Campaign(make_validation(), search=search, store=tmp_path / "a.sqlite")
    assert [trial.origin for trial in resumed.trials] == ["iid", "iid"]
    assert [trial.note.search["told"] for trial in resumed.trials if trial.note.search] == [0, 1]
    assert search.reminded == [trial.note.search for trial in resumed.trials]


def test_only_a_search_that_takes_a_prediction_is_given_one() -> None:
    given: list[Prediction | None] = []

    class Predicting(searches.Random):
        def use_prediction(self, prediction: Prediction | None) -> None:
            given.append(prediction)

    assert Predicting().uses_prediction
    assert searches.Auto().uses_prediction
    for search in (searches.GPUCB(), BaseSearch.of(Stranger())):
        assert not search.uses_prediction
    Campaign(make_validation(), search=Predicting()).run(2)
    assert len(given) == 2


def test_the_estimate_of_the_maximum_is_the_search_s() -> None:
    points, values = np.array([[0.1], [0.1], [0.2], [0.2], [0.3]]), np.array([1.0, 3.0, 2.5, 2.7, 9.0])
    assert searches.Random().estimate(points, values) == 9.0
    assert searches.SamplingDiscarding(2).estimate(points, values) == 2.7
    assert searches.SamplingDiscarding(5).estimate(points, values) is None
    for search in (searches.Random(), BaseSearch.of(Stranger())):
        assert search.estimate(np.empty((0, 1)), np.empty(0)) is None


@pytest.mark.parametrize("search", [Bare(), BaseSearch.of(Bare())])
def test_searches_of_three_methods_keep_the_contract(search: Search) -> None:
    check_search(search)


# Registry


@pytest.mark.parametrize("name", REGISTRY.built_in)
def test_every_name_makes_a_search(name: str) -> None:
    search = by_name(name)
    assert isinstance(search, Search)
    search.reset(3, seed=0)
    assert search.ask(2).shape == (2, 3)


def test_names_stand_for_their_classes() -> None:
    assert type(by_name("gp-ucb")) is GPUCB
    assert type(by_name("random")) is Random
    assert type(by_name("sampling-discarding")) is SamplingDiscarding


def test_options_reach_the_search() -> None:
    assert by_name("gp-ucb", beta=4.0, initial=3).beta == 4.0
    assert by_name("sampling-discarding", discard=2).discard == 2


def test_two_searches_of_one_name_are_two() -> None:
    assert by_name("random") is not by_name("random")


@pytest.mark.parametrize(("name", "nearest"), [("gp_ucb", "gp-ucb"), ("randon", "random"), ("GP-UCB ", None)])
def test_an_unknown_name_is_refused_with_the_nearest_one(name: str, nearest: str | None) -> None:
    with refuses(UnknownNameError, name, nearest or "gp-ucb"):
        by_name(name)


def test_an_unknown_option_is_refused_with_search_and_option() -> None:
    with refuses(UnknownNameError, "gamma", "prior_mean"):
        by_name("gp-ucb", gamma=2)
    with refuses(UnknownNameError, "random", "seed"):
        by_name("random", seed=2)


def test_an_option_of_a_bad_value_is_refused_by_value() -> None:
    with refuses(InputError, "beta", 0, -1):
        by_name("gp-ucb", beta=-1)
