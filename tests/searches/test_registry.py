from __future__ import annotations

import pytest

from ctxval.errors import InputError, UnknownNameError
from ctxval.searches import GPUCB, REGISTRY, Random, SamplingDiscarding, Search, by_name


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
    hint = f"did you mean '{nearest}'" if nearest else "known: .*gp-ucb"
    with pytest.raises(UnknownNameError, match=rf"no search is called '{name}'; {hint}"):
        by_name(name)


def test_an_unknown_option_is_refused_with_search_and_option() -> None:
    with pytest.raises(InputError, match=r"no argument of the search gp-ucb is called 'gamma'"):
        by_name("gp-ucb", gamma=2)
    with pytest.raises(InputError, match=r"no argument of the search random is called 'seed'; known: none"):
        by_name("random", seed=2)


def test_an_option_of_a_bad_value_is_refused_by_value() -> None:
    with pytest.raises(InputError, match=r"beta must be a finite number >= 0, got -1"):
        by_name("gp-ucb", beta=-1)
