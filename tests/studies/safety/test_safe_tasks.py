from __future__ import annotations

import json

import numpy as np
import pytest
from rig_safety import D_A, D_B, DT, FASTER, FASTEST, SPEC, closed_form, step, validation

from ctxval import (
    Campaign,
    Experiment,
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
from ctxval._util.arrays import Array
from ctxval._util.describe import describe
from ctxval.core.controller import Controller
from ctxval.core.rollout import rollout
from ctxval.distances import MaximumDeviation, UnsafeMargin
from ctxval.errors import InputError, ShapeError
from ctxval.specs import Ball, Box, ReachAvoid
from ctxval.studies.safety import assess, judged_by, require_safe_tasks
from facts import assert_names, refuses
from rig_thorough import more


def test_a_drift_with_one_wall_has_its_closed_form() -> None:
    given = validation()
    points = given.space.grid(101)
    of_model, of_system = closed_form(points)
    expected = np.maximum(of_model - 2 * np.maximum(of_system, 0), 0)
    np.testing.assert_allclose(given.distances(points), expected, atol=1e-12)
    assert expected.max() == pytest.approx(D_B, abs=0.01)
    assert given.with_parts(distance=MaximumDeviation()).distances(points).max() == pytest.approx(D_A)


@pytest.mark.slow
@pytest.mark.thorough
def test_a_campaign_certifies_the_margin_that_the_drift_needs() -> None:
    campaign = Campaign(validation(), seed=0).run(20, explore=False, progress=False)
    found = assess(campaign, tasks=2000, progress=False)
    of_model, _ = closed_form(campaign.validation.space.iid(20_000, np.random.default_rng(0)))
    assert found.d_b <= D_B + 1e-9
    assert found.d_b_bound is not None
    assert D_B - 1e-3 <= found.d_b_bound <= 1.1 * D_B
    assert found.d_a <= D_A + 1e-9
    assert found.share_satisfied == pytest.approx((of_model > 0).mean(), abs=0.03)
    assert found.share_certified == pytest.approx((of_model > found.d_b_bound).mean(), abs=0.03)
    assert found.counterexamples
    assert all(task.on_system <= 0 < task.on_model for task in found.counterexamples)
    assert found.tightened is not None
    assert found.tightened.avoid[0].low[0] == pytest.approx(-found.d_b_bound)
    assert json.loads(json.dumps(describe(found.to_json(), 10)))["d_b"] == found.d_b
    assert 0 < found.between <= DT * (FASTEST + FASTER * FASTEST**2) + 1e-9  # nothing is seen between two records


class Stops:
    """The drift, whose motor cuts out at high speed."""

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        if task.environment["speed"][0] > 1.0:
            raise RuntimeError("motor stalled")
        return rollout(step, controller, task)


@pytest.mark.slow
def test_no_task_is_called_safe_by_deviations_if_an_execution_failed() -> None:
    campaign = Campaign(validation().with_parts(system=Stops()), search=searches.Random(), seed=0)
    found = assess(campaign.run(8, progress=False), tasks=200, progress=False)
    assert campaign.failed
    assert found.d_a_bound is not None
    assert found.share_by_deviation is None
    assert "failed" in found.statement


@pytest.mark.slow
@pytest.mark.parametrize(("margin", "answer"), [(0.4, "falsified"), *more((0.65, "validated"))])
def test_a_margin_is_falsified_by_a_counterexample_or_certified(margin: float, answer: str) -> None:
    campaign = Campaign(validation(margin), seed=0).run(20, margin, explore=False, progress=False)
    found = assess(campaign, tasks=500, progress=False)
    assert found.answer == answer
    if answer == "falsified":
        worst = found.counterexamples[0]
        assert worst.on_system <= 0
        assert worst.on_model > margin
        assert found.d_b_bound is None
        assert_names(found.statement, "margin")
    else:
        assert found.d_b_bound == margin


def test_what_is_missing_for_a_margin_names_the_command_of_specifications() -> None:
    found = assess(Campaign(validation(0.65), seed=0).run(4, 0.65, explore=False, progress=False), tasks=200)
    assert found.answer == "undecided"


@pytest.mark.slow
def test_without_any_violation_in_sight_nothing_is_certified_and_it_says_why() -> None:
    given = validation()
    exact = given.with_parts(system=systems.Simulated(given.model))
    found = assess(Campaign(exact, seed=0).run(4, explore=False, progress=False), tasks=200, progress=False)
    assert (found.d_a, found.d_b, found.d_b_bound) == (0.0, 0.0, None)


def random_linear(seed: int) -> tuple[Validation, Validation]:
    """Return tasks of a random linear system among balls, with the deviation and with the margin as distance."""
    rng = np.random.default_rng(seed)
    A = np.eye(2) + 0.1 * rng.normal(size=(2, 2))
    other = models.Linear(A + 0.01 * rng.normal(size=(2, 2)), np.eye(2) * 0.1)
    spec = ReachAvoid(avoid=Ball("obstacle", radius=0.3), reach=Ball([1.0, 1.0], radius=0.6))
    plain = Validation(
        space=TaskSpace(obstacle=([-0.5, -0.5], [1.5, 1.5])),
        task=lambda p: Task([0.0, 0.0], goal=[1.0, 1.0], horizon=20, dt=0.1, environment={"obstacle": p.obstacle}),
        system=systems.Simulated(other),
        model=models.Linear(A, np.eye(2) * 0.1),
        synthesizer=controllers.LQR([1.0, 1.0], [0.1, 0.1]),
        distance=MaximumDeviation(2),
    )
    return plain, plain.with_parts(distance=UnsafeMargin(spec))


@pytest.mark.parametrize("seed", [0, 1, *more(*range(2, 8))])
def test_both_distances_certify_safe_tasks_alone_and_the_specification_certifies_more(seed: int) -> None:
    plain, judged = random_linear(seed)
    points = plain.space.iid(3000, np.random.default_rng(seed))
    parameters = plain.space.parameters(points)
    plan = plain.plan_of(parameters, plain.task_at(parameters))
    system = plain.system.execute(plan.controller, plan.task)
    spec = judged.distance.spec  # type: ignore[attr-defined]
    of_model, of_system = (spec.robustness(one, plan.task) for one in (plan.model_trajectory, system))
    d_a, q = plain.distances(points).max(), judged.distances(points).max()
    d_b = of_model[(of_model > 0) & (of_system <= 0)].max(initial=0.0)
    assert d_b <= q <= d_a + 1e-12
    by_deviation, by_specification = of_model > d_a, of_model > d_b
    assert (of_system[by_specification] > 0).all()
    assert not (by_deviation & ~by_specification).any()


def test_what_cannot_be_assessed_is_refused_in_one_sentence() -> None:
    with refuses(InputError, "distance", "UnsafeMargin"):
        assess(Campaign(validation().with_parts(distance=distances.FinalState())))
    with refuses(InputError, 9):
        require_safe_tasks(validation(9.0))
    with refuses(InputError):
        require_safe_tasks(validation(farthest=0.45))
    flat = ReachAvoid(avoid=Box(low=[0.0, 0.0], high=[1.0, 1.0]), components=(0,))
    with refuses(ShapeError, "Box", 1):
        require_safe_tasks(validation().with_parts(distance=UnsafeMargin(flat)))
    assert require_safe_tasks(validation()) == pytest.approx(0.62, abs=0.1)


def test_the_unit_is_that_of_the_states_that_are_looked_at() -> None:
    experiment = Experiment("wall", validation(), threshold=2.0, states=("position [m]",), units="rad")
    judged = judged_by(experiment, UnsafeMargin(SPEC, 0.25))
    assert (judged.units, judged.threshold) == ("m", 0.25)
    assert judged.validation.labels.units == "m"


def test_two_units_have_none_in_common() -> None:
    def step(x: Array, u: Array) -> Array:
        return x

    both = validation().with_parts(system=systems.Simulated(step), task=lambda p: Task([0.0, 0.0], horizon=2, dt=0.1))
    experiment = Experiment("two", both, states=("angle [rad]", "position [m]"))
    spec = ReachAvoid(avoid=Ball([0.0, 0.0], radius=0.1), components=("angle", "position"))
    assert judged_by(experiment, UnsafeMargin(spec)).units == ""
