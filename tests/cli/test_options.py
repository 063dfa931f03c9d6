"""Values of ``--option NAME=VALUE``, and the options of cases."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.cli.base import named_values, parsed
from ctxval.errors import InputError
from facts import assert_names, refuses
from rig_cli import calling


@pytest.fixture
def invoke(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.chdir(tmp_path)

    return calling()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("4", 4),
        ("1e-3", 0.001),
        ("true", True),
        ("basin", "basin"),
        ("'4'", "4"),
        ('"a b"', "a b"),
        ("[1, 2]", [1, 2]),
        ("", ""),
        ("2024-01-01", "2024-01-01"),
        ('{ ref = "os:getcwd" }', '{ ref = "os:getcwd" }'),
        ("4\nfolder = 5", "4\nfolder = 5"),
        ("[" * 5_000, "[" * 5_000),
    ],
)
def test_a_value_is_what_a_file_would_hold_or_else_text(text: str, value: Any) -> None:
    assert parsed(text) == value
    assert type(parsed(text)) is type(value)


@given(st.text())
def test_no_text_is_too_odd_for_a_value(text: str) -> None:
    assert isinstance(parsed(text), str | int | float | bool | list)


def test_options_with_an_option_of_their_own_stand_beside_the_others() -> None:
    assert named_values(["drag=0.5", " name = x=y "], dim=3, model=None) == {"dim": 3, "drag": 0.5, "name": "x=y"}
    assert named_values(None) == {}


@pytest.mark.parametrize(
    ("given_options", "facts"),
    [
        (["dim"], ("--option", "NAME", "VALUE")),
        (["=4"], ("--option", "NAME", "VALUE")),
        (["dim=4", "dim=5"], (4, "5", 5)),
        (["model=gp"], ("model", "fnn", "gp")),
    ],
)
def test_an_option_that_cannot_be_used_is_named(given_options: list[str], facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        named_values(given_options, model="fnn")


@pytest.mark.slow
@pytest.mark.usefixtures("without_costs")
def test_any_option_of_a_case_can_be_set(invoke: Any) -> None:
    command = ("run", "linear", "--budget", "2", "--search", "random", "--json")
    result = invoke(*command, "--option", "dim=2", "--store", "a.sqlite")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["options"] == {"dim": 2}
    assert invoke("check", "linear", "--option", "dim=2").exit_code == 0


@pytest.mark.parametrize("command", ["run", "check"])
def test_a_wrong_option_is_refused_with_the_nearest(invoke: Any, command: str) -> None:
    for option, facts in (
        ("dims=2", ("linear", "dims")),
        ("dim=large", ("linear", "dim", "large")),
    ):
        result = invoke(command, "linear", "--option", option)
        assert result.exit_code == 2
        assert_names(result.stderr.replace("\n", " "), *facts)
