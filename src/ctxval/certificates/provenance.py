"""What is known of trials besides their numbers: the task space, units, and changes of their store."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctxval._util.representation import ShortRepr
from ctxval.certificates.base import Certificate
from ctxval.certificates.bounds import Quantities
from ctxval.certificates.dynamics_evidence import LearnedDistance
from ctxval.certificates.sentences import verdicts as sentences
from ctxval.certificates.sentences import withdrawals
from ctxval.core.space import DISTRIBUTION, TaskSpace
from ctxval.core.task_distribution import distribution_text
from ctxval.core.task_suite import SUITE, TaskSuite
from ctxval.core.trial import Change, StatedThreshold, Trial
from ctxval.errors import InputError


@dataclass(frozen=True, eq=False)
class Neighbour(ShortRepr):
    """Another store of the same experiment: its path, and its worst trial; None if it knows no distance."""

    path: Path
    worst: Trial | None = None

    def falsifies(self, threshold: float) -> bool:
        """Return whether one of its distances exceeds a threshold."""
        return self.worst is not None and (self.worst.distance or 0.0) > threshold


@dataclass(frozen=True, eq=False)
class Provenance(ShortRepr):
    """Facts on a campaign, besides its trials, that concern a certificate."""

    space: TaskSpace | None = None  #: the task space, to state lengths in its units; None if it is not known
    #: sentences that a certificate lists among its assumptions, such as what was changed on the system
    remarks: tuple[str, ...] = ()
    #: what the experiment's model predicts, for kinds that need it; None if the experiment is not loaded
    learned: LearnedDistance | None = None
    distribution: str | None = None  #: the distribution of tasks as a text; None if it is uniform
    units: str = ""  #: the units of the distance
    #: the largest offset of the start of an execution, as the distance measures it, and as a text; None if executions
    #: were not recorded
    start: tuple[float, str] | None = None
    #: the thresholds in the order in which they were first stated; None if nobody has recorded them
    thresholds: tuple[StatedThreshold, ...] | None = None
    beside: tuple[Neighbour, ...] = ()  #: the other stores of the same experiment beside this one

    @classmethod
    def of(
        cls,
        description: Mapping[str, Any],
        changes: Iterable[Change] = (),
        thresholds: tuple[StatedThreshold, ...] | None = None,
        beside: Iterable[Neighbour] = (),
    ) -> Provenance:
        """Return the provenance from what a store says of its experiment, and from the stores beside it."""
        described, remarks = dict[str, Any](), list[str]()
        match description:
            case {"validation": {"space": dict(space)}}:
                described = space
        match description:
            case {"validation": {"model": {"type": "Refined"}}}:
                remarks.append(withdrawals.REFINED)
        distribution = described.get(DISTRIBUTION)
        for change in changes:
            if change.what == "accepted":
                different = "; ".join(change.content.get("differences", [])[:1]) or "nothing that is described"
                trials = change.content.get("trials", "some")
                remarks.append(withdrawals.ACCEPTED.format(trials=trials, why=change.why, differences=different))
            elif change.what == "remeasured":
                remarks.append(withdrawals.MEASURED_ANEW.format(why=change.why))
            elif change.what == "replaced":
                numbers = ", ".join(change.content.get("before", {}))
                remarks.append(withdrawals.REPLACED.format(numbers=numbers, why=change.why))
        return cls(
            space=_space_of(described),
            remarks=tuple(remarks),
            distribution=None if distribution is None else distribution_text(distribution),
            thresholds=thresholds,
            beside=tuple(beside),
        )

    def caution(self, threshold: float) -> str:
        """Return what speaks against any answer, each as a sentence after a space; empty if nothing does."""
        above = [(other.path.name, other.worst) for other in self.beside if other.worst and other.falsifies(threshold)]
        caution = sentences.falsified_beside(above, threshold, self.quantities)
        if self.start is not None and self.start[0] > threshold:
            limit = self.quantities.of(f"{threshold:.6g}")
            caution += f" The start of an execution was off by {self.start[1]}; the threshold is {limit}."
        return caution

    def known_before(self, threshold: float, trials: Sequence[Trial]) -> int:
        """Return how many distances were known when a threshold was first stated; 0 if no thresholds were recorded."""
        if self.thresholds is None:
            return 0
        first = (stated.distances for stated in self.thresholds if stated.threshold == threshold)
        return next(first, sum(trial.distance is not None for trial in trials))

    def looked(self, certificate: Certificate, threshold: float, trials: Sequence[Trial], volume: float = 0.0) -> str:
        """Return, as the end of a sentence, whether a validated threshold was chosen after looking; empty if not."""
        stated = [each.threshold for each in self.thresholds or ()]
        before = stated[: stated.index(threshold)] if threshold in stated else stated
        smaller = sorted(each for each in before if each < threshold and not certificate.covers(each, volume))
        largest = max((trial.distance or 0.0 for trial in trials), default=0.0)
        return sentences.looked(self.known_before(threshold, trials), smaller, largest, self.quantities)

    def alone(self, threshold: float, trials: Sequence[Trial]) -> list[str]:
        """Return what a validation rests on besides its certificate: that neither tau nor the campaign was selected."""
        falsifying = [other.path.name for other in self.beside if other.falsifies(threshold)]
        return sentences.not_selected(self.known_before(threshold, trials), len(self.beside), falsifying)

    @property
    def quantities(self) -> Quantities:
        """The units and tasks of sentences."""
        return Quantities(self.units, self.space)

    @property
    def stated(self) -> tuple[str, ...]:
        """The remarks that are the user's word, on which a validation rests."""
        return tuple(remark for remark in self.remarks if remark != withdrawals.REFINED)


def _space_of(described: Mapping[str, Any]) -> TaskSpace | None:
    """Return a task space that is described; None if it cannot be read, as only sentences depend on it."""
    try:
        if SUITE in described:
            return TaskSuite.described(described)
        bounds: dict[str, tuple[Any, ...]] = {}
        for name, bound in described.items():
            if name in ("type", DISTRIBUTION):
                continue
            low, high, *unit = bound
            vector = name.partition("[")[0]
            lows, highs, *_ = bounds.get(vector, ([], []))
            bounds[vector] = (low, high, *unit) if vector == name else ([*lows, low], [*highs, high], *unit)
        return TaskSpace(**bounds)
    except (TypeError, ValueError, InputError):
        return None
