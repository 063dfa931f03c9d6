"""Independent tasks that are executed in one call of a system whose batches are exact."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, Task, TaskSpace, Validation, controllers, distances, models, searches, systems
from ctxval._util.arrays import Array
from ctxval.campaign import execution, workers
from ctxval.core.controller import Controller
from ctxval.core.rollout import rollout
from ctxval.core.trajectory import Trajectory

CART = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body><joint name="slide" type="slide" axis="1 0 0" damping="0.3"/><geom size="0.1" mass="1"/></body>
  </worldbody>
  <actuator><motor joint="slide"/></actuator>
</mujoco>
"""


class Together:
    """The pendulum with exact batches: its rows are simulated one after the other. It knows the sizes of its calls.

    In the second call, this process is interrupted so many times.
    """

    batched = exact_batches = True

    def __init__(self, interrupts: int = 0) -> None:
        self.alone = make_validation().system
        self.interrupts = interrupts
        self.sizes = list[int]()

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        self.sizes.append(task.batch_shape[0] if task.batch_shape else 1)
        for _ in range(self.interrupts if len(self.sizes) == 2 else 0):
            signal.raise_signal(signal.SIGINT)
        return rollout(self.step, controller, task)

    def step(self, x: Array, u: Array) -> Array:
        if x.ndim == 1:
            return self.alone.model.step(x, u)
        return np.stack([self.alone.model.step(*row) for row in zip(x, u, strict=True)])


class Alone(Together):
    exact_batches = False


@pytest.fixture(autouse=True)
def any_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let as many tasks wait on slow computers as on fast ones."""
    for module in (workers, execution):
        monkeypatch.setattr(module, "AHEAD", 1e9)


def campaign(system: Any, store: Path | None = None, **parts: Any) -> Campaign:
    validation = make_validation(system, **parts)
    return Campaign(validation, search=searches.Random(), store=store, seed=5)


def facts(done: Campaign) -> list[tuple[object, ...]]:
    of_loops = ([part.states.tolist() for part in done.trajectories(trial) if part] for trial in done.trials)
    return [
        (trial.number, trial.state, trial.unit_point.tolist(), trial.distance, trial.failure, trial.note, states)
        for trial, states in zip(done.trials, of_loops, strict=True)
    ]


def test_random_tasks_are_executed_in_one_call_as_if_alone() -> None:
    system = Together()
    done = campaign(system).run(20)
    assert system.sizes == [1, 19]
    assert all(trial.seconds is not None for trial in done.trials)
    assert facts(done) == facts(campaign(Alone()).run(20))


def test_no_call_has_more_than_so_many_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_BATCH", 8)
    system = Together()
    campaign(system).run(20)
    assert system.sizes == [1, 8, 8, 3]


def test_draws_of_an_audit_are_executed_in_one_call_as_if_alone() -> None:
    system = Together()
    done = campaign(system).audit(20)
    assert system.sizes == [1, 19]
    assert facts(done) == facts(campaign(Alone()).audit(20))


@pytest.mark.parametrize("synthesizer", [controllers.LQR([1.0, 0.1], [0.1]), controllers.PID(2.0, 0.1, 1.0)])
def test_a_mujoco_model_gives_in_batches_what_it_gives_alone(synthesizer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    validation = Validation(
        space=TaskSpace(goal=(-1.0, 1.0, "m"), start=(-1.0, 1.0, "m")),
        task=lambda p: Task(
            np.stack([p.start, 0 * p.start], -1), goal=np.stack([p.goal, 0 * p.goal], -1), horizon=30, dt=0.02
        ),
        system=systems.MuJoCo(CART, substeps=2),
        model=models.Linear([[1.0, 0.02], [0.0, 1.0]], [[0.0], [0.02]]),
        synthesizer=synthesizer,
        distance=distances.MaximumDeviation(),
    )
    together = Campaign(validation, search=searches.Random(), seed=1).run(12)
    monkeypatch.setattr(workers, "_BATCH", 1)
    alone = Campaign(validation, search=searches.Random(), seed=1).run(12)
    assert facts(together) == facts(alone)
    assert len({trial.distance for trial in alone.trials}) == 12


@pytest.mark.parametrize(
    ("search", "options"),
    [
        (searches.GPUCB(), {}),
        (searches.Random(), {"until": lambda done: False}),
        (searches.Random(), {"threshold": 100.0, "explore": False}),
    ],
)
def test_tasks_that_results_may_change_are_executed_alone(search: searches.Search, options: dict[str, Any]) -> None:
    system = Together()
    Campaign(make_validation(system), search=search, seed=5).run(6, **options)
    assert set(system.sizes) == {1}


def test_tasks_of_a_system_whose_batches_are_not_exact_are_executed_alone() -> None:
    system = Alone()
    campaign(system).run(6)
    assert system.sizes == [1] * 6


def test_tasks_with_horizons_of_their_own_are_executed_alone() -> None:
    system = Together()
    validation = make_validation(system)
    of_task = validation.task
    validation.task = lambda p: Task(
        of_task(p).initial_state, goal=of_task(p).goal, horizon=20 + int(p.goal > 0), dt=0.02
    )
    done = Campaign(validation, search=searches.Random(), seed=5).run(6)
    assert system.sizes == [1] * 6
    assert {trial.state for trial in done.trials} == {"completed"}


class Diverging(Together):
    """Angles below 1.7 rad are not finite any more."""

    def step(self, x: Array, u: Array) -> Array:
        following = super().step(x, u)
        return np.where(following[..., :1] < 1.7, np.nan, following)


class DivergingAlone(Diverging):
    exact_batches = False


def test_a_task_that_fails_in_a_batch_has_the_reason_that_it_has_alone() -> None:
    system = Diverging()
    done = campaign(system).run(20)
    assert 2 < len(done.failed) < 15
    failed_later = sum(trial.number > 0 for trial in done.failed)
    assert system.sizes == [1, 19] + [1] * failed_later
    assert facts(done) == facts(campaign(DivergingAlone()).run(20))
    assert len({trial.failure for trial in done.failed}) > 1  # each ended at a step of its own


def test_tasks_of_a_batch_that_raises_are_executed_alone() -> None:
    class TooMany(Together):
        def step(self, x: Array, u: Array) -> Array:
            if x.ndim == 2:
                raise RuntimeError("too many")
            return super().step(x, u)

    system = TooMany()
    done = campaign(system).run(5)
    assert system.sizes == [1, 4, 1, 1, 1, 1]
    assert facts(done) == facts(campaign(Alone()).run(5))


def test_a_first_interrupt_ends_the_campaign_after_the_batch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_BATCH", 16)
    path = tmp_path / "a.sqlite"

    with pytest.raises(KeyboardInterrupt):
        campaign(Together(1), path).run(20)
    stored = campaign(Together(), path)
    assert [trial.state for trial in stored.trials] == ["completed"] * 17
    assert facts(stored.run(20)) == facts(campaign(Alone()).run(20))


def test_a_batch_that_is_interrupted_at_once_is_executed_again_as_the_same_trials(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"

    with pytest.raises(KeyboardInterrupt):
        campaign(Together(2), path).run(10)
    before = campaign(Together(), path)
    assert [(trial.state, trial.attempts) for trial in before.trials] == [("completed", 1)] + [("open", 1)] * 9
    assert facts(before.run(10)) == facts(campaign(Alone()).run(10))
    assert [trial.attempts for trial in before.trials] == [1] + [2] * 9


class Mutable:
    """A synthesizer that is its own controller."""

    def __init__(self) -> None:
        self.goal = 0.0

    def design(self, task: Task, model: models.Model) -> Mutable:
        self.goal = float(task.goal[0])
        return self

    def __call__(self, t: int, x: Array) -> Array:
        return np.asarray(3.0 * (self.goal - x[..., :1]) - x[..., 1:])


def test_a_synthesizer_that_returns_itself_designs_a_controller_for_each_task_of_a_batch() -> None:
    def own_controller(system: Any) -> Campaign:
        validation = make_validation(system)
        validation.synthesizer = Mutable()
        return Campaign(validation, search=searches.Random(), seed=5).run(8)

    together = own_controller(Together())
    assert facts(together) == facts(own_controller(Alone()))
