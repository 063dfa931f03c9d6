"""A watch over the certificate of a campaign."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from ctxval import Campaign, Task, TaskSpace, Trajectory, Validation, controllers, distances, models, searches, systems
from ctxval._util.arrays import Array
from ctxval.campaign.choices import Execution
from ctxval.campaign.watching import Watch
from ctxval.certificates import WatchState
from ctxval.core.controller import Controller
from ctxval.core.rollout import rollout
from ctxval.errors import CertificateError, ExecutionError, InputError
from facts import assert_names, refuses
from rig_thorough import more

THRESHOLD = 0.5


def step(x: Array, u: Array, mass: float = 1.0) -> Array:
    speed = x[..., 1]
    force = u[..., 0] - 0.4 * speed - 0.2 * speed * np.abs(speed)
    return np.asarray(x + 0.1 * np.stack([speed, force / mass], axis=-1))


def cart(mass: float = 1.0) -> Validation:
    return Validation(
        space=TaskSpace(goal=(-2.0, 2.0)),
        task=lambda p: Task(np.stack([0 * p.goal, 0 * p.goal], axis=-1), goal=[p.goal, 0.0], horizon=20, dt=0.1),
        system=systems.Simulated(lambda x, u: step(x, u, mass), vectorized=True),
        model=models.Linear([[1.0, 0.1], [0.0, 0.97]], [[0.0], [0.1]]),
        synthesizer=controllers.LQR([1.0, 0.1], [0.1]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


def execute(goal: float, mass: float = 1.0) -> Trajectory:
    validation = cart(mass)
    return validation.execute(validation.plan(validation.space.point({"goal": goal})))


@pytest.fixture(scope="module")
def campaign() -> Campaign:
    campaign = Campaign(cart(), search=searches.Random(), seed=0)
    for goal in (-1.9, -1.2, -0.5, 0.4, 1.1, 1.9):
        campaign.add({"goal": goal}, execute(goal))
    return campaign


@pytest.fixture(scope="module")
def begun(campaign: Campaign) -> Watch:
    return campaign.watch(THRESHOLD)


@pytest.fixture
def watch(begun: Watch) -> Watch:
    return copy.copy(begun)  # an update replaces its state


@pytest.mark.slow
def test_an_unchanged_system_holds_and_a_heavier_one_does_not(watch: Watch) -> None:
    for goal in np.linspace(-1.8, 1.8, 10):
        assert not watch.update(execute(goal), {"goal": goal}).expired
    assert watch.again() == []
    for goal in (1.5, -1.7, 1.2):
        state = watch.update(execute(goal, mass=1.1), {"goal": goal})
    assert state is watch.state
    assert state.expired
    assert state.since == 11
    assert state.sentence.startswith("expired: ")
    assert_names(state.sentence, "since", 11)
    assert repr(watch) == f"Watch({state.sentence})"
    again = watch.again(2)
    assert [abs(trial.parameters["goal"]) for trial in again] == [1.9, 1.9]


@pytest.mark.slow
def test_a_negligible_change_never_raises_an_alarm(watch: Watch) -> None:
    for k in range(40):
        goal = 1.9 * (-1) ** k
        state = watch.update(execute(goal, mass=1 + 2e-5), {"goal": goal})
    assert state.evidence < 1


@pytest.mark.slow
def test_it_goes_on_from_its_data(campaign: Campaign, watch: Watch) -> None:
    runs = [(execute(goal, 1.05), {"goal": goal}) for goal in (1.8, -1.5, 0.9)]
    for run, task in runs:
        watch.update(run, task)
    first = campaign.watch(THRESHOLD)
    first.update(*runs[0])
    text = json.dumps(first.state.to_json())
    again = campaign.watch(THRESHOLD, state=WatchState.from_json(json.loads(text)))
    for run, task in runs[1:]:
        again.update(run, task)
    assert json.dumps(again.state.to_json()) == json.dumps(watch.state.to_json())
    with refuses(InputError, "threshold", "rate"):
        campaign.watch(2 * THRESHOLD, state=first.state)


@pytest.mark.slow
def test_executions_and_recordings_without_tasks_are_judged(watch: Watch) -> None:
    validation, trajectory = cart(), execute(1.5, 1.3)
    plan = validation.plan(validation.space.point({"goal": 1.5}))
    execution = Execution(trajectory).measured(validation, plan)
    one = watch.update(execution, {"goal": 1.5}, name="with its distance")
    other = watch.update(trajectory, name="without")
    assert_names(other.runs, "without")
    *of_steps, of_distance = other.channels
    assert of_distance.later[1] is None
    assert of_distance.later[0] is not None
    assert one.channels[0].later[0] == other.channels[0].later[0]
    for channel in of_steps:
        assert [each and each.value for each in channel.later] == [channel.later[0] and channel.later[0].value] * 2


def test_what_cannot_be_judged_is_refused(watch: Watch) -> None:
    before = watch.state
    with refuses(InputError, "watch", "distance"):
        watch.update(Execution(distance=0.1))
    with refuses(InputError, "run", "None"):
        watch.update(None)  # type: ignore[arg-type]
    with refuses(InputError, 2, 1, 3):
        watch.update(Trajectory([0.0, 0.1], np.zeros((2, 3)), np.zeros((1, 1))))
    failed = replace(execute(1.0), ended="motor stalled")
    with refuses(ExecutionError, "motor stalled"):
        watch.update(failed, {"goal": 1.0})
    with refuses(InputError, "goal", 7):
        watch.update(execute(1.0), {"goal": 7.0})
    assert watch.state is before


def test_too_few_executions_and_a_certain_alarm_are_refused(campaign: Campaign) -> None:
    with refuses(CertificateError, 3, 0):
        Campaign(cart(), search=searches.Random()).watch(THRESHOLD)
    with refuses(InputError, "false_alarms", 1, 0.001):
        campaign.watch(THRESHOLD, false_alarms=2.0)


class Loaded:
    """A cart whose drag grows with the load, a task parameter, which the task hides in its name."""

    def __init__(self, mass: float) -> None:
        self.mass = mass

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        drag = np.array([0.0, 0.05 * float(task.name)])
        return rollout(lambda x, u: step(x, u, self.mass) - drag * x[..., 1:], controller, task)


def recording_outputs(mass: float = 1.0) -> Validation:
    """Return the cart of which the position alone is recorded."""
    plain = cart(mass)
    return Validation(
        space=plain.space,
        task=lambda p: Task(np.stack([0 * p.goal, 0 * p.goal], axis=-1), goal=p.goal[..., None], horizon=20, dt=0.1),
        system=systems.WithOutputs(plain.system, [0]),
        model=plain.model,
        synthesizer=controllers.Policy(lambda t, x, task: 1.6 * (task.reference[..., t, :1] - x[..., :1])),
        distance=distances.MaximumDeviation(components=(0,)),
        outputs=[0],
    )


def with_load(mass: float = 1.0) -> Validation:
    """Return the cart whose load changes its drag."""
    plain = cart()
    return Validation(
        space=TaskSpace(goal=(-2.0, 2.0), load=(0.0, 1.0)),
        task=lambda p: Task([0.0, 0.0], goal=[float(p.goal), 0.0], horizon=20, dt=0.1, name=str(float(p.load))),
        system=Loaded(mass),
        model=plain.model,
        synthesizer=plain.synthesizer,
        distance=plain.distance,
        physical=["load"],
    )


@pytest.mark.slow
@pytest.mark.parametrize("make", [recording_outputs, *more(with_load)])
def test_outputs_and_physical_parameters_are_watched(make: Callable[..., Validation]) -> None:
    def run(validation: Validation, goal: float, load: float) -> tuple[Trajectory, dict[str, float]]:
        task = {"goal": goal, "load": load} if "load" in validation.space.names else {"goal": goal}
        return validation.execute(validation.plan(validation.space.point(task))), task

    plain, heavier = make(), make(1.3)
    campaign = Campaign(plain, search=searches.Random(), seed=0)
    tasks = [(-1.9, 0.1), (-1.2, 0.9), (-0.5, 0.5), (0.4, 0.0), (0.8, 1.0), (1.1, 0.3), (1.9, 0.8), (-1.7, 0.6)]
    for goal, load in tasks:
        trajectory, task = run(plain, goal, load)
        campaign.add(task, trajectory)
    watch = campaign.watch(THRESHOLD)
    assert not [channel.name for channel in watch.state.channels if "load" in channel.name]  # a load has no residual
    for goal, load in [(1.0, 0.4), (-1.5, 0.7), (1.6, 0.2)]:
        assert not watch.update(*run(plain, goal, load)).expired
    with refuses(InputError, "recording", "--set"):
        watch.update(run(heavier, 1.0, 0.4)[0])
    for goal, load in [(1.6, 0.4), (-1.5, 0.7), (1.7, 0.2)]:
        state = watch.update(*run(heavier, goal, load))
    assert state.expired
    assert state.since == 4
