"""``ctxval collect``, as users call it."""

from __future__ import annotations

from pathlib import Path

import pytest

from ctxval import Trajectory
from facts import assert_names
from rig_cli import Invoke, calling, report

OPTIONS = ("--amplitude", "0.5", "--limits", "15")


@pytest.fixture
def invoke(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Invoke:
    monkeypatch.chdir(tmp_path)

    return calling("collect")


def test_executions_are_recorded_and_not_repeated(invoke: Invoke) -> None:
    first = report(invoke("pendulum", *OPTIONS, "--runs", "2", "--seed", "3", "--json"))
    assert first["recorded"] == ["logs/run0000.csv", "logs/run0001.csv"]
    kept = Path("logs/run0001.csv").read_bytes()
    again = report(invoke("pendulum", *OPTIONS, "--runs", "3", "--seed", "3", "--json"))
    assert (again["recorded"], again["known"]) == (["logs/run0002.csv"], 2)
    assert Path("logs/run0001.csv").read_bytes() == kept
    Path("logs/run0001.csv").unlink()  # as if the command had been interrupted
    report(invoke("pendulum", *OPTIONS, "--runs", "3", "--seed", "3", "--json"))
    assert Path("logs/run0001.csv").read_bytes() == kept
    run = Trajectory.from_csv("logs/run0000.csv", states=["angle [rad]", "rate [rad/s]"], inputs=["torque"])
    assert run.horizon == 150


def test_the_folder_and_the_kind_of_signal_are_chosen(invoke: Invoke) -> None:
    options = ("--out", "mine", "--kind", "chirp", "--runs", "1", "--option", "settings=1")
    assert invoke("pendulum", *OPTIONS, *options).exit_code == 2  # there is no such option
    result = invoke("pendulum", *OPTIONS, *options[:-2])
    assert_names(result.stdout, 1, "mine", 0)


def test_a_failed_execution_is_said_and_the_others_are_recorded(invoke: Invoke) -> None:
    Path("my_failing_rig.py").write_text(
        "from ctxval import Experiment, cases, testing\n"
        "from ctxval.core.validation import Validation\n"
        "def experiment(seed):\n"
        "    one = cases.by_name('pendulum', 0).validation\n"
        "    rig = testing.FaultyRig(one.system, {1: 'raise'})\n"
        "    parts = {n: getattr(one, n) for n in ('space', 'task', 'model', 'synthesizer', 'distance')}\n"
        "    return Experiment('rig', Validation(system=rig, **parts))\n"
    )
    result = invoke("my_failing_rig:experiment", *OPTIONS, "--runs", "3", "--json")
    found = report(result)
    assert [one["run"] for one in found["failed"]] == [1]
    assert_names(found["failed"][0]["reason"], "RuntimeError")
    assert len(found["recorded"]) == 2


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        (("pendulum", "--amplitude", "0.5"), ()),
        (("pendulum", "--amplitude", "much", "--limits", "3"), ("--amplitude",)),
        (("pendulum", *OPTIONS, "--kind", "noise"), ("kind", "noise")),
        (("pendulun", *OPTIONS), ("pendulum",)),
        (("pendulum", *OPTIONS, "--out", "file/logs"), ("logs",)),
    ],
)
def test_what_cannot_be_used_is_said_in_one_sentence(
    arguments: tuple[str, ...], facts: tuple[object, ...], invoke: Invoke
) -> None:
    Path("file").write_text("no folder")
    result = invoke(*arguments)
    assert result.exit_code == 2, result.stdout + result.stderr
    assert_names(" ".join(result.stderr.split()), *facts)
