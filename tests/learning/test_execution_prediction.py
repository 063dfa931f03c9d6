"""Predictions of executions: plain numbers, and scores of executions by them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Trajectory
from ctxval.learning import DynamicsStudy, ExecutionPrediction


def learned(seed: int = 0):  # type: ignore[no-untyped-def]
    validation = make_validation()
    points = np.random.default_rng(seed).random((2, 1))
    executed = [(point, validation.outcome(validation.space.from_unit(point)).system_trajectory) for point in points]
    found = DynamicsStudy(validation, seed).learn(executed)
    assert found is not None
    return validation, found


@pytest.mark.slow
def test_a_prediction_survives_json_and_scores_the_execution_it_was_made_for() -> None:
    validation, found = learned()
    point = np.array([0.37])
    predicted = found.predict(point)
    assert predicted is not None
    stored = ExecutionPrediction.from_json(json.loads(json.dumps(predicted.to_json(), allow_nan=False)))
    assert stored == predicted
    outcome = validation.outcome(validation.space.from_unit(point))
    score = stored.score(outcome.system_trajectory, outcome.distance)
    assert score is not None
    assert predicted.median == pytest.approx(outcome.distance, rel=0.05)
    assert score.ratio == pytest.approx(outcome.distance / predicted.median)
    assert score.z2 < 25
    # Another execution is a surprise.
    shifted = Trajectory(
        outcome.system_trajectory.times, outcome.system_trajectory.states + 0.5, outcome.system_trajectory.inputs
    )
    surprised = stored.score(shifted, 10 * outcome.distance)
    assert surprised is not None
    assert surprised.z2 > 1e3
    assert surprised.rank == 1.0


def test_a_prediction_is_a_function_of_the_executions_and_the_seed() -> None:
    point = np.array([0.8])
    first, again = learned()[1].predict(point), learned()[1].predict(point)
    assert first == again


def test_draws_that_diverge_predict_nothing() -> None:
    vague = ExecutionPrediction(1, (0.1, *[np.inf] * 20), 0.0, (1, 2), ((0.0,), (0.0,)), ((0.0,), (0.0,)), 0.9)
    assert ExecutionPrediction.from_json(json.loads(json.dumps(vague.to_json(), allow_nan=False))) == vague
    executed = Trajectory(np.arange(3.0), np.zeros((3, 1)), np.zeros((2, 1)))
    score = vague.score(executed, 0.3)
    assert score is not None
    assert score.z2 == np.inf


def test_what_is_no_prediction_or_does_not_fit_is_none() -> None:
    assert ExecutionPrediction.from_json({}) is None
    assert ExecutionPrediction.from_json({"learned_from": "x"}) is None
    good = ExecutionPrediction(1, tuple(np.linspace(0, 1, 21)), 0.1, (1, 9), ((0.0,), (0.0,)), ((0.1,), (0.1,)), 0.0)
    assert good.score(Trajectory(np.arange(3.0), np.zeros((3, 1)), np.zeros((2, 1))), 0.3) is None
    assert good.score(Trajectory(np.arange(11.0), np.zeros((11, 2)), np.zeros((10, 1))), 0.3) is None
