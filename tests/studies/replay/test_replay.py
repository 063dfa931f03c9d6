"""A replay finds what is wrong with a model, and nothing if nothing is."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from ctxval import Task, Trajectory, Transitions, controllers, grid_truth, models, rollout, systems
from ctxval.data import LogMapping, MemoryTable, Recordings, recordings_of
from ctxval.errors import InputError, ModelError
from ctxval.paper.cases import by_name
from ctxval.studies.replay import Suggestion, replay
from ctxval.studies.replay.accuracy import normalised, root_mean_square, step_errors
from ctxval.studies.replay.causes import suggestions
from ctxval.studies.replay.report import _informative
from facts import assert_names, refuses
from rig_logs import DT, run
from rig_thorough import more

A, B = [[1.0, DT], [0.0, 1.0 - 0.3 * DT]], [[0.0], [DT]]
TRUE = models.Linear(A, B)
WITHOUT_FRICTION = models.Linear([[1, DT], [0, 1]], B)


def recorded(runs: list[Trajectory], **options: Any) -> Recordings:
    logs = [
        MemoryTable(
            f"run {k}", {"t": one.times, "position": one.states[:, 0], "speed": one.states[:, 1], "u": one.inputs}
        )
        for k, one in enumerate(runs)
    ]
    states = {name: {"path": name, "unit": unit} for name, unit in (("position", "m"), ("speed", "m/s"))}
    return recordings_of(logs, LogMapping.from_table({"states": states, "inputs": {"u": "u"}, **options}))


RUNS = [run(120, seed) for seed in range(6)]
RECORDED = recorded(RUNS)


def timing(model: Any, recordings: Recordings) -> tuple[tuple[Suggestion, ...], float]:
    """Return what a replay suggests, and the largest one-step error relative to the change."""
    return suggestions(model, recordings), max(error.relative for error in step_errors(model, recordings, [1]))


def delayed(one: Trajectory, steps: int) -> Trajectory:
    """Return a run whose inputs are logged so many steps before they act."""
    return Trajectory(one.times[:-steps], one.states[:-steps], np.roll(one.inputs, -steps, axis=0)[:-steps])


def test_the_true_model_has_no_errors_and_gives_no_advice() -> None:
    report = replay(TRUE, RECORDED)
    assert max(one.relative for one in report.errors) < 1e-12
    assert (report.suggestions, report.insights, report.tasks) == ((), (), None)


def test_errors_of_several_steps_are_those_of_a_loop() -> None:
    report = replay(WITHOUT_FRICTION, RECORDED, steps=[1, 7])
    gaps = []
    for one in RUNS:
        for start in range(one.horizon - 7 + 1):
            x = one.states[start]
            for k in range(7):
                x = WITHOUT_FRICTION.step(x, one.inputs[start + k])
            gaps.append(x - one.states[start + 7])
    expected = np.sqrt(np.mean(np.square(gaps), axis=0))
    found = [one for one in report.errors if one.steps == 7]
    np.testing.assert_allclose([one.rms for one in found], expected, rtol=1e-9)
    assert [one.count for one in found] == [len(gaps)] * 2
    assert [(one.state, one.unit) for one in found] == [("position", "m"), ("speed", "m/s")]
    np.testing.assert_allclose([one.largest for one in found], np.abs(gaps).max(axis=0), rtol=1e-9)
    assert all(one.lowest < one.rms < one.highest for one in found)
    assert all(one.median < one.upper < one.largest for one in found)


def test_an_exact_nonlinear_model_gets_no_advice_on_the_timing_of_closed_loops() -> None:
    # Feedback makes late inputs a good guess of an affine model, and the exact model needs no guess.
    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        drag = 0.4 * x[..., 1] + 0.2 * x[..., 1] * np.abs(x[..., 1])
        return np.stack([x[..., 0] + 0.1 * x[..., 1], x[..., 1] + 0.1 * (u[..., 0] - drag)], axis=-1)

    linear = models.Linear([[1, 0.1], [0, 1]], [[0], [0.1]])
    tasks = [Task([0.0, 0.0], goal=[goal, 0.0], horizon=20, dt=0.1) for goal in (0.5, 1.0, 1.5, 2.0)]
    runs = [rollout(step, controllers.LQR([10, 1], [1]).design(task, linear), task) for task in tasks]
    assert timing(models.Function(step), recorded(runs))[0] == ()
    assert timing(models.Function(step, vectorized=True), recorded(runs))[0] == ()


def test_friction_that_the_model_lacks_is_an_affine_function_of_the_state() -> None:
    report = replay(WITHOUT_FRICTION, RECORDED)
    speed = report.residuals[1]
    assert speed.explained > 0.999
    assert speed.linear > 0.999
    assert_names(report.insights, "speed")
    assert report.suggestions == ()
    fast = [one for one in report.regions if one.variable == "speed"]
    assert len(fast) == 5
    assert sum(one.count for one in fast) == RECORDED.steps
    assert max(one.ratio for one in fast) > 1.4
    shares = np.array([one.count for one in fast]) / RECORDED.steps
    assert shares @ np.square([one.ratio for one in fast]) == pytest.approx(1.0, rel=1e-9)
    assert repr(report).startswith("ReplayReport(data=RecordedData(sources=('run 0', 'run 1',")


def test_a_nonlinear_residual_is_explained_by_a_function_that_is_not_affine() -> None:
    def bent(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return TRUE.step(x, u) + np.stack([0 * x[..., 0], 0.05 * np.sin(3 * x[..., 1])], axis=-1)

    report = replay(models.Function(bent, vectorized=True), RECORDED)
    speed = report.residuals[1]
    assert speed.explained > 0.95
    assert speed.linear < 0.8
    assert_names(report.insights, "speed")


def test_noise_cannot_be_explained() -> None:
    rng = np.random.default_rng(0)
    noisy = [Trajectory(one.times, one.states + 0.05 * rng.normal(size=one.states.shape), one.inputs) for one in RUNS]
    # White noise of the state is one of the residual with a correlation, so process noise is simulated instead.
    pushed = []
    for one in noisy:
        states = np.zeros_like(one.states)
        for k in range(one.horizon):
            states[k + 1] = TRUE.step(states[k], one.inputs[k]) + 0.02 * rng.normal(size=2)
        pushed.append(Trajectory(one.times, states, one.inputs))
    report = replay(TRUE, recorded(pushed))
    for one in report.residuals:
        assert one.explained < 0.05
        assert one.history < 0.05
        assert one.rest == pytest.approx(0.02, rel=0.1)


def test_a_state_that_is_not_recorded_is_found_in_the_step_before() -> None:
    position = [
        MemoryTable(f"run {k}", {"t": one.times, "x": one.states[:, 0], "u": one.inputs}) for k, one in enumerate(RUNS)
    ]
    found = recordings_of(position, LogMapping.from_table({"states": {"x": "x"}, "inputs": {"u": "u"}}))
    report = replay(models.Linear([[1.0]], [[0.0]]), found)
    assert report.residuals[0].history > 0.9


@pytest.mark.parametrize("steps", [1, 3, 6])
def test_a_delay_of_the_inputs_is_suggested(steps: int) -> None:
    (found,) = timing(TRUE, recorded([delayed(one, steps) for one in RUNS]))[0]
    assert found.kind == "delay"
    assert found.value == pytest.approx(steps * DT)
    assert found.ratio < 1e-6
    assert_names(found.sentence, "delay", f"{steps * DT:g}")
    corrected, error = timing(TRUE, recorded([delayed(one, steps) for one in RUNS], delay=steps * DT))
    assert corrected == ()
    assert error < 1e-12


@pytest.mark.parametrize("steps", [0.4, 1.5, 2.3])
def test_a_delay_of_a_part_of_a_step_is_found(steps: float) -> None:
    rng, dt, logs = np.random.default_rng(0), 0.02, []
    for number in range(4):
        u, speed = rng.normal(size=301), np.zeros(301)
        for k in range(300):
            j = k - int(steps)
            part = steps - int(steps)
            acting = part * u[max(j - 1, 0)] + (1 - part) * u[max(j, 0)]  # the mean over the step
            speed[k + 1] = 0.99 * speed[k] + dt * acting
        logs.append(MemoryTable(f"run {number}", {"t": dt * np.arange(301), "speed": speed, "u": u}))
    mapping = {"states": {"speed": "speed"}, "inputs": {"u": "u"}}
    model = models.Linear([[0.99]], [[dt]])
    (found,) = timing(model, recordings_of(logs, LogMapping.from_table(mapping)))[0]
    assert (found.kind, found.value) == ("delay", pytest.approx(steps * dt, abs=0.1 * dt))
    assert f"({found.value / dt:.2g} steps) after" in found.sentence
    corrected, error = timing(model, recordings_of(logs, LogMapping.from_table({**mapping, "delay": found.value})))
    assert corrected == ()
    assert error < 1e-9


def test_a_model_of_another_time_step_is_refused() -> None:
    model = models.Linear.fit(RECORDED.transitions()[0])
    assert model.data is not None
    assert model.data.dt == DT
    with refuses(InputError, 0.05, 0.1):
        replay(model, recorded(RUNS, dt=2 * DT))


def test_a_model_that_was_learned_with_a_delay_is_found_by_the_recordings_themselves() -> None:
    runs = [delayed(one, 4) for one in RUNS]
    wrong = models.Linear.fit(Transitions.joined([one.transitions() for one in runs]))
    (found,) = timing(models.Linear(wrong.A, wrong.B), recorded(runs))[0]
    assert (found.kind, round(found.value / DT)) == ("delay", 4)
    assert found.ratio < 0.5


@pytest.mark.parametrize(("model_dt", "factor"), [(2 * DT, 2.0), (DT / 2, 0.5), *more((5 * DT, 5.0), (DT / 10, 0.1))])
def test_another_time_step_of_the_model_is_suggested(model_dt: float, factor: float) -> None:
    model = models.Linear([[1, model_dt], [0, 1 - 0.3 * model_dt]], [[0], [model_dt]])
    rng = np.random.default_rng(1)
    held = []
    for seed in range(6):  # inputs that change slowly, so that a long step of the model can be right
        inputs = np.repeat(rng.normal(size=(12, 1)), 10, axis=0)
        states = [np.array([0.0, rng.normal()])]
        for u in inputs:
            states.append(TRUE.step(states[-1], u))
        held.append(Trajectory(DT * np.arange(len(states)), np.array(states), inputs))
        assert seed < 6
    (found,) = replay(model, recorded(held), steps=[1]).suggestions
    assert (found.kind, found.value) == ("time step", pytest.approx(factor * DT))
    assert_names(found.sentence, "step", "model")


def test_nothing_is_suggested_by_chance() -> None:
    rng = np.random.default_rng(3)
    for trial in range(4):
        runs = []
        for seed in range(6):
            one = run(60, 100 * trial + seed)
            noisy = one.states + 0.2 * rng.normal(size=one.states.shape)
            runs.append(Trajectory(one.times, noisy, one.inputs))
        assert timing(WITHOUT_FRICTION, recorded(runs))[0] == ()


def test_recordings_from_which_the_model_was_learned_are_left_out() -> None:
    learned = models.Linear.fit(Transitions.joined([one.transitions() for one in RUNS[:4]]))
    report = replay(learned, RECORDED)
    assert report.data.seen == 4
    assert report.errors[0].count == 2 * 120
    assert_names(report.insights[0], "learned", 4, "errors")
    all_seen = replay(models.Linear.fit(Transitions.joined([one.transitions() for one in RUNS])), RECORDED)
    assert all_seen.errors[0].count == 6 * 120
    assert_names(all_seen.insights[0], "learned")


def test_a_single_recording_is_judged_in_five_parts() -> None:
    report = replay(WITHOUT_FRICTION, recorded(RUNS[:1]))
    assert report.errors[1].lowest < report.errors[1].highest
    assert report.residuals[1].explained > 0.99


def test_a_model_that_diverges_is_said_to_diverge() -> None:
    def unstable(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.where(np.abs(x) > 3, np.inf, 1.2 * x + 0 * u)

    report = replay(models.Function(unstable, vectorized=True), RECORDED, steps=[1, 20])
    assert report.errors[-1].diverged > 0.1
    assert_names(report.insights, 20, "steps")
    json.dumps(report.to_json(), allow_nan=False)


def test_a_short_recording_has_only_short_predictions() -> None:
    report = replay(WITHOUT_FRICTION, recorded([run(4, seed) for seed in range(2)]))
    assert {one.steps for one in report.errors} == {1}
    assert report.residuals == ()
    assert report.suggestions == ()


def test_splits_of_the_logs_are_stated() -> None:
    columns = {"t": RUNS[0].times.copy(), "x": RUNS[0].states.copy(), "u": RUNS[0].inputs}
    columns["x"][50] = np.nan
    found = recordings_of([MemoryTable("run", columns)])
    report = replay(WITHOUT_FRICTION, found)
    assert_names(report.insights[0], 1, 0.1, "run", 2.45)
    assert report.data.recordings == 2


@pytest.mark.parametrize("steps", [[], [0], [1, -1], [True], [1.5]])
def test_numbers_of_steps_must_be_positive_integers(steps: list[Any]) -> None:
    with refuses(InputError, "steps"):
        replay(TRUE, RECORDED, steps=steps)


def test_a_model_of_other_dimensions_is_refused_with_those_of_the_recordings() -> None:
    with refuses(ModelError, 2, 1):
        replay(models.Linear(np.eye(3), np.zeros((3, 1))), RECORDED)
    with refuses(ModelError, 2, 1):
        replay(models.Function(lambda x, u: x[..., 0], vectorized=True), RECORDED)


def test_states_that_never_move_do_not_count() -> None:
    changes = np.stack([np.arange(4.0), np.zeros(4)], axis=-1)
    np.testing.assert_allclose(normalised(np.ones((4, 2)), changes), 1 / np.std(np.arange(4.0)))


# Tasks


def pendulum_runs(count: int) -> tuple[Any, Recordings]:
    experiment = by_name("pendulum", 0)
    rng = np.random.default_rng(0)
    runs = [experiment.validation.execute(experiment.validation.plan([goal])) for goal in rng.uniform(-3, 3, count)]
    logs = [MemoryTable(f"run {k}", {"t": one.times, "x": one.states, "u": one.inputs}) for k, one in enumerate(runs)]
    return experiment, recordings_of(logs)


@pytest.mark.slow
def test_recordings_predict_the_worst_task_of_the_pendulum_before_any_execution() -> None:
    experiment, recordings = pendulum_runs(6)
    report = replay(experiment.validation.model, recordings, validation=experiment.validation, executions=3)
    tasks = report.tasks
    assert tasks is not None
    truth = grid_truth(experiment.validation, per_axis=401, refinements=4)
    assert tasks.worst[0].median == pytest.approx(truth.distance, rel=0.01)
    assert tasks.worst[0].parameters["goal"] == pytest.approx(float(truth.parameters["goal"]), abs=0.05)
    assert tasks.upper >= 0.99 * truth.distance
    assert len(tasks.executions) == 3
    goals = [one.parameters["goal"] for one in tasks.executions]
    assert np.diff(np.sort(goals)).min() > 0.02 * 2 * np.pi * 0.9
    assert [one.resolved for one in tasks.executions] == sorted(one.resolved or 0 for one in tasks.executions)
    assert json.loads(json.dumps(report.to_json(), allow_nan=False))["tasks"]["worst"][0]["median"] > 0


@pytest.mark.slow
@pytest.mark.thorough
def test_recordings_of_a_small_region_are_said_to_be_left() -> None:
    experiment = by_name("pendulum", 0)
    runs = [experiment.validation.execute(experiment.validation.plan([goal])) for goal in (2.9, 3.0, 3.1)]
    logs = [MemoryTable(f"run {k}", {"t": one.times, "x": one.states, "u": one.inputs}) for k, one in enumerate(runs)]
    report = replay(experiment.validation.model, recordings_of(logs), validation=experiment.validation, executions=1)
    assert any("range" in text for text in report.insights)


def test_recordings_that_the_model_explains_predict_nothing_of_the_tasks() -> None:
    pendulum = by_name("pendulum", 0).validation
    model = models.Linear(pendulum.model.A, pendulum.model.B, pendulum.model.c)  # type: ignore[attr-defined]
    validation = pendulum.with_parts(model=model)  # without the data that it was learned from
    plan = validation.plan([1.0])
    one = systems.Simulated(model).execute(plan.controller, plan.task)
    log = MemoryTable("run", {"t": one.times, "x": one.states, "u": one.inputs})
    report = replay(model, recordings_of([log]), validation=validation)
    assert report.tasks is None
    assert_names(report.insights[-1], "tasks", "model")


def test_tasks_of_another_time_step_are_refused() -> None:
    with refuses(InputError, 0.02, 0.05):
        replay(TRUE, RECORDED, validation=by_name("pendulum", 0).validation)
    with refuses(InputError, 6, 2):
        replay(TRUE, RECORDED, validation=by_name("arm", 0, model="linear").validation)


def test_the_most_informative_task_is_the_one_that_tells_of_the_worst() -> None:
    rng = np.random.default_rng(0)
    common, own = rng.normal(size=(2, 400, 1))
    # Tasks 0 and 1 are likely worst and vary together; task 2 varies most but is never worst.
    drawn = np.concatenate([5 + common, 5 + 0.9 * common + 0.05 * own, 3 * rng.normal(size=(400, 1)) - 20], axis=1)
    chosen, shares = _informative(drawn, 3)
    assert chosen[0] in (0, 1)
    assert shares[0] > 0.8
    assert sorted(chosen.tolist()) == [0, 1, 2]
    assert (np.diff(shares) >= -1e-12).all()


def test_errors_whose_squares_are_not_finite_are_left_out() -> None:
    values = np.array([[3.0, 4.0], [1.0, -1e200], [np.inf, 1.0], [np.nan, 1.0], [3.0, 4.0]])
    np.testing.assert_array_equal(root_mean_square(values), [3, 4])
    assert np.isnan(root_mean_square(values[1:3])).all()
