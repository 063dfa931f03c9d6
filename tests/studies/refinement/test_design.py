"""Whose Jacobian controllers are designed with, and which controllers have not changed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ctxval import Transitions, Validation, controllers, models
from ctxval.studies.refinement import ResidualCorrection
from ctxval.studies.refinement.held_out import Records
from ctxval.studies.refinement.refine import same_controllers, with_best_jacobian
from rig_refine import FIRST, campaign, make_cart


def learned(validation: Validation) -> models.Refined:
    executed = [validation.execute(validation.plan([goal])) for goal in (1.0, 2.0)]
    records = Records.of(validation.model, executed)
    found = ResidualCorrection().learn(validation.model, records).model
    return models.Refined(found, records.transitions, validation.model)


@pytest.mark.parametrize(
    ("synthesizer", "linearised"),
    [(controllers.LQR([1.0, 0.1], [0.1]), "model"), (controllers.ILQR([1.0, 0.1], [0.1]), "corrected")],
)
def test_one_linearisation_keeps_that_of_a_linear_model(synthesizer: Any, linearised: str) -> None:
    validation = make_cart().with_parts(synthesizer=synthesizer)
    found, note = with_best_jacobian(validation, learned(validation))
    assert isinstance(found.model, models.Corrected)
    assert found.model.linearised == linearised
    assert (note is None) == (linearised == "corrected")


def test_the_jacobian_of_a_nonlinear_model_is_never_kept() -> None:
    validation = make_cart(models.Function(FIRST.step, vectorized=True))
    found, note = with_best_jacobian(validation, learned(validation))
    assert isinstance(found.model, models.Corrected)
    assert (found.model.linearised, note) == ("corrected", None)


def test_a_new_model_without_a_correction_is_left_as_it_is() -> None:
    refined = models.Refined(FIRST, Transitions(np.ones((2, 2)), np.ones((2, 1)), np.ones((2, 2))), FIRST)
    assert with_best_jacobian(make_cart(), refined) == (refined, None)


def test_the_distance_is_known_again_if_the_controller_has_not_changed() -> None:
    made = campaign().run(3)
    executed = [(trial, made.trajectories(trial)[1]) for trial in made.completed]
    same = same_controllers(made.validation, executed)  # type: ignore[arg-type]
    assert (same.tasks, same.same) == (3, 3)
    assert made.worst is not None
    assert same.worst == made.worst.distance
    other = make_cart(models.Linear(FIRST.A, 1.1 * FIRST.B))
    changed = same_controllers(other, executed)  # type: ignore[arg-type]
    assert (changed.tasks, changed.same, changed.worst) == (3, 0, None)
