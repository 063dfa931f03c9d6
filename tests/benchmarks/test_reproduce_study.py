from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from ctxval.errors import InputError, UnknownNameError
from facts import assert_names, refuses
from reproduce import QUICK, STUDIES, reproduce, studies_named, table_text
from reproduce.jobs import Job, Results
from reproduce.pendulum import _worst_goal
from reproduce.study import Claim, Scale, agreement, executions_within, running_estimate, spread


def test_the_estimate_of_sc_is_the_largest_and_that_of_sd_the_sixth() -> None:
    distances = [3.0, 1.0, np.nan, 5.0, 2.0, 4.0, 6.0, 0.5]
    np.testing.assert_array_equal(running_estimate(distances, "random"), [3, 3, 3, 5, 5, 5, 6, 6])
    np.testing.assert_array_equal(running_estimate(distances, "sampling-discarding")[-3:], [np.nan, 1, 1])


def test_executions_within_counts_from_one_and_never_is_infinite() -> None:
    assert executions_within([1.0, 9.6, 10.0], "random", 10.0, 5.0) == 2
    assert executions_within([1.0, 9.6, 10.0], "random", 11.0, 5.0) == np.inf


def test_a_median_that_touches_never_is_never() -> None:
    assert spread([1.0, 2.0, np.inf, np.inf]) == (np.inf, 1.0, np.inf)
    assert spread([1.0, 2.0, 3.0, np.inf])[0] == 2.5
    assert spread([1.0, 2.0])[0] == 1.5
    assert spread([7.0, 40.0, 44.0, np.inf])[0] == 42.0


def test_numbers_decide_whether_they_agree_with_a_claim() -> None:
    goals = np.linspace(-np.pi, np.pi, 101)

    def agrees(size: float, place: float) -> str:
        return _worst_goal("", [(goals, size - np.abs(goals - place))] * 3).agrees

    assert [agrees(0.3, 2.0), agrees(0.3, 1.3), agrees(0.9, 2.0), agrees(0.9, 1.3)] == ["yes", "partly", "partly", "no"]
    assert_names(_worst_goal("", [(goals, 0.9 - np.abs(goals - 2))]).remark, "size")
    assert [agreement(True), agreement(False, True), agreement(False)] == ["yes", "partly", "no"]


def test_a_reason_is_given_only_for_a_difference(tmp_path: Path) -> None:
    class Said:
        name, title, case = "said", "Said", "linear"

        def jobs(self, scale: Scale) -> list[Job]:
            return []

        def claims(self, results: Results, scale: Scale) -> list[Claim]:
            return [Claim("a", "1", "yes", "why"), Claim("b", "2", "partly", "because")]

    text = table_text(tmp_path / "paper", [Said()], Results(tmp_path), QUICK)  # type: ignore[list-item]
    assert "| a | 1 | yes |  |" in text
    assert "| b | 2 | partly | because |" in text


def test_there_are_the_papers_eight_figures() -> None:
    assert len(STUDIES) == 8
    assert len({study.name for study in STUDIES}) == 8
    assert studies_named("all") == list(STUDIES)
    with refuses(UnknownNameError, "frameworks"):
        studies_named("framework")


@pytest.mark.thorough
@pytest.mark.slow
def test_a_study_runs_is_drawn_and_enters_the_table_and_a_second_call_reuses_it(tmp_path: Path) -> None:
    started: list[int] = []
    done: list[object] = []
    out, stored = tmp_path / "paper", tmp_path / "runs"
    for _ in range(2):
        table = reproduce(
            "converged-gp", out, stored=stored, scale=QUICK, workers=1, on_start=started.append, on_done=done.append
        )
    assert started == [2, 0]
    assert len(done) == 2
    assert sorted(path.name for path in out.iterdir()) == ["converged-gp.csv", "converged-gp.png", "parameters.csv"]
    assert sorted(path.name for path in stored.iterdir()) == ["profile.jsonl", "search.jsonl"]
    assert (out / "converged-gp.png").stat().st_size > 10_000
    with (out / "converged-gp.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 801
    text = table.read_text()
    assert_names(text, "stored", stored.as_posix())
    assert "95 % band" in text
    assert "pendulum,,torque_weight,0.0001" in (out / "parameters.csv").read_text()
    assert "Dubins" not in text


def test_no_workers_are_refused(tmp_path: Path) -> None:
    with refuses(InputError, 1, "workers"):
        reproduce("converged-gp", tmp_path, workers=0)
