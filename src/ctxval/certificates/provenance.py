"""What is known of trials besides their numbers: the task space, units, and changes of their store."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctxval._util.representation import ShortRepr
from ctxval.certificates.bounds import Quantities
from ctxval.certificates.evidence import Learned
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
    remarks: tuple[str, ...] = ()  #: assumptions of certificates, such as what was changed on the system
    learned: Learned | None = None  #: what the experiment's model predicts; None if it is not loaded
    distribution: str | None = None  #: the distribution of tasks as a text; None if it is uniform
    units: str = ""  #: the units of the distance
    start: tuple[float, str] | None = None  #: largest offset of a start, by the distance and as a text; None: unknown
    thresholds: tuple[StatedThreshold, ...] | None = None  #: in the order of being stated; None if nobody recorded them
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
            elif change.what == "set aside":
                remarks.append(withdrawals.SET_ASIDE.format(why=change.why))
        shares = described.get(DISTRIBUTION)
        stated = None if shares is None else distribution_text(shares)
        others = tuple(beside)
        return cls(_space_of(described), tuple(remarks), None, stated, thresholds=thresholds, beside=others)

    def known_before(self, threshold: float, trials: Sequence[Trial]) -> int:
        """Return how many distances were known when a threshold was first stated; 0 if no thresholds were recorded."""
        if self.thresholds is None:
            return 0
        first = (stated.distances for stated in self.thresholds if stated.threshold == threshold)
        return next(first, sum(trial.distance is not None for trial in trials))

    @property
    def quantities(self) -> Quantities:
        """The units and tasks of sentences."""
        return Quantities(self.units, self.space)


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
