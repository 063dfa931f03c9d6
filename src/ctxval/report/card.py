"""The card of a campaign: the few facts by which others compare and repeat a verdict, as a row, Markdown and JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np

from ctxval._util.representation import ShortRepr, counted
from ctxval._util.texts import markdown_text
from ctxval._util.version import VERSION
from ctxval.report.context import ReportContext
from ctxval.report.distance_model import distance_of
from ctxval.report.markup import quantity
from ctxval.report.sections.repeat import repeating_command
from ctxval.report.sections.trials import task_of


@dataclass(frozen=True)
class CardVerdict(ShortRepr):
    """The verdict at one threshold."""

    threshold: float
    answer: str  #: validated, falsified or undecided
    executions: int | str  #: that it needed, or a text for several campaigns


@dataclass(frozen=True)
class Card(ShortRepr):
    """The facts of one campaign, or of several campaigns of one model."""

    system: str  #: the name of the experiment
    model: str  #: the type of M
    origin: str  #: who published the model and the recordings, and under which licence; empty if nobody stated it
    distance: str  #: the type of the distance
    units: str  #: of the distance
    least: float | None  #: the largest executed distance; d* is not smaller
    most: float | None  #: the bound on d*; None if there is none
    verdicts: tuple[CardVerdict, ...]
    executions: int | str  #: all of them
    worst: str  #: the task with the largest executed distance
    cause: str = ""  #: what M lacks, as ``ctxval why`` says; empty if it was not asked
    repair: str = ""  #: what a repair of M gave; empty if none was tried
    command: str = ""  #: what repeats the campaign; empty if no command made it
    version: str = VERSION

    HEAD: ClassVar[tuple[str, ...]] = (
        "system", "model", "origin", "distance", "d*", "verdicts", "executions", "worst task", "cause", "repair",
    )  # fmt: skip

    def row(self) -> list[str]:
        """Return the cells below :attr:`HEAD`, as Markdown."""
        if self.least is None:
            largest = "not known"
        elif self.most is not None and np.isclose(self.least, self.most):
            largest = quantity(self.least, self.units)
        else:
            bound = "" if self.most is None else f", at most {quantity(self.most, self.units)}"
            largest = f"at least {quantity(self.least, self.units)}{bound}"
        verdicts = "; ".join(
            f"{each.answer} at {quantity(each.threshold, self.units)} after {_executions(each.executions)}"
            for each in self.verdicts
        )
        cells = (self.system, self.model, self.origin, self.distance, largest, verdicts)
        others = (str(self.executions), self.worst, self.cause, self.repair)
        return [markdown_text(cell) or "\u2013" for cell in (*cells, *others)]

    def markdown(self) -> str:
        """Return the card as a table of one row, which rows of other cards may follow, and the command."""
        lines = [" | ".join(cells) for cells in (self.HEAD, ["---"] * len(self.HEAD), self.row())]
        fence = f"\n```console\n$ {self.command}\n```\n" if self.command and "\n" not in self.command else ""
        return "".join(f"| {line} |\n" for line in lines) + fence

    def to_json(self) -> dict[str, Any]:
        """Return all attributes, ready for JSON."""
        return asdict(self)


def card(context: ReportContext, origin: str = "") -> Card:
    """Return the card of a campaign, with the verdicts at all thresholds that were stated of it.

    Args:
        origin: who published the model and the recordings, and under which licence.
    """
    verdict, worst = context.verdict, context.worst_first[:1]
    bound = context.bound
    if context.space.are_executed(context.points):
        bound = distance_of(worst[0])
    executed = [trial for trial in context.trials if trial.executed]
    stated = {each.threshold for each in context.store.thresholds() or ()}
    verdicts = []
    for threshold in sorted(stated if verdict is None else {*stated, verdict.threshold}):
        above = next((k for k, trial in enumerate(executed, 1) if (trial.distance or 0.0) > threshold), None)
        answer = "undecided"
        if above is not None:
            answer = "falsified"
        elif (bound is not None and bound <= threshold) or (
            verdict is not None and verdict.answer == "validated" and verdict.threshold <= threshold
        ):
            answer = "validated"
        verdicts.append(CardVerdict(threshold, answer, above or context.executions))

    def kind(part: str) -> str:
        described = context.parts.get(part)
        return str(described.get("type", part)) if isinstance(described, Mapping) else part

    return Card(
        context.name,
        kind("model"),
        origin,
        kind("distance"),
        context.labels.units,
        distance_of(worst[0]) if worst else None,
        bound,
        tuple(verdicts),
        context.executions,
        task_of(context, worst[0]) if worst else "",
        context.cause,
        command=repeating_command(context),
    )


def _executions(count: int | str) -> str:
    return count if isinstance(count, str) else counted(count, "execution")
