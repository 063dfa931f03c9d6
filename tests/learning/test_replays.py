"""Replays on the corrected model: each is learned without the executions of its own task."""

from __future__ import annotations

import numpy as np

from conftest import make_validation
from ctxval import Validation, models
from ctxval.core.trajectory import Trajectory
from ctxval.learning import replay_executed


def executed(validation: Validation, units: np.ndarray) -> list[tuple[np.ndarray, Trajectory]]:
    found = []
    for unit in units[:, None]:
        found.append((unit, validation.outcome(validation.space.from_unit(unit)).system_trajectory))
    return found


def test_a_replay_predicts_the_execution_that_it_was_not_learned_from() -> None:
    validation = make_validation()
    known = executed(validation, np.linspace(0.05, 0.95, 6))
    points = [point for point, _ in known]
    for (point, trajectory), replay in zip(known, replay_executed(validation, known, points), strict=True):
        assert replay is not None
        assert replay.corrected is not None
        outcome = validation.outcome(validation.space.from_unit(point))
        assert abs(replay.distance - outcome.distance) < 0.05 * max(outcome.distance, 0.05)
        spans = np.ptp(trajectory.states, axis=0)
        assert (np.abs(replay.corrected.states - trajectory.states) < 0.05 * spans).all()
        assert replay.converged is None


def test_its_own_execution_does_not_matter() -> None:
    validation = make_validation()
    known = executed(validation, np.linspace(0.1, 0.9, 5))
    point, own = known[2]
    absurd = Trajectory(own.times, own.states + 1e3 * own.times[:, None], own.inputs)
    # The hyperparameters are learned from all executions; what is left out is the data.
    replay = replay_executed(validation, known, [point])[0]
    assert replay is not None
    other = replay_executed(validation, [*known[:2], (point, absurd), *known[3:]], [point])[0]
    assert other is not None
    assert abs(replay.distance - other.distance) < 0.5 * replay.distance + 0.1


def test_nothing_is_replayed_if_nothing_can_be_learned_or_planned() -> None:
    without_data = models.Linear([[1.0, 0.02], [0.2, 1.0]], [[0.0], [0.02]])
    validation = make_validation(model=without_data)
    replay = replay_executed(validation, [], [np.array([0.5])])[0]
    assert replay is not None
    assert replay.corrected is None
    assert np.isnan(replay.distance)

    class Refusing:
        batched = False

        def design(self, task: object, model: object) -> None:
            raise RuntimeError("no controller")

    parts = ("space", "task", "system", "model", "distance")
    other = Validation(**{part: getattr(validation, part) for part in parts}, synthesizer=Refusing())  # type: ignore[arg-type]
    assert replay_executed(other, [], [np.array([0.5])]) == [None]
