"""Recorded executions in the place of a system."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from ctxval import (
    Campaign,
    Experiment,
    Task,
    TaskSuite,
    Trajectory,
    Validation,
    controllers,
    distances,
    load_experiment,
    models,
    searches,
    systems,
)
from ctxval.certificates.automatic import WholeSuite
from ctxval.certificates.options import CertificateOptions
from ctxval.certificates.sample import Sample
from ctxval.cli.config.check import check_experiment
from ctxval.core.trajectory import COMPLETE
from ctxval.data import LogMapping
from ctxval.data.recorded_system import RecordedInputsWarning
from ctxval.errors import ExecutionError, InputError
from facts import assert_names, refuses, warns

TIMES = 0.1 * np.arange(6)
RUN = Trajectory(TIMES, np.stack([TIMES, 2 * TIMES], axis=-1), np.ones((5, 1)))
MAPPING = {"states": {"x": "x", "v": "v"}, "inputs": {"u": "u"}}


def task(name: str, horizon: int = 5) -> Task:
    return Task([0.0, 0.0], horizon=horizon, dt=0.1, name=name)


def constant(t: int, x: np.ndarray) -> np.ndarray:
    return np.ones(1)


def law(t: int, x: np.ndarray) -> np.ndarray:
    return np.array([10.0 * t + x[0]])


def folder_with(path: Path, *names: str) -> Path:
    rows = [{"t": t, "x": t, "v": 2 * t, "u": 1.0} for t in TIMES]
    for name in names:
        (path / f"{name}.json").write_text(json.dumps(rows))
    return path


def test_the_recording_of_a_task_is_its_execution(tmp_path: Path) -> None:
    for system in (systems.Recorded({"lift": RUN}), systems.Recorded(folder_with(tmp_path, "lift"), MAPPING)):
        executed = system.execute(constant, task("lift"))
        assert np.allclose(executed.states, RUN.states)
        assert np.allclose(executed.inputs, 1.0)
        assert len(system.execute(constant, task("lift", 3)).inputs) == 3
        assert system.names == ("lift",)
        assert "tasks=1" in repr(system)


def test_inputs_of_another_controller_are_remarked() -> None:
    with warns(RecordedInputsWarning, "u0", 1, 0.4, 40.4):
        executed = systems.Recorded({"lift": RUN}).execute(law, task("lift"))
    assert np.allclose(executed.inputs, 1.0)


def test_inputs_of_old_states_are_remarked() -> None:
    states = np.random.default_rng(0).normal(size=(31, 2))
    inputs = np.sin(states[np.maximum(np.arange(30) - 2, 0), :1])
    system = systems.Recorded({"lift": Trajectory(0.1 * np.arange(31), states, inputs)})
    with warns(RecordedInputsWarning, 2):
        system.execute(lambda t, x: np.sin(x[:1]), task("lift", 30))


def test_inputs_that_are_not_recorded_are_those_of_the_controller(tmp_path: Path) -> None:
    system = systems.Recorded(folder_with(tmp_path, "lift"), LogMapping({"x": "x", "v": "v"}))  # type: ignore[dict-item]
    executed = system.execute(law, task("lift"))
    assert np.allclose(executed.inputs[:, 0], 10.0 * np.arange(5) + TIMES[:-1])


def test_other_tasks_and_short_recordings_are_refused(tmp_path: Path) -> None:
    system = systems.Recorded({"lift": RUN})
    with refuses(ExecutionError, "turn", "lift"):
        system.execute(law, task("turn"))
    with refuses(ExecutionError, 5, 6):
        system.execute(law, task("lift", 6))
    with refuses(InputError):
        systems.Recorded({})
    with refuses(InputError, "files", 2):
        systems.Recorded(tmp_path)


def test_a_log_with_a_gap_is_no_execution(tmp_path: Path) -> None:
    rows = [{"t": t, "x": t if 0.2 < t < 0.3 else None, "v": t, "u": 0.0} for t in np.arange(0, 1, 0.1)]
    rows += [{"t": 1 + t, "x": t, "v": t, "u": 0.0} for t in np.arange(0, 1, 0.1)]
    rows[4]["x"] = rows[5]["x"] = rows[6]["x"] = 1.0
    (tmp_path / "lift.json").write_text(json.dumps(rows))
    with refuses(InputError, "lift.json", 2):
        systems.Recorded(tmp_path, MAPPING)


def test_a_recording_that_a_safety_limit_ended_is_an_outcome() -> None:
    stopped = systems.Recorded({"lift": RUN}, stopped_by="a safety limit").execute(constant, task("lift", 8))
    assert stopped.is_outcome
    assert stopped.horizon == 5
    whole = systems.Recorded({"lift": RUN}, stopped_by="a safety limit").execute(constant, task("lift", 4))
    assert whole.ended == COMPLETE
    fallen = systems.Recorded({"lift": replace(RUN, ended="terminated: it fell")}).execute(constant, task("lift", 8))
    assert fallen.ended == "terminated: it fell"


def test_a_model_that_goes_on_is_falsified_by_a_recording_that_was_stopped() -> None:
    names = ("lift", "turn")
    validation = Validation(
        space=TaskSuite(names),
        task=lambda p: task("", 5),
        system=systems.Recorded({"lift": RUN, "turn": RUN.first(3)}, stopped_by="a safety limit"),
        model=models.Linear([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]]),
        synthesizer=controllers.Policy(lambda t, x, task: np.ones(1)),
        distance=distances.MaximumDeviation(),
        start_tolerance=1.0,
    )
    campaign = Campaign(validation).run(2, 100.0)
    assert campaign.verdict(100.0).answer == "falsified"
    assert {trial.parameters["task"]: trial.state for trial in campaign.trials}["turn"] == "failed"


FILE = """
task = { type = "recorded" }
synthesizer = { type = "recorded" }
model = { type = "Linear", A = [[1.0, 0.1], [0.0, 1.0]], B = [[0.0], [0.1]] }
distance = { type = "MaximumDeviation" }

[system]
type = "Recorded"
runs = "."
mapping = { states = { x = "x", v = "v" }, inputs = { u = "u" } }
"""


def test_a_file_takes_tasks_and_inputs_from_recordings(tmp_path: Path) -> None:
    folder_with(tmp_path, "lift", "turn")
    rows = [{"t": t, "x": 3 * t, "v": 3.0, "u": -1.0} for t in 0.1 * np.arange(4)]
    (tmp_path / "turn.json").write_text(json.dumps(rows))
    (tmp_path / "arm.toml").write_text(FILE)
    validation = load_experiment(tmp_path / "arm.toml").validation
    assert isinstance(validation.space, TaskSuite)
    assert validation.space.task_names == ("lift", "turn")
    plan = validation.plan(validation.space.point({"task": "turn"}))
    assert plan.task.horizon == 3
    assert np.allclose(plan.model_trajectory.states[0], [0.0, 3.0])
    assert np.allclose(plan.model_trajectory.inputs, -1.0)
    campaign = Campaign(validation).run(2, 10.0)
    assert campaign.verdict(10.0).answer == "validated"
    findings = check_experiment(Experiment("arm", validation))  # of tasks with different horizons
    assert not [each for each in findings if each.state == "failed"]
    with_space = FILE.replace('"Recorded"', '"Simulated"')
    (tmp_path / "arm.toml").write_text(with_space.replace('runs = "."', "").replace("mapping", "step"))
    with refuses(InputError):
        load_experiment(tmp_path / "arm.toml")


def test_recorded_inputs_take_batches_of_draws() -> None:
    recorded = systems.Recorded({"lift": RUN})
    controller = recorded.design(task("lift"), models.Linear([[1.0]], [[1.0]]))
    assert controller(2, np.zeros((4, 3, 2))).shape == (4, 3, 1)


RANDOM = searches.by_name("random")


def noisy_lift(count: int) -> dict[str, list[Trajectory]]:
    """Return recordings of two tasks whose distances to the model of ``repeated`` are 0 to 1, and 0 to 0.5."""
    rng, runs = np.random.default_rng(0), dict[str, list[Trajectory]]()
    for name, size in (("lift", 1.0), ("drop", 0.5)):
        ends = size * rng.random(count)
        runs[name] = [Trajectory(TIMES, np.linspace([0, 0], [end, 0], 6), np.ones((5, 1))) for end in ends]
    return runs


def repeated(runs: dict[str, list[Trajectory]]) -> Validation:
    recorded = systems.Recorded(runs)
    return Validation(
        space=TaskSuite(list(runs), repeats=recorded.repeats),
        task=lambda p: Task([0.0, 0.0], horizon=5, dt=0.1),
        system=recorded,
        model=models.Linear(np.eye(2), np.zeros((2, 1))),
        synthesizer=recorded,
        distance=distances.FinalState(),
    )


def test_recordings_of_one_task_are_executed_in_turn_also_after_a_break(tmp_path: Path) -> None:
    runs = noisy_lift(3)
    Campaign(repeated(runs), search=RANDOM, store=tmp_path / "a.sqlite").run(3)
    campaign = Campaign(repeated(runs), search=RANDOM, store=tmp_path / "a.sqlite").run(20)
    assert [sorted({t.parameters["task"] for t in campaign.trials[k : k + 2]}) for k in (0, 2, 4)] == [
        ["drop", "lift"]
    ] * 3
    for name, recordings in runs.items():
        found = [trial.distance for trial in campaign.trials if trial.parameters["task"] == name]
        assert found == [abs(float(run.states[-1, 0])) for run in recordings]
    assert not campaign.recorder.has_tasks
    with refuses(ExecutionError, "lift", 3):
        systems.Recorded(runs).execute(constant, task("lift").again(3))
    folder = tmp_path / "logs"
    for name in ("lift", "drop"):
        (folder / name).mkdir(parents=True)
        folder_with(folder / name, "a", "b")
    assert systems.Recorded(folder, MAPPING).repeats == 2


def test_a_quantile_needs_as_many_repeats_as_the_binomial_law_says() -> None:
    # With two tasks, each has half of the 5 % by which the statement may be wrong.
    options = CertificateOptions(WholeSuite(quantile=0.9), 0.95)
    few = Campaign(repeated(noisy_lift(10)), search=RANDOM).run(20, 2.0, certificate=options)
    verdict = few.verdict(2.0, certificate=options)
    assert (len(few.trials), verdict.answer) == (20, "undecided")
    assert_names(verdict.reason, 10, 36, 90, f"{100 * 0.025 ** (1 / 10):.3g}")
    less = CertificateOptions(WholeSuite(quantile=0.69), 0.95)
    assert few.verdict(2.0, certificate=less).answer == "validated"
    many = Campaign(repeated(noisy_lift(50)), search=RANDOM).run(100, 2.0, certificate=options)
    verdict = many.verdict(2.0, certificate=options)
    assert verdict.answer == "validated"
    assert verdict.certificate is not None
    assert verdict.certificate.details["repeats"] == 36  # no more are executed than needed
    # Of 50, not the largest is the bound of one task but the second one: P(Bin(50, 0.9) <= 48) >= 0.95.
    values = np.random.default_rng(1).random(50)
    sample = Sample(np.zeros((50, 1)), values, ["manual"] * 50, ["completed"] * 50, suite=np.zeros((1, 1)), repeats=50)
    assert WholeSuite(quantile=0.9).certify(sample).upper_bound == np.sort(values)[-2]


def test_repeats_above_a_threshold_falsify_it_by_bets() -> None:
    campaign = Campaign(repeated(noisy_lift(50)), search=RANDOM).run(100, 0.3)
    verdict = campaign.verdict(0.3)
    assert verdict.answer == "falsified"
    assert sum((trial.distance or 0.0) > 0.3 for trial in campaign.trials) > 1
