from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

from conftest import make_validation
from ctxval import (
    Normal,
    Task,
    TaskSpace,
    Trajectory,
    Validation,
    aspect1,
    cases,
    controllers,
    distances,
    models,
    systems,
)
from ctxval._util.arrays import Array
from ctxval.cli.config.check import aspect1_findings
from ctxval.distances import FinalState, GoalError, MaximumDeviation, MeanDeviation, TrackingError
from ctxval.errors import DesignError, InputError
from ctxval.searches import Random
from facts import assert_names, refuses

DT = 0.1


class Refusing:
    """A system that must not be executed."""

    def execute(self, controller: object, task: Task) -> Trajectory:
        raise AssertionError("the system was executed")


def cart(synthesizer: object = None, distance: object = None, **parts: Any) -> Validation:
    """A cart that M describes exactly, brought to goals from 0.5 to 2 m; S must not be executed."""
    usual: dict[str, Any] = {
        "space": TaskSpace(goal=(0.5, 2.0, "m")),
        "task": lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=60, dt=DT),
        "system": Refusing(),
        "model": models.Linear([[1, DT], [0, 1]], [[0], [DT]]),
        "synthesizer": synthesizer or controllers.LQR([10.0, 1.0], [0.1]),
        "distance": distance or FinalState(norm=1, weights=[1, 1]),
    }
    return Validation(**{**usual, **parts})


@pytest.mark.slow
def test_a_model_that_completes_its_tasks_is_known_to() -> None:
    report = aspect1.check(cart(), threshold=0.05, tasks=40)
    assert report.completes
    assert report.distance == GoalError(1, weights=[1, 1])
    assert report.worst.error is not None
    assert report.worst.error < 0.05
    # No one of 20 independent draws exceeded the threshold: the exact bound is the rule of three.
    assert report.share == pytest.approx(1 - 0.05 ** (1 / 20))
    assert report.flips is not None
    assert report.flips.flipped == 0
    assert report.designs == 0  # LQR is not iterative


@pytest.mark.slow
def test_the_worst_task_is_that_of_a_dense_grid_and_the_share_of_bad_tasks_has_its_exact_bound() -> None:
    validation = cart(controllers.LQR([10.0, 1.0], [0.1], limits=0.5))  # too weak for far goals
    report = aspect1.check(validation, threshold=0.2, tasks=60)
    truth = validation.on_model(GoalError(1)).distances(validation.space.grid(401))
    assert report.worst.error is not None
    assert 0.9 * truth.max() < report.worst.error <= truth.max() * (1 + 1e-9)
    assert report.completes is False
    assert 0 < report.exceeding < 60
    assert report.verdict is not None
    assert report.verdict.answer == "falsified"
    assert report.saturation is not None
    assert report.saturation.known
    assert report.saturation.shares[0] > 0.1
    assert report.share is not None
    # With this share, so few of the 30 independent draws as there were are bad with a probability of 0.05.
    found = [k for k in range(31) if binom.cdf(k, 30, report.share) == pytest.approx(0.05, abs=1e-6)]
    assert len(found) == 1


@pytest.mark.thorough
def test_the_share_is_a_probability_under_the_distribution_of_tasks() -> None:
    validation = cart(controllers.LQR([10.0, 1.0], [0.1], limits=0.5))
    near = validation.with_parts(space=validation.space.distributed(goal=Normal(0.5, 0.05)))
    report = aspect1.check(near, threshold=0.2, tasks=40)
    assert report.exceeding  # the search goes everywhere
    assert report.share == pytest.approx(1 - 0.05 ** (1 / 20))  # and no draw is near the far goals
    assert_names(report.distribution, "goal")


@pytest.mark.slow
def test_a_controller_that_flips_is_named_with_two_neighbours() -> None:
    # The way around a pole: to the left for goals below 1.2345, and to the right for others.
    def policy(t: int, x: np.ndarray, task: Task) -> np.ndarray:
        side = np.where(task.goal[..., :1] < 1.2345, -1.0, 1.0)
        return side * np.sin(0.1 * t) * np.ones_like(x[..., :1])

    report = aspect1.check(cart(controllers.Policy(policy)), tasks=30)
    assert report.flips is not None
    assert report.flips.flipped > 0
    assert report.flipped is not None
    low, high = sorted(one["goal"] for one in report.flipped)
    assert low < 1.2345 <= high
    assert report.completes is None  # without a threshold


@pytest.mark.thorough
def test_designs_that_do_not_converge_are_counted_and_named() -> None:
    pendulum = cases.by_name("pendulum", seed=0).validation
    hasty = controllers.ILQR([1.0, 0.1], [1e-4], [10.0, 1.0], iterations=1, tolerance=1e-12, limits=0.5)
    report = aspect1.check(pendulum.with_parts(system=Refusing(), synthesizer=hasty), tasks=6)
    assert report.designs > 6  # neighbours are designed, too
    assert len(report.not_converged) == report.designs
    assert set(report.not_converged[0]) == {"goal"}


def test_a_task_without_a_closed_loop_is_not_completed() -> None:
    class Narrow(controllers.LQR):
        def design(self, task: Task, model: object) -> controllers.AffineFeedback:
            if (task.goal[..., 0] > 1.5).any():
                raise DesignError("the goal is out of reach")
            return super().design(task, model)  # type: ignore[arg-type]

    report = aspect1.check(cart(Narrow([10.0, 1.0], [0.1])), tasks=20)
    assert len(report.simulated) == 20
    assert 0 < len(report.failed) < 20
    assert report.completes is False
    assert report.worst.error is None
    assert_names(report.worst.reason, "goal")
    assert all(one.parameters["goal"] > 1.5 for one in report.failed)


def test_a_model_that_fails_everywhere_ends_too() -> None:
    report = aspect1.check(cart(model=lambda x, u: x * np.nan), tasks=4, threshold=1.0)
    assert len(report.failed) == 4
    assert report.share == 1.0
    assert report.verdict is None
    assert report.flips is None


@pytest.mark.parametrize(
    ("own", "found"),
    [
        (FinalState(2, (0,), scales=[0.1]), GoalError(2, (0,), scales=[0.1])),
        (MaximumDeviation(np.inf, angles=[1]), GoalError(np.inf, angles=[1])),
        (GoalError(1, (1,)), GoalError(1, (1,))),
        (lambda a, b, task: 0.0, GoalError(2)),
    ],
)
def test_completion_is_measured_as_the_distance_is(own: object, found: object) -> None:
    assert aspect1.completion(cart(distance=own)) == found


def test_states_that_no_controller_brings_to_a_goal_are_left_out() -> None:
    loose = cart(controllers.LQR([10.0, 0.0], [0.1]), FinalState(1))
    assert aspect1.completion(loose) == GoalError(1, (0,))


def test_a_changing_reference_is_followed() -> None:
    def follow(p: Any) -> Task:
        ramp = np.linspace(0, 1, 61)[:, None] * np.array([1.0, 0.0])
        return Task([0.0, 0.0], reference=np.asarray(p.goal)[..., None, None] * ramp, horizon=60, dt=DT)

    assert aspect1.completion(cart(task=follow, distance=MaximumDeviation(2))) == TrackingError(2)
    assert aspect1.completion(cart(task=follow, distance=MeanDeviation(1))) == TrackingError(1, over="mean")
    assert aspect1.check(cart(task=follow, distance=MaximumDeviation(2, (0,))), tasks=4).worst.error is not None


def test_tasks_without_a_goal_need_a_distance() -> None:
    aimless = cart(task=lambda p: Task([p.goal, 0.0], horizon=5, dt=DT))
    with refuses(InputError, "goal", "reference"):
        aspect1.check(aimless)
    report = aspect1.check(aimless, distance=lambda a, b, task: abs(b.final_state[..., 0]), tasks=4)
    assert report.units == ""
    assert report.worst.error is not None


@pytest.mark.parametrize("wrong", [{"tasks": 1}, {"tasks": 2.5}, {"tasks": True}, {"threshold": -1.0}])
def test_nonsense_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        aspect1.check(cart(), **wrong)


def test_a_check_is_the_same_again_and_takes_any_search() -> None:
    first, second = (aspect1.check(cart(), tasks=8, seed=3).to_json() for _ in range(2))
    assert first == second
    assert len(aspect1.check(cart(), tasks=8, search=Random()).simulated) == 8


def test_on_model_is_the_ordinary_validation_with_the_model_in_the_place_of_the_system() -> None:
    validation = make_validation(distance=FinalState(1))
    on_model = validation.on_model(GoalError(1))
    assert isinstance(on_model.system, systems.Simulated)
    assert on_model.system.model is validation.model
    assert on_model.batched
    plan = validation.plan([0.5])
    expected = np.abs(plan.model_trajectory.final_state - plan.task.goal).sum()
    assert on_model.outcome([0.5]).distance == pytest.approx(expected)
    assert validation.on_model(FinalState(1)).distances([[0.5], [1.0]]).tolist() == [0, 0]
    assert on_model.labels == validation.labels
    assert validation.on_model(GoalError(1), units="m").labels.units == "m"
    with refuses(InputError, "distance", "model_trajectory"):
        validation.on_model("far")  # type: ignore[arg-type]


def test_the_combined_measure_of_remark_1_is_a_distance() -> None:
    # d(p) = || xi_S(H; x_init, pi_p) - p ||_1, for regulation to p.
    outcome = make_validation(distance=distances.GoalError(norm=1)).outcome([0.5])
    assert outcome.distance == pytest.approx(np.abs(outcome.system_trajectory.final_state - [0.5, 0.0]).sum())


class Standing(controllers.Policy):
    fall = controllers.Fall(height=0.5)


def test_a_robot_of_m_that_falls_does_not_complete_its_tasks() -> None:
    def step(x: Array, u: Array) -> Array:  # a base that sinks the faster the faster it is
        return np.concatenate([x[..., :2], x[..., 2:3] - 0.1 * x[..., 7:8] ** 2, x[..., 3:]], axis=-1)

    validation = cart(
        space=TaskSpace(speed=(0.0, 1.0, "m/s")),
        task=lambda p: Task([0, 0, 1, 1, 0, 0, 0, p.speed, 0, 0, 0, 0, 0], command=[p.speed, 0, 0], horizon=6, dt=DT),
        model=models.Function(step, vectorized=True),
        synthesizer=Standing(lambda t, x, task: 0 * x[..., :1]),
        distance=distances.BodyVelocity(yaw=0.5),
    )
    assert aspect1.completion(validation) == distances.CommandError(yaw=0.5)
    report = aspect1.check(validation, tasks=12)
    assert report.completes is False
    fell = [float(task.parameters["speed"]) > np.sqrt(0.5 / 0.6) for task in report.simulated]
    assert [task.fell for task in report.simulated] == fell
    assert report.exceeding == len(report.fallen) == sum(fell) > 0
    assert len(report.to_json()["fallen"]) == sum(fell)
    findings = aspect1_findings(report)
    assert [finding.state for finding in findings if finding.check == "falls"] == ["failed"]
