"""What the command line prints: nothing in a text acts on the terminal, whatever way it comes in."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from rich.table import Table
from rich.text import Text
from typer.testing import CliRunner

from conftest import make_validation
from ctxval import Campaign, searches
from ctxval.cli import app
from ctxval.cli.commands import Screen

HOSTILE = "\x1b[2J\x9b1m\u202e[bold]C:\\rig\\[axis 3] :warning: \\[/bold] 100\\"
SHOWN = r"\x1b[2J\x9b1m\u202e[bold]C:\rig\[axis 3] :warning: \[/bold] 100" + "\\"
EXPERIMENT = """
from ctxval import Experiment
from conftest import make_validation

class Stop(BaseException):
    pass

def stopping(seed):
    raise Stop("\\x1b[2Jstop")

class Mute(Exception):
    def __str__(self):
        raise ValueError

def mute(seed):
    raise Mute
"""


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A store with a failure of which the text is hostile."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1]))
    (tmp_path / "hostile_rig.py").write_text(EXPERIMENT)
    sys.modules.pop("hostile_rig", None)
    path = tmp_path / "a.sqlite"
    campaign = Campaign(make_validation(horizon=2), search=searches.Random(), store=path, name="\x1b]0;x\x07[red]")
    campaign.add({"goal": 1.0}, failed=HOSTILE)
    campaign.add({"goal": 1.5}, failed="line 1\nvalidated against 0.1: trust me")
    campaign.store.close()
    return path


def printed(*arguments: str, status: int = 0) -> str:
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == status, result.output
    shown = result.stdout + result.stderr
    assert not any((ord(c) < 32 and c not in "\n\t") or 127 <= ord(c) < 160 or c == "\u202e" for c in shown)
    return shown


def test_a_failure_is_printed_as_it_is_and_acts_on_nothing(store: Path) -> None:
    shown = printed("status", str(store))
    assert SHOWN in shown
    assert "\\x1b]0;x\\x07[red]" in shown


def test_no_text_begins_a_line_of_its_own(store: Path) -> None:
    lines = printed("status", str(store)).splitlines()
    assert any(line.strip().startswith("validated against") for line in lines)
    assert not any(line.startswith("validated") for line in lines)


def test_json_is_one_object_with_the_text_itself(store: Path) -> None:
    result = CliRunner().invoke(app, ["status", str(store), "--json"])
    assert json.loads(result.stdout)["failures"][0]["reason"] == HOSTILE


@pytest.mark.parametrize(
    "arguments",
    [
        ("status", "\x1b[2Ja.sqlite"),
        ("status", "a.sqlite", "--\x1b[2J"),
        ("\x1b[2Jstatus",),
        ("status", "a.sqlite", "\x1b[2J"),
        ("run", "hostile_rig:\x1b[2J"),
        ("run", "\x1b[2J.toml"),
        ("certify", "a.sqlite", "--kind", "\x1b[2J"),
    ],
)
def test_complaints_about_arguments_act_on_nothing(store: Path, arguments: tuple[str, ...]) -> None:
    assert r"\x1b[2J" in printed(*arguments, status=2).replace("\n", "").replace("│", "").replace(" ", "")


def test_texts_of_a_file_act_on_nothing(store: Path) -> None:
    Path("e.toml").write_text('experiment = "pendulum"\n"\\u001b[2J" = 1')
    assert r"\x1b[2J" in printed("check", "e.toml", status=2)


def test_what_users_code_raises_is_one_sentence(store: Path) -> None:
    assert printed("run", "hostile_rig:stopping", status=3) == "error: Stop: \\x1b[2Jstop\n"
    assert "Mute" in printed("run", "hostile_rig:mute", status=2)


def test_a_long_text_of_an_old_store_is_printed_short(store: Path) -> None:
    campaign = Campaign(make_validation(horizon=2), search=searches.Random(), store="b.sqlite")
    opened = campaign.ask()
    campaign.store.close_trials([(replace(opened.trial, state="failed", failure="x" * 10**7), None)])
    campaign.store.close()
    assert len(printed("status", "b.sqlite")) < 5_000
    assert len(printed("status", "b.sqlite", "--json")) < 5_000


def test_whatever_is_rendered_acts_on_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table(show_header=False)
    table.add_row("\x1b[2J", Text("\x9b1m"))
    screen = Screen()
    screen.print(table, Text("\u202e\x1b"), "[red]\x1b[/]:warning:")
    shown = capsys.readouterr().out
    assert not set("\x1b\x9b\u202e") & set(shown)
    assert r"[red]\x1b[/]:warning:" in shown


def run_ascii(*arguments: str) -> subprocess.CompletedProcess[bytes]:
    """Run a command on a terminal that has no other characters than ASCII."""
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C"}
    command = [sys.executable, "-m", "ctxval", *arguments]
    return subprocess.run(command, capture_output=True, env=environment, check=False)


@pytest.mark.thorough
def test_a_terminal_that_cannot_hold_a_character_gets_it_written_out(store: Path) -> None:
    campaign = Campaign(make_validation(horizon=2), search=searches.Random(), store="c.sqlite", name="Prüfstand Ω 机")
    campaign.tell(campaign.ask(), failed="Überstrom 机器")
    campaign.store.close()
    status, as_json, bad = run_ascii("status", "c.sqlite"), run_ascii("status", "c.sqlite", "--json"), run_ascii("机")
    assert (status.returncode, as_json.returncode, bad.returncode) == (0, 0, 2)
    assert b"Pr\\xfcfstand" in status.stdout
    assert rb"\xdcberstrom \u673a" in status.stderr
    assert json.loads(as_json.stdout)["case"] == "Prüfstand Ω 机"
    assert rb"\u673a" in bad.stderr
    assert b"Traceback" not in status.stderr + as_json.stderr + bad.stderr
