"""``ctxval report``, and the report that ``ctxval run`` writes."""

from __future__ import annotations

import json
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from conftest import STATE
from ctxval import Store
from ctxval.report.context import context_of_store
from ctxval.report.sections.repeat import command_of, repeating_command
from facts import assert_names
from rig_cli import calling
from rig_thorough import more

RIG = """
from conftest import make_validation
from ctxval import Experiment, distances

def experiment(seed=0):
    open("imported", "a").close()
    return Experiment(
        "short", make_validation().with_parts(distance=distances.FinalState(weights=[1, 1])),
        budget=4, threshold=9.0, units="rad",
        states=("angle [rad]", "rate [rad/s]"), inputs=("torque [N m]",),
    )
"""

pytestmark = pytest.mark.slow


@pytest.fixture
def invoke(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1]))
    (tmp_path / "short_rig.py").write_text(RIG)
    sys.modules.pop("short_rig", None)

    return calling()


@pytest.fixture
def store(invoke: Any) -> Path:
    done = invoke(
        "run",
        "short_rig:experiment",
        "--search",
        "random",
        "--resolution",
        "1",
        "--tests",
        "0",
        "--store",
        "a.sqlite",
        "--no-report",
    )
    assert done.exit_code == 0, done.output
    assert not Path("a.report.html").exists()
    return Path("a.sqlite")


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--search", "gp-ucb", "--decide", "--threshold", "5", "--confidence", "0.9", "--budget", "6"],
        ["--search", "gp-ucb", "--decide", "--tests", "3", "--budget", "3"],
        ["--search", "gp-ucb", "--resolution", "1", "--budget", "3"],
    ],
    ids=" ".join,
)
@pytest.mark.thorough
def test_the_command_of_a_report_repeats_the_campaign(invoke: Any, options: list[str]) -> None:
    first = ["run", "short_rig:experiment", "--seed", "2", "--no-report", "--json", *options]
    ran = invoke(*first, "--store", "a.sqlite")
    command = shlex.split(repeating_command(context_of_store(Store.existing("a.sqlite"))))
    assert command[0] == "ctxval"
    repeated = invoke(*command[1:], "--no-report", "--json")
    assert json.loads(repeated.stdout) == {**json.loads(ran.stdout), "store": "again/a.sqlite"}
    one, other = (Store.existing(path) for path in ("a.sqlite", "again/a.sqlite"))
    assert [(trial.unit_point.tolist(), trial.origin, trial.distance) for trial in other.trials()] == [
        (trial.unit_point.tolist(), trial.origin, trial.distance) for trial in one.trials()
    ]
    assert command_of(context_of_store(other)) == command_of(context_of_store(one))


def test_the_command_of_a_report_names_the_experiment_file(invoke: Any) -> None:
    Path("rig 3.toml").write_text('experiment = "pendulum"\nthreshold = 0.5\n')
    run = ("run", "rig 3.toml", "--budget", "2", "--search", "random", "--no-report")
    assert invoke(*run, "--store", "a.sqlite").exit_code == 0
    command = shlex.split(command_of(context_of_store(Store.existing("a.sqlite"))))
    assert command[:3] == ["ctxval", "run", "rig 3.toml"]
    assert invoke(*command[1:], "--store", "b.sqlite", "--no-report").exit_code == 0
    assert Store.existing("b.sqlite").trials()[1].distance == Store.existing("a.sqlite").trials()[1].distance


def test_run_writes_a_report_next_to_the_store(invoke: Any) -> None:
    options = ("--search", "gp-ucb", "--threshold", "200", "--resolution", "1", "--tests", "0")
    done = invoke("run", "short_rig:experiment", *options, "--json")
    report = json.loads(done.stdout)
    assert report["report"] == "runs/short-gp-ucb-seed0.report.html"
    page = Path(report["report"]).read_text(encoding="utf-8")
    assert "</span> Validated</p>" in page
    assert "angle [rad]" in page


def test_a_report_that_cannot_be_written_does_not_hide_the_verdict(invoke: Any) -> None:
    Path("b.report.html").mkdir()
    done = invoke(
        "run", "short_rig:experiment", "--search", "random", "--resolution", "1", "--store", "b.sqlite", "--json"
    )
    assert done.exit_code == 0
    assert json.loads(done.stdout)["report"] is None
    assert "no report" in done.stderr


def test_a_store_that_you_made_has_a_report_with_its_experiment(invoke: Any, store: Path) -> None:
    done = invoke("report", str(store), "--junit", "a.xml", "--markdown", "a.md", "--card", "card.md")
    assert done.exit_code == 0, done.output
    assert json.loads(Path("card.json").read_text())["executions"] == 4
    page = Path("a.report.html").read_text(encoding="utf-8")
    assert "corrected model" in page
    assert_names(page, 4)
    verdict = ElementTree.parse("a.xml").getroot().find("testcase[@name='verdict']")
    assert verdict is not None
    assert list(verdict) == []
    assert Path("a.md").exists()


def test_a_store_of_somebody_else_runs_no_code(
    invoke: Any, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("imported").unlink()
    monkeypatch.setenv(STATE, str(tmp_path / "another user"))
    done = invoke("report", str(store), "--threshold", "9", "-o", "other.html")
    assert done.exit_code == 0, done.output
    assert not Path("imported").exists()
    assert Path("other.html").exists()
    done = invoke("report", str(store), "--experiment", "short_rig:experiment", "-o", "named.html")
    assert done.exit_code == 0, done.output
    assert "angle [rad]" in Path("named.html").read_text(encoding="utf-8")


def test_an_experiment_that_is_gone_leaves_the_report_of_the_data(invoke: Any, store: Path) -> None:
    Path("short_rig.py").unlink()
    sys.modules.pop("short_rig", None)
    done = invoke("report", str(store))
    assert done.exit_code == 0, done.output
    assert Path("a.report.html").exists()


def test_the_json_is_one_object_and_a_falsified_model_exits_with_1(invoke: Any, store: Path) -> None:
    done = invoke("report", str(store), "--threshold", "0.001", "--json")
    assert done.exit_code == 1
    found = json.loads(done.stdout)
    assert found["verdict"] == "falsified"
    assert found["files"] == {"report": "a.report.html"}
    assert found["insights"]


def test_a_kind_and_a_confidence_of_ones_own(invoke: Any, store: Path) -> None:
    asked = ("--kind", "posterior", "--confidence", "0.8", "--option", "resolution=0.9", "--json")
    found = json.loads(invoke("report", str(store), *asked).stdout)
    assert (found["certificate"]["kind"], found["certificate"]["confidence"]) == ("posterior", 0.8)
    assert invoke("report", str(store), "--kind", "posterior", "--volume", "0.1").exit_code == 2


def test_nonsense_is_one_sentence(invoke: Any, store: Path) -> None:
    for arguments, facts in (
        (("nothing.sqlite",), ()),
        (("short_rig.py",), ()),
        (("a.sqlite", "-o", "."), ("--out",)),
        (("a.sqlite", "--threshold", "-1"), ()),
        (("a.sqlite", "--trust", "--experiment", "pendulum"), ()),
        (("a.sqlite", "--junit", "a.sqlite/junit.xml"), ()),
    ):
        done = invoke("report", *arguments)
        assert done.exit_code == 2
        assert_names(" ".join(done.stderr.split()), *facts)
        assert "Traceback" not in done.output


def test_a_report_leaves_the_store_as_it_is(invoke: Any, store: Path) -> None:
    kept = shutil.copy(store, "copy.sqlite")
    before = [repr(trial) for trial in Store.existing(kept).trials()]
    assert invoke("report", "copy.sqlite").exit_code == 0
    assert [repr(trial) for trial in Store.existing(kept).trials()] == before


@pytest.mark.parametrize(("option", "suffix"), [("--out", "html"), *more(("--junit", "xml"), ("--markdown", "md"))])
def test_a_report_does_not_replace_a_store(invoke: Any, store: Path, option: str, suffix: str) -> None:
    kept = Path(shutil.copy(store, f"copy.{suffix}"))
    before = kept.read_bytes()
    for forced in ((), ("--force",)):
        done = invoke("report", "a.sqlite", option, str(kept), *forced)
        assert done.exit_code == 2
        assert kept.read_bytes() == before


def test_a_report_replaces_its_own_files_and_no_others(invoke: Any, store: Path) -> None:
    written = ("--out", "a.html", "--junit", "a.xml", "--markdown", "a.md")
    for _ in range(2):
        assert invoke("report", str(store), *written).exit_code == 0
    for option, name in zip(written[::2], written[1::2], strict=True):
        Path(name).write_text("work")
        done = invoke("report", str(store), option, name)
        assert done.exit_code == 2
        assert Path(name).read_text() == "work"
    assert invoke("report", str(store), *written, "--force").exit_code == 0
    assert not [name for name in written[1::2] if Path(name).read_text() == "work"]
    Path("experiment.toml").write_text("name = 'a'")
    for options in (("--out", "experiment.toml"), ("--out", "a.html", "--junit", "a.html")):
        assert invoke("report", str(store), *options, "--force").exit_code == 2
    assert Path("experiment.toml").read_text() == "name = 'a'"


def test_an_export_does_not_replace_the_files_of_others(invoke: Any, store: Path) -> None:
    assert [invoke("export", str(store), "--out", "saved").exit_code for _ in range(2)] == [0, 0]
    Path("mine").mkdir()
    for name in ("trials.csv", "trials.json"):
        Path("mine", name).write_text("mine")
        assert invoke("export", str(store), "--out", "mine").exit_code == 2
        assert Path("mine", name).read_text() == "mine"
    assert invoke("export", str(store), "--out", "mine", "--force").exit_code == 0
