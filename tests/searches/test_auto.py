from __future__ import annotations

import numpy as np
import pytest

from ctxval._util.arrays import Array
from ctxval.errors import InputError
from ctxval.searches import Auto, Prediction


def peak(Z: Array) -> Array:
    return np.exp(-10 * ((Z - 0.3) ** 2).sum(axis=1))


@pytest.mark.parametrize(("designs", "most"), [(None, 150), (30, 30), (10_000, 150)])
def test_a_choice_designs_no_more_controllers_than_are_afforded(designs: int | None, most: int) -> None:
    asked: list[int] = []

    def expected(points: Array) -> tuple[Array, Array]:
        asked.append(len(points))
        return peak(points), np.full(len(points), 0.1)

    search = Auto() if designs is None else Auto(designs=designs)
    search.reset(2, 0)
    search.use_prediction(Prediction(expected, lambda rows: np.empty(0), budget=150))
    point = search.ask()
    # What is noted of the choice, and what it promises, costs some more.
    assert 0.5 * most <= sum(asked) <= most + 8
    assert peak(point)[0] > 0.5


@pytest.mark.parametrize("designs", [0, -3])
def test_without_a_design_there_is_no_choice(designs: int) -> None:
    with pytest.raises(InputError, match="designs must be at least 1"):
        Auto(designs=designs)
