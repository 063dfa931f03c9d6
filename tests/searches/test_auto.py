from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ctxval._util.arrays import Array
from ctxval.errors import InputError, UnknownNameError
from ctxval.gp.ascent import usual_effort
from ctxval.searches import Auto, Costs, Prediction, by_name
from facts import refuses


def peak(Z: Array) -> Array:
    return np.exp(-10 * ((Z - 0.3) ** 2).sum(axis=1))


def asked(search: Auto, *costs: Costs, choices: int = 1) -> tuple[list[int], list[dict[str, Any] | None]]:
    """Return how many points a search predicts for each choice, and its notes; the values are told in between."""
    counts, notes = [], []
    for k in range(choices):
        predicted: list[int] = []

        def expected(points: Array, predicted: list[int] = predicted) -> tuple[Array, Array]:
            predicted.append(len(points))
            return peak(points), np.full(len(points), 0.1)

        measure = (lambda k=k: costs[min(k, len(costs) - 1)]) if costs else None
        search.use_prediction(Prediction(expected, lambda rows: np.empty(0), 500, costs=measure))
        point = search.ask()
        counts.append(sum(predicted))
        notes.append(search.note())
        search.tell(point, peak(point))
    return counts, notes


def made(*options: Any) -> Auto:
    search = Auto(*options)
    search.reset(2, 0)
    return search


@pytest.mark.parametrize(("thinking", "most"), [("balanced", 500), ("thorough", 500), ("fast", 75)])
def test_a_choice_predicts_no_more_points_than_its_thinking_allows(thinking: Any, most: int) -> None:
    (count,), _ = asked(made(thinking))
    # What is noted of the choice, and what it promises, costs some more.
    assert 0.5 * most <= count <= most + 8


@pytest.mark.parametrize(
    ("prediction", "evaluation", "designs"),
    [(1e-3, 0.0, 500), (0.1, 0.0, 75), (0.1, 25.0, 200), (0.1, 60.0, 500), (0.1, np.inf, 500), (10.0, 3.0, 75)],
)
def test_thinking_takes_no_longer_than_an_evaluation(prediction: float, evaluation: float, designs: int) -> None:
    (count,), (note,) = asked(made(), Costs(prediction, evaluation))
    assert note is not None
    assert note["designs"] == designs
    assert 0.4 * designs <= count <= designs + 8


def test_rough_predictions_and_batches_have_prices_of_their_own() -> None:
    search = by_name("auto")
    search.reset(6, 0)
    assert isinstance(search, Auto)
    effort = usual_effort(6, 2000)
    assert effort.rough > effort.exact > 0
    seconds = search.thinking_seconds(Costs(1.0, None, rough=0.1, batch=0.5), 2000)
    np.testing.assert_allclose(seconds, effort.exact + 0.1 * effort.rough + 0.5 * effort.batches)
    np.testing.assert_allclose(search.thinking_seconds(Costs(1.0, None), 2000), effort.exact + effort.rough)


def test_a_choice_that_is_mostly_rough_predicts_more_points() -> None:
    def designs(rough: float) -> int:
        search = made()
        search.reset(6, 0)
        prediction = Prediction(lambda Z: (peak(Z), peak(Z)), lambda rows: np.empty(0), 2000)
        return search.designs(replace(prediction, costs=lambda: Costs(0.01, 3.0, rough=rough)))

    assert [designs(rough) for rough in (0.01, 0.003, 0.001)] == [300, 800, 2000]


def test_the_number_is_fixed_once_an_evaluation_was_timed() -> None:
    costs = (Costs(0.1, None), Costs(0.1, 0.0), Costs(0.1, np.inf))
    counts, notes = asked(made(), *costs, choices=4)
    assert [(note or {}).get("designs") for note in notes] == [None, 75, None, None]
    assert counts[0] > 0
    assert all(count <= 75 + 8 for count in counts[1:])


def test_a_resumed_search_takes_the_number_from_its_notes() -> None:
    live = made()
    _, notes = asked(live, Costs(0.1, 0.0), choices=3)
    resumed = made()
    resumed.tell(live.points, live.values)
    resumed.remember(notes)
    costly = Costs(1e-6, np.inf)  # another machine measures other costs
    found = [asked(search, costly) for search in (live, resumed)]
    assert found[0] == found[1]
    np.testing.assert_array_equal(live.points, resumed.points)


@pytest.mark.parametrize(("seconds", "designs"), [(60.0, 500), (25.0, 200), (3.0, 25), (1e-3, 8)])
def test_a_number_is_the_seconds_of_a_choice(seconds: float, designs: int) -> None:
    _, (note,) = asked(made(seconds), Costs(0.1, np.inf))
    assert note is not None
    assert (note["designs"], note["thinking_seconds"]) == (designs, seconds)


def test_the_seconds_of_the_campaign_come_before_those_of_the_search() -> None:
    search = made("thorough")
    predicted = Prediction(lambda Z: (peak(Z), peak(Z)), lambda rows: np.empty(0), 500, costs=lambda: Costs(0.1, 1.0))
    assert [search.designs(replace(predicted, thinking=limit)) for limit in (None, 25.0)] == [500, 200]


def test_a_named_share_is_never_measured() -> None:
    def refuse() -> Costs:
        raise AssertionError

    for thinking in ("fast", "thorough"):
        search = made(thinking)
        search.use_prediction(Prediction(lambda Z: (peak(Z), peak(Z)), lambda rows: np.empty(0), 500, costs=refuse))
        search.ask()
        assert "designs" not in (search.note() or {})


@pytest.mark.parametrize("thinking", [0, -3, True, "slow", None])
def test_other_thinking_is_refused(thinking: Any) -> None:
    with refuses(InputError, "balanced", "fast", "thorough"):
        Auto(thinking)


def test_the_option_is_given_by_name() -> None:
    assert by_name("auto", thinking="fast").thinking == "fast"  # type: ignore[attr-defined]
    with refuses(UnknownNameError, "designs", "auto"):
        by_name("auto", designs=40)
