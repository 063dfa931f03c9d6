from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Parameters, Task, TaskSpace, Trajectory, Validation
from ctxval.controllers import ILQR, LQR, Policy
from ctxval.distances import FinalState, WholeTrajectory
from ctxval.errors import (
    DesignError,
    DistanceError,
    ExecutionError,
    InputError,
    ModelError,
    ShapeError,
    UnknownNameError,
)
from ctxval.models import Linear
from ctxval.systems import Simulated
from ctxval.systems.functions import rk4
from facts import assert_names, refuses

DT, HORIZON = 0.05, 12
SPACE = TaskSpace(goal=(-2, 2, "rad"), start=(-1, 1))


def derivative(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.stack([x[..., 1], 14.7 * np.sin(x[..., 0]) + 3 * u[..., 0]], axis=-1)


STEP = rk4(derivative, DT)
MODEL = Linear([[1.0, DT], [14.7 * DT, 1.0]], [[0.0], [3 * DT]])
POINT = np.array([1.0, 0.5])


def regulate(p: Parameters) -> Task:
    return Task([p.start, 0.0], goal=[p.goal, 0.0], horizon=HORIZON, dt=DT)


class Looped:
    """What it wraps, without saying that it takes batches, and refusing them."""

    def __init__(self, inner: object) -> None:
        self._inner = inner

    def execute(self, controller: object, task: Task) -> Trajectory:
        assert task.batch_shape == ()
        return self._inner.execute(controller, task)

    def design(self, task: Task, model: object) -> object:
        assert task.batch_shape == ()
        return self._inner.design(task, model)


class Rig:
    """A system that does what a function does to a good execution."""

    def __init__(self, change: Callable[[Trajectory], object]) -> None:
        self._change = change

    def execute(self, controller: object, task: Task) -> object:
        return self._change(Simulated(STEP, vectorized=True).execute(controller, task))


def make(**parts: object) -> Validation:
    whole = {
        "space": SPACE,
        "task": regulate,
        "system": Simulated(STEP, vectorized=True),
        "model": MODEL,
        "synthesizer": LQR([1.0, 0.1], [0.01], [10.0, 1.0]),
        "distance": FinalState(norm=1),
    }
    return Validation(**{**whole, **parts})


def points(n: int = 7) -> np.ndarray:
    return SPACE.iid(n, np.random.default_rng(0))


def raising(error: Exception) -> Callable[..., object]:
    def fail(*_: object) -> object:
        raise error

    return fail


# One task


def test_an_outcome_is_the_closed_loops_on_model_and_system_and_their_distance() -> None:
    validation = make()
    outcome = validation.outcome(POINT)
    controller = LQR([1.0, 0.1], [0.01], [10.0, 1.0]).design(regulate(SPACE.parameters(POINT)), MODEL)
    x = y = np.array([0.5, 0.0])
    for t in range(HORIZON):
        x, y = MODEL.step(x, controller(t, x)), STEP(y, controller(t, y))
    np.testing.assert_allclose(outcome.plan.model_trajectory.final_state, x, rtol=1e-12)
    np.testing.assert_allclose(outcome.system_trajectory.final_state, y, rtol=1e-12)
    assert outcome.distance == pytest.approx(np.abs(x - y).sum(), rel=1e-12)
    assert type(outcome.distance) is float


def test_a_plan_is_made_without_the_system() -> None:
    validation = make(system=Rig(raising(AssertionError("the system was touched"))))
    plan = validation.plan(POINT)
    assert plan.parameters.goal == 1.0
    assert plan.task.goal.tolist() == [1.0, 0.0]
    np.testing.assert_allclose(plan.model_trajectory.inputs[0], plan.controller(0, plan.task.initial_state))


def test_a_perfect_model_has_no_distance() -> None:
    np.testing.assert_allclose(make(system=Simulated(MODEL)).distances(points()), 0, atol=1e-12)


def test_steps_make_the_outcome() -> None:
    validation = make()
    plan = validation.plan(POINT)
    trajectory = validation.execute(plan)
    assert validation.measure(plan, trajectory) == validation.outcome(POINT).distance


# Many tasks

SYNTHESIZERS = [
    LQR([1.0, 0.1], [0.01]),
    ILQR([1.0, 0.1], [0.01], [10.0, 1.0]),
    Policy(lambda t, x, task: -5 * (x - task.goal)[..., :1] - x[..., 1:]),
]


@pytest.mark.parametrize("distance", [FinalState(1), WholeTrajectory(2, per_step=True)])
@pytest.mark.parametrize("synthesizer", SYNTHESIZERS)
def test_the_distances_of_many_tasks_are_those_of_their_outcomes(synthesizer: object, distance: object) -> None:
    validation = make(synthesizer=synthesizer, distance=distance)
    assert validation.batched
    expected = [validation.outcome(point).distance for point in points()]
    np.testing.assert_allclose(validation.distances(points()), expected, rtol=0, atol=1e-10)
    assert min(expected) > 0


def test_more_tasks_than_fit_in_one_call_are_all_measured() -> None:
    validation = make()
    many = SPACE.grid(70)
    values = validation.distances(many)
    assert values.shape == (4900,)
    np.testing.assert_allclose(values[4090:4105], validation.distances(many[4090:4105]), rtol=0, atol=1e-12)


@pytest.mark.parametrize("part", ["system", "synthesizer"])
def test_what_takes_no_batch_is_looped(part: str) -> None:
    whole = make()
    looped = make(**{part: Looped(getattr(whole, part))})
    assert not looped.batched
    np.testing.assert_allclose(looped.distances(points()), whole.distances(points()), rtol=0, atol=1e-10)


class Recording:
    """A synthesizer that notes the batch shape of each design, with controllers that may not be divisible."""

    batched = True

    def __init__(self, inner: object, divisible: bool = True) -> None:
        self._inner, self._divisible, self.shapes = inner, divisible, []

    def design(self, task: Task, model: object) -> object:
        self.shapes.append(task.batch_shape)
        controller = self._inner.design(task, model)
        return controller if self._divisible else lambda t, x: controller(t, x)


@pytest.mark.parametrize("synthesizer", SYNTHESIZERS)
def test_tasks_are_planned_together_and_executed_singly(synthesizer: object) -> None:
    whole = make(synthesizer=synthesizer)
    recording = Recording(synthesizer)
    values = make(synthesizer=recording, system=Looped(whole.system)).distances(points())
    assert recording.shapes == [(7,)]
    np.testing.assert_allclose(values, whole.distances(points()), rtol=0, atol=1e-9)


def test_plans_of_many_tasks_are_those_of_single_ones() -> None:
    validation = make(synthesizer=ILQR([1.0, 0.1], [0.01], [10.0, 1.0]))
    for plan, point in zip(validation.plans(points()), points(), strict=True):
        alone = validation.plan(point)
        assert (plan.parameters.goal, plan.task.batch_shape) == (alone.parameters.goal, ())
        for name in ("states", "inputs"):
            ours, theirs = getattr(plan.model_trajectory, name), getattr(alone.model_trajectory, name)
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)
        state = alone.task.initial_state + 0.1
        np.testing.assert_allclose(plan.controller(3, state), alone.controller(3, state), rtol=0, atol=1e-9)
    assert validation.plans(np.empty((0, 2))) == []


def test_controllers_that_cannot_be_divided_are_designed_one_by_one() -> None:
    whole = make()
    recording = Recording(LQR([1.0, 0.1], [0.01], [10.0, 1.0]), divisible=False)
    values = make(synthesizer=recording, system=Looped(whole.system)).distances(points(4))
    assert recording.shapes == [(4,), (), (), (), ()]
    np.testing.assert_allclose(values, whole.distances(points(4)), rtol=0, atol=1e-10)


def test_a_task_function_for_single_tasks_is_called_for_each() -> None:
    def regulate_one(p: Parameters) -> Task:
        return Task([float(p.start), 0.0], goal=[float(p.goal), 0.0], horizon=HORIZON, dt=DT)

    whole = make()
    values = make(task=regulate_one, system=Looped(whole.system)).distances(points(4))
    np.testing.assert_allclose(values, whole.distances(points(4)), rtol=0, atol=1e-10)


def test_a_design_that_fails_is_reported_after_the_executions_before_it() -> None:
    executed = []

    def goals_up_to_one(task: Task, model: object) -> object:
        if (task.goal[..., 0] > 1).any():
            raise DesignError("the goal is out of reach")
        return LQR([1.0, 0.1], [0.01]).design(task, model)

    synthesizer = Recording(LQR([1.0, 0.1], [0.01]))
    synthesizer.design = goals_up_to_one
    validation = make(synthesizer=synthesizer, system=Rig(lambda whole: executed.append(0) or whole))
    with refuses(DesignError, "goal", "start"):
        validation.distances([[0.0, 0.0], [0.5, 0.0], [1.5, 0.0], [0.2, 0.0]])
    assert len(executed) == 2


def test_a_plain_function_serves_as_model_and_as_system() -> None:
    def slow(x: np.ndarray, u: np.ndarray) -> list[float]:
        return [float(v) for v in STEP(x, u)]

    validation = make(system=Simulated(slow), model=MODEL.step)
    np.testing.assert_allclose(validation.distances(points(3)), make().distances(points(3)), rtol=0, atol=1e-7)


def test_one_point_is_a_batch_of_one() -> None:
    np.testing.assert_allclose(make().distances(POINT[None]), [make().outcome(POINT).distance], rtol=0, atol=1e-12)


def fragile(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Step as the pendulum does, but break beyond 1.2 rad."""
    return np.where(np.abs(x[..., :1]) > 1.2, np.nan, STEP(x, u))


@pytest.mark.parametrize("batched", [True, False])
def test_where_the_execution_fails_the_distance_is_unknown_and_the_others_are_known(batched: bool) -> None:
    system = Simulated(fragile, vectorized=True)
    values = make(system=system if batched else Looped(system)).distances(points(12))
    whole = make().distances(points(12))
    assert 0 < np.isnan(values).sum() < 12
    known = ~np.isnan(values)
    np.testing.assert_allclose(values[known], whole[known], rtol=0, atol=1e-10)


@pytest.mark.parametrize("shape", [(), (3,), (3, 1), (3, 3)])
def test_points_of_another_dimension_are_refused_with_both_shapes(shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError) as caught:
        make().distances(np.zeros(shape))
    assert_names(str(caught.value), "points", "shape", shape)


@pytest.mark.parametrize("batched", [True, False])
def test_one_point_is_no_list_of_points(batched: bool) -> None:
    system = make().system
    with pytest.raises(ShapeError):
        make(system=system if batched else Looped(system)).distances(POINT)


# The task function


def test_an_unknown_parameter_in_the_task_is_refused_with_the_nearest_name() -> None:
    validation = make(task=lambda p: Task([p.strat, 0.0], horizon=HORIZON, dt=DT))
    for ask in (validation.plan, lambda point: validation.distances(point[None])):
        with refuses(UnknownNameError, "strat", "start"):
            ask(POINT)


def test_a_task_function_that_ignores_the_batch_is_refused() -> None:
    validation = make(task=lambda p: Task([0.5, 0.0], goal=[1.0, 0.0], horizon=HORIZON, dt=DT))
    with refuses(ShapeError, 3, ()):
        validation.distances(points(3))


def test_a_task_function_that_makes_many_tasks_of_one_point_is_refused() -> None:
    validation = make(task=lambda p: Task([np.full(4, p.start), 0.0], horizon=HORIZON, dt=DT))
    with refuses(ShapeError, (4,)):
        validation.plan(POINT)


def test_a_task_function_that_returns_no_task_is_refused_by_value() -> None:
    with refuses(InputError, "task", "result", 3):
        make(task=lambda p: 3).plan(POINT)


def test_a_task_function_that_raises_is_named_with_its_reason() -> None:
    with refuses(InputError, "task", "KeyError", "map"):
        make(task=lambda p: {}["map"]).plan(POINT)


# The synthesizer and the model


class Failing:
    batched = True

    def __init__(self, error: Exception) -> None:
        self.design = raising(error)


def test_a_synthesizer_that_raises_is_named_with_its_reason() -> None:
    with refuses(DesignError, "synthesizer", "ZeroDivisionError", "goal"):
        make(synthesizer=Failing(ZeroDivisionError("no slope"))).plan(POINT)


def test_a_synthesizer_that_finds_no_controller_says_why_itself() -> None:
    with refuses(DesignError, "goal", "start"):
        make(synthesizer=Failing(DesignError("the goal is out of reach"))).plan(POINT)


def test_a_model_that_raises_is_named_with_its_reason() -> None:
    validation = make(model=raising(RuntimeError("no licence")), synthesizer=Policy(lambda t, x, task: x[..., :1]))
    with refuses(ModelError, "RuntimeError", "model"):
        validation.plan(POINT)


def test_a_model_that_diverges_is_refused_with_the_task() -> None:
    broken = Linear(MODEL.A, MODEL.B)
    broken.step = lambda x, u: np.where(np.abs(x) > 0.9, np.inf, MODEL.step(x, u))
    validation = make(model=broken, synthesizer=Policy(lambda t, x, task: 0 * x[..., :1]))
    with refuses(ModelError, "goal", "start"):
        validation.plan(POINT)
    with refuses(ModelError, "goal", "start"):
        validation.distances([[0.0, 0.0], POINT])


def test_a_controller_of_the_wrong_shape_is_refused() -> None:
    with refuses(ShapeError, "controller", ()):
        make(synthesizer=Policy(lambda t, x, task: 1.0)).plan(POINT)


# The system


def stopped(whole: Trajectory) -> Trajectory:
    return Trajectory(whole.times[:-2], whole.states[:-2], whole.inputs[:-2], ended="emergency stop")


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        (raising(RuntimeError("motor stalled")), ("RuntimeError",)),
        (raising(TimeoutError()), ("TimeoutError",)),
        (lambda whole: None, ("NoneType",)),
        (stopped, ("emergency",)),
        (
            lambda whole: Trajectory(whole.times, whole.states * np.nan, whole.inputs),
            (0,),
        ),
        (lambda whole: Trajectory(whole.times, whole.states[None] * np.nan, whole.inputs[None]), (0,)),
        (lambda whole: Trajectory(whole.times, whole.states, whole.inputs * np.inf), ("input",)),
        (
            lambda whole: Trajectory(whole.times, np.full_like(whole.states, 9.0), whole.inputs),
            ("system", 0),
        ),
        (
            lambda whole: Trajectory(whole.times[:-2], whole.states[:-2], whole.inputs[:-2]),
            (13, 12, 0.05),
        ),
        (
            lambda whole: Trajectory(whole.times, whole.states[:, :1], whole.inputs),
            ((13, 2), (12, 1), (13, 1)),
        ),
        (
            lambda whole: Trajectory(whole.times, whole.states[None], whole.inputs[None]),
            ((1, 13, 2), "trajectory"),
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_an_execution_that_is_not_whole_and_finite_fails_with_its_reason(
    change: Callable[[Trajectory], object], facts: tuple[object, ...]
) -> None:
    validation = make(system=Rig(change))
    with refuses(ExecutionError, *facts):
        validation.outcome(POINT)
    assert np.isnan(validation.distances(points(2))).all()


def test_accepting_checks_and_measures_at_once() -> None:
    validation = make()
    plan = validation.plan(POINT)
    whole = validation.system.execute(plan.controller, plan.task)
    assert validation.accept(plan, whole) == validation.measure(plan, whole)


def test_accepting_refuses_what_is_no_execution_of_the_plan() -> None:
    validation = make()
    plan = validation.plan(POINT)
    whole = validation.system.execute(plan.controller, plan.task)
    for broken in (None, "fell over", stopped(whole), Trajectory(whole.times, whole.states * np.nan, whole.inputs)):
        with pytest.raises(ExecutionError):
            validation.accept(plan, broken)
    moved = Trajectory(whole.times, whole.states + np.array([1.0, 0.0]), whole.inputs)
    with refuses(InputError, "start_tolerance", 0):
        validation.accept(plan, moved)
    assert validation.accept(plan, moved, start_tolerance=10.0) > 0


def test_noise_of_a_task_that_hardly_moves_is_no_other_start() -> None:
    validation = make()
    plan = validation.plan(POINT)
    whole = validation.system.execute(plan.controller, plan.task)
    noise = 0.3 * np.random.default_rng(0).standard_normal(whole.states.shape)
    noise[0] = 0.3
    assert validation.accept(plan, Trajectory(whole.times, whole.states + noise, whole.inputs)) > 0
    far = Trajectory(whole.times, whole.states + noise + 2.0, whole.inputs)
    with refuses(InputError, "start_tolerance", 0):
        validation.accept(plan, far)


@pytest.mark.parametrize("distance", [lambda a, b, task: np.nan, lambda a, b, task: 1 / 0, lambda a, b, task: -1.0])
def test_an_accepted_execution_without_a_usable_distance_says_why(distance: object) -> None:
    validation = make(distance=distance)
    plan = validation.plan(POINT)
    whole = validation.system.execute(plan.controller, plan.task)
    with refuses(DistanceError, "distance"):
        validation.accept(plan, whole)


def test_a_system_that_diverges_fails_with_the_step() -> None:
    system = Simulated(lambda x, u: np.where(x > 0.4, np.nan, STEP(x, u)), vectorized=True)
    with refuses(ExecutionError, 1):
        make(system=system).outcome(POINT)


# The distance


@pytest.mark.parametrize("value", [np.nan, np.inf, -0.5, np.zeros(1), np.zeros(2)])
def test_a_distance_that_is_no_finite_number_of_at_least_zero_is_refused_with_the_task(value: object) -> None:
    with refuses(DistanceError, 0, "goal", 1.0):
        make(distance=lambda model, system, task: value).outcome(POINT)


def test_a_distance_that_is_an_array_is_refused_without_its_numbers() -> None:
    with refuses(DistanceError, (61,), "distance"):
        make(distance=lambda model, system, task: np.ones(61)).outcome(POINT)


@pytest.mark.parametrize("batched", [True, False])
def test_a_distance_that_raises_is_named_with_its_reason(batched: bool) -> None:
    system = make().system
    validation = make(system=system if batched else Looped(system), distance=raising(IndexError("state 7")))
    with refuses(DistanceError, "IndexError", 7):
        validation.outcome(POINT)
    with refuses(DistanceError, "IndexError", 7):
        validation.distances(points(2))


@pytest.mark.parametrize(
    "distance",
    [
        lambda model, system, task: np.abs(model.states - system.states).max(),
        lambda model, system, task: np.abs(model.final_state - system.final_state),
        lambda model, system, task: np.zeros(3),
    ],
)
def test_a_distance_without_one_value_a_task_is_refused_with_both_shapes(distance: object) -> None:
    with refuses(DistanceError, "distance", (5,)):
        make(distance=distance).distances(points(5))


# The parts


@pytest.mark.parametrize(
    ("part", "value", "facts"),
    [
        ("space", (0, 1), ("space", "TaskSpace", (0, 1))),
        ("task", None, ("task", "None")),
        ("system", STEP, ("system", "task")),
        ("model", 3.0, ("model", 3.0)),
        ("synthesizer", MODEL, ("synthesizer", "model")),
        (
            "distance",
            1,
            ("distance", "model_trajectory", "system_trajectory"),
        ),
    ],
)
def test_a_part_that_cannot_serve_is_refused_by_its_name(part: str, value: object, facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        make(**{part: value})


def test_the_description_is_json_that_tells_validations_apart() -> None:
    described = json.dumps(make().describe())
    assert described == json.dumps(make().describe())
    for change in (
        {"space": TaskSpace(goal=(-2, 2), start=(-1, 1.5))},
        {"model": lambda x, u: x},
        {"synthesizer": LQR([1.0, 0.2], [0.01], [10.0, 1.0])},
        {"distance": FinalState(norm=2)},
    ):
        assert json.dumps(make(**change).describe()) != described


# A batch fails as its tasks would one by one


def test_a_batch_whose_execution_raises_is_executed_one_by_one() -> None:
    class Fragile(Simulated):
        def execute(self, controller, task):  # type: ignore[no-untyped-def]
            if (np.atleast_1d(task.goal[..., 0]) > 0.5).any():
                raise RuntimeError("the goal is out of reach")
            return super().execute(controller, task)

    plain = make_validation()
    fragile = make_validation(system=Fragile(plain.system.model))  # type: ignore[attr-defined]
    points = np.array([[-0.5], [0.0], [1.0]])
    expected = np.where(points[:, 0] > 0.5, np.nan, plain.distances(points))
    np.testing.assert_allclose(fragile.distances(points), expected, atol=1e-12)


def test_a_batch_with_a_distance_that_is_negative_or_nan_is_refused_like_one_task() -> None:
    for value in (-1.0, np.nan):
        bad = make_validation(distance=lambda m, s, task, value=value: np.full(task.batch_shape, value))
        with refuses(DistanceError, "distance", "goal"):
            bad.distances([[0.1], [0.2]])


def test_no_points_have_no_distances() -> None:
    assert make_validation().distances(np.empty((0, 1))).shape == (0,)


@pytest.mark.parametrize("value", [-0.0, np.float32(-0.0), np.array(-0.0), 0.0])
def test_a_distance_of_minus_zero_is_zero(value: object) -> None:
    validation = make_validation().with_parts(distance=lambda model, system, task: value)
    distance = validation.outcome(validation.space.low).distance
    assert (distance, np.signbit(distance)) == (0.0, False)


@pytest.mark.parametrize("value", [np.ma.masked, np.ma.masked_array(1.0, True), True, "0.5", 1j, [0.5, "1"], None])
def test_a_distance_that_numpy_would_convert_to_a_number_is_refused(value: object) -> None:
    validation = make_validation().with_parts(distance=lambda model, system, task: value)
    with pytest.raises(DistanceError):
        validation.outcome(validation.space.low)


def test_a_task_that_keeps_an_array_of_its_function_does_not_change_with_it() -> None:
    start, reference = np.zeros(2), np.zeros((4, 2))
    task = Task(start, horizon=3, dt=0.1, reference=reference, environment={"place": start})
    start += 1
    reference += 1
    assert not task.initial_state.any()
    assert not task.reference.any()
    assert not task.environment["place"].any()


def test_a_plan_that_people_hold_cannot_be_changed() -> None:
    plan = make_validation().plan(make_validation().space.low)
    nominal = plan.model_trajectory
    for array in (nominal.times, nominal.states, nominal.inputs, plan.task.reference, plan.parameters.points):
        with refuses(ValueError):
            array[...] = 0.0
