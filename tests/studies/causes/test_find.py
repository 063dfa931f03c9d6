"""Causes that are found in executions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ctxval import (
    Array,
    Campaign,
    Labels,
    Task,
    TaskSpace,
    Trajectory,
    Validation,
    controllers,
    distances,
    models,
    searches,
    systems,
)
from ctxval.campaign.history import at_points, executed_trials
from ctxval.core.controller import Controller
from ctxval.core.model import Step
from ctxval.errors import InputError
from ctxval.learning import DynamicsStudy
from ctxval.studies import causes
from ctxval.studies.causes import CauseReport, find_causes
from facts import assert_names, refuses

DT, PARTS = 0.05, 6


def slide(force: Callable[[Array, Array, Array], Array]) -> Step:
    """Return the step of a carriage of 1 kg with a force of position, rate, and what stops it."""

    def step(x: Array, u: Array) -> Array:
        position, speed, h = x[..., 0], x[..., 1], DT / PARTS
        for _ in range(PARTS):
            push = u[..., 0]
            speed = speed + h * (push + force(position, speed, -(speed / h + push)))
            position = position + h * speed
        return np.stack([position, speed], axis=-1)

    return step


def campaign(step: Step, **imperfect: Any) -> Campaign:
    validation = Validation(
        space=TaskSpace(goal=(-1.5, 1.5, "m"), start=(-0.5, 0.5, "m")),
        task=lambda p: Task(np.stack([p.start, 0 * p.start], axis=-1), goal=[p.goal, 0.0], horizon=40, dt=DT),
        system=systems.Imperfect(step, vectorized=True, seed=0, **imperfect),
        model=models.Linear([[1.0, DT], [0.0, 1.0]], [[0.5 * DT**2], [DT]]),
        synthesizer=controllers.LQR([10.0, 1.0], [0.5]),
        distance=distances.MaximumDeviation(components=(0,)),
        start_tolerance=1.0,
        labels=Labels(("position [m]", "speed [m/s]"), ("force [N]",), "m"),
    )
    return Campaign(validation, search=searches.by_name("random"), seed=0).run(3)


def no_force(position: Array, speed: Array, stopping: Array) -> Array:
    return 0.0 * position


def friction(position: Array, speed: Array, stopping: Array) -> Array:
    return np.clip(stopping, -0.4, 0.4)


def found(step: Step, **imperfect: Any) -> CauseReport:
    return find_causes(campaign(step, **imperfect))


@pytest.mark.slow
def test_dry_friction_and_a_delay_are_found_together() -> None:
    report = found(slide(friction), delay=0.7)
    sizes = {cause.name: cause.sizes for cause in report.causes}
    assert sizes == {"delay": pytest.approx([0.7], rel=0.02), "Coulomb friction": pytest.approx([0.4], rel=0.02)}
    assert "position sticks (0.4 n)" in report.sentence.lower()
    assert_names(report.sentence, 35)
    assert report.after is not None
    assert report.after < 0.1 * report.before


@pytest.mark.slow
def test_a_verdict_and_its_explanation_have_one_friction_and_one_delay() -> None:
    executed = campaign(slide(friction), delay=2).run(6)
    runs = at_points(executed_trials(executed.store, executed.trials))
    learned = DynamicsStudy(executed.validation).learn(runs)
    assert learned is not None
    sizes = {cause.name: cause.sizes for cause in find_causes(executed).causes}
    assert sizes.keys() == {"delay", "Coulomb friction"}
    assert learned.acting["delay [steps]"] == pytest.approx(sizes["delay"][0], rel=0.02)
    assert learned.friction["force [N]"] == pytest.approx(sizes["Coulomb friction"][0], rel=0.02)


@pytest.mark.slow
def test_a_stop_and_friction_by_direction_are_found() -> None:
    def held(x: Array, u: Array) -> Array:
        reached = slide(lambda position, speed, stopping: 0.0 * speed)(x, u)
        stops = reached[..., 0] > 0.5
        speed = np.where(stops & (reached[..., 1] > 0), 0.0, reached[..., 1])
        return np.stack([np.minimum(reached[..., 0], 0.5), speed], axis=-1)

    (stop,) = found(held).causes
    assert (type(stop), stop.sizes) == (causes.JointStop, pytest.approx((0.5,), rel=1e-3))
    (friction,) = found(slide(lambda position, speed, stopping: np.clip(stopping, -0.6, 0.2))).causes
    assert (type(friction), friction.sizes) == (causes.DirectedFriction, pytest.approx((0.6, 0.2), rel=0.02))


def test_an_offset_of_each_execution_is_estimated() -> None:
    class Drifting(systems.Imperfect):
        offsets = iter((0.3, -0.2, 0.1))

        def execute(self, controller: Controller, task: Task) -> Trajectory:
            offset, carriage = next(self.offsets), slide(no_force)
            moved = systems.Imperfect(lambda x, u: carriage(x, u + offset), vectorized=True)
            return moved.execute(controller, task)

    given = campaign(slide(no_force)).validation
    changed = given.with_parts(system=Drifting(slide(no_force), vectorized=True))
    report = find_causes(Campaign(changed, search=searches.by_name("random"), seed=0).run(3))
    (offset,) = report.causes
    assert type(offset) is causes.RunOffset
    # The executions are in the order of their distances.
    assert sorted(offset.sizes) == pytest.approx([-0.2, 0.1, 0.3], abs=1e-3)
    model = eval(offset.python(), {"causes": causes})
    assert model == offset.with_sizes([float(f"{size:.6g}") for size in offset.sizes])


@pytest.mark.slow
def test_noise_does_not_hide_a_weak_motor() -> None:
    weak = slide(no_force)
    report = found(lambda x, u: weak(x, 0.8 * u), measurement=[1e-3, 2e-3])
    assert any(isinstance(cause, causes.InputGain) for each in report.explained for cause in each.causes)
    (cause,) = report.causes
    inverse = cause.sizes[0] if isinstance(cause, causes.InputGain) else 1 / cause.sizes[0]
    assert inverse == pytest.approx(0.8, rel=0.02)


@pytest.mark.slow
def test_causes_that_are_the_same_to_a_model_are_said_together() -> None:
    weak = slide(no_force)
    report = found(lambda x, u: weak(x, 0.8 * u))
    names = {each.causes[0].name for each in report.explained}
    assert {"input gain", "sensor scale"} <= names  # and the inertia, if its fit comes as near
    assert report.separating_sentence is not None


@pytest.mark.slow
def test_a_fault_outside_of_the_dictionary_is_none_of_these() -> None:
    report = found(slide(lambda position, speed, stopping: 0.5 * np.sin(11 * position)))
    assert not report.named
    assert report.causes == ()
    assert_names(report.sentence, "causes", "tried", report.tried)
    assert report.python is None


def test_a_report_is_plain_values_and_its_python_makes_the_model() -> None:
    weak = slide(no_force)
    report = find_causes(campaign(lambda x, u: weak(x, u + 0.3)), most=1)
    stored = report.to_json()
    assert (stored["answer"], stored["sentence"]) == ("named", report.sentence)
    assert report.python is not None
    made: dict[str, Any] = {"model": models.Linear([[1.0, DT], [0.0, 1.0]], [[0.5 * DT**2], [DT]])}
    exec(report.python, made)
    x, u = np.array([0.3, -0.2]), np.array([0.5])
    np.testing.assert_allclose(made["model"].step(x, u), weak(x, u + 0.3), atol=2e-3)


def test_what_explains_most_is_said_although_the_largest_distance_rises() -> None:
    weak = slide(no_force)
    report = find_causes(campaign(lambda x, u: weak(x, u + 0.3)), most=1)
    partial = replace(report.explained[0], distance=2 * report.before)
    assert not partial.counts(report.before)
    sentence = replace(report, named=False, explained=(partial,)).sentence
    assert_names(sentence, "distance", 3, f"{report.before:.3g}")


def test_one_execution_is_too_few() -> None:
    few = campaign(slide(no_force))
    alone = Campaign(few.validation, search=searches.by_name("random"), seed=0).run(1)
    with refuses(InputError, 2, 1):
        find_causes(alone)


@pytest.mark.slow
def test_executions_that_failed_tell_which_inputs_are_exchanged() -> None:
    A, B = np.eye(4), np.zeros((4, 2))
    A[:2, 2:], B[2:] = DT * np.eye(2), DT * np.diag([1.0, 2.0])

    def step(x: Array, u: Array) -> Array:
        turned = x @ A.T + u[..., ::-1] @ B.T
        return np.where(np.abs(turned).max(axis=-1, keepdims=True) > 3, np.nan, turned)  # the robot stops

    validation = Validation(
        space=TaskSpace(goal=([-1, -1], [1, 1], "m")),
        task=lambda p: Task(np.zeros((*p.goal.shape[:-1], 4)), goal=[p.goal[0], p.goal[1], 0, 0], horizon=80, dt=DT),
        system=systems.Simulated(step),
        model=models.Linear(A, B),
        synthesizer=controllers.LQR([5.0, 5.0, 1.0, 1.0], [1.0, 1.0]),
        distance=distances.MaximumDeviation(components=(0, 1)),
    )
    failed = Campaign(validation, search=searches.by_name("random"), seed=0).run(4)
    assert {trial.state for trial in failed.trials} == {"failed"}
    report = find_causes(failed)
    assert [cause.name for cause in report.causes] == ["swapped inputs"]
    assert report.failed == report.executions == 4
    assert_names(report.sentence, 4, "executions", "failed")


@pytest.mark.slow
def test_executions_that_begin_elsewhere_are_not_explained_by_the_dynamics() -> None:
    """M contains no position, so that an offset of its sensor changes nothing but where the executions begin."""

    class Shifted:
        batched = True

        def execute(self, controller: Any, task: Any) -> Any:
            start = task.initial_state + self.shift * np.array([1.0, 0.0])
            return systems.Simulated(slide(self.force), vectorized=True).execute(controller, task.starting_at(start))

        def __init__(self, *shifts: float, force: Any) -> None:
            self.shifts, self.force = [*shifts], force

        @property
        def shift(self) -> float:
            return self.shifts.pop(0)

    def report_of(*shifts: float, force: Any = no_force) -> CauseReport:
        validation = campaign(slide(no_force)).validation.with_parts(system=Shifted(*shifts, force=force))
        return find_causes(Campaign(validation, search=searches.by_name("random"), seed=0).run(3))

    report = report_of(0.1, 0.1, 0.1)
    assert [(cause.name, cause.sizes) for cause in report.causes] == [("sensor offset", pytest.approx((0.1,)))]
    assert_names(report.sentence, 0.1)
    assert report.to_json()["began_elsewhere"]
    report = report_of(0.1, -0.2, 0.15)
    assert report.causes == ()
    # What is left of the distance is where the executions began, which a cause in the dynamics does not change.
    report = report_of(0.1, -0.2, 0.15, force=lambda position, speed, stop: -0.5 * speed)
    assert [cause.name for cause in report.causes] == ["viscous friction"]
    assert report.from_tasks == pytest.approx(0.2, rel=0.05)
    assert_names(report.sentence, 0.2)
