"""The page of the command line is what the command line says."""

from __future__ import annotations

import sys
from pathlib import Path

from typer.main import get_command

from ctxval.cli import app

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import command_line_page


def test_the_page_is_current() -> None:
    current = command_line_page.PAGE.read_text() == command_line_page.page()
    assert current, "docs/reference/command-line.md is not current; run `make parts`."


def test_it_has_every_command_and_every_option() -> None:
    page = command_line_page.page()
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        assert f"\n## `ctxval {name}`\n" in page
        section = page.split(f"\n## `ctxval {name}`\n")[1].split("\n## ")[0]
        options = [form for option in command.params for form in option.opts if form.startswith("--")]
        assert options
        for option in options:
            assert f"`{option}" in section or f", {option}" in section, option
