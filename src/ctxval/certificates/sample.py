"""The input of a certificate: points of the unit cube, distances, and why each trial was chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval._util.texts import enumerated
from ctxval.certificates.evidence import Learned
from ctxval.core.trial import TOLD_ALONE, Origin, State, Trial
from ctxval.errors import CertificateError

SAME = 1e-9
"""Points of the unit cube that differ by no more than this are the same task."""


@dataclass(frozen=True)
class RecoveredFailure(ShortRepr):
    """A failed trial whose task was executed with success later."""

    trial: int  #: number of the trial that failed
    by: int  #: number of the trial that succeeded
    because: str | None  #: what was changed on the system in between; None if nobody stated it


@dataclass(frozen=True, eq=False)
class Sample(ShortRepr):
    """Executed trials as a certificate sees them: points, distances, and why each task was chosen.

    Raises:
        CertificateError: if trials are open, or if the lists differ in length.
    """

    points: Array  #: tasks as points of the unit cube, shape ``(n, d)``
    distances: Array  #: their distances, shape ``(n,)``; NaN if the execution failed or could not be measured
    origins: Sequence[Origin]  #: why each task was chosen, n entries
    states: Sequence[State]  #: the state of each trial, n entries; none may be open
    numbers: Sequence[int] = ()  #: numbers of the trials, for messages; 0, 1, ... by default.
    #: for each trial, the total number of independent draws that was planned when it was drawn; 0 if they were to end
    #: with the verdict, None if that is not known
    planned: Sequence[int | None] = ()
    made_good: tuple[RecoveredFailure, ...] = ()  #: left-out failures whose tasks were executed later
    learned: Learned | None = None  #: what the experiment's model predicts; None if it is not loaded
    distribution: str | None = None  #: the distribution of tasks as a text; None if it is uniform
    suite: Array | None = None  #: the tasks of a suite, points of the unit cube ``(N, d)``; None if tasks fill the box
    repeats: int = 1  #: how often each task of the suite may be executed, because executions of one task differ
    threshold: float | None = None  #: the threshold that is to be decided; None if there is none
    selected: float = 1.0  #: the share of all hypercubes that those of the tests were chosen from

    def __post_init__(self) -> None:
        if not len(self.numbers):
            object.__setattr__(self, "numbers", range(len(self.points)))
        if not len(self.planned):
            object.__setattr__(self, "planned", [None] * len(self.points))
        parts = (self.points, self.distances, self.origins, self.states, self.numbers, self.planned)
        if len(lengths := {len(part) for part in parts}) != 1:
            raise CertificateError(
                "points, distances, origins, states, numbers and planned must be equally many, got lengths "
                f"{sorted(lengths)}."
            )
        if waiting := self.numbers_of("open"):
            numbers = ", ".join(map(str, waiting))
            raise CertificateError(f"trials are open: {numbers}; tell how they ended before certifying.")

    def __len__(self) -> int:
        return len(self.distances)

    @classmethod
    def of(cls, trials: Sequence[Trial], learned: Learned | None = None) -> Sample:
        """Return the sample of a campaign's trials; a task that failed before its execution has failed as well.

        A failure is left out if the same task was executed with success later, unless it is an independent draw. The
        order of trials that people chose or imported has no meaning, so they are sorted by their tasks.

        Raises:
            CertificateError: if there are no trials.
        """
        if not trials:
            raise CertificateError("nothing was executed yet, so nothing can be certified.")
        made_good = list[RecoveredFailure]()
        for trial in trials:
            if trial.state == "failed" and trial.ended_alone is None and trial.origin != "iid":
                later = [success for success in executions_of(trial, trials) if success.number > trial.number]
                by = next((success for success in later if success.because), later[0] if later else None)
                if by is not None:
                    made_good.append(RecoveredFailure(trial.number, by.number, by.because))
        # A distance that was told alone under another definition does not matter if the task was executed again.
        alone = [trial for trial in trials if trial.failure == TOLD_ALONE and trial.origin != "iid"]
        left_out = {failure.trial for failure in made_good} | {t.number for t in alone if executions_of(t, trials)}
        counted = [trial for trial in trials if trial.number not in left_out]
        places = [place for place, trial in enumerate(counted) if trial.origin == "manual"]
        manual = sorted(
            (counted[place] for place in places),
            key=lambda trial: (trial.unit_point.tolist(), np.inf if trial.distance is None else trial.distance),
        )
        for place, trial in zip(places, manual, strict=True):
            counted[place] = trial
        planned = [trial.note.draws if trial.origin == "iid" else None for trial in counted]
        return cls(
            np.array([trial.unit_point for trial in counted]),
            np.array([np.nan if trial.distance is None else trial.distance for trial in counted]),
            [trial.origin for trial in counted],
            [trial.state for trial in counted],
            [trial.number for trial in counted],
            planned,
            tuple(made_good),
            learned,
            selected=float(np.prod([chosen[1] for trial in trials if (chosen := trial.note.hypercube)])),
        )

    def only(self, origin: Origin) -> Sample:
        """Return the trials of one origin."""
        return self.rows([row for row, each in enumerate(self.origins) if each == origin])

    def rows(self, rows: Sequence[int]) -> Sample:
        """Return some of the trials."""
        names = ("origins", "states", "numbers", "planned")
        lists: dict[str, Any] = {name: [getattr(self, name)[row] for row in rows] for name in names}
        return replace(self, points=self.points[list(rows)], distances=self.distances[list(rows)], **lists)

    @property
    def countable(self) -> list[int]:
        """Rows of the independent draws whose number was chosen before they were executed.

        If the number was raised after some were known, these are the draws of the last decision.
        """
        rows = [row for row, origin in enumerate(self.origins) if origin == "iid"]
        plans = [self.planned[row] for row in rows if self.planned[row] != 0]  # 0: the draws end with the verdict
        return [row for row in rows if plans and self.planned[row] == plans[-1]]

    def with_countable_draws(self) -> Sample:
        """Return the sample in which only the countable draws are independent draws, and the others like a search's."""
        kept, origins = set(self.countable), list(self.origins)
        for row, origin in enumerate(origins):
            if origin == "iid" and row not in kept:
                origins[row] = "acquisition"
        return replace(self, origins=origins)

    @property
    def members(self) -> Array:
        """The tasks of the suite, points of the unit cube ``(N, d)``.

        Raises:
            CertificateError: if tasks fill a box.
        """
        if self.suite is None:
            raise CertificateError("tasks fill a box here, so they cannot all be executed; this kind is for a suite.")
        return self.suite

    @property
    def tasks(self) -> int | None:
        """The number of tasks of the suite; None if tasks fill the box."""
        return None if self.suite is None else len(self.suite)

    @property
    def is_uniform(self) -> bool:
        """Whether tasks fill the box and are distributed uniformly over it."""
        return self.distribution is None and self.suite is None

    @property
    def not_executed(self) -> int | None:
        """The number of tasks of the suite without a distance; None if tasks fill the box."""
        if self.suite is None:
            return None
        known = self.points[np.isfinite(self.distances)]
        return sum(not np.abs(known - task).max(axis=1, initial=0.0).min(initial=np.inf) <= SAME for task in self.suite)

    @property
    def best(self) -> float:
        """The largest distance; minus infinity if no distance is known."""
        return float(np.nanmax(self.distances, initial=-np.inf))

    @property
    def failed(self) -> int:
        """The number of trials without a distance: they failed, or could not be measured."""
        return int(np.isnan(self.distances).sum())

    def numbers_of(self, state: State) -> list[int]:
        """Return the numbers of the trials in a state."""
        return [number for number, each in zip(self.numbers, self.states, strict=True) if each == state]

    def differing(self, tolerance: float) -> tuple[int, int] | None:
        """Return the rows of the first execution of a task and of the one most unlike it, beyond a tolerance."""
        _, firsts, tasks = np.unique(self.points, axis=0, return_index=True, return_inverse=True)
        first_of = firsts[tasks.ravel()]
        differences = np.nan_to_num(np.abs(self.distances - self.distances[first_of]), nan=0.0, posinf=0.0)
        row = int(differences.argmax())
        return (int(first_of[row]), row) if differences[row] > tolerance else None

    @property
    def repeats_differ(self) -> bool:
        """Whether two executions of one task differ by more than rounding, so that the system is stochastic."""
        return self.differing(1e-6 * float(np.ptp(self.distances))) is not None

    @property
    def failures(self) -> dict[str, list[Any]]:
        """The trials that failed, that could not be measured and that were made good, ready for JSON."""
        failed, unmeasured = self.numbers_of("failed"), self.numbers_of("unmeasured")
        return {"failed": failed, "unmeasured": unmeasured, "made_good": [asdict(each) for each in self.made_good]}

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on the trials that failed, that could not be measured and that were made good."""
        failed, unmeasured = self.numbers_of("failed"), self.numbers_of("unmeasured")
        remarks = [f"{listed(failed)} failed, and no distance is known there"] if failed else []
        remarks += [_unmeasured(unmeasured)] if unmeasured else []
        for by, because in dict.fromkeys((failure.by, failure.because) for failure in self.made_good):
            which = listed([failure.trial for failure in self.made_good if failure.by == by])
            why = "nobody stated why" if because is None else f"you state why: {because!r}"
            remarks.append(f"{which} failed, and trial {by} executed the same task with success; {why}")
        return tuple(remarks)


def require_learned(sample: Sample, kind: str) -> Learned:
    """Return the predictions that come with a sample, which this kind of certificate needs.

    Raises:
        CertificateError: if the experiment is not loaded.
    """
    if sample.learned is None:
        raise CertificateError(
            f"the {kind} certificate uses what the experiment's model predicts, but the experiment is not loaded: use "
            "`ctxval certify`, Campaign.verdict, or Provenance(learned=...)."
        )
    return sample.learned


def listed(numbers: Sequence[int]) -> str:
    """Return numbers of trials as text; if there are many, only the first five."""
    first = enumerated(numbers, 5)
    return f"trial {first}" if len(numbers) == 1 else f"{len(numbers)} trials ({first})"


def _unmeasured(numbers: Sequence[int]) -> str:
    was = "was" if len(numbers) == 1 else "were"
    return f"{listed(numbers)} {was} executed, but the distance could not be measured"


def advice_to_remeasure(sample: Sample) -> str:
    """Return a sentence on what to do about trials that were executed but not measured; empty if there are none."""
    numbers = sample.numbers_of("unmeasured")
    if not numbers:
        return ""
    what = _unmeasured(numbers)
    return (
        f" {what[0].upper()}{what[1:]}: correct the distance, then measure the recorded executions with `ctxval "
        "remeasure STORE`; if an execution was not recorded, execute its task again."
    )


def without_success(trials: Sequence[Trial]) -> list[Trial]:
    """Return the trials without a distance whose task was not executed with success later."""
    unknown = (trial for trial in trials if trial.distance is None and trial.state != "open")
    return [each for each in unknown if all(other.number < each.number for other in executions_of(each, trials))]


def executions_of(trial: Trial, trials: Sequence[Trial]) -> list[Trial]:
    """Return the trials with a distance that executed the task of a trial; scaling rounds their unit-cube points."""
    known = [other for other in trials if other.distance is not None]
    return [other for other in known if np.abs(other.unit_point - trial.unit_point).max() <= SAME]
