"""``docs/parts.md``: the parts that are found by name, from their registries. Nothing is run here."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctxval import cases, certificates, controllers, distances, models, searches, specs, systems
from ctxval._util.registry import Declaration, Registry, declaration_of

PAGE = Path(__file__).parents[1] / "docs" / "parts.md"

INTRODUCTION = """\
# Parts that are found by name

This page is made from the registries by `make parts`, and a test fails if it is not current. In Python, every part is
also a class or a function of its package. Installed packages can add parts: see [CONTRIBUTING](../CONTRIBUTING.md).
"""


@dataclass(frozen=True)
class Section:
    """A kind of part on the page: its heading, its registry, and how one is named in a file and in Python."""

    title: str
    registry: Registry
    use: str


SECTIONS = (
    Section("Systems", systems.REGISTRY, '`[system]` with `type = "Simulated"`; `systems.by_name("Simulated", ...)`'),
    Section("Models", models.REGISTRY, '`[model]` with `type = "Linear"`; `models.by_name("Linear", ...)`'),
    Section(
        "Synthesizers", controllers.REGISTRY, '`[synthesizer]` with `type = "LQR"`; `controllers.by_name("LQR", ...)`'
    ),
    Section(
        "Distances", distances.REGISTRY, '`[distance]` with `type = "FinalState"`; `distances.by_name("FinalState")`'
    ),
    Section(
        "Specifications", specs.REGISTRY, '`[spec]` with `type = "ReachAvoid"`; `specs.by_name("ReachAvoid", ...)`'
    ),
    Section("Sets", specs.SETS, '`avoid = [{ type = "Ball", ... }]` of `[spec]`; `specs.Ball(...)`'),
    Section(
        "Searches", searches.REGISTRY, '`[search]` with `type = "auto"`; `--search auto`; `searches.by_name("auto")`'
    ),
    Section(
        "Certificates",
        certificates.KINDS,
        '`[certificate]` with `kind = "audit"`; `--kind audit`; `certificates.Audit().certify(sample, 0.95)`',
    ),
    Section(
        "Cases",
        cases.REGISTRY,
        '`experiment = "linear"` with `[options]`; `--option dim=4`; `cases.by_name("linear", dim=4)`',
    ),
)


def page() -> str:
    """Return the whole page."""
    return "\n".join([INTRODUCTION, *(line for section in SECTIONS for line in _lines(section))])


def _lines(section: Section) -> list[str]:
    heading = [f"## {section.title}", "", f"{section.use}.", "", "| name | part | arguments |", "|---|---|---|"]
    return [*heading, *(_row(section.registry, name) for name in section.registry.built_in), ""]


def _row(registry: Registry, name: str) -> str:
    found = registry.find(name)
    if registry is cases.REGISTRY:
        plain = (one for one in cases.options_of(name).items() if one[0] not in ("settings", "pendulum"))  # objects
        return _cells(f"`{name}`", cases.NAMES[name], ", ".join(_argument(*one) for one in plain))
    declared = declaration_of(found) or Declaration(name)
    text = registry.summary(name)
    arguments = _arguments(found, declared)
    if hasattr(found, "fit"):
        arguments += f"; or, to be learned from files: {_arguments(found.fit, declared)}"
    return _cells(f"`{name}`", text, arguments)


def _arguments(build: Any, declared: Declaration) -> str:
    parameters = inspect.signature(build).parameters.values()
    return ", ".join(
        _argument(str(one.replace(annotation=one.empty, default=one.empty)), one.default, declared)
        for one in parameters
    )


def _argument(name: str, default: Any, declared: Declaration | None = None) -> str:
    text = f"`{name}`" if default is inspect.Parameter.empty else f"`{name}={default!r}`"
    if declared is not None and name in declared.files:
        return f"{text} (a file)"
    form = {} if declared is None else declared.functions
    return f"{text} (a function `{form[name]}`)" if name in form else text


def _cells(*texts: str) -> str:
    return "| " + " | ".join(text.replace("|", "\\|").replace("``", "`") for text in texts) + " |"


if __name__ == "__main__":
    PAGE.write_text(page())
