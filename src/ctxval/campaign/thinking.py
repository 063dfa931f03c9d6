"""The budget of thinking of a campaign: what its trials store of it, and what follows for the next choice."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from ctxval import learning
from ctxval.core.trajectory import Transitions
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation

if TYPE_CHECKING:
    from ctxval.learning import DynamicsStudy, Ledger, Speed, Thinking, ThinkingSettings, WorstCaseSettings


@dataclass(frozen=True)
class TimeShortage:
    """The evidence of a verdict, or another statement, does not fit into the budget of thinking."""

    needed: float  #: seconds that it needs
    budget: float  #: seconds that it may take
    replaced: tuple[str, ...] = ()  #: the stages of choices that were replaced by cheaper ones
    of: str = "the evidence of a verdict"  #: what does not fit

    code: ClassVar[str] = "no_time"  #: of an undecided verdict

    def __str__(self) -> str:
        return (
            f"{self.of} needs about {self.needed:.2g} s of thinking, and its budget is {self.budget:.2g} s; give "
            f"--thinking {self.suggested:g} (thinking= in Python)"
        )

    @property
    def suggested(self) -> float:
        """A budget that suffices, with two digits."""
        return float(f"{1.2 * self.needed:.1e}")

    def to_json(self) -> dict[str, Any]:
        """Return the code and the seconds, ready for JSON."""
        seconds = {"needed": float(f"{self.needed:.3g}"), "budget": self.budget, "suggested": self.suggested}
        return {"code": self.code, **seconds, "replaced": list(self.replaced)}


class CampaignThinking:
    """The budgets of the choices of one campaign; there is none outside of :meth:`limited`.

    Args:
        study: returns what learns the dynamics.
        manual: whether people execute the tasks.
    """

    def __init__(self, study: Callable[[], DynamicsStudy], manual: bool) -> None:
        self._study, self._manual = study, manual
        self._limited, self._decides = False, False
        self._stated: float | None = None
        self._speed: Speed | None = None

    @property
    def _validation(self) -> Validation:
        return self._study().validation

    @property
    def _settings(self) -> ThinkingSettings:
        return self._study().settings.thinking

    @contextmanager
    def limited(self, stated: float | None) -> Iterator[None]:
        """Limit choices meanwhile to a number of seconds; None for the default, infinity for no limit."""
        before = self._limited, self._stated
        self._limited, self._stated = stated is None or bool(np.isfinite(stated)), stated
        try:
            yield
        finally:
            self._limited, self._stated = before

    @contextmanager
    def deciding(self) -> Iterator[None]:
        """Take the budget of a verdict meanwhile."""
        before, self._decides = self._decides, True
        try:
            yield
        finally:
            self._decides = before

    def after(self, trials: Sequence[Trial]) -> Thinking | None:
        """Return the budget of the next choice after trials; None if there is none, or if no speed is known."""
        speed = self._known(trials) if self._limited else None
        if speed is None:
            return None
        timed = [trial.seconds for trial in trials if trial.executed and trial.seconds is not None]
        execution = np.inf if self._manual else statistics.median(timed) if timed else None
        known = [trial.note.thinking for trial in trials if trial.state != "open" and trial.note.thinking is not None]
        thinking = learning.Thinking.after(known, self._stated, execution, speed, self._settings)
        return replace(thinking, seconds=thinking.decisive) if self._decides else thinking

    def _known(self, trials: Sequence[Trial]) -> Speed | None:
        """Return the speed that a trial stores, or that was measured; None if it is not known."""
        noted = (trial.note.thinking for trial in trials if trial.note.thinking is not None)
        stored = (learning.Speed.from_json(each.get("speed")) for each in noted)
        return next((speed for speed in stored if speed is not None), self._speed)

    def measure(self, trials: Sequence[Trial]) -> None:
        """Measure the speed of this machine if choices are limited and no trial stores it."""
        if self._limited and self._known(trials) is None:
            space = self._validation.space
            points = np.random.default_rng(0).random((16, space.dimension))
            measured = learning.Speed.measured(self._validation, space.candidates(points)[:16], self._settings)
            self._speed = None if measured is None else learning.Speed.from_json(learning.speed_to_json(measured))

    @property
    def search_settings(self) -> WorstCaseSettings:
        """The sizes of a search of all tasks."""
        space, batched = self._validation.space, bool(getattr(self._validation.synthesizer, "batched", False))
        return learning.WorstCaseSettings.for_space(space, batched)

    def ledger(self, trials: Sequence[Trial], executions: int) -> Ledger:
        """Return the ledger of the next choice, which is ``spent`` if nothing can be learned within its budget."""
        thinking = self.after(trials)
        if thinking is None:
            return learning.Ledger()
        space, settings = self._validation.space, self.search_settings
        smallest = learning.reduced(settings, thinking.settings.shares[-1])
        data = getattr(self._validation.model, "data", None)
        known = min(len(data), 600) if isinstance(data, Transitions) else 0
        sizes = learning.Sizes.of(thinking.speed, space.dimension, executions, known)
        ledger, few = learning.Ledger(learning.Costs(thinking, sizes)), thinking.settings.few_draws
        ledger.reserve = ledger.seconds("loops", lambda costs: costs.prediction(few) + costs.next_task())
        to_learn = ledger.seconds("learning", lambda costs: costs.learning())
        ledger.owed = ledger.seconds("loops", lambda costs: costs.search(smallest, whole=False) + costs.plan(4))
        if ledger.reserve + ledger.owed + to_learn > thinking.seconds:
            ledger.spent_up = True
            ledger.incomplete = to_learn + ledger.seconds("loops", lambda costs: costs.search(settings))
            ledger.replaced.append("learned dynamics, by the distances alone")
        return ledger

    def noted(self, trials: Sequence[Trial], ledger: Ledger) -> dict[str, Any] | None:
        """Return what the next trial stores of the choice of its task; None without a budget."""
        speed = self._known(trials) if self._limited else None
        return None if speed is None else {"speed": learning.speed_to_json(speed), **ledger.to_json()}
