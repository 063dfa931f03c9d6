"""What a search for causes says: sentences, numbers, and lines to paste."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ctxval._util.representation import ShortRepr, call, task_text
from ctxval.learning.effects import Effect, ModelWithEffects
from ctxval.learning.effects.fit import Explanation
from ctxval.learning.effects.plant import Plant


@dataclass(frozen=True, eq=False)
class Explained(ShortRepr):
    """Causes that were tried in closed loop, each execution predicted without itself."""

    explanation: Explanation
    share: float  #: of the squared closed-loop deviations of M that the causes explain, without those by noise
    uncertainty: float  #: the standard deviation of the share, because of noise
    structure: float  #: the same for the squared residuals of M after several steps
    uncertain_structure: float
    distance: float  #: the largest distance between an execution and its prediction
    spreads: tuple[float, ...]  #: the range of each size if one execution is left out

    @property
    def causes(self) -> tuple[Effect, ...]:
        """The causes with their sizes."""
        return self.explanation.repaired.effects

    @property
    def resolved(self) -> bool:
        """Whether closed loops follow causes rather than noise."""
        return self.uncertainty < 0.1

    @property
    def complete(self) -> float:
        """The largest share that the causes may explain: of deviations or, if noise makes these, of residuals."""
        if self.resolved:
            return min(self.share + 2 * self.uncertainty, 1.0)
        if self.uncertain_structure > 0.2 or self.share < 1 - 4 * self.uncertainty:
            return 0.0
        return min(self.structure + 2 * self.uncertain_structure, 1.0)

    def counts(self, before: float) -> bool:
        """Return whether executions are predicted better than by M, whose largest distance is given."""
        return self.distance < before and self.share > 0 if self.resolved else self.complete > 0.5


@dataclass(frozen=True)
class Separating(ShortRepr):
    """The task that tells two causes apart."""

    task: Mapping[str, Any]
    distance: float  #: between what the two causes predict of it
    other: int  #: the number of the second cause among those that were explained; the first one is 0
    gap: float = 0.0  #: the largest difference of a state in both predictions, in shares of its range


@dataclass(frozen=True, eq=False)
class CauseReport(ShortRepr):
    """Why a model fails."""

    plant: Plant
    #: the most probable causes, and those like them; empty if no cause predicts held-out executions better than M
    explained: tuple[Explained, ...]
    named: bool  #: whether the first of these is the cause; otherwise they are what comes nearest
    tried: int  #: the number of causes in the dictionary
    executions: int  #: the number of executions that were learned from
    before: float  #: their largest distance from M
    seen: tuple[Effect, ...] = ()  #: causes that recordings show by themselves, whatever else M lacks
    failed: int = 0  #: how many of them failed, of which only the steps before are known
    units: str = ""
    began_elsewhere: bool = False  #: whether M predicts from where executions began, and not from where tasks begin
    from_tasks: float | None = None  #: the largest distance if loops begin where tasks begin; None if it is not known
    separating: Separating | None = None  #: the task that tells causes apart which these executions do not
    ranked: tuple[Explanation, ...] = ()  #: the most probable causes alone, the best one first
    replaced: tuple[str, ...] = ()  #: stages that were replaced by cheaper ones, or left out, for lack of time

    @property
    def causes(self) -> tuple[Effect, ...]:
        """The causes that are named; empty if there are none."""
        return self.explained[0].causes if self.named else ()

    @property
    def repaired(self) -> ModelWithEffects | None:
        """M with the named causes in it; None if no cause is named."""
        return self.explained[0].explanation.repaired if self.named else None

    @property
    def after(self) -> float | None:
        """The largest distance of the same executions from M with the causes, each predicted without itself."""
        return self.explained[0].distance if self.explained else None

    @property
    def sentence(self) -> str:
        """What M lacks, in one to three sentences."""
        seen = "" if self.named else "; ".join(cause.sentence(self.plant) for cause in self.seen)
        return f"The recordings show: {seen}. {self._sentence()}" if seen else self._sentence()

    def _sentence(self) -> str:
        units = f" {self.units}" if self.units else ""
        none = f"None of the {self.tried} causes that were tried"
        if self.began_elsewhere and not self.named:
            return f"{none}: M predicts the executions from where they began, and that is not where their tasks begin."
        if not self.explained:
            return f"{none}: none predicts executions better that it was not fitted to."
        first = self.explained[0]
        failed = " until they failed" if self.failed else ""
        if 0 < self.failed < self.executions:
            failed = f", {self.failed} of them until {'they' if self.failed > 1 else 'it'} failed,"
        falls = first.distance < self.before
        effect = (
            f"the largest distance of {self.executions} executions{failed} "
            f"{'falls' if falls else 'rises'} from {self.before:.3g} to {first.distance:.3g}{units}"
        )
        # A share of the distance from M that is worth a remark.
        if self.from_tasks is not None and self.from_tasks > max(2 * first.distance, 0.1 * self.before):
            effect += ", predicted from where the executions began; from where their tasks begin, it is "
            effect += f"{self.from_tasks:.3g}{units}"
        part, of = (first.share, "deviations") if first.resolved else (first.structure, "residuals, except for noise")
        share = f"{np.floor(1e3 * part) / 10:.4g} % of the squared {of}"
        if not self.named:
            less = "The largest part of the error that one explains" if first.share > 0.5 else "What comes nearest"
            effect = f"{'and' if falls else 'but'} {effect}"
            return f"{none}. {less}: {self._text(first)}. It explains {share}, {effect}."
        what = "One of these, which the executions do not tell apart: " if len(self.explained) > 1 else ""
        what += "; or ".join(map(self._text, self.explained))
        what += ", or all executions began there" if self.began_elsewhere else ""
        together = "both" if len(first.causes) == 2 else "this"
        return f"{what[0].upper()}{what[1:]}. With {together} in M, {effect}. This explains {share}."

    def _text(self, each: Explained) -> str:
        return " and ".join(cause.sentence(self.plant) for cause in each.causes)

    @property
    def separating_sentence(self) -> str | None:
        """Which task tells causes apart; None if the executions do, or if no task does."""
        if self.separating is None:
            return None
        if self.separating.gap < 1e-3:
            return "No task tells them apart: they are the same to this model."
        units = f" {self.units}" if self.units else ""
        return (
            f"Execute the task {task_text(self.separating.task)} to tell them apart: there, the first and number "
            f"{self.separating.other + 1} differ by {self.separating.distance:.3g}{units}."
        )

    @property
    def python(self) -> str | None:
        """The lines of Python that make M with the causes; None if no cause is named."""
        if not self.named:
            return None
        made = "".join(f"    {cause.python()},\n" for cause in self.causes)
        repaired = self.explained[0].explanation.repaired
        inputs = "" if repaired.complete else f", inputs={repaired.inputs}"
        return f"from ctxval.studies import causes\n\nmodel = causes.ModelWithEffects(model, (\n{made}){inputs})"

    @property
    def mjcf(self) -> tuple[str, ...]:
        """The lines of MJCF that put the causes into a MuJoCo model; empty if there are none."""
        return self._lines("mjcf")

    @property
    def urdf(self) -> tuple[str, ...]:
        """The lines of URDF with the named causes, for elements of the same robot; empty if there are none."""
        return self._lines("urdf")

    def _lines(self, language: str) -> tuple[str, ...]:
        repairs = (cause.repair(self.plant) for cause in self.causes)
        return tuple(each[language] for each in repairs if language in each)

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain values."""
        about = ("tried", "executions", "failed", "began_elsewhere")
        shares = ("spreads", "share", "structure", "uncertainty", "uncertain_structure", "distance")
        return {
            "answer": "named" if self.named else "none of these",
            "sentence": self.sentence,
            "seen": [cause.sentence(self.plant) for cause in self.seen],
            "separating": self.separating and {**asdict(self.separating), "sentence": self.separating_sentence},
            "explained": [
                {
                    "text": self._text(each),
                    "causes": [{"name": c.name, "sizes": list(c.sizes), "python": c.python()} for c in each.causes],
                    **{name: getattr(each, name) for name in shares},
                    "criterion": each.explanation.criterion,
                    "residual_left": each.explanation.left,
                }
                for each in self.explained
            ],
            **{name: getattr(self, name) for name in about},
            "distance_before": self.before,
            "distance_after": self.after,
            "distance_from_tasks": self.from_tasks,
            "units": self.units,
            "python": self.python,
            "mjcf": list(self.mjcf),
            "urdf": list(self.urdf),
            "thinking": {"replaced": list(self.replaced)} if self.replaced else None,
        }

    def __repr__(self) -> str:
        return call(self, self.sentence, executions=self.executions, tried=self.tried)
