"""What the documents tell a reader to do works."""

from __future__ import annotations

import csv
import re
import tomllib
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from conftest import evidence_on, make_validation
from ctxval import Campaign, refine, searches, systems
from ctxval.certificates import (
    KINDS,
    AnytimeAudit,
    Audit,
    CheckedPrediction,
    DistanceBound,
    Evidence,
    Sample,
    StateInputCoverage,
    StateInputGap,
    WholeSuite,
    certify_dynamics,
    draw_maxima,
)
from ctxval.certificates.expiry import WatchedChannel, WatchState
from ctxval.cli.config.settings import ExperimentSettings
from ctxval.core.learned_numbers import Statistic
from ctxval.core.trial import Origin, State
from ctxval.data import Break, LogMapping, MemoryTable, recordings_of
from ctxval.learning import ExecutionPrediction
from ctxval.models import Linear
from ctxval.studies.causes import find_causes
from ctxval.studies.fitting import FittedParameter, fit
from ctxval.studies.refinement import HeldOut, measure_residual
from ctxval.studies.replay import PredictedTask, PredictedTasks, Suggestion, replay
from ctxval.studies.safety import DrawnTasks, SafetyReport, UnsafeTask
from ctxval.testing import check_search
from page_blocks import WRITTEN
from rig_logs import run

ROOT = Path(__file__).parents[1]
GLOSSARY = ROOT / "docs" / "tables" / "words.csv"


def block(document: str, language: str, holding: str) -> str:
    blocks = re.findall(rf"```{language}\n(.*?)```", (ROOT / document).read_text(), re.DOTALL)
    return next(code for code in blocks if holding in code)


@pytest.mark.slow
def test_the_python_of_the_readme_runs_in_ten_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code = block("README.md", "python", "Campaign")
    exec(code, {})
    assert capsys.readouterr().out.startswith("validated")
    assert len([line for line in code.splitlines() if line]) == 10


def test_the_settings_of_a_named_experiment_are_valid() -> None:
    page = "docs/how-to/experiment-file.md"
    settings = ExperimentSettings.model_validate(tomllib.loads(block(page, "toml", 'experiment = "pendulum"')))
    assert settings.search.build().thinking == "balanced"  # type: ignore[attr-defined]


def test_the_search_of_the_contributing_guide_conforms() -> None:
    names: dict[str, object] = {}
    exec(block("CONTRIBUTING.md", "python", "class Halving"), names)
    check_search(names["Halving"]())  # type: ignore[operator]


@pytest.mark.parametrize(
    "document",
    ["README.md", "CONTRIBUTING.md"]
    + [f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")) if path.name not in WRITTEN],
)
def test_links_lead_somewhere(document: str) -> None:
    path = ROOT / document
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", path.read_text()):
        assert (path.parent / target).exists(), target


def words() -> list[str]:
    """Return the keys that the glossary explains."""
    return re.findall(r"`([^`]+)`", GLOSSARY.read_text(encoding="utf-8"))


def keys(report: Any) -> set[str]:
    """Return the keys of a report, at every depth."""
    if isinstance(report, list):
        return set().union(*map(keys, report))
    if not isinstance(report, dict):
        return set()
    return set(report).union(*(keys(value) for value in report.values()))


def evidence() -> Evidence:
    gap = StateInputGap(0.01, ("x[0]",), {"x[0]": 0.0, "u[0]": 1.0})
    coverage = StateInputCoverage(gap, gap, gap, gap.place, np.zeros(1), 9)
    checked = tuple(CheckedPrediction(k, 0.5, 2.0, 2.1, 2.0) for k in range(3))
    return Evidence(np.linspace(2, 3, 40), np.zeros((40, 1)), 2.5, np.zeros((2, 1)), 99, 8, 0, 0, checked, coverage)


def test_the_glossary_explains_what_certificates_and_trials_say() -> None:
    points = np.linspace(0.05, 0.95, 8)[:, None]
    origins: list[Origin] = ["iid"] * 4 + ["acquisition"] * 4
    sample = Sample(points, np.sin(5 * points[:, 0]) + 2, origins, ["completed"] * 8, learned=evidence_on(1))
    certificates = [
        Audit().certify(sample),
        AnytimeAudit().certify(replace(sample, threshold=3.0)),
        certify_dynamics(sample, evidence()),
        WholeSuite().certify(replace(sample, suite=points)),
        DistanceBound().certify_drawn(sample, draw_maxima(sample, draws=4, paths=2), 0.5),
    ]
    used = set().union(*(keys(certificate.to_json()) for certificate in certificates))
    used |= keys({"prediction": ExecutionPrediction(1, (0.5,), 0.1, (1,), ((0.0,),), ((0.1,),), 0.0).to_json()})
    used |= {*get_args(Origin), *get_args(State), *KINDS, "validated", "falsified", "undecided"}
    explained = words()
    explained += re.findall(r"^\| `([^`]+)` \|", (ROOT / "docs" / "parts.md").read_text(), re.MULTILINE)  # added kinds
    assert used <= set(explained)


def test_the_glossary_explains_what_replay_and_fit_say() -> None:
    runs = [run(40, seed) for seed in range(3)]
    logs = [MemoryTable(str(k), {"t": one.times, "x": one.states, "u": one.inputs}) for k, one in enumerate(runs)]
    recordings = recordings_of(logs, LogMapping.from_table({"states": {"x": "x"}, "inputs": {"u": "u"}}))
    report = replay(Linear([[1, 0.05], [0, 1]], [[0], [0.05]]), recordings)
    task = PredictedTask({}, 0.5, 0.4, 0.6, 0.9)
    tasks = PredictedTasks((task,), 0.5, 0.6, (task,), 64, 0.0, 0.1, 0)
    suggestion, gap = Suggestion("delay", 0.1, 0.5, "later"), Break("a.csv", 0.5, 0.1, "x0", "has no value")
    report = replace(report, tasks=tasks, suggestions=(suggestion,), data=replace(report.data, breaks=(gap,)))
    learned = fit(recordings, ["linear"])
    parameter = FittedParameter("mass", 1.0, 0.9, 1.1)
    learned = replace(learned, fitted=(replace(learned.fitted[0], parameters=(parameter,)),))
    used = keys(report.to_json()) | keys(learned.to_json())
    names = {*recordings.states, *recordings.inputs}
    explained = words()
    assert used - names <= set(explained)


def test_the_glossary_explains_what_refine_says() -> None:
    held = HeldOut(*(np.ones((60, 3)), *[np.full((60, 2), 0.1)] * 5))
    residual = measure_residual(held, {"x": "m", "v": "m/s"}, {"u": "N"})
    found = replace(
        refine(Campaign(make_validation()).run(1), 1e-9, 1),
        residual=residual,
        accuracy={"x": (0.1, 0.2)},
        parameters=(FittedParameter("mass", 1.0, 0.9, 1.1),),
    )
    explained = words()
    assert keys(found.to_json()) - {"x", "v", "u", "goal"} <= set(explained)


def test_the_glossary_explains_what_a_watch_says() -> None:
    channel = WatchedChannel("rate residuals", (1.0, 1.1, 0.9), 4.0, np.eye(2))
    state = WatchState(0.5, 1e-3, (channel,))
    state = state.after("a.csv", {"rate residuals": Statistic(1.0, np.zeros(2), np.eye(2))})
    explained = words()
    said = {"watch", "skipped", "again", "statistic", "evidence", "ratio", "run", "task"}
    assert keys(state.to_json()) | said <= set(explained)


def test_the_glossary_explains_what_is_said_of_safety() -> None:
    said = {field.name for of in (SafetyReport, UnsafeTask, DrawnTasks) for field in fields(of)}
    explained = words()
    assert (said | {"avoid", "reach", "drawn", "store"}) - {"tightened"} <= set(explained)


def test_the_glossary_explains_what_why_says() -> None:
    model = make_validation().model
    shifted = make_validation(systems.Simulated(lambda x, u: model.step(x, u + 0.3), vectorized=True), model)
    said = keys(find_causes(Campaign(shifted, search=searches.by_name("random")).run(2), most=1).to_json())
    explained = words()
    assert said - {"goal"} | {"store", "task", "gap", "other"} <= set(explained)


def test_the_glossary_is_in_alphabetical_order() -> None:
    with GLOSSARY.open(encoding="utf-8") as file:
        terms = [row["word"].replace("`", "").lower() for row in csv.DictReader(file)]
    assert len(terms) > 100
    assert terms == sorted(terms)


def test_the_glossary_explains_no_word_that_the_source_does_not_have() -> None:
    source = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "src").rglob("*.py"))
    names = {name for name in words() if re.fullmatch(r"[a-z][a-z_0-9]*", name)}
    assert {name for name in names if not re.search(rf"\b{name}\b", source)} == set()


def test_no_page_has_the_name_of_one_that_the_manual_makes_itself() -> None:
    assert not {path.stem for path in (ROOT / "docs").glob("*.md")} & {"search", "genindex", "py-modindex"}


NEEDS = (
    "Few executions suffice if the dynamics depend on the task only through parameters that you state, or not at all. "
    "Noise, late commands and unrecorded states need more executions and widen the bound"
)


@pytest.mark.parametrize(
    "page",
    [
        *("README.md", "docs/index.md", "docs/theory.md", "docs/explanation/auto.md", "docs/how-to/decide.md"),
        "docs/tutorials/gymnasium-and-network.md",
    ],
)
def test_pages_that_promise_few_executions_say_what_they_need(page: str) -> None:
    assert NEEDS in " ".join((ROOT / page).read_text().split())
