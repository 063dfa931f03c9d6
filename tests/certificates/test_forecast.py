from __future__ import annotations

from ctxval.certificates import Forecast
from facts import assert_names


def test_a_forecast_speaks_in_words() -> None:
    assert_names(str(Forecast(1, 0.95)), 1, 95)
    assert_names(str(Forecast(8, 0.02)), 2)
