"""``pytest --ctxval``: outcomes of tests, stores that the next run continues, and what a failure prints."""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from ctxval import Store

ROBOT = """
import numpy as np

from ctxval import Task, TaskSpace, Validation, controllers, distances, models, systems

A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]])


def validation(gain=1.0, error=0.0, fails=False):
    def plant(x, u):
        if fails:
            raise RuntimeError("motor off")
        return A @ x + (1 + error) * (B @ u)

    return Validation(
        space=TaskSpace(goal=(0.5, 2.0, "m")),
        task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=12, dt=0.1),
        system=systems.Simulated(plant),
        model=models.Linear(A, B),
        synthesizer=controllers.LQR([gain, 1], [1]),
        distance=distances.FinalState(components=[0]),
    )
"""


@pytest.fixture
def nightly(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> Callable[..., pytest.RunResult]:
    """Run one test of a given body with the plugin, in a folder that keeps its cache."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(pytester.path / "summary.md"))
    # Of a process of its own, because pytester unloads modules that cannot be loaded twice.
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parents[1]), *sys.path]))

    def run(body: str, *options: str) -> pytest.RunResult:
        pytester.makepyfile(
            robot=ROBOT, test_robot=f"from robot import validation\n\ndef test_it(nightly):\n    {body}"
        )
        return pytester.runpytest_subprocess(
            "-p", "small_ctxval", "-p", "ctxval.pytest_plugin", "-W", "ignore", *options
        )

    return run


def trials(run: Path, name: str = "campaign") -> int:
    store = Store.existing(run / ".pytest_cache/d/ctxval/test_robot.py-test_it" / f"{name}.sqlite")
    return len(store.trials())


@pytest.mark.slow
def test_without_the_option_nothing_is_executed(nightly: Callable[..., pytest.RunResult]) -> None:
    nightly("nightly.validate(validation(fails=True), 0.1)").assert_outcomes(skipped=1)


@pytest.mark.slow
def test_a_validated_model_passes_and_is_not_executed_again(
    nightly: Callable[..., pytest.RunResult], pytester: pytest.Pytester
) -> None:
    body = "assert nightly.validate(validation(), 0.1).answer == 'validated'"
    assert nightly(body, "--ctxval").ret == 0
    made = trials(pytester.path)
    again = nightly(body, "--ctxval")
    assert again.ret == 0
    assert trials(pytester.path) == made
    again.stdout.fnmatch_lines(["validated*test_it: * 0 in this run"])


@pytest.mark.slow
def test_a_failure_prints_the_command_that_repeats_the_worst_task(
    nightly: Callable[..., pytest.RunResult], pytester: pytest.Pytester
) -> None:
    body = "nightly.validate(validation(error=0.5), 0.01)"
    failed = nightly(body, "--ctxval")
    assert failed.ret == 1
    command = re.search(r"repeat it +pytest (.*)", failed.stdout.str())
    assert command is not None
    assert (pytester.path / ".pytest_cache/d/ctxval/test_robot.py-test_it/campaign.report.html").is_file()
    summary = (pytester.path / "summary.md").read_text()
    assert "xychart-beta" in summary
    assert command[1] in summary
    nightly(body, *shlex.split(command[1])).assert_outcomes(failed=1)
    nightly(body.replace("0.01", "9"), *shlex.split(command[1])).assert_outcomes(skipped=1)


@pytest.mark.slow
def test_a_budget_for_each_run_is_continued_in_the_next(
    nightly: Callable[..., pytest.RunResult], pytester: pytest.Pytester
) -> None:
    body = "nightly.validate(validation(error=0.1), 0.2, budget=4)"
    options = ["--ctxval", "--ctxval-budget", "2"]
    nightly(body, *options).assert_outcomes(skipped=1)
    assert trials(pytester.path) == 2
    nightly(body, *options, "--ctxval-undecided", "xfail").assert_outcomes(xfailed=1)
    assert trials(pytester.path) == 4
    nightly(body, *options, "--ctxval-undecided", "fail").assert_outcomes(failed=1)
    assert trials(pytester.path) == 4


@pytest.mark.slow
def test_another_controller_begins_anew_beside_the_earlier_store(
    nightly: Callable[..., pytest.RunResult], pytester: pytest.Pytester
) -> None:
    nightly("nightly.validate(validation(error=0.5), 0.01)", "--ctxval").assert_outcomes(failed=1)
    nightly("nightly.validate(validation(gain=5.0, error=0.5), 0.01)", "--ctxval").assert_outcomes(failed=1)
    assert trials(pytester.path, "campaign.1") >= 1


@pytest.mark.slow
def test_executions_that_all_fail_are_a_failure(nightly: Callable[..., pytest.RunResult]) -> None:
    result = nightly("nightly.validate(validation(fails=True), 0.1, budget=2)", "--ctxval")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["failed*test_it: *"])


@pytest.mark.slow
def test_an_experiment_by_name_keeps_its_settings(
    nightly: Callable[..., pytest.RunResult], pytester: pytest.Pytester
) -> None:
    nightly("nightly.validate('robot:validation', 0.1, budget=1)", "--ctxval").assert_outcomes(skipped=1)
    path = pytester.path / ".pytest_cache/d/ctxval/test_robot.py-test_it/campaign.sqlite"
    assert Store.existing(path).settings()["experiment"] == "robot:validation"


@pytest.mark.slow
def test_a_checkpoint_is_compared_with_a_pinned_one(
    nightly: Callable[..., pytest.RunResult], pytester: pytest.Pytester
) -> None:
    body = "nightly.not_worse(validation({}, error=0.3), validation(1.0, error=0.3), budget=60)"
    nightly(body.format("8.0"), "--ctxval").assert_outcomes(failed=1)
    assert trials(pytester.path, "candidate") >= 2
    nightly(body.format("1.0"), "--ctxval").assert_outcomes(passed=1)  # equal ones, within the tolerance
