"""What every certificate says of itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ctxval.arrays import Array
from ctxval.errors import CertificateError
from ctxval.trial import Origin, State, Trial
from ctxval.version import VERSION

_SAME_TASK = 1e-9
"""How far points of the unit cube may be apart that are one task: parameters are scaled there and back."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Executed trials, as far as a certificate may know of them: numbers and why they were chosen.

    Attributes:
        points: of the unit cube, shape ``(n, d)``.
        distances: shape ``(n,)``; NaN where the execution failed.
        origins: n reasons why a trial was chosen.
        states: n states; open trials are refused by every certificate.
        numbers: of the trials, for messages; 0, 1, ... by default.

    Raises:
        CertificateError: the parts do not fit together, or a trial is still open.
    """

    points: Array
    distances: Array
    origins: Sequence[Origin]
    states: Sequence[State]
    numbers: Sequence[int] = ()

    def __post_init__(self) -> None:
        if not len(self.numbers):
            object.__setattr__(self, "numbers", range(len(self.points)))
        lengths = {len(self.points), len(self.distances), len(self.origins), len(self.states), len(self.numbers)}
        if len(lengths) != 1:
            raise CertificateError(
                f"points, distances, origins, states and numbers must be equally many, got {sorted(lengths)}."
            )
        if "open" in self.states:
            raise CertificateError(
                f"{list(self.states).count('open')} trials are open; tell how they ended before certifying."
            )

    def __len__(self) -> int:
        return len(self.distances)

    @classmethod
    def of(cls, trials: Sequence[Trial]) -> Sample:
        """Return what a certificate may know of trials; a task that failed before its execution has failed as well.

        A failure does not count where the same task was executed with success later, but for independent draws: those
        are what they are.

        Raises:
            CertificateError: there is none, or one is still open.
        """
        if not trials:
            raise CertificateError("nothing was executed yet, so nothing can be certified.")
        good = _made_good(trials)
        count = [trial for trial in trials if trial.number not in good]
        return cls(
            np.array([trial.unit_point for trial in count]),
            np.array([np.nan if trial.distance is None else trial.distance for trial in count]),
            [trial.origin for trial in count],
            [trial.state for trial in count],
            [trial.number for trial in count],
        )

    def only(self, origin: Origin) -> Sample:
        """Return the trials of one origin."""
        rows = [row for row, own in enumerate(self.origins) if own == origin]
        states, numbers = [self.states[row] for row in rows], [self.numbers[row] for row in rows]
        return Sample(self.points[rows], self.distances[rows], [origin] * len(rows), states, numbers)

    @property
    def best(self) -> float:
        """The largest distance; minus infinity where none is known."""
        return float(np.nanmax(self.distances, initial=-np.inf))

    @property
    def failed(self) -> int:
        """How many executions failed."""
        return int(np.isnan(self.distances).sum())


def _made_good(trials: Sequence[Trial]) -> set[int]:
    """Return the numbers of the trials that failed, but whose tasks were executed with success later."""
    known = [trial for trial in trials if trial.distance is not None]
    failed = [trial for trial in trials if trial.state == "failed" and trial.origin != "iid"]
    if not known or not failed:
        return set()
    points, numbers = np.array([trial.unit_point for trial in known]), np.array([trial.number for trial in known])
    return {
        trial.number
        for trial in failed
        if ((np.abs(points - trial.unit_point).max(axis=1) <= _SAME_TASK) & (numbers > trial.number)).any()
    }


@dataclass(frozen=True)
class Certificate:
    """A statement on d*, with everything it rests on.

    Attributes:
        kind: which theory.
        statement: what it says, in one sentence.
        upper_bound: h, in the distance's units.
        confidence: the probability of the statement, over what ``assumptions`` say is random.
        volume: the share of the task space that the statement leaves out; 0 where it covers all of it.
        trials: n.
        assumptions: what must hold, in plain words.
        details: the numbers behind it.
        doubt: why it is withdrawn, where the trials speak against what it assumes; a user must not believe it then.
        version: of ctxval.
    """

    kind: str
    statement: str
    upper_bound: float
    confidence: float
    volume: float
    trials: int
    assumptions: tuple[str, ...]
    details: dict[str, Any] = field(default_factory=dict)
    doubt: str | None = None
    version: str = VERSION

    def covers(self, threshold: float, volume: float = 0.0) -> bool:
        """Return whether it bounds the distance by the threshold, but for a volume that is acceptable."""
        return self.doubt is None and self.volume <= volume and self.upper_bound <= threshold

    def to_json(self) -> dict[str, Any]:
        """Return everything, ready for JSON."""
        return asdict(self)


def at_most(value: float, digits: int = 4) -> str:
    """Return a bound as text, rounded up: what is printed must not be smaller than what holds."""
    short = f"{value:.{digits}g}"
    if float(short) >= value or not np.isfinite(value):
        return short
    return f"{value + 10.0 ** (np.floor(np.log10(abs(value))) - digits + 1):.{digits}g}"


def require_probability(name: str, value: float) -> float:
    """Return a probability strictly between 0 and 1.

    Raises:
        CertificateError: it is not.
    """
    if not 0 < value < 1:
        raise CertificateError(f"{name} must be strictly between 0 and 1, got {value!r}.")
    return float(value)
