"""``ctxval serve``: what it refuses before it serves anything."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from conftest import STATE
from ctxval.cli import app
from facts import assert_names
from rig_page import MODULE

pytest.importorskip("starlette", reason="starlette is not installed")

pytestmark = pytest.mark.slow


@pytest.fixture
def invoke(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Run the command line in a folder with a store of a manual rig in it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_rig.py").write_text(MODULE)
    sys.modules.pop("my_rig", None)

    def run(*arguments: str, **environment: str) -> Result:
        return CliRunner().invoke(app, list(arguments), env=environment)

    assert run("ask", "my_rig:experiment", "--store", "a.sqlite").exit_code == 0
    yield run
    sys.modules.pop("my_rig", None)


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        (["b.sqlite"], ("b.sqlite",)),
        (["a.sqlite", "--port", "70000"], ("port", 65535, 70000)),
        (["a.sqlite", "--host", "no host"], ("no host", 8765)),
        (["a.sqlite", "--host", "203.0.113.7", "--port", "0"], ("203.0.113.7",)),
        (["a.sqlite", "--token", "short", "--port", "0"], ("token", 16)),
        (["a.sqlite", "--threshold", "-1", "--port", "0"], ("threshold", -1.0)),
        (["a.sqlite", "--experiment", "pendulum", "--port", "0"], ("experiment",)),
    ],
)
def test_what_cannot_be_served_is_refused_in_one_sentence(
    invoke: Any, arguments: list[str], facts: tuple[object, ...]
) -> None:
    refused = invoke("serve", *arguments)
    assert refused.exit_code == 2
    assert_names(refused.stderr.replace("\n", " "), *facts)
    assert "Traceback" not in refused.stderr
    assert "short" not in refused.stderr or "--token" not in refused.stderr


def test_a_port_that_is_in_use_is_named(invoke: Any) -> None:
    with socket.create_server(("127.0.0.1", 0)) as used:
        refused = invoke("serve", "a.sqlite", "--port", str(used.getsockname()[1]))
    assert refused.exit_code == 2


def test_the_code_of_other_peoples_stores_does_not_run(invoke: Any, tmp_path: Path) -> None:
    refused = invoke("serve", "a.sqlite", "--port", "0", **{STATE: str(tmp_path / "somebody else")})
    assert refused.exit_code == 2


def test_a_missing_extra_is_named_with_the_command(invoke: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("ctxval.web.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    refused = invoke("serve", "a.sqlite")
    assert refused.exit_code == 2
    assert_names(refused.stderr.replace("\n", " "), "page", "uvicorn", "ctxval[web]")
