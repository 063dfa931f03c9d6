from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ctxval import Task, TaskSpace, Trajectory, Transitions, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval._util.progress import Progress, listening, stage
from ctxval.core.controller import Controller
from ctxval.core.rollout import rollout
from ctxval.errors import DesignError
from ctxval.learning import closed_loops
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.learning.draws import DynamicsDraws
from ctxval.learning.dynamics_posterior import PosteriorSettings, learn_posterior

MODEL = models.Linear([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]])
LQR = controllers.LQR([1.0, 0.1], [0.1])
POINTS = np.random.default_rng(7).random((7, 2))


def truth(x: Array, u: Array) -> Array:
    return np.asarray(MODEL.step(x, u) + 0.05 * np.sin(2 * x) * (1 + u))


@functools.cache
def make_draws() -> DynamicsDraws:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(30, 2)), rng.normal(size=(30, 1))
    settings = PosteriorSettings(hyperparameters=4)
    posterior = learn_posterior(MODEL, Transitions(x, u, truth(x, u)), np.zeros(30, dtype=np.intp), settings=settings)
    assert posterior is not None
    return posterior.draw(2 * rng.normal(size=(80, 3)), rng)


def make_validation(synthesizer: Any = LQR, **parts: Any) -> Validation:
    chosen: dict[str, Any] = {
        "space": TaskSpace(start=([-2.0, -1.0], [2.0, 1.0])),
        "task": lambda p: Task(p.start, goal=[0.3, 0.0], horizon=12, dt=0.1),
        "system": systems.Simulated(truth, vectorized=True),
        "model": MODEL,
        "distance": distances.MeanDeviation(),
        **parts,
    }
    return Validation(synthesizer=synthesizer, **chosen)


class OneByOne:
    """LQR for one task, whose controllers take a single state or leading axes."""

    def __init__(self, wrap: Callable[[Controller], Controller] = lambda controller: controller) -> None:
        self.wrap = wrap

    def design(self, task: Task, model: models.Model) -> Controller:
        return self.wrap(LQR.design(task, model))


def single_state(controller: Controller) -> Controller:
    """Return a controller that takes one state ``(n,)`` and nothing else."""

    def act(t: int, x: Array) -> Array:
        if x.shape != (2,):
            raise ValueError("one state is needed")
        return controller(t, x)

    return act


def first_state_only(controller: Controller) -> Controller:
    """Return a controller that silently uses the first of several states for all of them."""

    def act(t: int, x: Array) -> Array:
        u = controller(t, x.reshape(-1, 2)[0])
        return np.broadcast_to(u, (*x.shape[:-1], 1))

    return act


def expected(validation: Validation) -> Array:
    """Return the distances of all draws on all tasks, one closed loop after the other."""
    draws = make_draws()
    found = np.empty((len(draws), len(POINTS)))
    for j, point in enumerate(POINTS):
        plan = validation.plan(validation.space.from_unit(point))
        for s in range(len(draws)):
            loop = rollout(draws[s].step, plan.controller, plan.task)
            found[s, j] = validation.distance(plan.model_trajectory, loop, plan.task)
    return found


@pytest.mark.slow
def test_distances_of_a_batch_are_those_of_single_loops() -> None:
    validation, draws = make_validation(), make_draws()
    planner = LoopPlanner(validation)
    found = planner.distances(draws, planner.plan(POINTS), len(POINTS))
    np.testing.assert_allclose(found, expected(validation), rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("wrap", [lambda controller: controller, single_state, first_state_only])
def test_synthesizers_of_single_tasks_give_the_same_numbers(wrap: Callable[[Controller], Controller]) -> None:
    draws, batched, single = make_draws(), LoopPlanner(make_validation()), LoopPlanner(make_validation(OneByOne(wrap)))
    together = batched.distances(draws, batched.plan(POINTS), len(POINTS))
    np.testing.assert_allclose(single.distances(draws, single.plan(POINTS), len(POINTS)), together, rtol=1e-8)
    own = np.random.default_rng(1).random((len(draws), 2, 2))
    np.testing.assert_allclose(single.own_distances(draws, own), batched.own_distances(draws, own), rtol=1e-8)


def test_batched_controllers_that_take_no_further_axis_give_the_same_numbers() -> None:
    class Strict:
        batched = True

        def design(self, task: Task, model: models.Model) -> Controller:
            controller, shape = LQR.design(task, model), task.initial_state.shape

            def act(t: int, x: Array) -> Array:
                if x.shape != shape:
                    raise ValueError(f"states of shape {shape} are needed")
                return controller(t, x)

            return act

    draws, planner, strict = make_draws(), LoopPlanner(make_validation()), LoopPlanner(make_validation(Strict()))
    found = strict.distances(draws, strict.plan(POINTS), len(POINTS))
    np.testing.assert_allclose(found, planner.distances(draws, planner.plan(POINTS), len(POINTS)), rtol=1e-8)


class ForgetsDraws:
    """A PID controller whose memory has the axes of its own task only, so that draws are run one after the other."""

    batched = True

    def design(self, task: Task, model: models.Model) -> Controller:
        made, axes = controllers.PID(2.0, 3.0, 0.5).design(task, model), task.batch_shape

        class Controlled:
            def start(self, task: Task) -> Any:
                return made.start(Task(np.zeros((*axes, 2)), horizon=1, dt=0.1))

            def step(self, t: int, x: Array, memory: Any) -> Any:
                u, new = made.step(t, x, memory)
                return u, type(memory)(
                    *(part.reshape(-1, *old.shape)[-1] for part, old in zip(new, memory, strict=True))
                )

        return Controlled()


@pytest.mark.parametrize("single", [False, True])
def test_draws_have_memories_of_their_own(single: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    pid, draws = controllers.PID(2.0, 3.0, 0.5, limits=4.0), make_draws()
    monkeypatch.setattr(pid, "batched", not single)
    validation, lengths = make_validation(pid), list[int]()
    planner = LoopPlanner(validation)
    monkeypatch.setattr(closed_loops, "rollout", lambda *loop: lengths.append(1) or rollout(*loop))
    found = planner.distances(draws, planner.plan(POINTS), len(POINTS))
    assert len(lengths) == (len(POINTS) if single else 1)  # all draws at once
    np.testing.assert_allclose(found, expected(validation), rtol=1e-8)


def test_draws_run_one_after_the_other_if_the_memory_has_no_axis_for_them() -> None:
    draws, planner = make_draws(), LoopPlanner(make_validation(ForgetsDraws()))
    usual = LoopPlanner(make_validation(controllers.PID(2.0, 3.0, 0.5)))
    found = planner.distances(draws, planner.plan(POINTS), len(POINTS))
    np.testing.assert_allclose(found, usual.distances(draws, usual.plan(POINTS), len(POINTS)), rtol=1e-8)


@pytest.mark.parametrize("together", [1, 4, 512])
def test_the_size_of_batches_does_not_matter(together: int) -> None:
    draws, planner = make_draws(), LoopPlanner(make_validation())
    plans = planner.plan(POINTS, together=together)
    assert len(plans) == -(-len(POINTS) // together)
    found = planner.distances(draws, plans, len(POINTS))
    np.testing.assert_allclose(found, planner.distances(draws, planner.plan(POINTS), len(POINTS)), rtol=1e-8)


def test_own_distances_are_distances_of_each_draw_on_its_own_tasks() -> None:
    draws, planner = make_draws(), LoopPlanner(make_validation())
    points = np.random.default_rng(2).random((len(draws), 3, 2))
    found = planner.own_distances(draws, points)
    for s in (0, 1, len(draws) - 1):
        same = planner.distances(draws, planner.plan(points[s]), 3)[s]
        np.testing.assert_allclose(found[s], same, rtol=1e-8)


def test_states_and_inputs_of_loops_belong_to_their_draws_and_tasks() -> None:
    draws, planner = make_draws(), LoopPlanner(make_validation())
    (loops,) = planner.run(draws, planner.plan(POINTS))
    assert loops.states.shape == (len(draws), len(POINTS), 13, 2)
    assert loops.inputs.shape == (len(draws), len(POINTS), 12, 1)
    following = draws.step(loops.states[:, :, 4], loops.inputs[:, :, 4])
    np.testing.assert_allclose(following, loops.states[:, :, 5], rtol=1e-8)


class Failing:
    """LQR that has no controller for starts on the right."""

    def __init__(self, *, batched: bool) -> None:
        self.batched = batched

    def design(self, task: Task, model: models.Model) -> Controller:
        if (task.initial_state[..., 0] > 1).any():
            raise DesignError("there is no controller for this task.")
        return LQR.design(task, model)


@pytest.mark.slow
@pytest.mark.parametrize("batched", [True, False])
def test_tasks_without_a_controller_have_no_distance(batched: bool) -> None:
    draws, planner = make_draws(), LoopPlanner(make_validation(Failing(batched=batched)))
    right = POINTS[:, 0] > 0.75
    found = planner.distances(draws, planner.plan(POINTS), len(POINTS))
    np.testing.assert_array_equal(np.isnan(found), np.repeat(right[None], len(draws), axis=0))
    usual = LoopPlanner(make_validation())
    same = usual.distances(draws, usual.plan(POINTS), len(POINTS))
    np.testing.assert_allclose(found[:, ~right], same[:, ~right], rtol=1e-8)
    own = np.repeat(POINTS[None], len(draws), axis=0)
    np.testing.assert_allclose(planner.own_distances(draws, own), found, rtol=1e-8)


def test_if_no_task_has_a_controller_there_is_no_distance() -> None:
    class Never:
        batched = True

        def design(self, task: Task, model: models.Model) -> Controller:
            raise DesignError("there is no controller.")

    draws, planner = make_draws(), LoopPlanner(make_validation(Never()))
    assert planner.plan(POINTS) == []
    assert np.isnan(planner.distances(draws, [], len(POINTS))).all()
    assert np.isnan(planner.own_distances(draws, np.repeat(POINTS[None], len(draws), axis=0))).all()


@pytest.mark.parametrize("synthesizer", [controllers.Policy(lambda t, x, task: 1e80 * x[..., :1] ** 3), None])
def test_loops_that_diverge_are_infinitely_far(synthesizer: Any) -> None:
    def push(t: int, x: Array, task: Task) -> Array:
        return np.where(task.initial_state[..., :1] > 0, 1e80 * x[..., :1] ** 3, 0 * x[..., :1])

    space = TaskSpace(start=([0.5, -1.0], [2.0, 1.0])) if synthesizer else TaskSpace(start=([-2.0, -1.0], [2.0, 1.0]))
    quiet = models.Function(lambda x, u: 0.5 * x, vectorized=True)
    parts = {"space": space, "model": quiet}
    planner = LoopPlanner(make_validation(synthesizer or controllers.Policy(push), **parts))
    draws = make_draws()
    found = planner.distances(draws, planner.plan(POINTS), len(POINTS))
    diverging = np.ones(len(POINTS), dtype=bool) if synthesizer else POINTS[:, 0] > 0.5
    assert np.isinf(found[:, diverging]).all()
    assert np.isfinite(found[:, ~diverging]).all()
    own = np.repeat(POINTS[None], len(draws), axis=0)
    np.testing.assert_array_equal(np.isinf(planner.own_distances(draws, own)), np.isinf(found))


def test_a_distance_that_fails_for_diverging_loops_is_infinite_for_them() -> None:
    def strict(model: Trajectory, system: Trajectory, task: Task) -> Array:
        if not np.isfinite(system.states).all():
            raise ValueError("states must be finite")
        return distances.MeanDeviation()(model, system, task)

    def push(t: int, x: Array, task: Task) -> Array:
        return np.where(task.initial_state[..., :1] > 0, 1e80 * x[..., :1] ** 3, 0 * x[..., :1])

    quiet = models.Function(lambda x, u: 0.5 * x, vectorized=True)
    planner = LoopPlanner(make_validation(controllers.Policy(push), model=quiet, distance=strict))
    found = planner.distances(make_draws(), planner.plan(POINTS), len(POINTS))
    np.testing.assert_array_equal(np.isinf(found), np.repeat(POINTS[None, :, 0] > 0.5, len(make_draws()), axis=0))


def test_the_system_is_never_executed() -> None:
    class Costly:
        def execute(self, controller: Controller, task: Task) -> Trajectory:
            raise AssertionError("an execution costs money")

    draws, planner = make_draws(), LoopPlanner(make_validation(system=Costly()))
    assert np.isfinite(planner.distances(draws, planner.plan(POINTS), len(POINTS))).all()


def test_tasks_on_which_the_model_diverges_have_no_distance() -> None:
    def push(t: int, x: Array, task: Task) -> Array:
        return np.where(task.initial_state[..., :1] > 0, 1e80 * x[..., :1] ** 3, 0 * x[..., :1])

    planner = LoopPlanner(make_validation(controllers.Policy(push)))
    found = planner.distances(make_draws(), planner.plan(POINTS), len(POINTS))
    np.testing.assert_array_equal(np.isnan(found), np.repeat(POINTS[None, :, 0] > 0.5, len(make_draws()), axis=0))


# Plans that are kept


class CountingLQR(controllers.LQR):
    """An LQR that counts the tasks for which it designs controllers."""

    designed = 0

    def design(self, task: Task, model: models.Model) -> controllers.AffineFeedback:
        self.designed += int(np.prod(task.batch_shape))
        return super().design(task, model)


def counting(batched: bool) -> tuple[LoopPlanner, CountingLQR]:
    synthesizer = CountingLQR([1.0, 0.1], [0.1])
    synthesizer.batched = batched  # type: ignore[misc]
    return LoopPlanner(make_validation(synthesizer)), synthesizer


def final_states(planner: LoopPlanner, points: Array) -> Array:
    found = np.full((len(points), 2), np.nan)
    for one in planner.plan(points, together=4):
        found[one.rows] = one.nominal.final_state
    return found


@pytest.mark.parametrize("batched", [True, False])
def test_tasks_that_were_planned_are_not_planned_again(batched: bool) -> None:
    planner, synthesizer = counting(batched)
    first = final_states(planner, POINTS)
    designed = synthesizer.designed
    np.testing.assert_array_equal(final_states(planner, POINTS), first)
    assert synthesizer.designed == designed
    if not batched:
        np.testing.assert_array_equal(final_states(planner, POINTS[::-1]), first[::-1])
        assert synthesizer.designed == designed
        assert planner.has(POINTS[0])


def test_the_oldest_plans_make_room_for_new_ones() -> None:
    planner, synthesizer = counting(False)
    planner.plan(POINTS[:1])
    planner.kept_bytes = 0
    planner.plan(POINTS[1:])
    assert not planner.has(POINTS[0])
    assert synthesizer.designed >= len(POINTS)


@pytest.mark.parametrize("batched", [True, False])
def test_each_task_is_counted_once_whether_it_is_planned_or_kept(batched: bool) -> None:
    planner, _ = counting(batched)
    assert planner.batched is batched  # found out before the count, with tasks of its own
    heard: list[Progress] = []
    with listening(heard.append), stage("choosing a task", unit="designs"):
        planner.plan(POINTS)
        planner.plan(POINTS)
    assert heard[-1].done == 2 * len(POINTS)


class Falling(controllers.Policy):
    fall = controllers.Fall(height=0.52)


def test_robots_lie_still_from_their_fall_on_even_if_m_diverges_there() -> None:
    def sink(x: Array, u: Array) -> Array:
        moved = np.array(x)
        moved[..., 2] += 0.1 * x[..., 9]
        return np.where(x[..., 2:3] < 0.3, np.inf, moved)

    validation = Validation(
        space=TaskSpace(speed=(0.5, 1.5, "m/s")),
        task=lambda p: Task([0, 0, 1, 1, 0, 0, 0, 0, 0, -p.speed, 0, 0, 0], horizon=10, dt=0.1),
        system=systems.Simulated(sink, vectorized=True),
        model=models.Function(sink, vectorized=True),
        synthesizer=Falling(lambda t, x, task: 0 * x[..., :1]),
        distance=distances.FinalState(components=[2]),
    )
    [plan] = LoopPlanner(validation).plan(np.array([[0.0], [1.0]]))
    assert plan.nominal.finite.all()
    assert plan.nominal.final_state[:, 2] == pytest.approx([0.5, 0.4])
    assert not plan.nominal.states[1, 5:, 7:].any()
