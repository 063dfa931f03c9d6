"""Hardware by hand: asking and telling, from Python and from many real processes."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from ctxval import Campaign, Store, TaskSpace, Trajectory, searches
from ctxval.campaign.by_hand import parameters_from
from ctxval.certificates import Sample
from ctxval.cli import app
from ctxval.controllers import read_controller
from ctxval.core.exchange import read_task
from ctxval.core.rollout import rollout
from ctxval.errors import ExecutionError, InputError, StoreAccessError, UnknownNameError
from facts import assert_names, is_named, refuses
from rig_cli import SMALL

MODULE = """
from ctxval import Experiment, Task, TaskSpace, Validation, controllers, distances, models, systems


def experiment(seed):
    rig = systems.Manual(states={"position": "m", "speed": "m/s"}, inputs={"force": "N"}, dt=0.1)
    validation = Validation(
        space=TaskSpace(goal=(0.5, 2.0, "m")),
        task=lambda p: Task([0, 0], goal=[p.goal, 0], horizon=20, dt=rig.dt),
        system=rig,
        model=models.Linear([[1, 0.1], [0, 1]], [[0], [0.1]]),
        synthesizer=controllers.LQR([10, 1], [0.1], limits=3.0),
        distance=distances.FinalState(weights=(1, 1)),
    )
    return Experiment("rig", validation, threshold=2.0, units="m")


def policy(seed):
    made = experiment(seed)
    made.validation.synthesizer = controllers.Policy(lambda t, x, task: task.goal[..., :1] - x[..., :1] - x[..., 1:])
    return made
"""


@pytest.fixture
def invoke(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    """Run the command line in a folder with a manual rig in it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_rig.py").write_text(MODULE)
    sys.modules.pop("my_rig", None)

    def run(*arguments: str) -> Result:
        return CliRunner().invoke(app, list(arguments))

    yield run
    sys.modules.pop("my_rig", None)


def asked(invoke: Any, *arguments: str) -> dict[str, Any]:
    result = invoke("ask", *arguments, "--json")
    assert result.exit_code == 0, result.stderr
    report: dict[str, Any] = json.loads(result.stdout)
    return report


def new(invoke: Any) -> dict[str, Any]:
    return asked(invoke, "my_rig:experiment", "--store", "a.sqlite")


def record(folder: str, path: str = "run.csv", *, substeps: int = 1, rate: float = 0.98) -> Trajectory:
    """Do what a rig does with the files alone: read them, run, and write down what happened."""
    found, task = read_controller(Path(folder) / "controller.npz"), read_task(Path(folder) / "task.json")

    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.array([x[0] + 0.1 * x[1], rate * x[1] + 0.1 * u[0]])

    trajectory = rollout(step, found.controller, task)
    if substeps > 1:
        times = np.arange(substeps * task.horizon + 1) * task.dt / substeps
        states = np.stack([np.interp(times, trajectory.times, column) for column in trajectory.states.T], axis=-1)
        trajectory = Trajectory(times, states, np.repeat(trajectory.inputs, substeps, axis=0))
    trajectory.to_csv(path, states=["position [m]", "speed"], inputs=["force"])
    return trajectory


def refused(result: Result) -> str:
    """Return the sentence of a command that refused its input."""
    assert result.exit_code == 2, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    return result.stderr.replace("\n", " ")


# Asking


def test_asking_writes_all_that_a_rig_needs(invoke: Any) -> None:
    report = new(invoke)
    folder = Path(report["folder"])
    assert (report["trial"], report["folder"]) == (0, "a.trials/0")
    assert sorted(path.name for path in folder.iterdir()) == sorted(report["files"])
    assert {"task.json", "controller.json", "controller.npz", "model.csv"} == set(report["files"])
    found = read_controller(folder / "controller.json")
    assert (found.states, found.inputs, found.dt) == ({"position": "m", "speed": "m/s"}, {"force": "N"}, 0.1)
    assert read_task(folder / "task.json").goal[0] == report["task"]["goal"]
    assert_names((folder / "model.csv").read_text(), "position", "speed", "force")
    assert Store("a.sqlite").trials()[0].state == "open"


def test_a_store_knows_what_it_is_of(invoke: Any) -> None:
    new(invoke)
    second = asked(invoke, "a.sqlite")
    chosen = asked(invoke, "a.sqlite", "--set", "goal=1.25", "--out", "elsewhere")
    drawn = asked(invoke, "a.sqlite", "--draw")
    assert [r["trial"] for r in (second, chosen, drawn)] == [1, 2, 3]
    assert (chosen["task"], chosen["origin"], drawn["origin"]) == ({"goal": 1.25}, "manual", "iid")
    assert Path("elsewhere/task.json").exists()
    assert [r["open"] for r in (second, chosen, drawn)] == [[0], [0, 1], [0, 1, 2]]
    said = " ".join(invoke("ask", "a.sqlite", "--trial", "1").stdout.split())
    assert_names(said, 3, "open", 0, 2)
    status = json.loads(invoke("status", "a.sqlite", "--json").stdout)
    assert (status["open"], status["executions"]) == ([0, 1, 2, 3], 0)


def test_the_files_of_an_open_trial_can_be_written_again(invoke: Any) -> None:
    first = new(invoke)
    before = (Path(first["folder"]) / "controller.json").read_bytes()
    again = asked(invoke, "a.sqlite", "--trial", "0", "--out", "again")
    assert (Path("again") / "controller.json").read_bytes() == before
    assert again["task"] == first["task"]
    assert len(Store("a.sqlite").trials()) == 1


def test_a_controller_that_has_no_file_is_said_so(invoke: Any) -> None:
    result = invoke("ask", "my_rig:policy", "--store", "b.sqlite")
    assert result.exit_code == 0
    assert "ctxval tell b.sqlite 0 --trajectory run.csv" in result.stdout


def test_a_folder_that_cannot_be_written_leaves_the_trial_open_and_says_how_to_go_on(invoke: Any) -> None:
    new(invoke)
    Path("file").write_text("")
    sentence = refused(invoke("ask", "a.sqlite", "--out", "file/inside"))
    assert_names(sentence, "ask", "STORE", "--trial", 1)
    assert asked(invoke, "a.sqlite", "--trial", "1")["trial"] == 1


@pytest.mark.slow
def test_asking_by_command_chooses_what_a_campaign_chooses(invoke: Any) -> None:
    sys.path.insert(0, os.getcwd())
    import my_rig  # type: ignore[import-not-found]

    for number in range(3):
        target = ("a.sqlite",) if number else ("my_rig:experiment", "--store", "a.sqlite")
        report = asked(invoke, *target, "--explore")
        record(report["folder"])
        assert invoke("tell", "a.sqlite", str(number), "--trajectory", "run.csv").exit_code == 0
    sys.path.remove(os.getcwd())
    one = Campaign(my_rig.experiment(0).validation, search=searches.Auto(), seed=0)
    kept = Store("a.sqlite")
    for trial in kept.trials():
        opened = one.ask()
        np.testing.assert_array_equal(opened.trial.unit_point, trial.unit_point)
        one.tell(opened, kept.trajectory(trial.number, "system"))


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        (["a.sqlite", "--set", "gaol=1"], ("goal",)),
        (["a.sqlite", "--set", "goal=9"], ("goal", 9)),
        (["a.sqlite", "--set", "goal"], ("goal",)),
        (["a.sqlite", "--set", "goal=1", "--set", "goal=2"], ()),
        (["a.sqlite", "--set", "goal=one"], ("goal", "one")),
        (
            ["a.sqlite", "--set", "goal=1", "--draw"],
            ("--set", "--draw", "--again", "--trial"),
        ),
        (["a.sqlite", "--explore", "--draw"], ("--trial", "--explore")),
        (["a.sqlite", "--draw", "--threshold", "1"], ()),
        (["a.sqlite", "--threshold", "nan"], ("threshold",)),
        (["a.sqlite", "--budget", "0"], ("budget",)),
        (["a.sqlite", "--trial", "9"], ("trial", 9)),
        (["a.sqlite", "--seed", "3"], ()),
        (["none.sqlite"], ("none.sqlite", "ask", "FILE.toml", "--store")),
        (["none"], ("none",)),
    ],
)
def test_what_cannot_be_asked_opens_no_trial(invoke: Any, arguments: list[str], facts: tuple[object, ...]) -> None:
    new(invoke)
    assert_names(refused(invoke("ask", *arguments)), *facts)
    assert len(Store("a.sqlite").trials()) == 1


def test_a_manual_system_is_not_run(invoke: Any) -> None:
    sentence = refused(invoke("run", "my_rig:experiment", "--store", "a.sqlite"))
    assert_names(sentence, "run")
    new(invoke)
    refused(invoke("certify", "a.sqlite", "--audit", "3"))
    assert len(Store("a.sqlite").trials()) == 1


SPACE = TaskSpace(goal=([0.0, 0.0], [2.0, 2.0], "rad"), load=(0.0, 1.0, "m/s^2"), bare=(-1.0, 1.0))
WHOLE = {"goal": [1.5, 0.5], "load": 0.2, "bare": -0.001}


@pytest.mark.parametrize(
    "texts",
    [
        ["goal=1.5,0.5", "load=0.2", "bare=-1e-3"],
        ["goal=[1.5, 0.5]", "load = 0.2", "bare=-.001"],
        ["goal = [1.5, 0.5] rad", "load=0.2 m/s^2", "bare=-0.001"],
        ["goal=1.5 rad, 0.5 rad", "load=0.2 [m/s^2]", "bare=-0.001"],
        ["goal[0]=1.5", "goal[1]=0.5 rad", "load=.2", "bare=-0.001"],
        ["goal[1] = 0.5, goal[0] = 1.5, load = 0.2, bare = -0.001"],
        ["goal = 1.5, 0.5, load = 0.2, bare = -0.001"],
        ["goal = [1.5, 0.5], load = 0.2", "bare = -0.001"],
    ],
)
def test_parameters_are_taken_in_every_form_in_which_they_are_printed(texts: list[str]) -> None:
    assert parameters_from(texts, SPACE) == WHOLE


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("goal[0]=1.5", ("goal", "goal[1]")),
        ("goal[0]=1, goal[1]=1, goal=1,1", ("goal",)),
        ("goal[2]=1", ("goal[2]", "goal")),
        ("load[0]=1", ("load[0]", "load")),
        ("load=0.2 rad", ("load", "m/s^2", "0.2 rad")),
        ("load=0.2 deg/s", ("load", "m/s^2")),
        ("goal=[1.5 deg, 0.5]", ("goal", "rad")),
        ("bare=1 m", ("bare", "1 m")),
        ("goal=[1.5, 0.5", ("goal", "[1.5, 0.5")),
        ("load=one", ("load", "one")),
        ("load=", ("load", "''")),
        ("load=1,,2", ("load", "''")),
        ("load", ("load",)),
        ("=1", ("=1",)),
        ("", ("''",)),
        ("load=1, load=2", ("load",)),
    ],
)
def test_parameters_that_cannot_be_used_are_named(text: str, facts: tuple[str, ...]) -> None:
    with refuses((InputError, UnknownNameError), *facts):
        SPACE.point(parameters_from([text], SPACE))


def test_what_a_person_types_comes_back_as_it_was_typed(invoke: Any) -> None:
    new(invoke)
    for number, typed in enumerate(("0.7", "1.1", "1.9 m", "0.9000001"), 1):
        report = asked(invoke, "a.sqlite", "--set", f"goal={typed}")
        value = float(typed.removesuffix(" m"))
        assert report["task"] == {"goal": value}
        assert read_task(Path(report["folder"]) / "task.json").goal[0] == value
        assert report["trial"] == number


# Telling


def test_open_trials_are_told_in_any_order_and_in_every_way(invoke: Any) -> None:
    reports = [new(invoke), *(asked(invoke, "a.sqlite") for _ in range(3))]
    whole = record(reports[2]["folder"])
    Path("run.npz").write_bytes(record(reports[0]["folder"], "other.csv").to_npz())
    told = [
        ("2", "--trajectory", "run.csv"),
        ("0", "--npz", "run.npz"),
        ("3", "--distance", "0.125"),
        ("1", "--failed", "motor cut out"),
    ]
    answers = [json.loads(invoke("tell", "a.sqlite", *arguments, "--json").stdout) for arguments in told]
    assert [(a["trial"], a["state"]) for a in answers] == [
        (2, "completed"),
        (0, "completed"),
        (3, "completed"),
        (1, "failed"),
    ]
    assert answers[-1]["executions"] == 4
    store = Store("a.sqlite")
    store.trials()
    assert store.trials()[3].distance == 0.125
    kept = store.trajectory(2, "system")
    assert kept is not None
    np.testing.assert_array_equal(kept.states, whole.states)


def test_what_was_told_is_said(invoke: Any) -> None:
    record(new(invoke)["folder"])
    assert_names(invoke("tell", "a.sqlite", "0", "--trajectory", "run.csv").stdout, 0)
    asked(invoke, "a.sqlite")
    assert_names(invoke("tell", "a.sqlite", "1", "--failed", "fuse [blown]").stdout, 1)


def test_the_task_of_a_failed_trial_can_be_executed_again(invoke: Any) -> None:
    first = new(invoke)
    assert invoke("tell", "a.sqlite", "0", "--failed", "cable off").exit_code == 0
    again = asked(invoke, "a.sqlite", "--again", "0")
    assert (again["trial"], again["task"]) == (1, first["task"])
    record(again["folder"])
    assert invoke("tell", "a.sqlite", "1", "--trajectory", "run.csv").exit_code == 0
    failed, made_good = Store("a.sqlite").trials()
    assert Sample.of([failed]).failed == 1
    assert Sample.of([failed, made_good]).failed == 0
    assert made_good.because is None
    refused = invoke("ask", "a.sqlite", "--again", "7")
    assert refused.exit_code == 2
    assert_names(refused.stderr, "trial", 7, 2, 0)


@pytest.mark.slow
def test_why_a_failed_task_is_executed_again_is_kept_and_certified(invoke: Any) -> None:
    new(invoke)
    invoke("tell", "a.sqlite", "0", "--failed", "the fuse blew")
    assert asked(invoke, "a.sqlite", "--again", "0", "--because", "fuse replaced")["trial"] == 1
    invoke("tell", "a.sqlite", "1", "--distance", "0.1")
    assert Store("a.sqlite").trials()[1].because == "fuse replaced"
    for number, goal in enumerate((0.6, 0.9, 1.4, 1.9), start=2):
        asked(invoke, "a.sqlite", "--set", f"goal={goal}")
        invoke("tell", "a.sqlite", str(number), "--distance", f"{0.1 + 0.01 * goal}")
    report = json.loads(invoke("certify", "a.sqlite", "--resolution", "1", "--json").stdout)
    assert report["details"]["failures"]["made_good"] == [{"trial": 0, "by": 1, "because": "fuse replaced"}]
    assert_names(report["assumptions"], "fuse replaced")
    refused = invoke("ask", "a.sqlite", "--because", "oil")
    assert refused.exit_code == 2
    assert "--because needs --again TRIAL" in refused.stderr.replace("\n", " ")


def edit(change: Any) -> None:
    """Change the rows of the recording."""
    with open("run.csv", newline="") as file:
        rows = list(csv.reader(file))
    with open("run.csv", "w", newline="") as file:
        csv.writer(file).writerows(change(rows))


def without(column: int) -> Any:
    return lambda rows: [[cell for i, cell in enumerate(row) if i != column] for row in rows]


def with_cell(line: int, column: int, text: str) -> Any:
    def change(rows: list[list[str]]) -> list[list[str]]:
        rows[line - 1][column] = text
        return rows

    return change


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        (without(2), ("run.csv",)),
        (without(3), ()),
        (with_cell(1, 1, "position [kg]"), ("position", "kg")),
        (with_cell(1, 1, "speed [m/s]"), ("speed",)),
        (with_cell(1, 0, "t [ms]"), (0.1, 1, 0.0001)),
        (
            lambda rows: [rows[0], *([str(100 * k), *row[1:]] for k, row in enumerate(rows[1:]))],
            (),
        ),
        (with_cell(5, 1, "-999"), (-999, 0.3)),
        (with_cell(7, 1, "1,5"), ()),
        (without(0), ()),
        (lambda rows: rows[:15], (21, 20, 0.1, 14)),
        (lambda rows: rows[:1], ()),
        (with_cell(5, 1, "n/a"), ("run.csv", 5, "n/a")),
        (with_cell(5, 1, ""), ("run.csv", 5)),
        (lambda rows: [";".join(row).split(",") for row in with_cell(7, 1, "0,5")(rows)], ()),
        (with_cell(5, 1, "nan"), ("run.csv", "nan", 0.3)),
        (with_cell(4, 3, "-inf"), ("run.csv", "inf", 0.2)),
        (with_cell(2, 1, "0.7"), (0,)),
        (with_cell(4, 0, "0.35"), (0.1, 2, 0.2, 0.35)),
        (lambda rows: [rows[0], *([str(2 * float(r[0])), *r[1:]] for r in rows[1:])], (1, 0.1)),
    ],
)
def test_a_recording_of_something_else_is_refused_and_the_trial_stays_open(
    invoke: Any, change: Any, facts: tuple[object, ...]
) -> None:
    record(new(invoke)["folder"])
    edit(change)
    result = invoke("tell", "a.sqlite", "0", "--trajectory", "run.csv")
    assert result.exit_code in (2, 3)
    assert "Traceback" not in result.stderr
    assert_names(result.stderr.replace("\n", " "), *facts)
    assert Store("a.sqlite").trials()[0].state == "open"


def test_a_batch_of_recordings_is_refused(invoke: Any) -> None:
    one = record(new(invoke)["folder"])
    states = np.stack([one.states, np.full_like(one.states, np.nan)])
    Path("two.npz").write_bytes(Trajectory(one.times, states, np.stack([one.inputs] * 2)).to_npz())
    assert_names(refused(invoke("tell", "a.sqlite", "0", "--npz", "two.npz")), "two.npz", (2, 21, 2))
    assert Store("a.sqlite").trials()[0].state == "open"


def test_a_start_that_is_elsewhere_can_be_allowed(invoke: Any) -> None:
    record(new(invoke)["folder"])
    edit(with_cell(2, 1, "0.3"))
    assert "starts elsewhere" in refused(invoke("tell", "a.sqlite", "0", "--trajectory", "run.csv"))
    given = ("--trajectory", "run.csv", "--start-tolerance", "1")
    assert invoke("tell", "a.sqlite", "0", *given).exit_code == 0


def test_a_start_is_held_to_the_tolerance_of_the_experiment(invoke: Any) -> None:
    Path("my_rig.py").write_text(
        MODULE.replace(
            "distances.FinalState(weights=(1, 1)),", "distances.FinalState(weights=(1, 1)), start_tolerance=1,"
        )
    )
    record(new(invoke)["folder"])
    edit(with_cell(2, 1, "0.3"))
    strict = ("run.csv", "--start-tolerance", "0.01")
    assert "starts elsewhere" in refused(invoke("tell", "a.sqlite", "0", "--trajectory", *strict))
    assert invoke("tell", "a.sqlite", "0", "--trajectory", "run.csv").exit_code == 0
    assert "starts elsewhere" in refused(invoke("import", "a.sqlite", *strict, "--set", "goal=1"))
    assert invoke("import", "a.sqlite", "run.csv", "--set", "goal=1").exit_code == 0


def test_options_of_the_experiment_are_set_for_a_new_store(invoke: Any) -> None:
    Path("my_rig.py").write_text(MODULE.replace("seed):", "seed, steps=20):").replace("horizon=20", "horizon=steps"))
    folder = asked(invoke, "my_rig:experiment", "--store", "a.sqlite", "--option", "steps=7")["folder"]
    assert read_task(Path(folder) / "task.json").horizon == 7
    assert "remove --store, --search, --seed and --option" in refused(invoke("ask", "a.sqlite", "--option", "steps=7"))


def test_a_recording_at_other_times_is_resampled_on_request(invoke: Any) -> None:
    report = new(invoke)
    record(report["folder"], substeps=5)
    assert_names(refused(invoke("tell", "a.sqlite", "0", "--trajectory", "run.csv")), 21)
    answer = invoke("tell", "a.sqlite", "0", "--trajectory", "run.csv", "--resample", "--json")
    whole, kept = record(report["folder"], "plain.csv"), Store("a.sqlite").trajectory(0, "system")
    assert kept is not None
    np.testing.assert_allclose(kept.states, whole.states, atol=1e-12)
    np.testing.assert_allclose(kept.inputs, whole.inputs, rtol=1e-12)
    assert json.loads(answer.stdout)["state"] == "completed"
    asked(invoke, "a.sqlite")
    edit(lambda rows: rows[:60])
    sentence = refused(invoke("tell", "a.sqlite", "1", "--trajectory", "run.csv", "--resample"))
    assert_names(sentence, 1.16, 2)


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        (["7", "--failed", "x"], (7, 1)),
        (["0"], ("--trajectory", "--npz", "--distance", "--failed")),
        (["0", "--failed", "x", "--distance", "1"], ()),
        (["0", "--distance", "-1"], (0, -1.0)),
        (["0", "--distance", "nan"], (0, "nan")),
        (["0", "--trajectory", "none.csv"], ("none.csv",)),
        (["0", "--npz", "none.npz"], ("none.npz",)),
        (["0", "--trajectory", "."], ()),
        (["0", "--trajectory", "no_inputs.csv"], ("no_inputs.csv",)),
        (["0", "--failed", " "], ("--failed",)),
        (["0", "--distance", "1", "--resample"], ("--resample", "--start-tolerance")),
        (["0", "--failed", "x", "--start-tolerance", "0.1"], ("--trajectory", "--npz")),
        (["0", "--trajectory", "no_inputs.csv", "--start-tolerance", "nan"], (0, "nan")),
        (["0", "--trajectory", "no_inputs.csv", "--start-tolerance", "-1"], (0, -1.0)),
        (["0", "--npz", "my_rig.py"], ("my_rig.py",)),
    ],
)
def test_what_cannot_be_told_is_one_sentence(invoke: Any, arguments: list[str], facts: tuple[object, ...]) -> None:
    new(invoke)
    Path("no_inputs.csv").write_text("t,position,speed\n" + "".join(f"{t / 10},0,0\n" for t in range(21)))
    assert_names(refused(invoke("tell", "a.sqlite", *arguments)), *facts)
    assert Store("a.sqlite").trials()[0].state == "open"


def test_a_trial_is_told_once(invoke: Any) -> None:
    new(invoke)
    assert invoke("tell", "a.sqlite", "0", "--distance", "1").exit_code == 0
    sentence = refused(invoke("tell", "a.sqlite", "0", "--failed", "x"))
    assert_names(sentence, 0)
    assert Store("a.sqlite").trials()[0].distance == 1


# Importing


def test_known_runs_come_in_once_with_their_origin(invoke: Any) -> None:
    record(asked(invoke, "my_rig:experiment", "--store", "a.sqlite", "--set", "goal=0.75")["folder"])
    Path("runs.csv").write_text("goal,trajectory,distance,failed\n0.75,run.csv,,\n\n1.5,,0.25,\n2,,,cable too short\n")
    report = json.loads(invoke("import", "a.sqlite", "runs.csv", "--json").stdout)
    assert [(r["task"]["goal"], r["state"]) for r in report["imported"]] == [
        (0.75, "completed"),
        (1.5, "completed"),
        (2.0, "failed"),
    ]
    second = invoke("import", "a.sqlite", "runs.csv", "--json")
    assert second.exit_code == 0, second.stderr
    again = json.loads(second.stdout)
    assert (again["imported"], again["known"]) == ([], 3)
    store = Store("a.sqlite")
    assert [(t.origin, t.state, t.executed) for t in store.trials()] == [
        ("manual", "open", False),
        ("manual", "completed", True),
        ("manual", "completed", True),
        ("manual", "failed", True),
    ]
    assert store.trajectory(1, "system") is not None
    assert store.trajectory(2, "system") is None
    one = invoke("import", "a.sqlite", "run.csv", "--set", "goal=0.75")
    assert_names(one.stdout, 0, "imported", 1, "store")


@pytest.mark.parametrize(
    ("table", "facts"),
    [
        ("goal,distance\n1,0.5\n9,0.5\n", ("runs.csv", 3, "goal", 9)),
        ("goal,distance\n1,0.5\n\n\n1,x\n", ("runs.csv", 5, "distance", "x")),
        ("goal,distance\n1,0.5\n1,-1\n", ("runs.csv", 3, "distance", 0)),
        ("goal,distance,failed\n1,0.5,x\n", (2, "distance", "failed")),
        (
            "gaol,distance\n1,0.5\n",
            ("distance", "gaol"),
        ),
        ("goal,trajectory\n1,none.csv\n", (2, "none.csv")),
        ("goal,distance\n", ("runs.csv",)),
        (
            "goal,distance,goal\n1,2,3\n",
            ("runs.csv", "goal"),
        ),
        ("", ()),
        ("\x00\x01", ("runs.csv",)),
    ],
)
def test_a_table_with_one_wrong_row_brings_nothing_in(invoke: Any, table: str, facts: tuple[object, ...]) -> None:
    new(invoke)
    Path("runs.csv").write_text(table)
    assert_names(refused(invoke("import", "a.sqlite", "runs.csv")), *facts)
    assert len(Store("a.sqlite").trials()) == 1


def test_a_table_of_runs_is_read_with_a_bound(invoke: Any) -> None:
    new(invoke)
    Path("runs.csv").touch()
    os.truncate("runs.csv", 2**33)
    assert_names(refused(invoke("import", "a.sqlite", "runs.csv")), "runs.csv", 8589934592)
    Path("runs.csv").write_text("distance,goal\n0.5\n")
    assert_names(refused(invoke("import", "a.sqlite", "runs.csv")), 2, "goal")


def test_many_runs_are_imported_in_one_transaction_and_told_once(invoke: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    new(invoke)
    rows = [f"{0.5 + k / 100},{k / 1000}" for k in range(100)]
    Path("runs.csv").write_text("\n".join(["goal,distance", *rows, rows[7]]))
    calls: Counter[str] = Counter()
    for kind, name in ((Store, "add"), (Store, "_transaction")):
        monkeypatch.setattr(kind, name, counted(getattr(kind, name), name, calls))
    result = invoke("import", "a.sqlite", "runs.csv")
    assert result.exit_code == 0, result.stderr
    assert (calls["add"], len(Store("a.sqlite").trials())) == (1, 101)
    assert calls["_transaction"] < 10
    assert_names(result.stdout.splitlines()[-2:], 90, "trials", "--json", 100, 1)


def counted(function: Any, name: str, calls: Counter[str]) -> Any:
    def call(*args: Any, **kwargs: Any) -> Any:
        calls[name] += 1
        return function(*args, **kwargs)

    return call


def test_a_table_of_runs_is_converted_to_the_units_of_the_tasks(invoke: Any) -> None:
    new(invoke)
    Path("runs.csv").write_text("goal [mm];distance\n750;0,25\n")
    found = json.loads(invoke("import", "a.sqlite", "runs.csv", "--json").stdout)["imported"]
    assert [(one["task"]["goal"], one["distance"]) for one in found] == [(0.75, 0.25)]
    Path("runs.csv").write_text("goal [s],distance\n1,0.25\n")
    sentence = refused(invoke("import", "a.sqlite", "runs.csv"))
    assert_names(sentence, "runs.csv")


def test_a_little_jitter_is_refused_with_its_size_and_the_option_that_helps(invoke: Any) -> None:
    record(new(invoke)["folder"])
    edit(lambda rows: [rows[0], *([str(0.1 * k + 0.0025 * (k % 2)), *row[1:]] for k, row in enumerate(rows[1:]))])
    sentence = refused(invoke("tell", "a.sqlite", "0", "--trajectory", "run.csv"))
    assert_names(sentence, 0.0025, "--resample")
    assert invoke("tell", "a.sqlite", "0", "--trajectory", "run.csv", "--resample").exit_code == 0


def test_what_is_imported_must_be_there(invoke: Any) -> None:
    new(invoke)
    assert_names(refused(invoke("import", "a.sqlite", "none.csv")), "none.csv")
    assert "finite number >= 0" in refused(invoke("import", "a.sqlite", "none.csv", "--start-tolerance", "inf"))
    refused(invoke("import", "a.sqlite", "x" * 300))


def test_the_search_knows_what_was_imported(invoke: Any) -> None:
    plain = [asked(invoke, "my_rig:experiment", "--store", "plain.sqlite")["task"] for _ in range(1)]
    new(invoke)
    Path("runs.csv").write_text("goal,distance\n" + "".join(f"{g},{0.1 * g}\n" for g in (0.6, 0.9, 1.2, 1.5, 1.8)))
    assert invoke("import", "a.sqlite", "runs.csv").exit_code == 0
    assert asked(invoke, "a.sqlite", "--explore")["origin"] == "acquisition"
    assert plain[0] == Store("a.sqlite").trials()[0].parameters


# Many terminals


def start(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen([*SMALL, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def ends(processes: list[subprocess.Popen[str]]) -> list[tuple[int, str, str]]:
    ended = []
    for process in processes:
        stdout, stderr = process.communicate(timeout=120)
        ended.append((process.returncode, stdout, stderr))
    return ended


@pytest.mark.thorough
def test_several_terminals_ask_and_tell_at_once(invoke: Any) -> None:
    ask = ["ask", "my_rig:experiment", "--store", "a.sqlite", "--search", "random", "--json"]
    first = ends([start(*ask) for _ in range(3)])
    assert [status for status, _, _ in first] == [0] * 3, first
    reports = [json.loads(stdout) for _, stdout, _ in first]
    assert sorted(report["trial"] for report in reports) == [0, 1, 2]
    assert len({report["task"]["goal"] for report in reports}) == 3
    told = ends(
        [start("tell", "a.sqlite", "1", "--distance", f"0.{who}") for who in (1, 2)]
        + [start("ask", "a.sqlite", "--json")]
    )
    assert Counter(status for status, _, _ in told[:2]) == {0: 1, 2: 1}
    for status, _, stderr in told[:2]:
        assert status == 0 or is_named(stderr, 1)
    assert (told[2][0], json.loads(told[2][1])["trial"]) == (0, 3)
    assert [trial.state for trial in Store("a.sqlite").trials()] == ["open", "completed", "open", "open"]


@pytest.mark.slow
def test_an_asking_campaign_learns_what_others_stored(validation: Any, tmp_path: Path) -> None:
    store, search = tmp_path / "a.sqlite", searches.GPUCB()
    first, second = (Campaign(validation, search=search, store=store, seed=3) for _ in range(2))
    opened = first.ask()
    assert second.ask().number == 1
    assert first.ask().number == 2
    second.tell(0, validation.execute(opened.plan))
    with refuses(InputError, 0):
        first.tell(opened, failed="x")
    assert first.executions == 1
    with second.store.sole_writer(), refuses(StoreAccessError, "a.sqlite"):
        first.ask()


@pytest.mark.slow
def test_a_point_that_was_asked_for_twice_does_not_hinder_a_resumption(validation: Any, tmp_path: Path) -> None:
    campaign = Campaign(validation, store=tmp_path / "a.sqlite", seed=3)
    for _ in range(2):
        campaign.ask({"goal": 1.0})
    campaign.tell(1, failed="x")
    campaign.ask({"goal": 1.0})
    campaign.tell(2, distance=1.0)
    campaign.run(4)
    again = Campaign(validation, store=tmp_path / "a.sqlite", seed=3)
    np.testing.assert_array_equal(again.ask().trial.unit_point, campaign.reopen(5).trial.unit_point)


def test_an_execution_that_ended_early_is_no_whole_recording(validation: Any) -> None:
    campaign = Campaign(validation)
    opened = campaign.ask()
    whole = validation.execute(opened.plan)
    with refuses(ExecutionError, "operator"):
        campaign.tell(opened, Trajectory(whole.times, whole.states, whole.inputs, "operator stop"))
    assert campaign.tell(opened, distance=2).distance == 2.0


# Logs of other programs


def log_of_trial(path: Path, trial: dict[str, Any], speed: float = 1.0) -> None:
    """Write the model's trajectory of a trial to MCAP, as a rig would log it."""
    from rig_logs import write_mcap_json

    model = Trajectory.from_csv(Path(trial["folder"]) / "model.csv", states=["position", "speed"], inputs=["force"])
    states = model.states * [1.0, speed]
    write_mcap_json(path, Trajectory(model.times, states, model.inputs))


FIELDS = """
[recordings]
states = { position = "/state.cart.position", speed = "/state.cart.speed" }
inputs = { force = "/command.force" }
"""


def mapped_experiment() -> None:
    Path("my_rig.py").write_text(MODULE)
    Path("rig.toml").write_text(f'experiment = "my_rig:experiment"\n{FIELDS}')


def test_a_log_of_another_program_is_told_with_the_mapping_of_the_experiment(invoke: Any) -> None:
    mapped_experiment()
    trial = asked(invoke, "rig.toml", "--store", "a.sqlite")
    log_of_trial(Path("run.mcap"), trial)
    result = invoke("tell", "a.sqlite", "0", "--trajectory", "run.mcap", "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["distance"] == pytest.approx(0, abs=1e-12)


def test_a_log_with_a_gap_is_no_execution(invoke: Any) -> None:
    from rig_logs import run, write_mcap_json

    mapped_experiment()
    asked(invoke, "rig.toml", "--store", "a.sqlite")
    write_mcap_json(Path("run.mcap"), run(20, dt=0.1), lost=(7,))
    result = invoke("tell", "a.sqlite", "0", "--trajectory", "run.mcap")
    assert result.exit_code == 2
    assert_names(" ".join(result.stderr.split()), 2, "split", "run.mcap", 0.6)


def test_logs_of_earlier_runs_are_imported(invoke: Any) -> None:
    mapped_experiment()
    trial = asked(invoke, "rig.toml", "--store", "a.sqlite", "--set", "goal=1.5")
    log_of_trial(Path("run.mcap"), trial)
    Path("runs.csv").write_text("goal,trajectory\n1.5,run.mcap\n")
    result = invoke("import", "a.sqlite", "runs.csv", "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["imported"][0]["distance"] == pytest.approx(0, abs=1e-12)


def test_asking_ends_with_the_verdict(invoke: Any) -> None:
    first = asked(invoke, "my_rig:experiment", "--store", "a.sqlite")
    assert first["trial"] == 0
    record(first["folder"])
    told = invoke("tell", "a.sqlite", "0", "--trajectory", "run.csv", "--json")
    assert told.exit_code == 0, told.stderr
    second = asked(invoke, "a.sqlite", "--budget", "9")
    assert second["trial"] == 1
    assert invoke("tell", "a.sqlite", "1", "--distance", "2.5").exit_code == 0
    ended = invoke("ask", "a.sqlite", "--json")
    report = json.loads(ended.stdout)
    assert (ended.exit_code, report["trial"], report["verdict"]) == (1, None, "falsified")
    shown = invoke("ask", "a.sqlite", "--threshold", "2")
    assert_names(" ".join(shown.stdout.split()), "FALSIFIED", 2, "trial", 1)
    assert len(Store("a.sqlite").trials()) == 2


def test_a_budget_that_is_spent_opens_no_trial(invoke: Any) -> None:
    asked(invoke, "my_rig:experiment", "--store", "a.sqlite", "--budget", "1")
    assert invoke("tell", "a.sqlite", "0", "--distance", "0.5").exit_code == 0
    ended = invoke("ask", "a.sqlite", "--budget", "1", "--json")
    assert (ended.exit_code, json.loads(ended.stdout)["verdict"]) == (0, "undecided")
