"""The origin of trials: the task space, the search, and changes of their store."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ctxval._util.representation import ShortRepr
from ctxval.certificates.learned import LearnedDistance
from ctxval.certificates.sample import Sample
from ctxval.core.space import DISTRIBUTION, TaskSpace
from ctxval.core.task_distribution import distribution_text
from ctxval.core.trial import Change, Trial
from ctxval.errors import InputError


@dataclass(frozen=True, eq=False)
class Provenance(ShortRepr):
    """Facts on a campaign, besides its trials, that concern a certificate.

    Attributes:
        space: the task space, to state lengths in its units; None if it is not known.
        search: the type of the search that chose the tasks; None if it is not known.
        remarks: sentences that a certificate lists among its assumptions, such as what was changed on the system.
        learned: what the experiment's model predicts, for kinds that need it; None if the experiment is not loaded.
        distribution: the distribution of tasks as a text; None if it is uniform.
        start: the largest offset of the start of an execution, as the distance measures it, and as a text; None if
            executions were not recorded.
    """

    space: TaskSpace | None = None
    search: str | None = None
    remarks: tuple[str, ...] = ()
    learned: LearnedDistance | None = None
    distribution: str | None = None
    start: tuple[float, str] | None = None

    @classmethod
    def of(cls, description: Mapping[str, Any], changes: Iterable[Change] = ()) -> Provenance:
        """Return the provenance from a store's description of its experiment and its list of changes."""
        search = description.get("search")
        return cls(
            space=_space_of(description),
            search=search.get("type") if isinstance(search, dict) else None,
            remarks=(*_remarks_on_model(description), *remarks_on(changes)),
            distribution=_distribution_of(description),
        )

    def caution(self, threshold: float) -> str:
        """Return a sentence if an execution started farther from its task than the threshold; empty if none did."""
        if self.start is None or self.start[0] <= threshold:
            return ""
        return f" The start of an execution was off by {self.start[1]}; the threshold is {threshold:.6g}."

    def sample(self, trials: Sequence[Trial]) -> Sample:
        """Return trials as a certificate sees them, with what is known here.

        Raises:
            CertificateError: if there is no trial, or one is still open.
        """
        return replace(Sample.of(trials, self.search, self.learned), distribution=self.distribution)


def remarks_on(changes: Iterable[Change]) -> tuple[str, ...]:
    """Return sentences on later changes of a store, for a certificate's assumptions."""
    found = []
    for change in changes:
        if change.what == "accepted":
            different = "; ".join(change.content.get("differences", [])[:1]) or "nothing that is described"
            found.append(
                f"what was changed after {change.content.get('trials', 'some')} trials makes no difference to them, as "
                f"you state: {change.why!r} ({different})"
            )
        elif change.what == "remeasured":
            found.append(f"the distances are those measured anew: {change.why!r}")
        elif change.what == "replaced":
            numbers = ", ".join(change.content.get("before", {}))
            found.append(f"the result of trial {numbers} that was told first is wrong, as you state: {change.why!r}")
    return tuple(found)


def _remarks_on_model(description: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what a certificate says of a model that was refined."""
    try:
        refined = description["validation"]["model"]["type"] == "Refined"
    except (KeyError, TypeError):
        refined = False
    return (REFINED,) if refined else ()


REFINED = (
    "the model was learned again from executions of earlier models: these are data of the model and no trials of it, "
    "so only executions under its own controllers are counted"
)
"""What a certificate says of a model that was refined."""


def _distribution_of(description: Mapping[str, Any]) -> str | None:
    """Return the distribution of tasks in a description as a text; None if tasks are uniform."""
    try:
        described = description["validation"]["space"].get(DISTRIBUTION)
    except (KeyError, TypeError, AttributeError):
        return None
    return None if described is None else distribution_text(described)


def _space_of(description: Mapping[str, Any]) -> TaskSpace | None:
    """Return the task space of a description; None if it has none that can be read."""
    try:
        described = dict(description["validation"]["space"])
        described.pop("type", None)
        described.pop(DISTRIBUTION, None)
        bounds: dict[str, tuple[Any, ...]] = {}
        for name, (low, high, *unit) in described.items():
            vector = name.partition("[")[0]
            lows, highs, *_ = bounds.get(vector, ([], []))
            bounds[vector] = (low, high, *unit) if vector == name else ([*lows, low], [*highs, high], *unit)
        return TaskSpace(**bounds)
    except (KeyError, TypeError, ValueError, InputError):
        return None  # only the units in a sentence depend on it
