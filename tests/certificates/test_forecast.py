from __future__ import annotations

import sys

import numpy as np
import pytest

from ctxval.certificates import Forecast, Maxima, Sample, draw_maxima, forecast
from facts import assert_names
from rig_thorough import more

CONFIDENCE = 0.9


@pytest.fixture(scope="module")
def sample() -> Sample:
    X = np.array([[0.0], [0.15], [0.4], [0.55], [0.8], [1.0]])
    y = 1 + np.sin(9 * X[:, 0])
    return Sample(X, y, ["acquisition"] * len(y), ["completed"] * len(y))


@pytest.fixture(scope="module")
def found(sample: Sample) -> Maxima:
    return draw_maxima(sample, draws=12, paths=4)


@pytest.mark.slow
def test_what_is_decided_already_takes_no_more_executions(sample: Sample, found: Maxima) -> None:
    validated = forecast(sample, found, 100 * found.upper(CONFIDENCE), CONFIDENCE, futures=8)
    assert (validated.executions, validated.validated, validated.falsified) == (0, 1.0, 0.0)
    falsified = forecast(sample, found, 0.9 * sample.best, CONFIDENCE, futures=8)
    assert (falsified.executions, falsified.validated, falsified.falsified) == (0, 0.0, 1.0)


@pytest.mark.slow
def test_a_threshold_closer_to_the_largest_distance_takes_more_executions_to_keep(
    sample: Sample, found: Maxima
) -> None:
    gap = found.upper(CONFIDENCE) - sample.best
    near, far = (forecast(sample, found, sample.best + share * gap, CONFIDENCE, futures=8) for share in (0.4, 3.0))
    assert near.executions is not None
    assert far.executions is not None
    assert near.executions > far.executions
    assert near.validated < far.validated
    assert near.falsified > far.falsified


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.3, 0.99, *more(0.6, 0.9)])
def test_what_the_bound_leaves_undecided_takes_at_least_one_execution(
    share: float, sample: Sample, found: Maxima
) -> None:
    tau = sample.best + share * (found.upper(CONFIDENCE) - sample.best)
    expected = forecast(sample, found, tau, CONFIDENCE, futures=4)
    assert expected.executions is None or expected.executions >= 1


@pytest.mark.thorough
def test_a_forecast_is_the_same_twice(sample: Sample, found: Maxima) -> None:
    tau = 0.5 * (sample.best + found.upper(CONFIDENCE))
    first, again = (forecast(sample, found, tau, CONFIDENCE, seed=3, futures=4) for _ in range(2))
    assert first == again
    assert 0 <= first.validated + first.falsified <= 1


def test_beyond_the_horizon_nothing_is_promised(sample: Sample, found: Maxima, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules["ctxval.certificates.forecast"], "HORIZON", 0)
    tau = 0.5 * (sample.best + found.upper(CONFIDENCE))
    expected = forecast(sample, found, tau, CONFIDENCE, futures=4)
    assert expected.executions is None
    assert "more than" in str(expected)


def test_a_forecast_speaks_in_words() -> None:
    facts = (7,)
    assert_names(str(Forecast(7, 0.8, 0.2)), *facts)
    assert "falsified in 90 %" in str(Forecast(1, 0.0, 0.9))
    fewest = Forecast(1, 0.95, 0.05, fewest=True)
    assert_names(str(fewest), 1, 95)
    facts = (2,)
    assert_names(str(Forecast(8, 0.02, 0.98, fewest=True)), *facts)
