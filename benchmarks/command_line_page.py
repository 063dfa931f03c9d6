"""``docs/reference/command-line.md``: every command and its options, from the command line itself."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

from typer import Context
from typer.cli import get_docs_for_click
from typer.main import get_command

from ctxval.cli import app
from ctxval.cli.commands import MODULES

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "command-line.md"

INTRODUCTION = """\
# Command line

This page is made from the command line by `make parts`, and a test fails if it is not current. `ctxval COMMAND --help`
prints the same text, and `ctxval --version` the version. The [glossary](../glossary.md) explains what the commands
print, and [exit statuses](exit-statuses.md) how they end.
"""


def page() -> str:
    """Return the whole page: a list of the commands, and a section for each of them."""
    for module in MODULES.values():
        importlib.import_module(module)
    group = get_command(app)
    text = get_docs_for_click(obj=group, ctx=Context(group, info_name="ctxval"), name="ctxval")
    sections = text[text.index("## `ctxval ") :]
    for name, command in getattr(group, "commands").items():  # noqa: B009
        advanced = [each for each in command.params if getattr(each, "rich_help_panel", None) == "Advanced"]
        if advanced:  # they are the last ones
            heading, rest = re.split(rf"(?<=\n## `ctxval {name}`\n)", f"\n{sections}", maxsplit=1)
            rest = rest.replace(
                f"* `{advanced[0].opts[-1]}", f"\n**Advanced options**:\n\n* `{advanced[0].opts[-1]}", 1
            )
            sections = f"{heading}{rest}".removeprefix("\n")
    sections = re.sub(r"^\* `--help`: .*\n", "", sections, flags=re.MULTILINE)
    sections = sections.replace("```console\n", "```text\n").replace("**Usage**:\n\n", "")
    names = re.findall(r"^## `ctxval (\w+)`$", sections, re.MULTILINE)
    listed = "\n".join(f"- [`{name}`](#ctxval-{name}): {_summary(group, name)}" for name in names)
    return f"{INTRODUCTION}\n{listed}\n\n{sections.strip()}\n"


def _summary(group: Any, name: str) -> str:
    """Return the first paragraph of a command's help, which typer's own list shortens."""
    return " ".join((group.commands[name].help or "").strip().split("\n\n")[0].split())


if __name__ == "__main__":
    PAGE.write_text(page())
