"""The command line, as tests of its commands call it."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from typer.testing import CliRunner, Result

from ctxval.cli import app

Invoke = Callable[..., Result]

SMALL = [sys.executable, str(Path(__file__).with_name("small_ctxval.py"))]
"""Starts ``ctxval`` in a process of its own, with as few draws and loops as it computes here."""


def calling(*before: str) -> Invoke:
    """Return a function that calls ``ctxval`` with arguments that follow these."""

    def called(*arguments: str) -> Result:
        return CliRunner().invoke(app, [*before, *arguments])

    return called


def report(result: Result) -> dict[str, Any]:
    """Return the JSON object that a command has printed; it must have ended well."""
    assert result.exit_code == 0, result.stdout + result.stderr
    found: dict[str, Any] = json.loads(result.stdout)
    return found
