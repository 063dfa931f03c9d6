"""The page of a report, its twins, and what users add to it."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from rig_pages import HOSTILE, hostile_store, pendulum, plane

from ctxval import Campaign, Trial, report
from ctxval.certificates import CertificateOptions, DistanceBound
from ctxval.errors import InputError
from ctxval.learning.stage_costs import Speed
from ctxval.report import ReportContext, context_of_campaign, context_of_store
from ctxval.report.sections.repeat import command_of, identity, python_snippet
from ctxval.report.sections.trials import packed, recorded_lines
from facts import assert_names, refuses

POSTERIOR = CertificateOptions(DistanceBound())


@pytest.fixture(scope="module")
def swing() -> ReportContext:
    return context_of_campaign(pendulum(), threshold=0.2, certificate=POSTERIOR)


@pytest.fixture(scope="module")
def html(swing: ReportContext) -> str:
    return report.page(swing)


def test_pictures_think_within_their_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = Speed(1.0, 0.1, 0.1, 0.05, 0.05, False, False, 2, 1, 25)
    monkeypatch.setattr(Speed, "measured", classmethod(lambda *_: slow))
    for thinking, corrected in ((0.5, False), (np.inf, True)):
        context = context_of_campaign(pendulum(executions=4), thinking=thinking)
        assert len(context.replays) == 4
        assert {each.corrected is not None for each in context.replays.values()} == {corrected}


def broken(page: str) -> bool:
    """Return whether a part of a page could not be made."""
    return any(text in page for text in ("cannot be shown", "could not be computed"))


def test_the_page_has_all_sections_in_their_order(html: str) -> None:
    titles = re.findall(r"<h2 id=\"heading-\d\"[^>]*>([^<]*)</h2>", html)
    assert [title.split()[0] for title in titles] == [
        *("Verdict", "Assumptions", "Insights", "Distance", "Trials", "Convergence", "To")
    ]
    assert not broken(html)


def test_the_page_opens_no_connection(html: str) -> None:
    assert not re.findall(r'(?:src|href)="(?!#|data:)[^"]*"', html)
    assert "http" not in html.replace("http-equiv", "").replace("http://www.w3.org/2000/svg", "")


def test_the_policy_allows_exactly_the_script_and_the_style_of_the_page(html: str) -> None:
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', html)
    assert policy is not None
    allowed = policy[1].replace("&#39;", "'")
    assert allowed.startswith("default-src 'none'")
    for tag in ("script", "style"):
        content = re.search(rf"<{tag}>(.*?)</{tag}>", html, re.DOTALL)
        assert content is not None
        digest = base64.b64encode(hashlib.sha256(content[1].encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in allowed
    assert not re.search(r"\son\w+=|style=", html)


def test_names_units_threshold_and_verdict_are_on_the_page(html: str) -> None:
    for words in ("angle [rad]", "rate [rad/s]", "torque [N m]", "goal [rad]", "distance [rad]", "threshold 0.2"):
        assert words in html
    assert "</span> Falsified</p>" in html


@pytest.mark.parametrize("dimension", [2, 5])
def test_the_first_screen_is_a_map_of_the_parameters_that_matter(dimension: int) -> None:
    found = report.page(context_of_campaign(plane(dimension)))
    first, _, others = found.partition('id="section-2"')
    assert (first.count('class="map"'), others.count('class="map"')) == (1, 0)
    assert "Sensitivity" in others
    assert not broken(found)


def test_the_next_task_is_marked_on_the_map() -> None:
    campaign = plane(2)
    campaign.ask({"a": 0.5, "b": -0.5})
    assert "<title>next task</title>" in report.page(context_of_campaign(campaign))


def test_a_report_of_nothing_says_so() -> None:
    empty = Campaign(pendulum(executions=1).validation, name="empty")
    found = report.page(context_of_campaign(empty, threshold=0.5))
    assert not broken(found)


@pytest.mark.parametrize("executions", [1, 2])
def test_a_report_of_few_trials_is_whole(executions: int) -> None:
    found = report.page(context_of_campaign(pendulum(executions=executions)))
    assert not broken(found)


def test_all_executions_may_have_failed() -> None:
    campaign = plane(2, 3, {0: "raise", 1: "raise", 2: "raise"})
    found = report.page(context_of_campaign(campaign, threshold=0.5))
    assert not broken(found)
    assert_names(found, 3)


def test_other_campaigns_of_the_experiment_are_named(tmp_path: Path) -> None:
    for name in ("one", "two"):
        context = context_of_campaign(pendulum(tmp_path / f"{name}.sqlite", 2))
    assert_names(report.page(context), 1, "one.sqlite")


# Hostile stores


@pytest.fixture
def hostile(tmp_path: Path) -> ReportContext:
    return context_of_store(hostile_store(tmp_path / "hostile.sqlite"), 1.0, missing=HOSTILE)


def test_a_hostile_store_cannot_script_the_page(hostile: ReportContext) -> None:
    found = report.page(hostile)
    assert found.count("<script") == 2  # the data and the script of the page
    assert "<img" not in found
    assert "onerror=alert(1)>" not in found
    assert not broken(found)
    data = re.search(r'<script type="application/json" id="trial-data">(.*?)</script>', found, re.DOTALL)
    assert data is not None
    assert set(json.loads(data[1])) == {"signals", "trials"}
    assert "<" not in data[1]


def test_a_hostile_store_has_harmless_twins(hostile: ReportContext) -> None:
    ElementTree.fromstring(report.junit(hostile))
    words = report.markdown(hostile)
    assert "<script" not in words.replace("\\<", "")
    assert json.dumps(report.to_json(hostile), allow_nan=False)


def test_a_snippet_of_a_hostile_store_runs_nothing_of_it(hostile: ReportContext) -> None:
    import ast

    for trial in hostile.worst_first:
        tree = ast.parse(python_snippet(hostile, trial))
        called = {
            node.func.id for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        }
        assert called <= {"print", "trusted_settings"}
    assert command_of(hostile).startswith("ctxval run '")


def test_a_store_without_a_task_space_is_refused(tmp_path: Path) -> None:
    from ctxval import Store

    store = Store(tmp_path / "nothing.sqlite")
    store.describe_first({"name": "nothing"})
    with refuses(InputError, "nothing.sqlite"):
        context_of_store(store)


# Data of the page


def test_lines_are_as_exact_as_a_picture_needs() -> None:
    values = np.linspace(-3.0, 5.0, 50) ** 3
    line = packed(values)
    raw = np.frombuffer(base64.b64decode(line["data"]), dtype="<u2")
    np.testing.assert_allclose(line["low"] + line["step"] * raw, values, atol=np.ptp(values) / 60_000)
    assert packed(np.full(4, 2.5)) == {"low": 2.5, "step": 0.0, "n": 4}


def test_too_many_lines_are_left_out_and_the_page_says_so(swing: ReportContext) -> None:
    kept = list(recorded_lines(swing, most=3_000)[0]["trials"])
    assert 0 < len(kept) < len(swing.recordings)
    assert kept == [str(number) for number in swing.recordings][: len(kept)]  # the worst first
    assert len(recorded_lines(swing)[0]["trials"]) == len(swing.recordings)


def test_every_recorded_trial_has_a_button_and_data(html: str, swing: ReportContext) -> None:
    buttons = set(map(int, re.findall(r'data-trial="(\d+)"', html)))
    assert buttons == set(swing.recordings)


# Sections of users


class Weather:
    """A section of a user."""

    title = "Weather <b>"

    def __init__(self, content: Any) -> None:
        self.content = content

    def render(self, context: ReportContext) -> Any:
        return self.content(context)


def test_a_user_adds_a_section(swing: ReportContext) -> None:
    chart = report.Chart("Wind", report.Axis("t [s]", 0, 1), report.Axis("wind [m/s]", 0, 3)).line(
        [0, 1], [1, 2], "mean"
    )
    found = report.page(swing, [Weather(lambda context: chart)])
    assert "Weather &lt;b&gt;" in found
    assert "wind [m/s]" in found


def test_a_plain_text_of_a_section_is_escaped(swing: ReportContext) -> None:
    report.page(swing, [Weather(lambda context: "<script>")])


def test_a_section_that_fails_says_why_and_the_others_are_shown(swing: ReportContext) -> None:
    def fail(context: ReportContext) -> str:
        raise ValueError("no <wind>")

    found = report.page(swing, [Weather(fail)])
    assert_names(found, "ValueError")


def test_what_is_no_section_is_refused(swing: ReportContext) -> None:
    with refuses(InputError, "section"):
        report.page(swing, [object()])  # type: ignore[list-item]


def test_installed_packages_add_sections(swing: ReportContext, monkeypatch: pytest.MonkeyPatch) -> None:
    module = sys.modules[report.page.__module__]
    point = EntryPoint("weather", "test_report_page:Sunny", "ctxval.report_sections")
    monkeypatch.setattr(module, "entry_points", lambda group: [point])
    assert "sunshine" in report.page(swing)
    broken = EntryPoint("broken", "no_such_module:Nothing", "ctxval.report_sections")
    monkeypatch.setattr(module, "entry_points", lambda group: [broken])
    with refuses(InputError, "broken", "no_such_module"):
        report.page(swing)


class Sunny:
    title = "Weather"

    def render(self, context: ReportContext) -> str:
        return "sunshine"


# Twins


def test_the_json_has_everything_that_decides(swing: ReportContext) -> None:
    found = report.to_json(swing)
    assert (found["verdict"], found["threshold"], found["executions"]) == ("falsified", 0.2, 9)
    assert found["worst"][0]["distance"] == pytest.approx(float(swing.distances.max()))
    assert found["insights"]


@pytest.mark.parametrize(("threshold", "tag"), [(0.2, "failure"), (None, "skipped")])
def test_junit_fails_if_m_is_falsified(threshold: float | None, tag: str) -> None:
    context = context_of_campaign(pendulum(), threshold=threshold, certificate=POSTERIOR)
    suite = ElementTree.fromstring(report.junit(context))
    verdict = suite.find("testcase[@name='verdict']")
    assert verdict is not None
    assert verdict.find(tag) is not None
    assert int(suite.attrib["tests"]) == len(suite)
    assert int(suite.attrib["failures"]) == len(suite.findall("testcase/failure"))


def test_markdown_names_the_verdict_and_the_worst_tasks(swing: ReportContext) -> None:
    words = report.markdown(swing)
    assert "**falsified: trial" in words


def test_the_identity_has_digests_of_the_parts(swing: ReportContext) -> None:
    found = identity(swing)
    assert len(found["digest of the system"]) == 64
    assert found["seed"] == "1"


def test_a_report_is_written_in_python(tmp_path: Path) -> None:
    campaign = pendulum(executions=3)
    path = report.write(campaign, tmp_path / "new" / "report.html", threshold=9.0, certificate=POSTERIOR)
    assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    with refuses(InputError, tmp_path):
        report.write(campaign, tmp_path)


def test_the_snippet_executes_the_task_again(tmp_path: Path) -> None:
    campaign = pendulum(tmp_path / "swing.sqlite", 3)
    context = context_of_campaign(campaign)
    trial: Trial = context.worst_first[0]
    code = python_snippet(context, trial).replace("validation = ...", "pass")
    names: dict[str, Any] = {"validation": campaign.validation}
    exec(code, names)
    assert names["outcome"].distance == pytest.approx(trial.distance)


@pytest.mark.thorough
def test_the_report_of_very_many_trials_stays_small(tmp_path: Path) -> None:
    from ctxval import Store
    from ctxval.core.trajectory import Trajectory

    store = Store(tmp_path / "many.sqlite")
    space = {"type": "TaskSpace", "a": [0.0, 1.0], "b": [0.0, 1.0]}
    store.describe_first({"name": "many", "validation": {"space": space}})
    rng = np.random.default_rng(0)
    model = Trajectory(np.arange(201.0), np.zeros((201, 3)), np.zeros((200, 2)))
    new: list[tuple[Trial, Trajectory | None, Trajectory | None]] = []
    for number, point in enumerate(rng.random((1500, 2))):
        named = {"a": float(point[0]), "b": float(point[1])}
        trial = Trial(number, "iid", "completed", point, named, 1, True, float(point.sum()))
        executed = Trajectory(model.times, rng.random((201, 3)), model.inputs)
        new.append((trial, None, None) if number % 5 else (trial, model, executed))
    store.add(new)
    path = report.write_page(context_of_store(store, 1.9, certificate=POSTERIOR), tmp_path / "many.html")
    assert path.stat().st_size < 1_500_000
    assert not broken(path.read_text(encoding="utf-8"))
    assert "left out" in path.read_text(encoding="utf-8")
