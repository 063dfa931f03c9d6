"""``ctxval start``: from logs to a first statement and files to edit."""

from __future__ import annotations

import csv
import tomllib
from pathlib import Path

import numpy as np
import pytest

from ctxval import load_experiment
from ctxval.data import LogMapping, read_recordings
from ctxval.models import read_model
from facts import assert_names
from rig_cli import calling, report
from rig_logs import run, write_mat, write_parquet

pytestmark = pytest.mark.slow

OBSERVER = """
import numpy as np

def estimate(y, u, dt):
    return 2 * np.hstack([y, np.gradient(y, dt, axis=0)])
"""


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    (tmp_path / "logs").mkdir()
    for seed in range(4):
        write_parquet(tmp_path / "logs" / f"run{seed}.parquet", run(100, seed))
    return tmp_path / "logs"


@pytest.mark.usefixtures("without_costs")
def test_logs_lead_to_a_statement_and_to_files_that_work(logs: Path, tmp_path: Path) -> None:
    out, call = tmp_path / "start", calling()
    done = call("start", str(logs), "--out", str(out))
    assert done.exit_code == 0, done.output
    text = " ".join(done.output.split())
    assert_names(text, 10)
    mapping = LogMapping.from_toml(out / "mapping.toml")
    assert list(read_recordings([logs], mapping).states) == ["position", "speed"]
    assert read_model(out / "model.npz").step([[0.0, 1.0]], [[0.0]]).shape == (1, 2)
    plan = load_experiment(out / "experiment.toml").validation.plan([0.5])
    assert plan.model_trajectory.finite
    assert call("check", str(out / "experiment.toml")).exit_code == 0
    assert call("fit", str(logs), "--mapping", str(out / "mapping.toml")).exit_code == 0


def test_the_answer_is_also_json_and_files_of_others_are_kept(logs: Path, tmp_path: Path) -> None:
    out, call = tmp_path / "start", calling()
    found = report(call("start", str(logs), "--out", str(out), "--json"))
    assert found["states"] == {"position": "", "speed": ""}
    assert found["close"] == found["compared"] > 10
    assert {Path(name).name for name in found["files"]} >= {"mapping.toml", "experiment.toml"}
    (out / "mapping.toml").write_text("mine = true\n")
    refused = call("start", str(logs), "--out", str(out))
    assert refused.exit_code == 2
    assert (out / "mapping.toml").read_text() == "mine = true\n"
    assert call("start", str(logs), "--out", str(out), "--force").exit_code == 0


@pytest.mark.parametrize(
    "name", ['position"\n[system]\ntype = "evil:Rig"\n[x]\n"', "position 😀", "\x1b[31mposition", "\u200fposition"]
)
def test_names_of_fields_are_data_in_every_file(name: str, tmp_path: Path) -> None:
    x, v = 0.0, 0.0
    with (tmp_path / "log.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["t", name, "speed", "force"])
        for t in range(400):
            u = float(np.sign(np.sin(0.07 * t)) + 0.3 * np.sin(0.31 * t))
            rows.writerow([t / 100, x, v, u])
            x, v = x + 0.01 * v, v + 0.01 * (u - 0.4 * v)
    call, out = calling(), tmp_path / "start"
    stated = ("--state", f"first={name}", "--state", "speed", "--input", "force", "--time", "t")
    line = ("start", str(tmp_path / "log.csv"), "--out", str(out))
    for more in ((), stated):
        done = call(*line, *more, "--force")
        if done.exit_code:
            assert "Traceback" not in done.output
            continue
        content = tomllib.loads((out / "experiment.toml").read_text("utf-8"))
        assert content["system"]["type"] == "Manual"
        assert set(content) <= {
            *("name", "budget", "units", "space", "task", "system", "model", "synthesizer", "distance", "states"),
            "inputs",
        }
        assert tomllib.loads((out / "mapping.toml").read_text("utf-8"))["states"]
        load_experiment(out / "experiment.toml")
        assert "\x1b" not in done.output
    assert done.exit_code == 0
    assert call(*line, *stated).exit_code == 0  # its own files, which nobody has changed
    before = (out / "experiment.toml").read_text("utf-8").replace("budget = 20", "budget = 9")
    (out / "experiment.toml").write_text(before, "utf-8")
    refused = call(*line, *stated)
    assert refused.exit_code == 2
    assert "was edited" in " ".join(refused.output.split())
    assert (out / "experiment.toml").read_text("utf-8") == before


def test_fields_that_are_stated_are_taken(tmp_path: Path) -> None:
    write_mat(tmp_path / "run.mat", run(100), version="5")
    call, out = calling(), str(tmp_path / "start")
    stated = ("--state", "x=log.state[1]", "--input", "f=force", "--time", "log.time")
    found = report(call("start", str(tmp_path / "run.mat"), *stated, "--out", out, "--json"))
    assert (found["states"], found["inputs"], found["guesses"]) == ({"x": ""}, {"f": ""}, [])


def test_without_inputs_there_is_no_experiment(tmp_path: Path) -> None:
    rows = "\n".join(f"{0.1 * k},{0.9**k}" for k in range(60))
    (tmp_path / "run.csv").write_text(f"time,level\n{rows}\n")
    found = report(calling()("start", str(tmp_path / "run.csv"), "--out", str(tmp_path / "start"), "--json"))
    assert not (tmp_path / "start" / "experiment.toml").exists()
    assert found["inputs"] == {}


def test_what_cannot_be_read_is_said_in_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("time,force\n0,1\n1,2\n")
    for name, facts in (("run.csv", ()), ("none.csv", ())):
        refused = calling()("start", str(tmp_path / name), "--out", str(tmp_path / "start"))
        assert refused.exit_code == 2
        assert_names(" ".join(refused.stderr.split()), *facts)
    assert not list((tmp_path / "start").glob("*"))


@pytest.mark.thorough
def test_an_observer_is_loaded_from_the_folder_of_its_mapping(logs: Path, tmp_path: Path) -> None:
    (tmp_path / "apart").mkdir()
    (tmp_path / "apart" / "an_observer.py").write_text(OBSERVER)
    mapping = tmp_path / "apart" / "mapping.toml"
    observer = '[observer]\nfunction = { ref = "an_observer:estimate" }\nstates = { twice = "m", rate = "m/s" }\n'
    mapping.write_text(f'[states]\nposition = "position"\n[inputs]\nforce = "force"\n{observer}')
    call = calling()
    found = report(call("fit", str(logs), "--mapping", str(mapping), "--json"))
    assert_names(str(found), "an_observer")
    out = tmp_path / "apart" / "start"
    started = report(call("start", str(logs), "--mapping", str(mapping), "--out", str(out), "--json"))
    assert started["states"] == {"twice": "m", "rate": "m/s"}
    written = LogMapping.from_toml(out / "mapping.toml")
    assert written.observer == LogMapping.from_toml(mapping).observer
    mapping.write_text(mapping.read_text().replace(":estimate", ":missing"))
    refused = call("fit", str(logs), "--mapping", str(mapping))
    assert refused.exit_code == 2
    assert_names(" ".join(refused.output.split()), "an_observer")
