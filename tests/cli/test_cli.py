from __future__ import annotations

import importlib
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

import pytest
import typer
from typer.testing import CliRunner, Result

from conftest import make_validation
from ctxval import Campaign, Store, TaskSpace, Validation, __version__, searches
from ctxval.cli import app
from ctxval.cli.commands import MODULES, PANELS, TEXTS
from ctxval.cli.config.trust import allow
from facts import assert_names
from rig_thorough import more

EXPERIMENT = """
import sys
from conftest import make_validation
from ctxval import Experiment
from ctxval.core import truth
from faulty_rig import FaultyRig

validation = make_validation()

def without_a_seed():
    return make_validation()

def experiment(seed=0, horizon=25):
    made = make_validation(horizon=horizon)
    return Experiment("short", made, budget=6, truth=lambda: truth.grid_truth(made, 101), units="rad")

def slow(seed):
    raise KeyboardInterrupt

def crashing(seed):
    return {}["nothing"]

def faulty(*executions):
    return make_validation(FaultyRig(validation.system, dict.fromkeys(executions, "raise")))

def sometimes(seed):
    return Experiment("sometimes", faulty(1))

def never(seed):
    return Experiment("never", faulty(0, 1))

leaving = lambda seed: sys.exit(0)
broken = make_validation(model=lambda x, u: x * float("nan"))
number = 3
"""


@pytest.fixture
def invoke(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    """Run the command line in an empty folder with one module in it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1]))
    (tmp_path / "rig.py").write_text(EXPERIMENT)
    sys.modules.pop("rig", None)

    def run(*arguments: str) -> Result:
        return CliRunner().invoke(app, quick(*arguments))

    return run


def quick(*arguments: str) -> list[str]:
    """Add the paper's search and no report to what names none: what is tested here depends on neither."""
    if arguments[:1] != ("run",):
        return [*arguments]
    named = "--search" in arguments or any(a.endswith(".toml") for a in arguments)
    reported = "--report" in arguments or "--no-report" in arguments
    return [*arguments, *(() if named else ("--search", "gp-ucb")), *(() if reported else ("--no-report",))]


@pytest.mark.slow
def test_the_default_search_learns_from_trajectories(invoke) -> None:  # type: ignore[no-untyped-def]
    result = CliRunner().invoke(app, ["run", "rig:experiment", "--explore", "--budget", "3", "--no-report", "--json"])
    report = json.loads(result.stdout)
    assert (report["search"], report["store"]) == ("auto", "runs/short-auto-seed0.sqlite")
    assert Store(Path(report["store"])).trials()[-1].note.to_json()["engine"] == "climb"


@pytest.mark.slow
def test_json_is_one_object_with_everything_asked_for(invoke) -> None:  # type: ignore[no-untyped-def]
    asked = (
        "--budget",
        "8",
        "--seed",
        "3",
        "--threshold",
        "9",
        "--resolution",
        "1",
        "--tests",
        "0",
        "--report",
        "--json",
    )
    result = invoke("run", "rig:experiment", *asked)
    report = json.loads(result.stdout)
    assert result.exit_code == 0
    assert report["case"] == "short"
    assert (report["search"], report["seed"], report["budget"], report["executions"]) == ("gp-ucb", 3, 8, 8)
    assert report["failed"] == 0
    assert list(report["worst"]["task"]) == ["goal"]
    assert (report["verdict"], report["threshold"]) == ("validated", 9.0)
    assert report["certificate"]["kind"] == "posterior"
    assert report["worst"]["distance"] <= report["certificate"]["upper_bound"] <= 9.0
    assert report["store"] == "runs/short-gp-ucb-seed3.sqlite"
    assert Path(report["report"]).stat().st_size > 1000


@pytest.mark.slow
def test_running_again_resumes(invoke) -> None:  # type: ignore[no-untyped-def]
    first = json.loads(invoke("run", "rig:experiment", "--budget", "5", "--json").stdout)
    again = json.loads(invoke("run", "rig:experiment", "--budget", "5", "--json").stdout)
    assert first == again
    assert json.loads(invoke("run", "rig:experiment", "--budget", "7", "--json").stdout)["executions"] == 7


def test_a_falsified_model_exits_with_1(invoke) -> None:  # type: ignore[no-untyped-def]
    result = invoke("run", "rig:experiment", "--threshold", "0.001", "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["verdict"] == "falsified"
    text = " ".join(invoke("run", "rig:without_a_seed", "--threshold", "0.001").stdout.split())
    assert_names(text, "without_a_seed")


def test_the_human_report_names_the_worst_task_and_the_verdict(invoke) -> None:  # type: ignore[no-untyped-def]
    result = invoke("run", "rig:validation", "--budget", "6", "--threshold", "5", "--resolution", "1", "--tests", "0")
    assert result.exit_code == 0
    assert "goal =" in result.stdout
    assert re.search(r"^VALIDATED: .* 5\.$", result.stdout, re.MULTILINE)
    assert "(posterior, 95 %)" in result.stdout


@pytest.mark.parametrize("search", ["random", "sampling-discarding"])
def test_the_random_baselines_run(invoke, search: str) -> None:  # type: ignore[no-untyped-def]
    report = json.loads(invoke("run", "rig:experiment", "--search", search, "--budget", "7", "--json").stdout)
    assert report["search"] == search
    assert (report["estimate"] == report["worst"]["distance"]) == (search == "random")


def test_an_experiment_file_runs_and_the_command_line_wins(invoke) -> None:  # type: ignore[no-untyped-def]
    Path("e.toml").write_text(
        'experiment = "rig:experiment"\nbudget = 9\nseed = 2\nstore = "x.sqlite"\n'
        '[options]\nhorizon = 20\n[search]\ntype = "gp-ucb"\nbeta = 3.0\n'
    )
    report = json.loads(invoke("run", "e.toml", "--budget", "6", "--json").stdout)
    assert (report["executions"], report["seed"], report["store"]) == (6, 2, "x.sqlite")
    assert report["options"] == {"horizon": 20}


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        (["run", "pendulm"], ("pendulum",)),
        (["run", "rig:experiment", "--search", "gpucb"], ("gp-ucb",)),
        (["run", "rig:experiment", "--budget", "0"], ("budget",)),
        (["run", "rig:experiment", "--threshold", "nan"], ("threshold",)),
        (["run", "rig:experiment", "--threshold", "-1"], ("threshold",)),
        (["run", "rig:experiment", "--seed", "-1"], ("seed",)),
        (["run", "rig:nothing"], ()),
        (["run", "nowhere:nothing"], ()),
        (["run", "rig:number"], ()),
        (["run", "rig:experiment", "--option", "dim=3"], ("seed",)),
        (["run", "pendulum", "--option", "dim=3"], ("option", "pendulum", "dim")),
        (["run", "rig:crashing"], ("rig", "crashing", "KeyError")),
        (["run", "none.toml"], ("none.toml",)),
        (["run", "rig:experiment", "--store", "/proc/none/x.sqlite"], ("store",)),
        (["run", "rig:experiment", "--store", "rig.py"], ("store",)),
        (["status", "none.sqlite"], ()),
    ],
)
def test_bad_input_is_one_sentence_and_exit_status_2(invoke, arguments: list[str], facts: tuple[object, ...]) -> None:  # type: ignore[no-untyped-def]
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert_names(result.stderr.replace("\n", " "), *facts)
    assert "Traceback" not in result.stderr
    assert result.stdout == ""


@pytest.mark.parametrize(
    ("arguments", "status"),
    [
        (["run", "rig:crashing"], 2),
        (["run", "rig:slow"], 130),
        (["check", "none.toml"], 2),
        (["status", "none.sqlite"], 2),
        (["tell", "none.sqlite", "0", "--distance", "1"], 2),
    ],
)
def test_an_error_is_a_json_object_if_the_result_is(invoke, arguments: list[str], status: int) -> None:  # type: ignore[no-untyped-def]
    result = invoke(*arguments, "--json")
    assert result.exit_code == status
    (sentence,) = json.loads(result.stdout).values()
    assert list(json.loads(result.stdout)) == ["error"]
    assert sentence in result.stderr


def test_an_unusable_option_is_not_blamed_on_the_file(invoke) -> None:  # type: ignore[no-untyped-def]
    Path("e.toml").write_text('experiment = "rig:experiment"\nthreshold = 3.0\n')
    result = invoke("run", "e.toml", "--threshold", "-1")
    assert result.exit_code == 2
    assert_names(result.stderr, "--threshold", -1.0)
    assert_names(invoke("run", "e.toml", "--budget", "0").stderr, "--budget", 0)
    Path("e.toml").write_text('experiment = "rig:experiment"\nthreshold = -3.0\n')
    assert_names(invoke("run", "e.toml").stderr, "e.toml", "threshold", -3.0)


@pytest.mark.thorough
def test_certify_says_that_the_campaign_was_decided_otherwise(invoke) -> None:  # type: ignore[no-untyped-def]
    invoke("run", "rig:experiment", "--store", "a.sqlite", "--threshold", "9", "--budget", "4")
    facts = ("certify", "a.sqlite", "--kind")
    assert_names(" ".join(invoke("certify", "a.sqlite").stdout.split()), *facts)
    assert "--kind auto" not in invoke("certify", "a.sqlite", "--kind", "posterior").stdout


def test_an_example_is_written_to_a_new_folder(invoke) -> None:  # type: ignore[no-untyped-def]
    assert invoke("init", "new/cart.toml").exit_code == 0
    assert sorted(path.name for path in Path("new").iterdir()) == ["cart.toml", "cart_system.py"]


@pytest.mark.parametrize(
    ("toml", "facts"),
    [
        ('experiment = "pendulum"\nbudgit = 3', ("budgit",)),
        ('experiment = "pendulum"\nbudget = "many"', ("budget",)),
        ("budget = 3", ("experiment",)),
        ("not toml at all", ()),
        ('experiment = "pendulum"\noptions = 3', ()),
        ('experiment = "pendulum"\nsearch = 3', ("search",)),
        ('experiment = "pendulum"\n[search]\ntype = "gp-ucb"\nbetta = 1', ("betta",)),
    ],
)
def test_bad_experiment_files_are_named_with_what_is_wrong(invoke, toml: str, facts: tuple[object, ...]) -> None:  # type: ignore[no-untyped-def]
    Path("e.toml").write_text(toml)
    result = invoke("run", "e.toml")
    assert result.exit_code == 2
    assert_names(result.stderr.replace("\n", " "), *facts)


def test_a_store_of_another_seed_is_refused_and_kept(invoke) -> None:  # type: ignore[no-untyped-def]
    invoke("run", "rig:experiment", "--store", "a.sqlite", "--budget", "5", "--json")
    result = invoke("run", "rig:experiment", "--store", "a.sqlite", "--seed", "4")
    assert result.exit_code == 2
    assert_names(result.stderr, 0, 4)
    assert json.loads(invoke("status", "a.sqlite", "--json").stdout)["executions"] == 5


def test_a_campaign_that_cannot_go_on_exits_with_3(invoke) -> None:  # type: ignore[no-untyped-def]
    result = invoke("run", "rig:broken")
    assert result.exit_code == 3


def test_an_interrupt_says_how_to_go_on(invoke) -> None:  # type: ignore[no-untyped-def]
    result = invoke("run", "rig:slow")
    assert result.exit_code == 130


@pytest.mark.thorough
def test_a_confidence_that_no_bound_can_have_does_not_lose_the_report(invoke) -> None:  # type: ignore[no-untyped-def]
    given = ("--budget", "4", "--threshold", "9", "--confidence", "0.9999999", "--report", "--json")
    result = invoke("run", "rig:experiment", *given)
    report = json.loads(result.stdout)
    assert (result.exit_code, report["executions"], report["verdict"]) == (0, 4, "undecided")


@pytest.mark.thorough
def test_a_campaign_stops_as_soon_as_its_verdict_is_reached(invoke) -> None:  # type: ignore[no-untyped-def]
    given = ("run", "rig:experiment", "--budget", "30", "--decide", "--tests", "0", "--no-report", "--json")
    validated = json.loads(invoke(*given, "--threshold", "9").stdout)
    assert validated["verdict"] == "validated"
    assert 4 <= validated["executions"] < 22
    falsified = invoke(*given, "--threshold", "0.001", "--seed", "1")
    assert falsified.exit_code == 1
    assert json.loads(falsified.stdout)["executions"] == 1


# Certificates of what is stored


def stored(folder: Path, *arguments: str) -> Path:
    """Return the store of a campaign that was run in a folder."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        result = CliRunner().invoke(app, quick("run", *arguments, "--json"))
        assert result.exit_code in (0, 1), result.stderr
        return folder / json.loads(result.stdout)["store"]
    finally:
        os.chdir(before)


class Stores(dict[str, Path]):
    """Stores of campaigns of two cases, searched and drawn; those of a case are run when one is needed first."""

    linear = ("linear", "--option", "dim=1", "--seed", "1")
    pendulum = ("pendulum", "--threshold", "1e-9")  # which the first execution decides: its verdict is not looked at
    commands: ClassVar = {
        "pendulum": (*pendulum, "--budget", "12"),
        "linear": (*linear, "--budget", "12"),
        "pendulum drawn": (*pendulum, "--budget", "12", "--search", "random"),
        "linear drawn": (*linear, "--budget", "20", "--search", "random"),
    }

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __missing__(self, name: str) -> Path:
        case = name.removesuffix(" drawn")
        for each in (case, f"{case} drawn"):
            self[each] = stored(self.folder, *self.commands[each])
        return self[name]

    def __getitem__(self, name: str) -> Path:
        path = super().__getitem__(name)
        allow(Store(path).settings())  # also for the user of this test
        return path


@pytest.fixture(scope="session")
def campaigns(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return Stores(tmp_path_factory.mktemp("campaigns"))


KINDS = {
    "posterior": ("--resolution", "1"),
    "scenario": (),
    "sampling-discarding": ("--discard", "2"),
    "audit": (),
}


def of_kind(campaigns: dict[str, Path], case: str, kind: str) -> list[str]:
    drawn = kind in ("scenario", "sampling-discarding", "audit")
    return ["certify", str(campaigns[f"{case} drawn" if drawn else case]), "--kind", kind, *KINDS[kind]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "kind"), [*(("linear", kind) for kind in KINDS), *more(*(("pendulum", kind) for kind in KINDS))]
)
def test_every_kind_certifies_stored_campaigns(invoke, campaigns: dict[str, Path], case: str, kind: str) -> None:  # type: ignore[no-untyped-def]
    volume = () if kind == "posterior" else ("--volume", "0.5")
    result = invoke(*of_kind(campaigns, case, kind), *volume, "--threshold", "90", "--confidence", "0.9", "--json")
    assert result.exit_code == 0, result.stderr
    report = json.loads(result.stdout)
    assert (report["kind"], report["confidence"], report["verdict"]) == (kind, 0.9, "validated")
    assert report["rests_on"]
    assert 0 < report["upper_bound"] <= 90
    assert report["assumptions"]
    assert report["trials"] >= 12
    assert (report["volume"] == 0) == (kind == "posterior")


def test_the_version_is_printed(invoke) -> None:  # type: ignore[no-untyped-def]
    result = invoke("--version")
    assert (result.exit_code, result.stdout) == (0, f"ctxval {__version__}\n")


@pytest.mark.parametrize("kind", list(KINDS))
def test_every_kind_speaks_to_people(invoke, campaigns: dict[str, Path], kind: str) -> None:  # type: ignore[no-untyped-def]
    result = invoke(*of_kind(campaigns, "linear", kind))
    assert result.exit_code == 0
    text = " ".join(result.stdout.split())
    assert text.startswith(f"{kind}: With ")
    assert "verdict" not in text
    assert f"version {__version__}" in text
    assert_names(text, 1)


def test_what_was_executed_falsifies_without_any_certificate(invoke, campaigns: dict[str, Path]) -> None:  # type: ignore[no-untyped-def]
    arguments = ["certify", str(campaigns["linear"]), "--kind", "scenario", "--threshold", "0.001"]
    refused = invoke(*arguments, "--json")
    report = json.loads(refused.stdout)
    assert refused.exit_code == 1
    assert report["verdict"] == "falsified"
    spoken = invoke(*arguments)
    assert spoken.exit_code == 1
    assert "FALSIFIED against 0.001" in spoken.stdout
    assert "no certificate" in spoken.stdout


@pytest.mark.thorough
def test_what_is_undecided_says_how_many_more_executions_would_decide(invoke, campaigns: dict[str, Path]) -> None:  # type: ignore[no-untyped-def]
    plain = json.loads(invoke("certify", str(campaigns["linear"]), "--resolution", "1", "--json").stdout)
    tau = 0.5 * (plain["details"]["best"] + plain["upper_bound"])
    report = json.loads(
        invoke("certify", str(campaigns["linear"]), "--resolution", "1", "--threshold", str(tau), "--json").stdout
    )
    assert report["verdict"] == "undecided"
    assert set(report["expected"]) == {"executions", "validated", "falsified", "fewest"}
    assert "verdict" not in plain


def test_an_audit_executes_what_is_missing_and_is_remembered(invoke, campaigns: dict[str, Path]) -> None:  # type: ignore[no-untyped-def]
    shutil.copy(campaigns["linear"], "a.sqlite")
    arguments = ("certify", "a.sqlite", "--audit", "5", "--threshold", "90", "--volume", "0.5", "--json")
    report = json.loads(invoke(*arguments).stdout)
    assert (report["kind"], report["trials"], report["verdict"]) == ("audit", 5, "validated")
    assert report["volume"] == pytest.approx(1 - 0.05 ** (1 / 5))
    assert json.loads(invoke("status", "a.sqlite", "--json").stdout)["executions"] == 17
    assert json.loads(invoke(*arguments).stdout) == report
    assert json.loads(invoke("status", "a.sqlite", "--json").stdout)["executions"] == 17
    # The campaign goes on with its own search.
    again = invoke(
        "run", "linear", "--option", "dim=1", "--seed", "1", "--store", "a.sqlite", "--budget", "18", "--json"
    )
    assert json.loads(again.stdout)["executions"] == 18


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        (["--kind", "scenaro"], ("scenario",)),
        (["--kind", "scenario"], (12,)),
        (["--kind", "audit"], ("certify", "--audit", "N")),
        (["--kind", "sampling-discarding"], ()),
        (["--threshold", "-1"], ("threshold",)),
        (["--threshold", "nan"], ("threshold",)),
        (["--confidence", "0"], (0.5, 1)),
        (["--confidence", "1.5"], (0.5, 1)),
        (["--volume", "1.5"], ()),
        (["--volume", "nan"], ()),
        (["--audit", "0"], ("draws", 0)),
        (["--audit", "5", "--kind", "scenaro"], ("scenario",)),
        (["--audit", "5", "--confidence", "95"], (0.5, 1)),
        (["--audit", "5", "--kind", "scenario"], ("--kind", "audit")),
        (["--audit", "5", "--kind", "sampling-discarding"], ()),
        (
            ["--discard", "2"],
            ("discard",),
        ),
        (
            ["--kind", "audit", "--resolution", "1"],
            ("resolution", "kind", "audit"),
        ),
        (
            ["--audit", "5", "--resolution", "1"],
            ("resolution", "audit"),
        ),
        (
            ["--volume", "0.1", "--threshold", "9"],
            ("volume", "audit", "scenario"),
        ),
        (["--kind", "audit", "--volume", "0.1"], ("--volume", "--threshold")),
        (["--confidence", "1e-300"], ()),
        (["--confidence", "0.1"], ()),
        (["--audit", "5", "--confidence", "0.1"], ()),
        (["--audit", "5", "--threshold", "9", "--volume", "0.99"], ()),
    ],
)
def test_what_cannot_be_certified_is_one_sentence_and_costs_no_execution(  # type: ignore[no-untyped-def]
    invoke, campaigns: dict[str, Path], arguments: list[str], facts: tuple[object, ...]
) -> None:
    shutil.copy(campaigns["linear"], "a.sqlite")
    result = invoke("certify", "a.sqlite", *arguments)
    assert result.exit_code == 2
    assert_names(result.stderr.replace("\n", " "), *facts)
    assert "Traceback" not in result.stderr
    assert result.stdout == ""
    assert json.loads(invoke("status", "a.sqlite", "--json").stdout)["executions"] == 12


def test_an_audit_that_is_extended_counts_what_was_decided_on_last(invoke, campaigns: dict[str, Path]) -> None:  # type: ignore[no-untyped-def]
    shutil.copy(campaigns["linear"], "a.sqlite")
    assert json.loads(invoke("certify", "a.sqlite", "--audit", "5", "--json").stdout)["trials"] == 5
    extended = json.loads(invoke("certify", "a.sqlite", "--audit", "9", "--json").stdout)
    assert (extended["trials"], extended["details"]["not_counted"]) == (4, 5)
    assert_names(extended["assumptions"], 5)
    said = json.loads(invoke("certify", "a.sqlite", "--audit", "9", "--threshold", "90", "--json").stdout)["reason"]
    assert_names(said, 5)


@pytest.mark.slow
def test_draws_that_ended_with_the_verdict_have_no_number_chosen_beforehand(invoke) -> None:  # type: ignore[no-untyped-def]
    arguments = ("run", "rig:experiment", "--search", "random", "--store", "a.sqlite")
    invoke(*arguments, "--threshold", "90", "--resolution", "1", "--tests", "0", "--decide", "--budget", "4")
    for kind, facts in (("scenario", ()), ("audit", ())):
        result = invoke("certify", "a.sqlite", "--kind", kind)
        assert result.exit_code == 2
        assert_names(result.stderr, *facts)


@pytest.mark.slow
def test_a_scenario_bound_of_a_budget_that_was_raised_is_refused(invoke) -> None:  # type: ignore[no-untyped-def]
    for budget in ("6", "9"):
        invoke("run", "rig:experiment", "--search", "random", "--store", "a.sqlite", "--budget", budget)
    refused = invoke("certify", "a.sqlite", "--kind", "scenario")
    assert_names(refused.stderr, 6, 9)
    assert json.loads(invoke("certify", "a.sqlite", "--kind", "audit", "--json").stdout)["trials"] == 3


@pytest.mark.slow
@pytest.mark.thorough
def test_a_run_names_what_its_verdict_rests_on_and_the_other_campaigns(invoke) -> None:  # type: ignore[no-untyped-def]
    invoke("run", "rig:experiment", "--budget", "7")  # each later execution needs a bound
    arguments = ("run", "rig:experiment", "--budget", "12", "--threshold", "90", "--resolution", "0.6", "--tests", "0")
    arguments += ("--decide",)
    alone = invoke(*arguments)
    text = " ".join(alone.stdout.split())
    assert "VALIDATED against 90" in text
    assert_names(text, 3.6, 100)
    assert "other store" not in text
    other = invoke("run", "rig:experiment", "--budget", "1", "--threshold", "90", "--seed", "1")
    assert_names(other.stdout, 1, "gp-ucb-seed0.sqlite")
    report = json.loads(invoke(*arguments, "--json").stdout)
    assert report["other_stores"] == ["runs/short-gp-ucb-seed1.sqlite"]
    assert report["rests_on"]


@pytest.mark.slow
@pytest.mark.thorough
def test_a_certificate_tells_its_resolution_in_the_units_of_the_stored_task_space(invoke) -> None:  # type: ignore[no-untyped-def]
    space = TaskSpace(goal=(-3.0, 3.0, "rad"), load=([0.0, 0.0], [1.0, 2.0], "kg"))
    validation = make_validation()
    wider = Validation(
        space=space,
        task=validation.task,
        system=validation.system,
        model=validation.model,
        synthesizer=validation.synthesizer,
        distance=validation.distance,
    )
    campaign = Campaign(wider, search=searches.Random(), store="own.sqlite").run(6)
    for goal, load in itertools.product((-3.0, 3.0), ([0.0, 0.0], [0.0, 2.0], [1.0, 0.0], [1.0, 2.0])):
        opened = campaign.ask({"goal": goal, "load": load})
        campaign.tell(opened, wider.execute(opened.plan))
    result = invoke("certify", "own.sqlite", "--threshold", "1e6", "--resolution", "0.5766")
    text = " ".join(result.stdout.split())
    assert_names(text, 6, "rad", "goal", 1)


@pytest.mark.parametrize("value", ["0.1", "0.4999"])
def test_a_run_with_a_confidence_worse_than_a_coin_is_refused(invoke, value: str) -> None:  # type: ignore[no-untyped-def]
    result = invoke("run", "rig:experiment", "--threshold", "9", "--confidence", value)
    assert result.exit_code == 2
    assert_names(result.stderr.replace("\n", " "), "--confidence", 0.5, value)
    assert not Path("runs").exists()


def test_an_audit_waits_for_what_people_are_executing(invoke, campaigns: dict[str, Path]) -> None:  # type: ignore[no-untyped-def]
    shutil.copy(campaigns["linear"], "a.sqlite")
    assert invoke("ask", "a.sqlite").exit_code == 0
    result = invoke("certify", "a.sqlite", "--audit", "3")
    assert result.exit_code == 2
    assert_names(result.stderr.replace("\n", " "), 12)
    assert json.loads(invoke("status", "a.sqlite", "--json").stdout)["executions"] == 12


@pytest.mark.slow
@pytest.mark.thorough
def test_a_store_that_no_command_made_cannot_be_audited_but_certified(invoke) -> None:  # type: ignore[no-untyped-def]
    Campaign(make_validation(), store="own.sqlite").run(6, explore=True)
    result = invoke("certify", "own.sqlite", "--audit", "3")
    assert result.exit_code == 2
    assert_names(result.stderr.replace("\n", " "), "store")
    assert invoke("certify", "own.sqlite").exit_code == 0
    assert_names(invoke("certify", "none.sqlite").stderr, "store")


def test_status_speaks_to_people(invoke) -> None:  # type: ignore[no-untyped-def]
    invoke("run", "rig:experiment", "--store", "a.sqlite", "--json")
    assert "executions  6" in invoke("status", "a.sqlite").stdout


@pytest.mark.slow
def test_a_store_is_certified_against_the_threshold_of_its_file(invoke) -> None:  # type: ignore[no-untyped-def]
    settings = 'budget = 5\nthreshold = 0.01\nexplore = true\nsearch = { type = "gp-ucb" }'
    Path("e.toml").write_text(f'experiment = "rig:experiment"\nstore = "e.sqlite"\n{settings}')
    assert invoke("run", "e.toml").exit_code == 1
    result = invoke("certify", "e.sqlite", "--json")
    assert result.exit_code == 1
    report = json.loads(result.stdout)
    assert (report["verdict"], report["threshold"]) == ("falsified", 0.01)
    assert json.loads(invoke("certify", "e.sqlite", "--threshold", "90", "--json").stdout)["threshold"] == 90


@pytest.mark.slow
def test_why_executions_failed_is_said(invoke) -> None:  # type: ignore[no-untyped-def]
    assert invoke("run", "rig:sometimes", "--budget", "4", "--store", "a.sqlite").exit_code == 0
    for command in (["status", "a.sqlite"], ["run", "rig:sometimes", "--budget", "4", "--store", "a.sqlite"]):
        assert "RuntimeError" in invoke(*command).stderr
        report = json.loads(invoke(*command, "--json").stdout)
        assert [failure["trials"] for failure in report["failures"]] == [[1]]
        assert report["failed"] == 1


def test_a_run_without_any_distance_is_an_error(invoke) -> None:  # type: ignore[no-untyped-def]
    result = invoke("run", "rig:never", "--budget", "2", "--store", "a.sqlite")
    assert result.exit_code == 3
    assert_names(result.stderr, 2)
    assert "2 trials failed" in result.stderr
    assert "RuntimeError" in result.stderr


def test_what_is_no_store_is_not_exported(invoke) -> None:  # type: ignore[no-untyped-def]
    Path("e.toml").write_text('experiment = "pendulum"')
    result = invoke("export", "e.toml")
    assert result.exit_code == 2
    assert_names(result.stderr, "e.toml")
    assert not Path("e.export").exists()


@pytest.mark.slow
@pytest.mark.thorough
def test_a_reader_that_goes_away_is_no_error(tmp_path: Path) -> None:
    command = f"{sys.executable} -c 'from ctxval.cli import main; main()' cases --help | head -c 1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, cwd=tmp_path)
    assert "error" not in done.stderr


def every_command() -> dict[str, Any]:
    """Return the commands with their options, from their modules."""
    for module in MODULES.values():
        importlib.import_module(module)
    return dict(typer.main.get_group(app).commands)


def test_every_command_is_in_the_module_that_the_texts_name() -> None:
    commands = every_command()
    assert list(commands) == list(MODULES)
    assert len(app.registered_commands) == len(MODULES)
    for name, module in MODULES.items():
        assert commands[name].callback.__module__ == module


def test_every_text_of_an_option_is_shown() -> None:
    shown = {name: {each.name for each in command.params} for name, command in every_command().items()}
    for command, texts in TEXTS.items():
        if command not in ("groups", "leading", "hidden"):
            named = set().union(*shown.values()) if command == "options" else shown[command]
            assert set(texts) <= named, command


def test_few_options_lead_the_help_of_a_command_with_many(invoke) -> None:  # type: ignore[no-untyped-def]
    for name, command in every_command().items():
        options = [each for each in command.params if each.param_type_name == "option" and each.name != "help"]
        leading = [each for each in options if each.rich_help_panel is None]
        assert len(leading) <= 10, name
        assert name not in TEXTS["leading"] or {each.name for each in leading} == {*TEXTS["leading"][name]}
    text = invoke("certify", "--help").stdout
    assert text.index("--kind") < text.index("─ Advanced ─") < text.index("--resolution")


def test_every_command_has_an_example() -> None:
    pages = (Path(__file__).parents[2] / "docs").rglob("*.md")
    examples = "".join(page.read_text() for page in pages if page.stem != "command-line")
    for command in MODULES:
        assert f"ctxval {command}" in examples


def test_user_code_that_leaves_python_is_not_taken_for_done(invoke) -> None:  # type: ignore[no-untyped-def]
    assert invoke("run", "rig:leaving").exit_code == 2


def test_the_help_lists_the_usual_commands_in_groups_and_names_the_glossary(invoke) -> None:  # type: ignore[no-untyped-def]
    text = invoke("--help").stdout
    listed = {name for name in MODULES if re.search(rf"^│ {name} +[A-Z]", text, re.MULTILINE)}
    assert listed == {*MODULES} - {"remeasure", "certify"}
    places = [text.index(f"─ {panel} ─") for panel in PANELS]
    assert places == sorted(places)
    assert "docs/glossary.md" in text


def test_every_help_text_is_a_sentence() -> None:
    for name, command in every_command().items():
        texts = [command.help, *(parameter.help for parameter in command.params if parameter.name != "help")]
        for text in texts:
            assert text, name
            assert text[0].isupper(), text
            assert text.endswith("."), text
            assert not re.search(r"\[[a-z#/@]", text.replace("position[", "")), (
                f"rich would take this for markup: {text}"
            )


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.parametrize(("reader", "status"), [*more(("ended", 141)), ("full disk", 2)])
def test_an_error_that_cannot_be_written_as_json_keeps_its_exit_status(
    tmp_path: Path, reader: str, status: int
) -> None:
    if reader == "full disk" and not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full here")
    if reader == "ended":
        ours, theirs = os.pipe()
        os.close(ours)
    else:
        theirs = os.open("/dev/full", os.O_WRONLY)
    command = [sys.executable, "-m", "ctxval", "status", "none.sqlite", "--json"]
    done = subprocess.run(command, stdout=theirs, stderr=subprocess.PIPE, text=True, cwd=tmp_path, check=False)
    os.close(theirs)
    assert done.returncode == status
    assert_names(done.stderr, "none.sqlite")
