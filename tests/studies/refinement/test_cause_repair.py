"""A model that is refined by the causes of its error."""

from __future__ import annotations

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, refine, searches, systems
from ctxval.core.model import Step
from ctxval.errors import InputError
from ctxval.learning.effects import ModelWithEffects
from ctxval.studies.refinement import CauseRepair
from ctxval.studies.refinement.methods import method_of
from facts import refuses


def executed(step: Step) -> Campaign:
    validation = make_validation(systems.Simulated(step, vectorized=True), make_validation().model)
    return Campaign(validation, search=searches.by_name("random"), seed=0).run(3)


@pytest.mark.slow
def test_the_repaired_model_is_validated_under_its_own_controllers() -> None:
    model = make_validation().model
    campaign = executed(lambda x, u: model.step(x, u + 0.5))
    first = campaign.worst
    assert first is not None
    assert first.distance is not None
    result = refine(campaign, 0.1 * first.distance, 5, method=CauseRepair(campaign))
    assert isinstance(result.model, ModelWithEffects)
    (effect,) = result.model.effects
    assert effect.sizes == pytest.approx([0.5], rel=1e-4)
    assert result.last.worst is not None
    assert result.last.worst < 1e-3 * first.distance
    assert "offset" in " ".join(result.last.notes)


@pytest.mark.slow
def test_an_error_without_a_known_cause_ends_the_refinement() -> None:
    model = make_validation().model
    campaign = executed(lambda x, u: model.step(x, u) + 0.02 * np.sin(60 * x))
    with refuses(InputError, 25):
        refine(campaign, 1e-6, 6, method=CauseRepair(campaign))


def test_by_its_name_alone_it_cannot_be_made() -> None:
    with refuses(InputError, "causes", "refinement.CauseRepair"):
        method_of("causes")
