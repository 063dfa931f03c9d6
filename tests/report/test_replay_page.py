"""The page of ``ctxval replay``: complete, harmless, quiet and accessible."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rig_pages import HOSTILE

from browser import accessibility_findings
from ctxval.data import LogMapping, recordings_of
from ctxval.data.log import MemoryTable
from ctxval.data.sampling import Break
from ctxval.errors import InputError
from ctxval.models import Linear
from ctxval.report.replay_page import replay_page, write_replay_page
from ctxval.studies.replay import PredictedTask, PredictedTasks, ReplayReport, replay
from facts import assert_names, refuses
from rig_logs import run
from rig_thorough import more

LARGEST = 300_000
"""Bytes of a page; it does not grow with the recordings."""


@functools.cache
def report(seeds: int = 3, steps: int = 60) -> ReplayReport:
    logs = [
        MemoryTable(f"run{seed}.csv", {"t": one.times, "x": one.states, "u": one.inputs})
        for seed, one in enumerate(run(steps, seed) for seed in range(seeds))
    ]
    table = {"states": {"position": "x[0]", "speed": {"path": "x[1]", "unit": "m/s"}}, "inputs": {"force": "u"}}
    return replay(Linear([[1, 0.05], [0, 1]], [[0], [0.05]]), recordings_of(logs, LogMapping.from_table(table)))


def with_tasks(one: ReplayReport, name: str = "goal") -> ReplayReport:
    tasks = [PredictedTask({name: 0.5 * k}, 0.5 - 0.1 * k, 0.4 - 0.1 * k, 0.7, 0.5 + 0.1 * k) for k in range(3)]
    worst = tuple(replace(task, resolved=None) for task in tasks)
    return replace(one, tasks=PredictedTasks(worst, 0.5, 0.6, tuple(tasks), 64, 0.25, 0.1, 0))


def test_every_part_of_a_replay_is_on_the_page() -> None:
    found = with_tasks(report())
    found = replace(found, data=replace(found.data, breaks=(Break("run0.csv", 0.5, 0.1, "x0", "has no value"),)))
    page = replay_page(found, name="model.npz", units="m")
    assert_names(page, "model.npz")
    for sentence in found.insights:
        assert sentence[1:60].replace("'", "&#39;") in page
    headings = ["What follows", "Error of the prediction", "Where the error is large", "What a better model could"]
    for heading in [*headings, "Tasks", "Recordings"]:
        assert heading in page
    assert "speed [m/s]" in page
    assert "goal = 0.5" in page
    assert_names(page, 25)
    assert "1 split" in page
    assert page.count("<svg") > 5


def test_the_error_table_has_the_numbers_of_the_report() -> None:
    found = report()
    page = replay_page(found)
    for one in found.errors:
        assert f"{one.rms:.4g}".replace("-", "\u2212") in page


def test_a_page_without_an_experiment_has_no_tasks() -> None:
    page = replay_page(report())
    assert ">Tasks<" not in page


def test_a_replay_without_results_has_a_page_too() -> None:
    empty = replace(report(), errors=(), regions=(), residuals=(), suggestions=(), insights=())
    replay_page(empty)


def test_numbers_that_are_not_finite_have_a_page() -> None:
    found = report()
    odd = replace(found.errors[0], rms=np.inf, change=0.0, highest=np.nan, diverged=1.0)
    assert_names(replay_page(replace(found, errors=(odd, *found.errors[1:]))), "change")


def test_texts_of_others_stay_texts() -> None:
    found = with_tasks(report(), HOSTILE)
    data = replace(found.data, sources=(HOSTILE,) * 30, notes=(HOSTILE,), states={HOSTILE: HOSTILE, "b": ""})
    errors = tuple(replace(one, state=HOSTILE, unit=HOSTILE) for one in found.errors)
    page = replay_page(replace(found, data=data, errors=errors, insights=(HOSTILE,)), name=HOSTILE, units=HOSTILE)
    assert "<img" not in page
    assert page.count("<script>") == 1
    assert_names(page, 10, "--json")


def test_a_page_is_written_where_it_is_asked_for_and_never_over_a_store(tmp_path: Path) -> None:
    path = write_replay_page(report(), tmp_path / "new" / "page.html")
    assert path.read_text().startswith("<!DOCTYPE html>")
    store = tmp_path / "store.sqlite"
    store.write_bytes(b"SQLite format 3\x00 and more")
    with refuses(InputError, "store.sqlite"):
        write_replay_page(report(), store)
    with refuses(InputError, "page.html"):
        write_replay_page(report(), path / "below" / "page.html")


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.parametrize("scheme", ["light", *more("dark")])
def test_a_page_is_quiet_small_and_accessible(browser: Any, tmp_path: Path, scheme: Any) -> None:
    path = write_replay_page(with_tasks(report(12, 400)), tmp_path / "page.html", name="arm", units="m")
    assert path.stat().st_size < LARGEST
    context = browser.new_context(color_scheme=scheme, viewport={"width": 390, "height": 800})
    page, said, asked = context.new_page(), list[str](), list[str]()
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(path.as_uri())
    page.eval_on_selector_all("details", "all => all.forEach(one => one.open = true)")
    assert said == []
    assert [url for url in asked if not url.startswith("data:")] == [path.as_uri()]
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")  # only tables scroll
    assert accessibility_findings(page) == []
    context.close()
