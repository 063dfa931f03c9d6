"""Refinement of a model whose system records outputs in the place of states."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ctxval import Campaign, searches
from ctxval.errors import InputError
from ctxval.studies.refinement import Refinement, refine
from facts import refuses
from rig_outputs import Swing, swing_validation

THRESHOLD, GOALS = 0.05, np.linspace(-1, 1, 11)[:, None]


def refined(store: Path | None = None, budget: int = 3, **parts: object) -> Refinement:
    search = searches.by_name("auto", thinking="fast")
    return refine(Campaign(swing_validation(**parts), search=search, store=store, seed=1), THRESHOLD, budget)


@pytest.mark.slow
def test_a_model_without_friction_is_refined_from_angles_alone(tmp_path: Path) -> None:
    found = refined(tmp_path / "a.sqlite")
    before, after = (each.campaign.validation.distances(GOALS).max() for each in (found.rounds[0], found.last))
    assert before > 2 * THRESHOLD
    assert after < before / 5
    assert found.residual is not None
    assert list(found.residual.states) == ["x0", "x1"]  # the states of M, and not the output
    assert found.accuracy["x1"][1] < 0.8 * found.accuracy["x1"][0]
    again = refined(tmp_path / "a.sqlite")
    assert again.accuracy == found.accuracy
    assert again.residual is not None
    assert again.residual.to_json() == found.residual.to_json()


def test_a_model_whose_derivatives_are_not_finite_is_refused() -> None:
    class Cornered(Swing):
        def jacobian(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.full((*x.shape, 2), np.nan), np.full((*x.shape, 1), np.nan)

    with refuses(InputError, "model"):
        refined(model=Cornered())
