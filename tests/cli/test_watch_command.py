"""``ctxval watch``, as users call it."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from ctxval import Campaign, Experiment, Trajectory
from ctxval._util.arrays import Array
from ctxval.campaign.storage.store import Store
from ctxval.core.task import Task
from ctxval.core.validation import Validation
from facts import assert_names
from rig_cli import Invoke, calling, report

MODULE = '''
"""A cart with a drag that its model does not contain."""

import numpy as np

from ctxval import Experiment, Task, TaskSpace, Validation, controllers, distances, models, systems


def experiment(seed=0, mass=1.0):
    def step(x, u):
        force = u[..., 0] - 0.4 * x[..., 1] - 0.2 * x[..., 1] * np.abs(x[..., 1])
        return x + 0.1 * np.stack([x[..., 1], force / mass], axis=-1)

    validation = Validation(
        space=TaskSpace(goal=(-2.0, 2.0, "m")),
        task=lambda p: Task(np.stack([0 * p.goal, 0 * p.goal], axis=-1), goal=[p.goal, 0.0], horizon=20, dt=0.1),
        system=systems.Simulated(step, vectorized=True),
        model=models.Linear([[1.0, 0.1], [0.0, 0.97]], [[0.0], [0.1]]),
        synthesizer=controllers.LQR([1.0, 0.1], [0.1]),
        distance=distances.MaximumDeviation(components=(0,)),
    )
    return Experiment("cart", validation, threshold=0.5, units="m", states=["position", "speed"], inputs=["force"])
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return a folder with a store of six executions, and recordings of a heavier cart and of an unchanged one."""
    folder = tmp_path_factory.mktemp("watched")
    (folder / "watched_cart.py").write_text(MODULE)
    sys.path.insert(0, str(folder))
    make = importlib.import_module("watched_cart").experiment
    plain = make()
    campaign = Campaign(plain.validation, store=folder / "cart.sqlite", seed=0, name="cart")
    for goal in (-1.9, -1.2, -0.5, 0.4, 1.1, 1.9):
        campaign.add({"goal": goal}, execute(plain.validation, goal))
    for name, mass, goals in (("same", 1.0, (-1.5, 0.8, 1.4)), ("heavier", 1.1, (1.7, -1.6, 1.3))):
        rows = ["goal [m],trajectory,failed"]
        for k, goal in enumerate(goals):
            write(folder / f"{name}{k}.csv", execute(make(mass=mass).validation, goal))
            rows.append(f"{goal},{name}{k}.csv,")
        (folder / f"{name}.csv").write_text("\n".join([*rows, "1.0,,motor stalled"]))
    yield folder
    sys.path.remove(str(folder))
    del sys.modules["watched_cart"]


def execute(validation: Validation, goal: float) -> Trajectory:
    return validation.execute(validation.plan(validation.space.point({"goal": goal})))


def write(path: Path, trajectory: Trajectory) -> None:
    trajectory.to_csv(path, states=["position", "speed"], inputs=["force"])


@pytest.fixture
def invoke(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Invoke:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "160")
    return calling("watch", "cart.sqlite", "--experiment", "watched_cart:experiment")


@pytest.mark.slow
def test_a_table_of_runs_is_judged_and_nothing_is_stored(folder: Path, invoke: Invoke) -> None:
    before = Store.existing(folder / "cart.sqlite").digest()
    holds = report(invoke("same.csv", "--json"))
    assert [each["run"] for each in holds["runs"]] == [f"same.csv, line {line}" for line in (2, 3, 4)]
    assert holds["skipped"] == [{"run": "same.csv, line 5", "reason": "motor stalled"}]
    assert (holds["watch"]["expired"], holds["again"]) == (False, [])
    expired = invoke("heavier.csv", "same.csv")
    assert expired.exit_code == 1
    assert "EXPIRED: " in expired.stdout
    assert_names(expired.stdout, "run", 1)
    assert_names(expired.stdout, "cart.sqlite", "--again")
    assert_names(" ".join(expired.stderr.split()), "line", 5)
    assert_names(expired.stdout, 2, 8, "runs")
    assert Store.existing(folder / "cart.sqlite").digest() == before


@pytest.mark.slow
def test_a_recording_that_is_given_twice_counts_once(folder: Path, invoke: Invoke) -> None:
    once = report(invoke("same0.csv", "same1.csv", "--json"))
    (folder / "copy.csv").write_bytes((folder / "same0.csv").read_bytes())
    twice = report(invoke("same0.csv", "same1.csv", "copy.csv", "same1.csv", "--json"))
    assert once["watch"] == twice["watch"]
    assert (len(twice["runs"]), len(twice["counted_before"]), once["counted_before"]) == (2, 2, [])


@pytest.mark.slow
@pytest.mark.thorough
def test_a_system_that_is_executed_is_validated_anew_in_another_store(folder: Path, invoke: Invoke) -> None:
    """`ctxval ask` would open a trial that only people execute."""
    from watched_cart import experiment  # type: ignore[import-not-found]

    validation: Validation = experiment().validation
    Campaign(validation, store=folder / "ran.sqlite", seed=0, name="cart").run(6)
    watch = calling("watch", "ran.sqlite", "--experiment", "watched_cart:experiment")
    expired = watch("heavier.csv")
    assert expired.exit_code == 1, expired.stderr
    assert_names(expired.stdout, "run", "watched_cart", "experiment", "--threshold")
    watch("same0.csv", "--set", "goal=-1.5", "--resample")


@pytest.mark.slow
@pytest.mark.thorough
def test_the_next_command_has_the_options_of_the_campaign(folder: Path, invoke: Invoke) -> None:
    run = calling("run", "watched_cart:experiment")
    made = run("--option", "mass=1.05", "--seed", "3", "--explore", "--budget", "6", "--store", "option.sqlite")
    assert made.exit_code in (0, 1), made.stderr
    expired = calling("watch", "option.sqlite")("heavier.csv", "--threshold", "0.25")
    assert expired.exit_code == 1, expired.stderr
    options = "--seed 3 --budget 6 --threshold 0.25 --explore --option mass=1.05"
    assert_names(expired.stdout, "run", "watched_cart", "--store", "option.changed.sqlite", options)


@pytest.mark.slow
@pytest.mark.thorough
def test_a_trajectory_with_its_task_and_recordings_without(folder: Path, invoke: Invoke) -> None:
    one = report(invoke("same0.csv", "--set", "goal=-1.5", "--json"))
    names = [each["name"] for each in one["watch"]["channels"] if each["later"] != [None]]
    assert any("distance" in name for name in names)
    result = invoke("heavier0.csv", "heavier1.csv", "heavier2.csv", "--json")
    assert result.exit_code == 1
    without = json.loads(result.stdout)
    of_distance = without["watch"]["channels"][-1]
    assert of_distance["later"] == [None] * 3


@pytest.mark.slow
def test_a_long_recording_is_judged_in_parts_as_long_as_a_task(folder: Path, invoke: Invoke) -> None:
    from watched_cart import experiment  # type: ignore[import-not-found]

    wide: Experiment = experiment()
    runs = [execute(wide.validation, goal) for goal in (1.5,)]
    task = Task([0.0, 0.0], goal=[1.0, 0.0], horizon=45, dt=0.1)
    controller = wide.validation.synthesizer.design(task, wide.validation.model)
    write(folder / "long.csv", wide.validation.system.execute(controller, task))
    write(folder / "short.csv", _cut(runs[0], 8))
    found = report(invoke("long.csv", "short.csv", "--json"))
    assert [each["run"] for each in found["runs"]] == ["long.csv, part 1", "long.csv, part 2"]
    (skipped,) = found["skipped"]
    assert skipped["run"] == "short.csv"
    assert_names(skipped["reason"], 8, 20)


def _cut(run: Trajectory, steps: int) -> Trajectory:
    kept: Sequence[Array] = (run.times[: steps + 1], run.states[: steps + 1], run.inputs[:steps])
    return Trajectory(*kept)


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        (["nowhere.csv"], ("nowhere.csv",)),
        (["same0.csv", "same1.csv", "--set", "goal=1"], ("--set", 2)),
        (["same0.csv", "--set", "goal=9"], ("goal",)),
        (["same0.csv", "--false-alarms", "1"], ("--false-alarms", 1, 0.001)),
        (["same0.csv", "--threshold", "-1"], ("threshold",)),
    ],
)
def test_bad_input_is_one_sentence(invoke: Invoke, arguments: list[str], facts: tuple[object, ...]) -> None:
    result = invoke(*arguments)
    assert result.exit_code == 2, result.output
    assert_names(" ".join(result.stderr.split()), *facts)
    assert "Traceback" not in result.output


def test_a_store_without_enough_executions(folder: Path, invoke: Invoke) -> None:
    from watched_cart import experiment

    store = folder / "few.sqlite"
    if not store.exists():
        validation = experiment().validation
        few = Campaign(validation, store=store, seed=0, name="cart")
        few.add({"goal": 1.0}, execute(validation, 1.0))
    result = calling("watch", "few.sqlite", "--experiment", "watched_cart:experiment")("same0.csv")
    assert result.exit_code == 2
    assert_names(" ".join(result.stderr.split()), "watch", 3)
