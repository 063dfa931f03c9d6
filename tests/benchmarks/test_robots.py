"""Models on real robots: two motions and two repeats are read, and the page is that of the stored results."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from ctxval import Campaign, Task, TaskSuite, Validation, distances, load_experiment, searches, systems
from ctxval.core.controller import started
from ctxval.models import read_model
from rig_cli import calling
from shared_data import shared_data

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from robots import cards, double_pendulum, page, so101


@pytest.fixture(scope="module")
def two_motions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with links to two motions of the arm."""
    folder = tmp_path_factory.mktemp("so101")
    for name in ("multisine", "slow_precision"):
        (folder / f"{name}.npz").symlink_to(shared_data("so101") / f"{name}.npz")
    return folder


def test_the_page_and_its_cards_are_those_of_the_stored_results() -> None:
    assert page.page().outdated() == [], "run `make robots`."
    assert json.loads(page.CARDS.read_text()) == json.loads(json.dumps([card.to_json() for card in cards.all_cards()]))


def test_rates_of_the_arm_are_differences_of_its_angles(two_motions: Path) -> None:
    motions = so101.recordings(two_motions)
    assert set(motions) == {"multisine", "slow_precision"}
    for run in motions.values():
        steps = so101.DT * run.states[1:, 6:]
        assert np.allclose(np.diff(run.states[:, :6], axis=0), steps, rtol=0, atol=1e-9)
        assert np.array_equal(run.inputs[1:, 6:], run.inputs[:-1, :6])


def test_a_linear_model_of_one_motion_is_validated_on_the_other(two_motions: Path) -> None:
    model = so101.linear([so101.recordings(two_motions)["multisine"]])
    validation = so101.validation(two_motions, model, ["multisine", "slow_precision"])
    distances = validation.distances(validation.space.grid(2))
    assert 0.005 < distances.min() < distances.max() < 0.5
    # The model of one joint is a part of that of all.
    alone = so101.linear([so101.recordings(two_motions)["multisine"]], joint=2)
    assert np.allclose(alone.A, model.A[np.ix_([2, 8], [2, 8])])
    verdict = Campaign(validation).run(2, 1.1 * distances.max()).verdict(1.1 * distances.max())
    assert verdict.answer == "validated"


def test_the_physical_arm_is_fitted_to_free_runs(two_motions: Path) -> None:
    runs = list(so101.recordings(two_motions).values())
    arm = so101.physical(runs, steps=300)

    def errors(model: so101.Arm) -> float:
        x, left = runs[0].states[0], []
        for t in range(300):
            x = model.step(x, runs[0].inputs[t])
            left.append(x[:5] - runs[0].states[t + 1, :5])
        return float(np.abs(left).max())

    start = so101.Arm(*(np.full(6, value) for value in (20.0, 2.0, 0.3, 0.0)))
    assert errors(arm) < 0.5 * errors(start)


def test_dry_friction_holds_the_arm() -> None:
    arm = so101.Arm(np.full(6, 20.0), np.full(6, 2.0), np.full(6, 5.0), np.zeros(6))
    x = np.concatenate([np.full(6, 0.1), np.zeros(6)])
    assert np.array_equal(arm.step(x, np.full(12, 0.11)), x)
    assert arm.step(x, np.full(12, 1.0))[0] > x[0]


def test_the_frictionless_double_pendulum_keeps_its_energy() -> None:
    model = double_pendulum.FRICTIONLESS
    (m1, m2), (r1, r2), l1 = model.mass, model.centre, model.length

    def height(x: np.ndarray) -> float:
        upper = m1 * r1 + m2 * l1
        return float(-9.81 * (upper * np.cos(x[0]) + m2 * r2 * np.cos(x[0] + x[1])))

    x = np.array([1.0, -0.5, 0.0, 0.0])
    begun, states = height(x), [x]
    for _ in range(2000):
        states.append(model.step(states[-1], np.zeros(2)))
    turning = min(states[200:], key=lambda each: float(np.abs(each[2:]).max()))
    # Where it nearly stops, all energy is that of height.
    assert height(turning) <= begun + 1e-3
    assert max(map(height, states)) == pytest.approx(begun, abs=1e-6)


def test_two_repeats_against_the_published_models() -> None:
    folder = shared_data("double_pendulum")
    repeats = dict(list(double_pendulum.runs(folder, double_pendulum.UNDISTURBED, 0.5).items())[:2])
    for run in repeats.values():
        controller = started(double_pendulum.controller(folder), Task(run.states[0], horizon=200, dt=0.0025))
        torques = np.stack([controller(t, run.states[t]) for t in range(run.horizon)])
        assert np.abs(torques - run.inputs).mean() < 0.1
    for model, answer in (("1.0", "validated"), ("3.0", "falsified")):
        whole = double_pendulum.validation(folder, double_pendulum.PUBLISHED[model], 0.5)
        suite = TaskSuite({name: {"number": number} for number, name in enumerate(repeats)})
        campaign = Campaign(whole.with_parts(space=suite)).run(2, 0.1)
        assert campaign.verdict(0.1).answer == answer


def saved(path: Path, fields: dict[str, np.ndarray], seconds: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **{name: values[fields["t"] <= seconds] for name, values in fields.items()})


def as_hints_say(file: Path, folder: Path) -> None:
    """Edit the experiment file of ``ctxval start``: its recordings are the system, the tasks and the controllers."""
    lines, kept = file.read_text().splitlines(), True
    text = []
    for line in lines:
        if line.startswith("["):
            kept = line not in ("[space]", "[task]", "[synthesizer]", "[system]")
        table = line.removeprefix("# ")
        if line != table and table.split(" = ")[0] in ("[system]", "type", "runs", "mapping"):
            text.append(table.replace("FOLDER", str(folder)))
        elif kept and not line.startswith("#"):
            text.append(line)
    parts = [f'{name} = {{ type = "recorded" }}' for name in ("task", "synthesizer")]
    first = next(k for k, line in enumerate(text) if line.startswith("["))
    file.write_text("\n".join([*text[:first], *parts, *text[first:]]))


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["so101", "double_pendulum"])
@pytest.mark.usefixtures("without_costs")
def test_python_and_files_of_start_conclude_the_same(robot: str, tmp_path: Path) -> None:
    data, logs = shared_data(robot), tmp_path / "logs"
    if robot == "so101":
        for name in ("multisine", "slow_precision"):
            file = np.load(data / f"{name}.npz")
            saved(logs / f"{name}.npz", {field: file[field] for field in ("t", "command", "position")}, 8.0)
    else:
        for condition in (double_pendulum.UNDISTURBED, double_pendulum.PERTURBED):
            file = np.load(data / f"{condition}.npz")
            for k in ("00", "01"):
                fields = {name: file[f"{name}_{k}"] for name in ("t", "position", "velocity", "torque_command")}
                saved(logs / condition / f"repeat{k}.npz", fields, 0.4)
    started_with = calling()("start", *map(str, sorted(logs.rglob("*.npz"))), "--out", str(tmp_path / "start"))
    assert started_with.exit_code == 0, started_with.output
    as_hints_say(tmp_path / "start" / "experiment.toml", logs)
    of_file = load_experiment(tmp_path / "start" / "experiment.toml").validation

    recorded = systems.Recorded(logs, tmp_path / "start" / "mapping.toml")
    of_python = Validation(
        space=TaskSuite(recorded.names, repeats=recorded.repeats),
        task=recorded.task,
        system=recorded,
        model=read_model(tmp_path / "start" / "model.npz"),
        synthesizer=recorded,
        distance=distances.MaximumDeviation(components=(0,)),
        start_tolerance=of_file.start_tolerance,
    )
    assert recorded.repeats == (1 if robot == "so101" else 2)
    found = []
    for validation in (of_file, of_python):
        campaign = Campaign(validation, search=searches.by_name("random"), seed=0).run(4, 1e3)
        largest = max(trial.distance or 0.0 for trial in campaign.trials)
        answers = [campaign.verdict(share * largest).answer for share in (0.9, 1.1)]
        found.append(([(trial.parameters, trial.distance) for trial in campaign.trials], answers))
    assert found[0] == found[1]
    # Two repeats of a task show nothing of 90 % of its executions.
    assert found[0][1] == (["falsified", "validated"] if robot == "so101" else ["undecided", "undecided"])
