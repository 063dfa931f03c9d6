"""Replays on the corrected model: each is learned without the executions of its own task."""

from __future__ import annotations

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Task, Validation, controllers, models
from ctxval._util.progress import Progress, listening, stage
from ctxval.core.trajectory import Trajectory
from ctxval.learning import DynamicsStudy, Replay, replay_executed


def executed(validation: Validation, units: np.ndarray) -> list[tuple[np.ndarray, Trajectory]]:
    found = []
    for unit in units[:, None]:
        found.append((unit, validation.outcome(validation.space.from_unit(unit)).system_trajectory))
    return found


def replays(
    validation: Validation, known: list[tuple[np.ndarray, Trajectory]], wanted: list[np.ndarray]
) -> list[Replay | None]:
    return replay_executed(validation, DynamicsStudy(validation).learn(known), wanted)


def test_a_replay_predicts_the_execution_that_it_was_not_learned_from() -> None:
    validation = make_validation()
    known = executed(validation, np.linspace(0.05, 0.95, 6))
    points = [point for point, _ in known]
    for (point, trajectory), replay in zip(known, replays(validation, known, points), strict=True):
        assert replay is not None
        assert replay.corrected is not None
        outcome = validation.outcome(validation.space.from_unit(point))
        assert abs(replay.distance - outcome.distance) < 0.05 * max(outcome.distance, 0.05)
        spans = np.ptp(trajectory.states, axis=0)
        assert (np.abs(replay.corrected.states - trajectory.states) < 0.05 * spans).all()


@pytest.mark.usefixtures("few_loops")
def test_its_own_execution_does_not_matter() -> None:
    validation = make_validation()
    known = executed(validation, np.linspace(0.1, 0.9, 5))
    point, own = known[2]
    absurd = Trajectory(own.times, own.states + 1e3 * own.times[:, None], own.inputs)
    # The hyperparameters are learned from all executions; what is left out is the data.
    replay = replays(validation, known, [point])[0]
    assert replay is not None
    other = replays(validation, [*known[:2], (point, absurd), *known[3:]], [point])[0]
    assert other is not None
    assert abs(replay.distance - other.distance) < 0.5 * replay.distance + 0.1


def test_nothing_is_replayed_if_nothing_can_be_learned_or_planned() -> None:
    without_data = models.Linear([[1.0, 0.02], [0.2, 1.0]], [[0.0], [0.02]])
    validation = make_validation(model=without_data)
    replay = replays(validation, [], [np.array([0.5])])[0]
    assert replay is not None
    assert replay.corrected is None
    assert np.isnan(replay.distance)

    class Refusing:
        batched = False

        def design(self, task: object, model: object) -> None:
            raise RuntimeError("no controller")

    parts = ("space", "task", "system", "model", "distance")
    other = Validation(**{part: getattr(validation, part) for part in parts}, synthesizer=Refusing())  # type: ignore[arg-type]
    assert replays(other, [], [np.array([0.5])]) == [None]


class Solving(controllers.LQR):
    """A user's synthesizer, whose method of this name is another one."""

    def solve(self, riccati: object) -> None:
        raise RuntimeError("no matrix")


class InPlace:
    """A distance that changes the arrays that it is given."""

    def __call__(self, model: Trajectory, system: Trajectory, task: Task) -> np.ndarray:
        found = np.abs(model.states[..., -1, 0] - system.states[..., -1, 0])
        system.states[...] = 0.0
        return np.asarray(found)


def test_a_method_of_the_synthesizer_that_is_another_one_loses_no_replay() -> None:
    validation = make_validation()
    validation.synthesizer = Solving([1.0, 0.1], [1e-2], [10.0, 1.0])
    replay = replays(validation, [], [np.array([0.5])])[0]
    assert replay is not None
    assert np.isfinite(replay.distance)


def test_a_distance_that_changes_its_arrays_does_not_change_the_replay() -> None:
    replay = replays(make_validation().with_parts(distance=InPlace()), [], [np.array([0.5])])[0]
    assert replay is not None
    assert replay.corrected is not None
    assert replay.corrected.states.any()


def test_each_replay_is_reported() -> None:
    heard: list[Progress] = []
    with listening(heard.append), stage("replaying executed tasks", 2, "tasks"):
        replays(make_validation(), [], [np.array([0.2]), np.array([0.7])])
    assert (heard[-1].done, heard[-1].expected) == (2, 2)
