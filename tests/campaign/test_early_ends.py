"""Closed loops that end early, by a fall or an instability: on M and on S, on S alone, on M alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import Campaign, Task, TaskSpace, Trajectory, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.errors import CampaignError, InputError, ModelError
from facts import assert_names, refuses

H, DT = 20, 0.1


def faller(edge: float, push: float = 0.1) -> Any:
    """Return the steps of a state that moves by its push in each step, and has no next one beyond an edge."""

    def step(x: Array, u: Array) -> Array:
        return np.where(np.abs(x) > edge, np.nan, x + push)

    return step


def validation(of_model: Any, of_system: Any, **parts: Any) -> Validation:
    given: dict[str, Any] = {
        "space": TaskSpace(start=(0.0, 1.0, "m")),
        "task": lambda p: Task([p.start], horizon=H, dt=DT),
        "system": systems.Simulated(of_system or of_model, vectorized=True),
        "model": models.Function(of_model, vectorized=True),
        "synthesizer": controllers.Policy(lambda t, x, task: 0 * x),
        "distance": distances.MaximumDeviation(),
    }
    return Validation(**{**given, **parts})


def test_if_both_end_the_distance_is_that_of_the_common_part(tmp_path: Path) -> None:
    parts = validation(faller(1.55), faller(1.55, 0.11))
    campaign = Campaign(parts, store=tmp_path / "a.sqlite").run(4, explore=True)
    assert not campaign.failed
    for trial in campaign.completed:
        start = trial.parameters["start"]
        steps = int(np.ceil((1.55 - start) / 0.11 - 1e-9))
        common = min(steps, int(np.ceil((1.55 - start) / 0.1 - 1e-9)))
        assert trial.distance == pytest.approx(0.01 * min(common, H))
        assert (H * DT if trial.note.ends is None else trial.note.ends.system) == pytest.approx(DT * min(steps, H))
    again = Campaign(parts, store=tmp_path / "a.sqlite")
    assert again.trials.distances.tolist() == campaign.trials.distances.tolist()
    assert again.run(6, explore=True).executions == 6
    points = campaign.trials.points(1)
    np.testing.assert_allclose(parts.distances(points), campaign.trials.distances)
    assert again.verdict(1e-4).answer == "falsified"


@pytest.mark.usefixtures("without_costs")
def test_a_perfect_model_that_falls_is_validated_with_its_system() -> None:
    campaign = Campaign(validation(faller(1.55), faller(1.55))).run(20, threshold=0.05)
    assert not campaign.failed
    assert campaign.trials.distances.tolist() == [0.0] * len(campaign.trials)
    assert campaign.verdict(0.05).answer != "falsified"


def test_a_system_that_ends_alone_is_a_counterexample_with_its_time(tmp_path: Path) -> None:
    parts = validation(faller(np.inf), faller(1.45))
    campaign = Campaign(parts, store=tmp_path / "a.sqlite").run(8, threshold=1e9)
    verdict = campaign.verdict(1e9)
    assert verdict.answer == "falsified"
    worst = verdict.witness
    assert worst is not None
    assert worst.attempts == 1
    assert worst.ended_alone == pytest.approx(DT * np.ceil((1.45 - worst.parameters["start"]) / 0.1 - 1e-9))
    assert f"S ended after {worst.ended_alone:.3g} s" in verdict.reason
    json.dumps(verdict.to_json(), allow_nan=False)
    again = Campaign(parts, store=tmp_path / "a.sqlite")
    assert again.verdict(1e9).answer == "falsified"
    stored = again.trajectories(again.trials[worst.number])[1]
    assert stored.is_outcome
    assert stored.times[-1] == pytest.approx(worst.ended_alone)
    again.remeasure()
    assert again.verdict(1e9).answer == "falsified"


def test_a_model_that_ends_alone_is_a_question_of_the_model() -> None:
    campaign = Campaign(validation(faller(1.55), faller(np.inf))).run(2, explore=True)
    ended = [trial for trial in campaign.trials if trial.parameters["start"] > 0.0]
    assert ended
    for trial in ended:
        assert_names(trial.failure or "", "ended")
        assert trial.ended_alone is None
    assert campaign.verdict(1.0).answer == "undecided"


@pytest.mark.parametrize("ended", ["operator stop", "truncated"])
def test_a_failure_is_no_outcome(ended: str) -> None:
    class Stopped(systems.Simulated):
        def execute(self, controller: Any, task: Task) -> Trajectory:
            return Trajectory(DT * np.arange(3), np.zeros((3, 1)), np.zeros((2, 1)), ended)

    with pytest.raises(CampaignError):
        Campaign(validation(faller(1.55), None, system=Stopped(faller(1.55)))).run(9, explore=True)
    campaign = Campaign(validation(faller(np.inf), None, system=Stopped(faller(1.55)))).run(2, explore=True)
    assert [trial.failure for trial in campaign.failed] == [ended] * 2
    assert campaign.verdict(1e9).answer == "undecided"


def test_a_told_end_is_an_outcome_and_one_of_another_task_is_refused() -> None:
    campaign = Campaign(validation(faller(np.inf), faller(1.55)))
    opened = campaign.ask()
    times, start = DT * np.arange(6), opened.plan.task.initial_state[0]
    states = start + 0.1 * np.arange(6.0)[:, None]
    with refuses(InputError, "start_tolerance", 0):
        campaign.tell(opened, Trajectory(times, states + 1, np.zeros((5, 1)), "terminated: fell"))
    told = campaign.tell(opened, Trajectory(times, states, np.zeros((5, 1)), "terminated: fell"))
    assert (told.state, told.ended_alone, told.failure) == ("failed", pytest.approx(0.5), "terminated: fell")
    at_once = campaign.ask()
    first = np.full((2, 1), np.nan)
    first[0] = at_once.plan.task.initial_state
    fell = campaign.tell(at_once, Trajectory(times[:2], first, np.zeros((1, 1)), "terminated: fell"))
    assert fell.ended_alone == 0.0


def test_a_loop_that_grows_without_bounds_is_refused_before_an_execution() -> None:
    with refuses(ModelError, "diverged", "start"):
        validation(lambda x, u: (x + 2) ** 9, faller(1.0)).plan([0.5])


def balanced(edge: float) -> Any:
    """Return the linear model of the inverted pendulum of gymnasium, which knows when it has fallen."""
    A = np.array([[1, 0, 0.04, 0], [0, 1.0, 0, 0.04], [0, -0.03, 1, 0], [0, 0.9, 0, 1.0]])
    return lambda x, u: np.where(np.abs(x[..., 1:2]) > edge, np.nan, x @ A.T)


def test_an_environment_and_a_model_that_both_terminate_agree_until_then() -> None:
    pytest.importorskip("gymnasium")
    system = systems.Gymnasium("InvertedPendulum-v5")
    parts: dict[str, Any] = {
        "space": TaskSpace(angle=(0.05, 0.1, "rad")),
        "task": lambda p: Task([0, p.angle, 0, 0], horizon=30, dt=system.dt),
        "system": system,
        "synthesizer": controllers.Policy(lambda t, x, task: 0 * x[..., :1]),
    }
    both = Campaign(validation(balanced(0.2), None, **parts)).run(3, explore=True)
    assert not both.failed
    assert all(0 < trial.distance < 1 for trial in both.trials if trial.distance is not None)
    alone = Campaign(validation(balanced(np.inf), None, **parts)).run(2, threshold=100.0)
    assert alone.verdict(100.0).answer == "falsified"
