"""Controllers with memory: the loop holds it, and the controller never changes."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import Task, TaskSpace, Validation, controllers, distances, systems
from ctxval._util.arrays import Array
from ctxval.controllers import PID, ControllerRun, ControllerWithMemory, started
from ctxval.core.controller import is_controller
from ctxval.core.plan import gives_inputs
from ctxval.core.rollout import rollout
from ctxval.errors import InputError, ShapeError
from ctxval.models import Linear
from ctxval.systems.episode import run_episode
from facts import refuses

CART = Linear([[1.0, 0.1], [0.0, 0.95]], [[0.0], [0.1]])
TASK = Task([0.0, 0.0], goal=[1.0, 0.0], horizon=20, dt=0.1)


class Recorder:
    """Pushes with the step of its last call; its memory is a dict, which every step changes in place."""

    def __init__(self) -> None:
        self.first = np.zeros(1)

    def start(self, task: Task) -> dict[str, Any]:
        return {"steps": self.first, "seen": [0.0]}

    def step(self, t: int, x: Array, memory: dict[str, Any]) -> tuple[Array, dict[str, Any]]:
        u = memory["steps"] + 0 * x[..., :1]
        memory["steps"] += 1
        memory["seen"].append(t)
        return u, memory


class Half:
    def step(self, t: int, x: Array, memory: Any) -> tuple[Array, Any]:
        return x[..., :1], memory


class Returns(Half):
    """A controller whose step returns what it is made with."""

    def __init__(self, returned: Any) -> None:
        self.returned = returned

    def start(self, task: Task) -> None:
        return None

    def step(self, t: int, x: Array, memory: Any) -> Any:
        return self.returned


def test_the_input_depends_on_earlier_steps_and_every_run_begins_anew() -> None:
    controller = Recorder()
    for _ in range(2):
        loop = rollout(CART.step, controller, TASK)
        assert loop.inputs[:, 0].tolist() == list(range(20))
    assert controller.first.tolist() == [0.0]  # even though its steps change the memory in place


def test_functions_and_objects_with_memory_are_controllers() -> None:
    assert isinstance(Recorder(), ControllerWithMemory)
    assert is_controller(Recorder())
    assert is_controller(lambda t, x: x)
    assert not is_controller(Half())
    pi = controllers.LQR([1, 1], [1]).design(TASK, CART)
    assert started(pi, TASK) is pi
    with refuses(InputError, "controller", "Half"):
        rollout(CART.step, Half(), TASK)  # type: ignore[arg-type]


@pytest.mark.parametrize("returned", [np.zeros(2), [np.zeros(1), None], (np.zeros(1),), None])
def test_a_step_must_return_the_pair_of_inputs_and_memory(returned: Any) -> None:
    with refuses(InputError, "controller"):
        rollout(CART.step, Returns(returned), TASK)


def test_inputs_of_a_wrong_shape_are_refused_as_without_memory() -> None:
    with refuses(ShapeError, "controller", ()):
        rollout(CART.step, Returns((1.0, None)), TASK)


def test_a_run_goes_through_the_steps_in_order_and_only_once() -> None:
    pi = started(PID(1.0, 1.0).design(TASK, CART), TASK)
    assert isinstance(pi, ControllerRun)
    pi(0, np.zeros(2))
    for t in (0, 2):
        with refuses(InputError, 1, "memory", t):
            pi(t, np.zeros(2))
    assert pi(1, np.zeros(2)) == pytest.approx([1.2])


def test_a_loop_on_an_episode_is_that_of_a_rollout() -> None:
    controller, x = PID(3.0, 2.0, 1.0, limits=2.0).design(TASK, CART), TASK.initial_state

    def advance(u: Array) -> tuple[Array, str]:
        nonlocal x
        x = CART.step(x, u)
        return x, ""

    episode = run_episode(advance, controller, TASK, 1)
    np.testing.assert_array_equal(episode.states, rollout(CART.step, controller, TASK).states)


def validation(**parts: Any) -> Validation:
    chosen: dict[str, Any] = {
        "system": systems.Simulated(lambda x, u: CART.step(x, u) - 0.02 * np.sign(x), vectorized=True),
        "synthesizer": PID(3.0, 2.0, 2.0, limits=4.0),
        **parts,
    }
    return Validation(
        space=TaskSpace(goal=(0.5, 2.0, "m")),
        task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=30, dt=0.1),
        model=CART,
        distance=distances.FinalState(),
        **chosen,
    )


def test_tasks_are_validated_alike_singly_and_together_and_from_python_functions() -> None:
    points = np.linspace(0.5, 2.0, 5)[:, None]
    together = validation().distances(points)
    alone = [validation().outcome(point).distance for point in points]
    np.testing.assert_allclose(together, alone, rtol=1e-9)
    plans = validation().plans(points)
    assert [plan.controller.reference.shape for plan in plans] == [(31, 1)] * 5  # designed together
    one_by_one = systems.Function(driven)
    np.testing.assert_allclose(validation(system=one_by_one).distances(points), alone, rtol=1e-9)


def driven(pi: Any, task: Task) -> tuple[list[Array], list[Array]]:
    """Run the loop that a user would write."""
    states, inputs = [task.initial_state], []
    for t in range(task.horizon):
        inputs.append(pi(t, states[-1]))
        states.append(CART.step(states[-1], inputs[-1]) - 0.02 * np.sign(states[-1]))
    return states, inputs


def test_an_execution_agrees_with_a_controller_whose_memory_gave_its_inputs() -> None:
    made = validation()
    outcome = made.outcome([1.0])
    assert gives_inputs(made.plan([1.0]), outcome.system_trajectory, 1e-9)
    other = validation(synthesizer=PID(3.0, 1.0, 2.0, limits=4.0)).plan([1.0])
    assert not gives_inputs(other, outcome.system_trajectory, 1e-9)
    assert not gives_inputs(replace(other, controller=Returns(None)), outcome.system_trajectory, 1e-9)


def test_it_can_be_pickled_and_is_no_file(tmp_path: Path) -> None:
    controller = PID(3.0, 2.0).design(TASK, CART)
    sent = pickle.loads(pickle.dumps(controller))
    np.testing.assert_array_equal(rollout(CART.step, sent, TASK).states, rollout(CART.step, controller, TASK).states)
    with refuses(InputError, "PIDFeedback", "derivative_filter"):
        controllers.write_controller(tmp_path / "pid.json", controller, dt=0.1)
