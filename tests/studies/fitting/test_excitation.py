"""Signals that excite a system, and executions with them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conftest import make_validation
from ctxval import Task, Trajectory, controllers, systems
from ctxval.campaign import workers
from ctxval.errors import DesignError, ExecutionError, InputError, ShapeError, UnknownNameError
from ctxval.studies.fitting import Excitation, excitation
from facts import refuses

KINDS: list[Any] = ["random", "multisine", "chirp"]


@pytest.mark.parametrize("kind", KINDS)
@given(st.integers(1, 300), st.lists(st.floats(0.1, 10), min_size=1, max_size=3), st.integers(0, 10**6))
def test_a_signal_stays_within_its_amplitude(kind: Any, horizon: int, amplitude: list[float], seed: int) -> None:
    signal = excitation(kind, horizon, amplitude, np.random.default_rng(seed))
    assert signal.shape == (horizon, len(amplitude))
    assert (np.abs(signal) <= np.array(amplitude) * (1 + 1e-12)).all()
    np.testing.assert_array_equal(signal, excitation(kind, horizon, amplitude, np.random.default_rng(seed)))


@pytest.mark.parametrize("kind", KINDS)
def test_a_signal_excites_slow_motion_and_no_fast_one(kind: Any) -> None:
    signal = excitation(kind, 400, 1.0, np.random.default_rng(0))[:, 0]
    power = np.abs(np.fft.rfft(signal)) ** 2
    share = power[np.fft.rfftfreq(400) <= 0.12].sum() / power.sum()
    assert share > (0.6 if kind == "random" else 0.98)
    assert (power[1:30] > 1e-6 * power.max()).mean() > 0.25


def test_runs_excite_the_system_within_limits_and_depend_on_seed_and_number() -> None:
    validation = make_validation()
    made = Excitation(validation, "random", 2.0, 3.0, seed=4)
    first, second = made.run(0), made.run(1)
    assert not np.array_equal(first.states, second.states)
    np.testing.assert_array_equal(Excitation(validation, "random", 2.0, 3.0, seed=4).run(1).states, second.states)
    plan = made.plan(0)
    plain = validation.execute(plan)
    assert np.abs(first.inputs).max() <= 3.0 + 1e-12
    assert np.abs(first.inputs - plain.inputs).max() > 0.1


def test_a_controller_with_memory_is_excited_too() -> None:
    validation = make_validation()
    validation.synthesizer = controllers.PID(-5.0, -1.0, -0.5, limits=3.0)
    made = Excitation(validation, "random", 2.0, seed=4)
    first, plan = made.run(0), made.plan(0)
    np.testing.assert_array_equal(first.states, made.run(0).states)
    np.testing.assert_array_equal(made.limits.high, [3.0])
    # Its memory is that of the states that the excited system took.
    pi = controllers.started(plan.controller, plan.task)
    inputs = np.stack([pi(t, x) for t, x in enumerate(first.states[:-1])])
    signal = excitation("random", plan.task.horizon, np.array([2.0]), np.random.default_rng([4, 0, 1]))
    np.testing.assert_allclose(first.inputs, np.clip(inputs + signal, -3, 3), atol=1e-12)


class Failing(systems.Simulated):
    """A pendulum whose runs fail if their input at step 10 is positive. It knows the sizes of its calls."""

    def __init__(self, exact: bool) -> None:
        super().__init__(make_validation().system.model)
        self.exact_batches, self.calls = exact, list[int]()

    def execute(self, controller: Any, task: Task) -> Trajectory:
        self.calls.append(len(task.initial_state) if task.batch_shape else 1)
        done = super().execute(controller, task)
        done.states[done.inputs[..., 10, 0] > 0] = np.nan
        return done


def test_runs_are_executed_together_and_are_those_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "AHEAD", 1e9)  # on slow computers as on fast ones
    numbers = [0, 1, 2, 5, 6, 7, 8, 9]
    together, alone = Failing(True), Failing(False)
    results = [
        list(Excitation(make_validation(system), "random", 2.0, 3.0, seed=4).runs(numbers))
        for system in (together, alone)
    ]
    assert alone.calls == [1] * 8
    assert together.calls[:2] == [1, 7]
    assert [number for number, _ in results[0]] == numbers
    failed = 0
    for (_, run), (_, expected) in zip(*results, strict=True):
        if isinstance(expected, ExecutionError):
            assert str(run) == str(expected)
            failed += 1
        else:
            assert isinstance(run, Trajectory)
            np.testing.assert_array_equal(run.states, expected.states)
            np.testing.assert_array_equal(run.inputs, expected.inputs)
    assert 0 < failed < 7


def test_a_run_that_cannot_be_planned_ends_the_runs_after_those_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "AHEAD", 1e9)
    made = Excitation(make_validation(Failing(True)), "random", 2.0, 30.0, seed=4)
    synthesizer, designs = made.validation.synthesizer, list[int]()

    class Third:
        def design(self, task: Task, model: Any) -> Any:
            designs.append(1)
            if len(designs) == 3:
                raise DesignError("no gains.")
            return synthesizer.design(task, model)

    made.validation.synthesizer = Third()
    ended = list[int]()
    runs = (ended.append(number) for number, _ in made.runs(range(5)))
    with refuses(DesignError, "goal"):
        list(runs)
    assert ended == [0, 1]


@pytest.mark.parametrize(
    ("options", "error", "facts"),
    [
        ({"kind": "chrip"}, UnknownNameError, ("chirp", "kind")),
        ({"amplitude": -1.0}, InputError, ("amplitude", 0)),
        ({"amplitude": [0.0]}, InputError, ("amplitude", 0)),
        ({"amplitude": [1.0, 2.0]}, ShapeError, ("amplitude", 1)),
        ({"limits": None}, InputError, ("limits", "inputs")),
    ],
)
def test_what_cannot_be_used_is_refused(
    options: dict[str, Any], error: type[Exception], facts: tuple[object, ...]
) -> None:
    with refuses(error, *facts):
        Excitation(make_validation(), **({"kind": "random", "amplitude": 1.0, "limits": 5.0} | options))


def test_people_are_not_asked_to_run_signals() -> None:
    rig = systems.Manual(states={"angle": "rad", "rate": "rad/s"}, inputs={"torque": "N m"}, dt=0.02)
    with refuses(InputError, "system"):
        Excitation(make_validation(system=rig), "random", 1.0, 5.0)
