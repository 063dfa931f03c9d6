"""The results of a refinement: what each round showed, and what follows for the refined model."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ctxval._util.describe import describe
from ctxval._util.files import MADE_BY, write_text
from ctxval._util.representation import ShortRepr, call, counted
from ctxval._util.texts import aligned
from ctxval.campaign.campaign import Campaign
from ctxval.certificates.verdict import Answer, Verdict
from ctxval.core.model import Model
from ctxval.errors import InputError
from ctxval.models import Refined
from ctxval.studies.fitting import FittedParameter
from ctxval.studies.fitting.model_file import write_model_file
from ctxval.studies.refinement.held_out import MeasuredResidual


@dataclass(frozen=True)
class SameControllers:
    """Executed tasks of earlier rounds on which the refined model has the controller that was executed.

    The distance of the refined model on such a task is known without another execution, if the system is
    deterministic. The model has learned from them, so they can falsify it, and they never count for it.
    """

    tasks: int = 0  #: number of executed tasks that were compared, and of those with numerically the same controller
    same: int = 0
    worst: float | None = None  #: the largest distance of the refined model on the latter; None if there are none


@dataclass(frozen=True, eq=False)
class Round(ShortRepr):
    """One model, and what its executions showed."""

    number: int  #: 0 and ``given`` for the first model; then 1, 2, ... and the method by which it was learned.
    method: str
    campaign: Campaign  #: the campaign of the model, whose store belongs to it alone
    verdict: Verdict  #: the verdict on the model, and the confidence of this round
    confidence: float
    learned_from: int = 0  #: number of transitions that the model was learned from
    model_file: Path | None = None
    notes: tuple[str, ...] = ()  #: sentences on the model
    unchanged: SameControllers = field(default_factory=SameControllers)  #: executed tasks with the same controllers

    @property
    def model(self) -> Model:
        """The model of the round."""
        return self.campaign.validation.model

    @property
    def executions(self) -> int:
        """The number of executions under controllers that were designed on this model."""
        return self.campaign.executions

    @property
    def worst(self) -> float | None:
        """The largest distance that was executed; None if there is none."""
        return None if self.campaign.worst is None else self.campaign.worst.distance

    @property
    def store(self) -> Path | None:
        """The store of the round; None if it is in memory."""
        return self.campaign.store.path

    @property
    def cells(self) -> tuple[str, ...]:
        """Number, method, executions, largest distance and verdict as texts."""
        worst = "-" if self.worst is None else f"{self.worst:.4g}"
        return str(self.number), self.method, str(self.executions), worst, self.verdict.answer

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        worst, certificate = self.campaign.worst, self.verdict.certificate
        return {
            "round": self.number,
            "method": self.method,
            "model": repr(self.model),
            "model_file": self.model_file and str(self.model_file),
            "store": self.store and str(self.store),
            "learned_from": self.learned_from,
            "executions": self.executions,
            "worst": worst and {"task": worst.parameters, "distance": worst.distance},
            "verdict": self.verdict.answer,
            "reason": self.verdict.reason,
            "confidence": self.confidence,
            "bound": self.verdict.bound,
            "certificate": certificate and certificate.to_json(),
            "notes": list(self.notes),
            "unchanged_controllers": asdict(self.unchanged),
        }


@dataclass(frozen=True, eq=False)
class Refinement:
    """A sequence of models of one system, each validated by executions under its own controllers."""

    rounds: tuple[Round, ...]  #: the first model and the refined ones
    threshold: float  #: tau
    confidence: float  #: the confidence of the whole sequence
    budget: int  #: the largest total number of executions
    ended: str  #: why the sequence ended, in one sentence
    residual: MeasuredResidual | None = None  #: the measured residual of the last model; None if no model was learned
    #: the one-step errors on held-out executions, before and after, for each state
    accuracy: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    parameters: tuple[FittedParameter, ...] = ()  #: those of the user's function in the last model; else none
    units: str = ""

    @property
    def last(self) -> Round:
        """The last round."""
        return self.rounds[-1]

    @property
    def model(self) -> Model:
        """The model of the last round, without the records that it carries."""
        model = self.last.model
        return model.model if isinstance(model, Refined) else model

    @property
    def answer(self) -> Answer:
        """The verdict on the last model."""
        return self.last.verdict.answer

    @property
    def executions(self) -> int:
        """The number of executions of all rounds."""
        return sum(item.executions for item in self.rounds)

    @property
    def statement(self) -> str:
        """What the last verdict means: the executions that it counts, and its confidence after several rounds."""
        last, others = self.last.executions, self.executions - self.last.executions
        counts = (
            f"The verdict on the model of round {self.last.number} counts {counted(last, 'execution')} under its own "
            "controllers"
        )
        if others:
            counts += (
                f"; {counted(others, 'execution')} under controllers of other models taught the model, and "
                f"{'proves' if others == 1 else 'prove'} nothing of it"
            )
        if self.answer != "validated" or not self.last.number:
            return f"{counts}."
        return (
            f"{counts}. Its confidence is {self.last.confidence:.6g}: the k-th refined model may be validated wrongly "
            f"with probability {1 - self.confidence:.3g} / (k (k + 1)), so the whole sequence is wrong with "
            f"probability at most {1 - self.confidence:.3g}, however many models were tried. This holds for one "
            "refinement: if several refinements begin with the same stores or executions, the probability that any of "
            "them validates a model wrongly is larger."
        )

    @property
    def head(self) -> tuple[str, ...]:
        """What the cells of a round are."""
        return "round", "model", "executions", f"worst distance{f' [{self.units}]' if self.units else ''}", "verdict"

    @property
    def text(self) -> str:
        """The rounds as a table of plain text."""
        return aligned([self.head, *(item.cells for item in self.rounds)])

    def to_json(self) -> dict[str, Any]:
        """Return everything but the models as plain values."""
        names = ("threshold", "confidence", "units", "budget", "executions", "ended", "statement")
        errors = {name: {"before": before, "after": after} for name, (before, after) in self.accuracy.items()}
        return {
            "verdict": self.answer,
            **{name: getattr(self, name) for name in names},
            "distance_before": self.rounds[0].worst,
            "distance_after": self.last.worst,
            "rounds": [item.to_json() for item in self.rounds],
            "one_step_error": errors,
            "parameters": [vars(parameter) for parameter in self.parameters],
            "residual": self.residual and self.residual.to_json(),
        }

    def __repr__(self) -> str:
        known = {"threshold": self.threshold, "executions": self.executions, "ended": self.ended}
        return call(self, self.answer, **known)


def write_refined(path: str | Path, refinement: Refinement, step: str | None = None) -> list[str]:
    """Write the last model of a refinement, and next to it its residual as JSON and as a table; return the paths."""
    if not refinement.last.number:
        raise InputError("no model was refined, so there is none to write.")
    target = Path(path)
    written = write_model_file(target, refinement.model, step)
    if refinement.residual is None:
        return written
    names = ("verdict", "threshold", "units", "statement", "residual")
    about = {"made_by": MADE_BY, "model": target.name, **{name: refinement.to_json()[name] for name in names}}
    remark = (
        f"{MADE_BY}. Residual S(x, u) - M(x, u) of one step, measured on executions that the model was not learned "
        f"from, and not guaranteed.\nMeasured for {refinement.residual.range_text}.\nA robust controller must assume "
        "at least these disturbances."
    )
    described = json.dumps(describe(about, 12), indent=1, allow_nan=False)
    beside = {".residual.json": f"{described}\n", ".residual.txt": f"{refinement.residual.text}\n\n{remark}\n"}
    return [*written, *(str(write_text(target.with_suffix(suffix), text)) for suffix, text in beside.items())]
