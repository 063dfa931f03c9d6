r"""The bound on the tasks of a suite that were not executed, by a law of the distances over the task parameters.

The logarithm of the distance is normal about a linear function of the logarithms of positive task parameters, and of
the others as they are, with a flat prior of its coefficients and of :math:`\ln \sigma`. So the logarithm at a task
follows Student's law (Gelman et al., Bayesian Data Analysis, 3rd ed., Sec. 14.2). The bound h has

.. math:: \sum_i P(d_i > h) = 1 - c,

summed over the tasks that are left, so it holds with probability c whatever the dependence of their distances is. The
law knows nothing of a joint's stop or of a contact that no execution has met. So no run of M on a task may leave the
records far, and executions of tasks that were drawn at random among all that were left must not contradict the law of
the executions before them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import scipy

from ctxval._util.arrays import Array, Mask, Rows
from ctxval._util.representation import ShortRepr, counted
from ctxval.certificates.evidence import SuiteRuns
from ctxval.certificates.limits import LIMITS, CheckLimits
from ctxval.certificates.prediction_tests import DRAWN
from ctxval.certificates.sample import SAME, Sample


@dataclass(frozen=True, eq=False)
class DistanceLaw(ShortRepr):
    """Student's laws of the logarithms of r distances."""

    centres: Array  #: their medians ``(r,)``
    scales: Array  #: their scales ``(r,)``
    freedom: int  #: the degrees of freedom

    @classmethod
    def given(cls, features: Array, distances: Array, at: Array) -> Self:
        """Return the laws at features ``(r, k)`` given positive distances ``(n,)`` at others ``(n, k)``, n > k + 1."""
        X, Z = (np.concatenate([np.ones((len(each), 1)), each], axis=1) for each in (features, at))
        y, inverse = np.log(distances), np.linalg.pinv(X)
        freedom = len(X) - X.shape[1]
        variance = float(((y - X @ (inverse @ y)) ** 2).sum() / freedom)
        leverage = ((Z @ inverse) ** 2).sum(axis=1)
        return cls(Z @ (inverse @ y), np.sqrt(variance * (1 + leverage)), freedom)

    def above(self, distance: float) -> Array:
        """Return the probabilities ``(r,)`` that distances exceed a positive one."""
        standardised = (self.centres - np.log(distance)) / np.maximum(self.scales, np.finfo(np.float64).tiny)
        return np.asarray(scipy.special.stdtr(self.freedom, standardised))

    def bound(self, confidence: float) -> float:
        """Return the distance that all stay below with this probability at least."""
        farthest = -scipy.special.stdtrit(self.freedom, (1 - confidence) / len(self.centres))
        low, high = float(self.centres.min()), float((self.centres + farthest * self.scales).max())
        for _ in range(60):
            middle = (low + high) / 2
            exceeds = self.above(np.exp(middle)).sum() > 1 - confidence
            low, high = (middle, high) if exceeds else (low, middle)
        return float(np.exp(high))


@dataclass(frozen=True, eq=False)
class RemainingTasks(ShortRepr):
    """The tasks of a suite that were not executed, and what the others teach of their distances.

    Args:
        sample: the trials, of a suite whose runs of M are known.
        tests: the number of executions of tasks that were drawn at random among those that were left.
    """

    sample: Sample
    tests: int
    limits: CheckLimits = LIMITS

    @property
    def can_be_bounded(self) -> bool:
        """Whether enough positive distances are known for a law, none is unknown, and tasks are left beside tests."""
        sample = self.sample
        if sample.learned is None or sample.learned.suite is None or sample.repeats > 1 or not len(self.rows):
            return False
        needed, untested = self.limits.freedom + self.runs.features.shape[1] + 1, self.tests - len(self.drawn)
        return len(sample) >= needed and untested < len(self.rows) and bool((sample.distances > 0).all())

    @cached_property
    def _same(self) -> Mask:
        """Which task of the suite ``(N, n)`` is that of a trial."""
        return np.asarray(np.abs(self.sample.members[:, None] - self.sample.points).max(axis=2) <= SAME)

    @cached_property
    def rows(self) -> Rows:
        """The rows of the tasks in the suite."""
        return np.flatnonzero(~self._same.any(axis=1))

    @property
    def runs(self) -> SuiteRuns:
        """The runs of M on the tasks of the suite."""
        assert self.sample.learned is not None
        assert self.sample.learned.suite is not None
        return self.sample.learned.suite

    @property
    def _executed(self) -> Array:
        """The features of the trials' tasks ``(n, k)``."""
        return np.asarray(self.runs.features[self._same.argmax(axis=0)])

    @cached_property
    def law(self) -> DistanceLaw:
        """The law of the distances of the tasks, given all executions."""
        return DistanceLaw.given(self._executed, self.sample.distances, self.runs.features[self.rows])

    @property
    def beyond(self) -> Array:
        """How far runs of M leave the records, as shares of the recorded range ``(r,)``."""
        return np.asarray(self.runs.beyond[self.rows])

    @property
    def drawn(self) -> list[int]:
        """The rows of the trials whose tasks were drawn."""
        return [row for row, origin in enumerate(self.sample.origins) if origin in DRAWN]

    def missed_by_tests(self, confidence: float) -> int:
        """Return how many of the tasks that are left may exceed what no drawn task exceeded, whatever their law is.

        Each was drawn at random among those that were left then, so all K are missed with the probability
        ``prod (1 - K / n)`` of the numbers n that were left.
        """
        executed = [len(np.unique(self._same[:, :row].argmax(axis=0))) for row in self.drawn]
        left, count = len(self.sample.members) - np.array(executed, dtype=np.float64), len(self.rows)
        missed = [k for k in range(1, count + 1) if np.prod(1 - k / np.maximum(left, k)) > 1 - confidence]
        return len(missed)

    @cached_property
    def against(self) -> float:
        """The evidence of the drawn tasks against the law of the executions before each.

        The square root of a p-value has an e-value of 1 / (2 sqrt p), and those of one task after the other multiply
        (Vovk and Wang 2021).
        """
        against, (X, y) = 1.0, (self._executed, self.sample.distances)
        for row in self.drawn:
            if row - X.shape[1] - 1 > 0:
                p = float(DistanceLaw.given(X[:row], y[:row], X[row : row + 1]).above(y[row])[0])
                against *= 0.5 / np.sqrt(max(p, np.finfo(np.float64).tiny))
        return against

    def withdrawal(self) -> tuple[str, str] | None:
        """Return the code and the sentence of why the bound is withdrawn; None if it is not."""
        beyond, missing, against = float(self.beyond.max()), self.tests - len(self.drawn), self.against
        if beyond > self.limits.gap:
            return "beyond", (
                f"on a task that was not executed, M leaves the records by {100 * beyond:.3g} % of their range; "
                "execute it"
            )
        if missing > 0:
            return "tests_missing", (
                f"{counted(missing, 'more task')} drawn among those that are left must be executed (`ctxval run` does)"
            )
        if against > self.limits.e_value:
            return "contradicted", (
                f"executions at drawn tasks contradict the law of the distances (e-value {against:.3g}); execute all "
                "tasks"
            )
        return None

    def next_row(self, threshold: float) -> int | None:
        """Return the row of the suite's task to execute next; None if a task that is drawn comes next."""
        code, _ = self.withdrawal() or (None, "")
        if code == "tests_missing":
            return None
        return int(self.rows[(self.beyond if code == "beyond" else self.law.above(threshold)).argmax()])
