"""The charts of the page: how the interval of the largest distance closed."""

from __future__ import annotations

import re

import pytest

from ctxval.web.jobs import Interval, interval_chart


@pytest.mark.parametrize(
    "history", [[], [Interval(3, 0.1, 0.4)], [Interval(1, float("-inf"), None), Interval(2, 0.1, 0.2)]]
)
def test_one_interval_is_no_chart(history: list[Interval]) -> None:
    assert not interval_chart(history, 0.5, "m")


def test_the_interval_is_drawn_with_a_threshold_that_is_near() -> None:
    history = [Interval(1, 0.1, None), Interval(2, 0.2, 9.0), Interval(3, 0.2, 0.3)]
    drawn = str(interval_chart(history, 0.5, "m"))
    assert "largest distance [m]" in drawn
    assert re.search("threshold 0.5<", drawn)
    assert "threshold 90, above this chart" in str(interval_chart(history[:1] + history[2:], 90.0, ""))
