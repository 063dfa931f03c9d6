"""Task parameters that change the dynamics are states of what is learned, and nothing that the user's parts see."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import Campaign, Task, TaskSpace, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.core.task import Task as CoreTask
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, UnknownNameError
from ctxval.learning import DynamicsStudy
from ctxval.learning.extended import ExtendedValidation
from ctxval.learning.replays import replay_executed
from facts import assert_names, refuses

H, DT = 30, 0.1


class Carried(Task):
    """A task with a load that the system knows, and its model and its controller do not."""

    def __init__(self, task: CoreTask, load: Array) -> None:
        super().__init__(task.initial_state, goal=task.goal, horizon=H, dt=DT)
        self.load = np.broadcast_to(load, self.batch_shape)

    def __getitem__(self, index: int) -> Carried:
        return Carried(super().__getitem__(index), self.load[index])


def cart(x: Array, u: Array, load: Array) -> Array:
    position, speed = x[..., 0], x[..., 1]
    pushed = u[..., 0] / (1 + load) - 0.3 * speed * np.abs(speed)
    return np.stack([position + DT * speed, speed + DT * pushed], axis=-1)


@dataclass(frozen=True)
class Cart:
    """Carries the load of its task."""

    batched: bool = True

    def execute(self, controller: Any, task: Task) -> Any:
        assert isinstance(task, Carried)
        return systems.Simulated(lambda x, u: cart(x, u, task.load), vectorized=True).execute(controller, task)


def loaded_cart(physical: tuple[str, ...] = ("load",), synthesizer: Any = None) -> Validation:
    model = models.Linear(np.array([[1.0, DT], [0.0, 1.0]]), np.array([[0.0], [DT]]))
    return Validation(
        space=TaskSpace(goal=(0.5, 2.0, "m"), load=(0.0, 1.0, "kg")),
        task=lambda p: Carried(Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=H, dt=DT), 0.4 * p.load**2),
        system=Cart(),
        model=model,
        synthesizer=synthesizer or controllers.LQR([10.0, 1.0], [1.0]),
        distance=distances.MaximumDeviation(components=(0,)),
        physical=physical,
    )


def test_names_are_those_of_task_parameters() -> None:
    with refuses(UnknownNameError, "lod", "load"):
        loaded_cart(("lod",))
    with refuses(InputError, "physical", "load"):
        loaded_cart("load")  # type: ignore[arg-type]
    assert loaded_cart(("load", "load")).physical == ("load",)


def test_without_physical_parameters_nothing_changes() -> None:
    validation = loaded_cart(())
    extended = ExtendedValidation(validation)
    assert extended.validation is validation
    trajectory = validation.execute(validation.plan(np.array([1.0, 0.5])))
    ((_, longer),) = extended.executions([(np.array([0.3, 0.5]), trajectory)], 1) or []
    assert longer is trajectory
    assert extended.recorded(trajectory) is trajectory


@pytest.mark.parametrize(
    "synthesizer", [controllers.LQR([10.0, 1.0], [1.0]), controllers.PID(4.0, 0.5, 2.0)], ids=["LQR", "PID"]
)
def test_controllers_model_and_distance_are_those_of_the_user(synthesizer: Any) -> None:
    """The loops of M and the distances of a trajectory are the same with the parameter as a state and without."""
    validation = loaded_cart(synthesizer=synthesizer)
    both, unit = ExtendedValidation(validation), np.array([[0.2, 0.9], [0.7, 0.1]])
    extended = both.validation
    points = validation.space.from_unit(unit)
    for row, point in zip(unit, points, strict=True):
        plan, beside = validation.plan(point), extended.plan(point)
        states = beside.model_trajectory.states
        np.testing.assert_allclose(states[:, :2], plan.model_trajectory.states, rtol=1e-12)
        np.testing.assert_array_equal(states[:, 2], point[1])
        trajectory = validation.execute(plan)
        ((_, longer),) = both.executions([(row, trajectory)], 1) or []
        np.testing.assert_array_equal(both.recorded(longer).states, trajectory.states)
        assert extended.measure(beside, longer) == pytest.approx(validation.measure(plan, trajectory), rel=1e-12)


def test_a_batch_is_planned_as_its_tasks_are() -> None:
    extended = ExtendedValidation(loaded_cart()).validation
    points = extended.space.from_unit(np.array([[0.2, 0.9], [0.7, 0.1], [1.0, 0.0]]))
    for plan, point in zip(extended.plans(points), points, strict=True):
        np.testing.assert_allclose(
            plan.model_trajectory.states, extended.plan(point).model_trajectory.states, rtol=1e-12, atol=1e-12
        )


def test_states_keep_their_names_and_a_parameter_of_the_same_name_gets_another() -> None:
    labels = ExtendedValidation(loaded_cart()).validation.labels
    assert labels.states == ("x0", "x1", "load [kg]")
    validation = loaded_cart()
    named = validation.with_parts(labels=type(validation.labels)(states=("load [N]", "speed [m/s]")))
    ExtendedValidation(named)


@pytest.mark.slow
@pytest.mark.usefixtures("few_loops")
def test_dynamics_that_depend_on_a_stated_parameter_are_validated_by_a_bound_that_is_true(tmp_path: Path) -> None:
    validation = loaded_cart()
    largest = float(validation.distances(validation.space.grid(21)).max())
    store = tmp_path / "cart.sqlite"
    campaign = Campaign(validation, store=store, seed=0).run(25, 1.25 * largest)
    verdict = campaign.verdict(1.25 * largest)
    assert verdict.answer == "validated"
    assert verdict.bound is not None
    assert verdict.bound >= largest * (1 - 1e-3)
    assert_names(str(verdict), "load")
    assert verdict.certificate is not None
    assert verdict.certificate.details["physical"] == ["load"]
    # A campaign that is opened again with another statement does not count predictions of the first one.
    without = Campaign(validation.with_parts(physical=()), store=store, seed=0)
    assert without.executions == campaign.executions
    assert without.recorder.dynamics.stored_prediction(campaign.trials[-1]) is None


@pytest.mark.slow
@pytest.mark.usefixtures("few_loops")
def test_a_statement_that_leaves_out_the_parameter_is_not_validated_below_the_largest_distance() -> None:
    validation = loaded_cart(("goal",))
    largest = float(validation.distances(validation.space.grid(21)).max())
    assert Campaign(validation, seed=0).run(14, 0.95 * largest).verdict(0.95 * largest).answer != "validated"


def test_executed_tasks_are_replayed_in_the_states_of_the_user() -> None:
    validation, executed = loaded_cart(), []
    for unit in (np.array([0.2, 0.9]), np.array([0.7, 0.1]), np.array([1.0, 0.5])):
        executed.append((unit, validation.execute(validation.plan(validation.space.from_unit(unit)))))
    for replay in replay_executed(validation, DynamicsStudy(validation).learn(executed), [executed[0][0]]):
        assert replay is not None
        assert isinstance(replay.task, Carried)
        assert replay.corrected is not None
        assert replay.corrected.states.shape == (H + 1, 2)


def random_executions(validation: Validation, count: int) -> list[tuple[Array, Any]]:
    points = np.random.default_rng(3).random((count, 2))
    return [(unit, validation.execute(validation.plan(validation.space.from_unit(unit)))) for unit in points]


@pytest.mark.usefixtures("few_loops")
def test_nothing_is_suspected_if_state_and_input_explain_the_executions() -> None:
    validation = loaded_cart().with_parts(
        system=systems.Simulated(lambda x, u: cart(x, u, np.array(0.3)), vectorized=True)
    )
    study = DynamicsStudy(validation.with_parts(physical=()))
    executed = random_executions(validation, 8)
    learned = study.learn(executed)
    assert learned is not None
    assert learned.study is study
    assert study.suspected_parameter(learned, executed) is None


@pytest.mark.thorough  # one of test_actuators finds a parameter and a delay together
def test_a_parameter_that_clearly_explains_the_executions_is_found() -> None:
    validation = loaded_cart(())
    executed = random_executions(validation, 8)
    learned = DynamicsStudy(validation).learn(executed)
    assert learned is not None
    assert learned.study.given.physical == ("load",)
    few = DynamicsStudy(validation).learn(executed[:5])
    assert few is not None
    assert few.study.given.physical == ()
    assert learned.left_out_error < 0.1
    stated = DynamicsStudy(loaded_cart()).learn(executed)
    assert stated is not None
    point = np.array([0.9, 0.9])
    assert learned.predict(point) == stated.predict(point)
    prediction = learned.predict(point)
    assert prediction is not None
    trajectory = validation.execute(validation.plan(validation.space.from_unit(point)))
    assert prediction.score(trajectory, 0.2) is not None  # it is one of the states of the system


@pytest.mark.usefixtures("few_loops")
@pytest.mark.parametrize("load", [0.0, 0.5])
def test_data_of_another_system_are_left_out(load: float) -> None:
    """M was learned without a load. If the system carries one, the data of M contradict its executions."""
    rng = np.random.default_rng(0)
    x, u = rng.uniform([-0.5, -0.5], [2.5, 1.5], (200, 2)), rng.uniform(-6, 6, (200, 1))
    model = models.Linear.fit(Transitions(x, u, cart(x, u, np.zeros(200)), DT))
    validation = loaded_cart(()).with_parts(model=model)
    validation = validation.with_parts(
        system=systems.Simulated(lambda x, u: cart(x, u, np.array(load)), vectorized=True)
    )
    learned = DynamicsStudy(validation).learn(random_executions(validation, 4))
    assert learned is not None
    assert learned.with_data == (load == 0)
    assert bool((learned.posterior.data.sources == -1).any()) == (load == 0)
    assert learned.left_out_error < 0.2


def test_values_of_a_parameter_that_changes_no_prediction_are_spread_over_its_range() -> None:
    validation, task = loaded_cart(()), np.array([0.7, 0.9])
    executed = [(point, validation.execute(validation.plan(point))) for point in np.array([[1.0, 0.2], [0.0, 0.8]])]
    learned = DynamicsStudy(validation).learn(executed)
    assert learned is not None
    assert learned.has_idle
    known = np.empty((0, 2))
    for _ in range(5):
        moved = learned.spread_unseen(task, known)
        assert moved[0] == task[0]
        known = np.vstack([known, moved])
    np.testing.assert_array_equal(np.sort(known[:, 1]), [0.0, 0.25, 0.5, 0.75, 1.0])
    # The dynamics that are learned with the load as a state depend on it, and so does the distance.
    validation = loaded_cart()
    executed = [(point, validation.execute(validation.plan(point))) for point, _ in executed]
    learned = DynamicsStudy(validation).learn(executed)
    assert learned is not None
    assert not learned.has_idle
    np.testing.assert_array_equal(learned.spread_unseen(task, known), task)
