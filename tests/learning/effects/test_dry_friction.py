"""Dry friction that M lacks is found in executions, and predictions with it are accurate where joints stop."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from ctxval import Campaign, Task, TaskSpace, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.core.target import Largest
from ctxval.core.trajectory import Transitions
from ctxval.learning import DynamicsStudy
from ctxval.learning.dynamics_posterior import learn_posterior
from ctxval.learning.effects import Delay, ModelWithEffects
from ctxval.learning.effects.dry_friction import DryFriction, found_friction
from facts import assert_names
from rig_thorough import more

H, DT, GRIP, SLOW = 40, 0.05, 0.8, 0.1
MASS = np.array([[2.0, 0.6], [0.6, 1.0]])
MODEL = models.Linear(np.array([[1.0, DT], [0.0, 1.0]]), np.array([[0.0], [DT]]))
JOINTS = models.Linear(np.eye(2), DT * np.linalg.inv(MASS))  # rates of two joints on which torques act


def sticky_step(
    x: Array, u: Array, grip: float = GRIP, excess: float = 0.0, load: float = 0.0, slow: float = SLOW
) -> Array:
    """A cart with drag and dry friction, of 40 short steps, so that it may stop within a step."""
    position, speed = x[..., 0], x[..., 1]
    dt = DT / 40
    for _ in range(40):
        free = speed + dt * (u[..., 0] - 0.3 * speed)
        most = grip + load * np.abs(u[..., 0]) + excess * np.exp(-((speed / slow) ** 2))
        speed = np.sign(free) * np.maximum(np.abs(free) - dt * most, 0.0)
        position = position + dt * speed
    return np.stack([position, speed], axis=-1)


def rubbing(model: models.Linear, rates: list[int], sliding: Array) -> DryFriction:
    m = len(rates)
    sizes = tuple(np.stack([sliding, *np.zeros((2, m)), np.ones(m)], axis=1).ravel().tolist())
    rest, passed = np.stack([sliding] * 2), np.full(m, np.inf)
    return DryFriction(
        sizes, model, np.array(rates), np.ones(m), np.zeros(m), np.full(m, 1e-3), np.zeros(m), rest, passed
    )


def recorded(step: Any, count: int = 300, inputs: int = 1) -> Transitions:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(count, 2)), 2 * rng.normal(size=(count, inputs))
    x[::3, 1] = 0.0
    return Transitions(x, u, step(x, u))


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0, 4))
def test_friction_slows_a_rate_and_never_turns_it(speed: float, push: float, grip: float) -> None:
    held = rubbing(MODEL, [1], np.array([grip]))
    free = speed + DT * push
    after = held.step(np.array([0.0, speed]), np.array([push]))[1]
    assert after == pytest.approx(np.sign(free) * max(abs(free) - DT * grip, 0.0), abs=1e-9)


def test_what_holds_a_joint_at_rest_is_bounded_by_what_it_withstood_and_what_set_it_in_motion() -> None:
    step = partial(sticky_step, excess=0.4, slow=1e-3)  # holds up to 1.2, and slides with 0.8
    moving, still = recorded(step), np.zeros((4, 2))
    u = np.array([[0.5], [-1.1], [-1.3], [2.0]])
    moving = moving[moving.x[:, 1] != 0]
    x, inputs = np.concatenate([moving.x, still]), np.concatenate([moving.u, u])
    known = rubbing(MODEL, [1], np.array([GRIP]))

    def missed(x: Array, acting: Array) -> Array:
        return sticky_step(x, acting, 0.0) - MODEL.step(x, acting)

    transitions = Transitions(x, inputs, step(x, inputs))
    told = known.told_by(transitions, missed)
    assert told.told is not None
    least, largest = told.told.least, told.told.largest
    assert (told.told.uneven == 1).all()
    # At another place, the joint withstands three times the force that moved it here.
    place = np.array([[0.8, 0.0]])
    at, pushes = np.concatenate([x, place]), np.concatenate([inputs, [[3.9]]])
    caught = Transitions(at, pushes, np.concatenate([transitions.x_next, place]))
    elsewhere = known.told_by(caught, missed).told
    assert elsewhere is not None
    assert elsewhere.uneven[1, 0] == pytest.approx(3.9 / 2.0, rel=0.05)
    assert least[:, 0] == pytest.approx([1.1, GRIP], abs=0.01)
    assert largest[:, 0] == pytest.approx([1.3, 2.0], abs=0.02)
    assert told.passed[0] > GRIP
    held = replace(known, rest=np.array([[1.2], [1.2]]))
    np.testing.assert_allclose(held.following(still, u, lambda acting: 0 * still)[:2], 0.0, atol=1e-12)
    slid = DT * np.sign(u[2:, 0]) * (np.abs(u[2:, 0]) - GRIP)
    np.testing.assert_allclose(held.step(still, u)[2:, 1], slid, atol=1e-9)
    lip = replace(known, rest=np.array([[1.2], [0.9]]))
    np.testing.assert_array_equal(lip.step(still, np.array([[1.1], [-1.1], [0.85], [-1.3]]))[:, 1] != 0, [1, 0, 0, 1])


@given(st.lists(st.floats(-3, 3), min_size=4, max_size=4), st.floats(0, 5), st.floats(0, 5))
def test_coupled_frictions_are_those_of_the_quadratic_program(values: list[float], first: float, second: float) -> None:
    rates, torques, largest = np.array(values[:2]), np.array(values[2:]), np.array([first, second]) + 1e-6
    held = rubbing(JOINTS, [0, 1], largest)
    root = np.linalg.cholesky(DT * np.linalg.inv(MASS))
    solved = lsq_linear(root.T, np.linalg.solve(root, JOINTS.step(rates, torques)), (-largest, largest), tol=1e-14)
    expected = JOINTS.step(rates, torques - solved.x)
    np.testing.assert_allclose(held.step(rates, torques), expected, rtol=0, atol=1e-5)


def test_its_size_is_found_beside_another_error_of_the_model() -> None:
    friction = found_friction(MODEL, recorded(sticky_step))
    assert friction is not None
    assert friction.rates.tolist() == [1]
    assert friction.sliding[0] == pytest.approx(GRIP, rel=0.02)


def test_its_size_is_in_units_of_the_input_if_the_model_errs_in_what_an_input_does() -> None:
    weak = models.Linear(MODEL.A, 0.8 * MODEL.B)
    friction = found_friction(weak, recorded(sticky_step))
    assert friction is not None
    assert friction.sliding[0] == pytest.approx(GRIP, rel=0.02)


def test_friction_that_is_hidden_beside_another_error_is_found_beside_its_gaussian_process() -> None:
    steps = recorded(lambda x, u: sticky_step(x, u + 2 * np.sin(2 * x[..., :1]), 0.3))
    posterior = learn_posterior(MODEL, steps, np.zeros(len(steps), dtype=np.intp))
    assert posterior is not None
    assert found_friction(MODEL, steps) is None
    friction = found_friction(MODEL, steps, prior=posterior.prior)
    assert friction is not None
    assert friction.sliding[0] == pytest.approx(0.3, rel=0.05)


def test_it_is_found_at_an_input_that_drives_its_joint_backwards() -> None:
    backwards, steps = models.Linear(MODEL.A, -MODEL.B), recorded(lambda x, u: sticky_step(x, -u))
    friction = found_friction(backwards, steps)
    assert friction is not None
    assert friction.sliding[0] == pytest.approx(GRIP, rel=0.02)
    there, moving = friction.teaching(steps)
    left = there.x_next - backwards.step(there.x, there.u)
    np.testing.assert_allclose(left[moving, 1], -DT * 0.3 * steps.x[moving, 1], atol=0.02)  # drag alone
    assert np.abs(friction.step(np.zeros((2, 2)), np.array([[0.7], [-0.7]]))[:, 1]).max() < 1e-12


@pytest.mark.parametrize("excess", [0.0, 0.4])
def test_friction_that_is_larger_at_rest_is_found_to_be_so(excess: float) -> None:
    friction = found_friction(MODEL, recorded(partial(sticky_step, excess=excess), 2000))
    assert friction is not None
    assert friction.sliding[0] == pytest.approx(GRIP, rel=0.02)
    assert friction.excess[0] == pytest.approx(excess, rel=0.15)
    if excess:
        assert friction.slow[0] == pytest.approx(SLOW, rel=0.3)
        x, u = np.zeros((2, 2)), np.array([[GRIP + 0.25], [GRIP + 0.6]])  # the first one is held, the second one is not
        np.testing.assert_allclose(friction.step(x, u), sticky_step(x, u, excess=excess), rtol=0, atol=0.01)


@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-3])
def test_its_size_is_found_under_feedback_with_fixed_gains(noise: float) -> None:
    rng, x, runs = np.random.default_rng(0), np.array([[1.5, 0.0], [-1.2, 0.5], [0.8, -1.0], [-2.0, 0.0]]), []
    for _ in range(40):
        u = -x @ np.array([[3.0], [2.6]])
        runs.append((x, u, sticky_step(x, u)))
        x = runs[-1][2]
    states, inputs, reached = map(np.concatenate, zip(*runs, strict=True))
    measured = [each + noise * rng.normal(size=each.shape) for each in (states, reached)]
    friction = found_friction(MODEL, Transitions(measured[0], inputs, measured[1]))
    assert friction is not None
    assert friction.sliding[0] == pytest.approx(GRIP, rel=0.05)


def test_smooth_drag_is_not_taken_for_friction_that_is_larger_at_rest() -> None:
    def draggy(x: Array, u: Array) -> Array:
        return sticky_step(x, u) - DT * 0.5 * np.stack([0 * x[..., 1], x[..., 1] * np.abs(x[..., 1])], axis=-1)

    friction = found_friction(MODEL, recorded(draggy))
    assert friction is not None
    assert friction.sliding[0] == pytest.approx(GRIP, rel=0.05)
    assert friction.excess[0] == 0.0


def test_friction_that_grows_with_the_input_is_found_to_do_so() -> None:
    friction = found_friction(MODEL, recorded(partial(sticky_step, load=0.2)))
    assert friction is not None
    assert friction.sliding[0] == pytest.approx(GRIP, rel=0.05)
    assert friction.load[0] == pytest.approx(0.2, rel=0.05)
    assert friction.excess[0] == 0.0


@pytest.mark.parametrize(
    "transitions",
    [
        recorded(MODEL.step),
        recorded(lambda x, u: sticky_step(x, u, 0.0)),
        Transitions(np.ones((5, 2)), np.zeros((5, 1)), np.ones((5, 2))),
        Transitions(np.ones((5, 2)), np.zeros((5, 0)), np.ones((5, 2))),
    ],
    ids=["exact", "smooth", "without inputs", "no input"],
)
def test_none_is_found_where_there_is_none(transitions: Transitions) -> None:
    assert found_friction(MODEL, transitions) is None


def test_a_joint_that_creeps_while_it_is_held_is_found_to_do_so() -> None:
    def creeping(x: Array, u: Array) -> Array:
        speed = x[..., 1] + DT * u[..., 0]
        held = np.abs(speed - 0.006 * u[..., 0]) <= DT * GRIP  # friction is what the input exceeds the creep by
        slowed = np.where(held, 0.006 * u[..., 0], speed - DT * GRIP * np.sign(speed))
        return np.stack([x[..., 0] + DT * slowed, slowed], axis=-1)

    rng = np.random.default_rng(0)
    moving, resting = 2 * rng.normal(size=(200, 2)), np.stack([rng.normal(size=100), np.zeros(100)], -1)
    x, u = np.concatenate([moving, resting]), np.concatenate([2 * rng.normal(size=200), rng.uniform(-0.7, 0.7, 100)])
    friction = found_friction(MODEL, Transitions(x, u[:, None], creeping(x, u[:, None])))
    assert friction is not None
    assert friction.sliding[0] == pytest.approx(GRIP, rel=0.02)
    assert friction.creep[0] == pytest.approx(0.006 / (1 - 0.006 / DT), rel=0.02)  # for a unit of friction
    np.testing.assert_allclose(friction.step(resting, u[200:, None]), creeping(resting, u[200:, None]), atol=6e-4)
    # A joint that moves faster than it could creep is not held.
    start, push = np.array([[0.3, 0.0]]), np.array([[0.95]])
    begun = np.concatenate([x, start]), np.concatenate([u[:, None], push])
    steps = Transitions(*begun, creeping(*begun))
    told = friction.told_by(steps, lambda x, acting: np.zeros_like(x)).told
    assert told is not None
    assert creeping(start, push)[0, 1] < 2 * 0.006 * 0.95
    assert told.least[:, 0] == pytest.approx(GRIP, rel=0.02)
    # A joint that begins to creep does not move yet.
    start, push = np.array([[0.3, 0.0]]), np.array([[2.0]])
    x, u = np.concatenate([x, start]), np.concatenate([u[:, None], push])
    steps = Transitions(x, u, creeping(x, u))
    told = friction.told_by(steps, lambda x, acting: np.zeros_like(x)).told
    assert told is not None
    assert told.least[:, 0] == pytest.approx(GRIP, rel=0.02)
    assert told.largest[1, 0] == pytest.approx(2.0, rel=0.05)


def test_two_inputs_of_one_rate_have_no_friction_of_their_own() -> None:
    twice = models.Linear(np.array([[1.0, DT], [0.0, 1.0]]), np.array([[0.0, 0.0], [DT, DT]]))
    assert found_friction(twice, recorded(lambda x, u: sticky_step(x, u.sum(axis=-1, keepdims=True)), inputs=2)) is None


def cart(step: Any = sticky_step) -> Validation:
    return Validation(
        space=TaskSpace(goal=(-2.0, 2.0, "m"), start=(-1.0, 1.0, "m")),
        task=lambda p: Task(
            np.stack([p.start, 0 * p.start], -1), goal=np.stack([p.goal, 0 * p.goal], -1), horizon=H, dt=DT
        ),
        system=systems.Simulated(step, vectorized=True),
        model=MODEL,
        synthesizer=controllers.LQR([10.0, 1.0], [1.0]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


@pytest.mark.parametrize(
    ("count", "shape", "friction"),
    [
        (4, {}, {"u[0]": GRIP}),
        *more(
            (6, {"excess": 0.4}, {"u[0]": GRIP}),
            (6, {"grip": 0.2, "load": 0.2}, {"u[0]": 0.2, "share of u[0]": 0.2}),  # joints are also braked
        ),
    ],
    ids=["constant", "larger at rest", "by load"],
)
def test_runs_that_stop_short_are_predicted_from_few_executions(
    count: int, shape: dict[str, float], friction: dict[str, float]
) -> None:
    validation = cart(partial(sticky_step, **shape))
    points = np.random.default_rng(0).random((12, 2))
    runs = [validation.outcome(validation.space.from_unit(point)) for point in points]
    executed = [(point, run.system_trajectory) for point, run in zip(points[:count], runs, strict=False)]
    learned = DynamicsStudy(validation).learn(executed)
    assert learned is not None
    assert {name: learned.friction.get(name) for name in friction} == pytest.approx(friction, rel=0.1)
    assert learned.noisy is None  # what friction does within a step is no history
    expected, distances_ = learned.expected(points[count:]), [run.distance for run in runs[count:]]
    np.testing.assert_allclose(expected, distances_, rtol=0, atol=0.05 * max(distances_))


def test_friction_and_a_delay_are_found_together_in_any_order() -> None:
    late = ModelWithEffects(models.Function(sticky_step, vectorized=True), (Delay((2.0,)),), 1)
    validation = cart().with_parts(system=late)
    points = np.random.default_rng(0).random((10, 2))
    runs = [validation.outcome(validation.space.from_unit(point)) for point in points]
    executed = [(point, run.system_trajectory) for point, run in zip(points[:6], runs, strict=False)]
    study = DynamicsStudy(validation)
    learned = study.learn(executed)
    assert learned is not None
    assert learned.acting == pytest.approx({"delay [steps]": 2.0}, rel=0.05)
    assert learned.friction["u[0]"] == pytest.approx(GRIP, rel=0.1)
    expected, distances_ = learned.expected(points[6:]), [run.distance for run in runs[6:]]
    np.testing.assert_allclose(expected, distances_, rtol=0, atol=0.1 * max(distances_))
    within = study.made(effects=learned.study.within_steps)
    both = study.structures.with_inputs(within, executed)
    assert both is not None
    assert [type(each.effect) for each in both.effects] == [Delay, DryFriction]
    assert both.effects[0].effect.sizes == pytest.approx((2.0,), rel=0.05)


@pytest.mark.thorough
def test_friction_is_found_in_records_with_noise() -> None:
    rng, validation = np.random.default_rng(0), cart()
    points, executed = rng.random((8, 2)), []
    for point in points:
        loop = validation.outcome(validation.space.from_unit(point)).system_trajectory
        assert loop is not None
        executed.append((point, replace(loop, states=loop.states + 0.01 * rng.normal(size=loop.states.shape))))
    learned = DynamicsStudy(validation, target=Largest(0.9)).learn(executed)
    assert learned is not None
    assert learned.friction["u[0]"] == pytest.approx(GRIP, rel=0.1)
    assert learned.friction["u[0] at rest at most"] > GRIP


@pytest.mark.slow
def test_friction_that_only_rest_shows_is_not_validated_falsely() -> None:
    """Seals and guides hold with more than they slide with, in few tasks: a random one would hardly show it."""
    validation = cart(partial(sticky_step, grip=0.4, excess=0.2, slow=1e-3))
    tasks = validation.space.iid(4000, np.random.default_rng(1))
    distances_ = np.asarray(validation.distances(tasks))
    threshold = 0.95 * float(distances_.max())
    assert (distances_ > threshold).mean() < 0.02
    assert Campaign(validation, seed=0).run(20, threshold).verdict(threshold).answer != "validated"


@pytest.mark.parametrize("seed", more(0, 1, 2))
def test_a_model_without_friction_is_validated_and_the_verdict_names_it(seed: int) -> None:
    validation = cart()
    largest = float(np.max(validation.distances(validation.space.from_unit(np.random.default_rng(1).random((400, 2))))))
    verdict = Campaign(validation, seed=seed).run(25, threshold=1.25 * largest).verdict(1.25 * largest)
    assert verdict.answer == "validated"
    assert_names(str(verdict), "u[0]", [0], 0)
    assert Campaign(validation, seed=seed).run(25, threshold=0.9 * largest).verdict(0.9 * largest).answer == "falsified"
