"""``docs/reference/command-line.md``: every command and its options, from the command line itself."""

from __future__ import annotations

import importlib
from collections import Counter
from pathlib import Path
from typing import Any

from typer import Context
from typer.main import get_command

from ctxval.cli import app
from ctxval.cli.commands import MODULES, PANELS

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "command-line.md"

INTRODUCTION = """\
# Command line

This page is made from the command line by `make parts`, and a test fails if it is not current. `ctxval COMMAND --help`
prints the same text, and `ctxval --version` the version. The [glossary](../glossary.md) explains what the commands
print, and [exit statuses](exit-statuses.md) how they end. Arguments and options that several commands share are
described [once, at the end](#arguments-and-options-of-several-commands).
"""

SHARED = "## Arguments and options of several commands"

Record = tuple[str, str]
"""How an argument or an option is written, and its text."""


def page() -> str:
    """Return the whole page: the commands in groups, a section for each of them, and the records that they share."""
    for module in MODULES.values():
        importlib.import_module(module)
    group: Any = get_command(app)
    records = {name: _records(group, name) for name in MODULES}
    counts = Counter(record for of_command in records.values() for record in of_command)
    usual = {_name(record): record for record, count in reversed(counts.most_common()) if count > 1}
    shared = [usual[name] for name in sorted(usual)]
    listed = [
        f"- {panel}: {', '.join(f'[`{name}`](#ctxval-{name})' for name in names)}" for panel, names in PANELS.items()
    ]
    sections = [_section(group, name, [each for each in records[name] if each not in shared]) for name in MODULES]
    return "\n\n".join([INTRODUCTION.strip(), "\n".join(listed), *sections, SHARED, _items(shared)]) + "\n"


def _records(group: Any, name: str) -> list[Record]:
    """Return the arguments and options of a command, but not ``--help``."""
    command = group.commands[name]
    found = (each.get_help_record(_context(group, name)) for each in command.params if each.name != "help")
    return [(" ".join(form.split()), " ".join(text.removesuffix("[required]").split())) for form, text in found]


def _section(group: Any, name: str, own: list[Record]) -> str:
    """Return the section of a command: what it does, how it is called, its own options, and the names of the others."""
    command, described = group.commands[name], {form for form, _ in own}
    others = [form for form, _ in _records(group, name) if form.startswith("-") and form not in described]
    parts = [f"## `ctxval {name}`", *_paragraphs(group, name)]
    parts += [f"`{command.get_usage(_context(group, name)).removeprefix('Usage: ').strip()}`", _items(own)]
    parts += ["Also " + ", ".join(f"`{_name((form, ''))}`" for form in others) + "."] if others else []
    return "\n\n".join(filter(None, parts))


def _context(group: Any, name: str) -> Context:
    return Context(group.commands[name], info_name=name, parent=Context(group, info_name="ctxval"))


def _paragraphs(group: Any, name: str) -> list[str]:
    return [" ".join(each.split()) for each in group.commands[name].help.split("\n\n")]


def _name(record: Record) -> str:
    """Return the long name of an option, or the argument."""
    form = record[0]
    return next((each for each in form.replace(",", "").replace("/", "").split() if each.startswith("--")), form)


def _items(records: list[Record]) -> str:
    return "\n".join(f"- `{form}`: {text}" for form, text in records)


if __name__ == "__main__":
    PAGE.write_text(page())
