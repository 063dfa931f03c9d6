"""Evidence: what the executions of a campaign teach, as one frozen value that certificates, checks and choices read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.certificates.bounds import rank_of
from ctxval.certificates.explained import ExplainedExecution
from ctxval.certificates.limits import LIMITS, CheckLimits
from ctxval.certificates.prediction_tests import MANY, TESTS
from ctxval.certificates.predictions import CheckedPrediction, latest_tests
from ctxval.core.coverage import StateInputCoverage, UnsampledCorner, UnsampledParameter, UntestedRest, UnvisitedRegion
from ctxval.core.learned_numbers import PushedDistances
from ctxval.core.target import LARGEST_DISTANCE, Target


@dataclass(frozen=True, eq=False)
class Evidence(ShortRepr):
    """What executions teach of the dynamics and of d*, computed once after each execution; the checks read it."""

    maxima: Array  #: the largest distance over all tasks of each draw, shape ``(S,)``; infinity if its loop diverges
    points: Array  #: where it lies, points of the unit cube ``(S, d)``
    highest: float  #: the largest distance on the posterior mean, and below it those of other tasks
    local_maxima: Array  #: tasks with large distances on the posterior mean, points ``(e, d)``, the largest first
    evaluations: int  #: number of closed loops on learned dynamics that were run to find the maxima
    executions: int  #: number of executions with a trajectory, from which the dynamics were learned
    left_out: float  #: share of the posterior variance that a draw leaves out between its pivots
    noise: float  #: learned variance of noise, as a share of the mean square of the residual
    predictions: tuple[CheckedPrediction, ...]  #: predictions and executions, in the order of the trials
    coverage: StateInputCoverage  #: how well the records cover the closed loops of the tasks
    groups: int = 2  #: number of draws that share hyperparameters
    unplanned: float = 0.0  #: share of the tasks for which no controller can be designed, or on which M diverges
    unsampled_parameter: UnsampledParameter | None = None  #: a parameter that M's loops do not depend on
    unsampled_corner: UnsampledCorner | None = None  #: the corner of a position farthest from executed tasks
    without_model: bool = False  #: whether the system was learned without M, because M is rougher than the system
    peak_ratio: float = 0.0  #: largest share by which a large distance on the mean exceeds those of nearly same tasks
    jump: float = 0.0  #: largest jump of the distance on the mean between nearly the same tasks; 0 if not computed
    low_dimensional: bool = False  #: whether an intensified search can find maxima in spite of jumps
    search_shortfall: float = 1.0  #: factor by which intensified searches find a larger maximum; at least 1
    disagreement: float = 0.0  #: share by which the smaller result of these searches is below the larger one
    tests: int = TESTS  #: the number of tests that a bound needs; see :mod:`~ctxval.certificates.prediction_tests`
    pushed: PushedDistances | None = None  #: largest distances under pushes; None if the bound is withdrawn anyway
    target: Target = LARGEST_DISTANCE  #: what the maxima are in each draw: by default, the largest distance
    lags: int = 0  #: number of earlier records and inputs that the learned dynamics depend on
    acting: Mapping[str, float] = field(default_factory=dict)  #: sizes of effects of inputs by labels, such as a delay
    #: the dry friction at each input, by its label, the most at rest if that is more, and its share of the input if it
    #: grows with it; empty if what M misses is smooth
    friction: Mapping[str, float] = field(default_factory=dict)
    unvisited_region: UnvisitedRegion | None = None  #: the largest region that no execution has entered
    physical: tuple[str, ...] = ()  #: the task parameters that the learned dynamics depend on
    #: another one that they seem to depend on, and how many times less predictions of executions from the others err
    #: with it; None if predictions hold, or if there is none
    suspect: tuple[str, float] | None = None
    without_data: bool = False  #: whether the data that M was made from are left out, as they contradict the executions
    estimated: bool = False  #: whether states of M are estimated from recorded outputs
    executed: tuple[ExplainedExecution, ...] = ()  #: all executions beside what they teach; empty in a screening
    #: the execution of which the learned noisy dynamics depend most, if its task was executed once; else None
    influential: tuple[float, ...] | None = None
    drift: tuple[str, float] | None = None  #: with what effects of executions change, and its p-value; None without any
    #: of friction at rest, by how many times a force that a joint withstood exceeds one that moved it elsewhere
    uneven: float = 1.0
    untested_rest: UntestedRest | None = None  #: where friction at rest was not tested; None without dry friction
    #: the uncertain parameters of M: median, 5 % and 95 % quantile of each by its name; empty without any
    parameters: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    #: of M with uncertain parameters, the deviation of a task's distance that they leave, as a share of the largest
    scatter: float = 0.0
    #: the largest distance under errors of M as small as all that were recorded; 0 if such errors are learned
    negligible: float = 0.0
    replaced: tuple[str, ...] = ()  #: stages that were left out, or replaced by cheaper ones, for lack of time
    # The question
    best: float = 0.0  #: the largest executed distance
    worst: tuple[float, ...] = ()  #: its task, a point of the unit cube ``(d,)``; empty if it is not known
    confidence: float = 0.95  #: that of the bound
    threshold: float | None = None  #: the value that the bound must not exceed; None if there is none
    idle: tuple[int, ...] = ()  #: the indices of the task parameters that M's loops do not depend on
    settings: CheckLimits = LIMITS  #: the limits of the checks, with those of noise

    @cached_property
    def limits(self) -> CheckLimits:
        """The limits of the checks."""
        return self.settings.of_noise() if self.target.is_noisy else self.settings

    @property
    def is_parametric(self) -> bool:
        """Whether uncertain parameters of M are learned."""
        return bool(self.parameters)

    @property
    def holds_beyond_records(self) -> bool:
        """Whether parameters of M take the place of coverage: with more coordinates than executions can cover."""
        return self.is_parametric and self.coverage.pair is None

    @property
    def rank(self) -> int:
        """The row, in ascending order, of the maximum that d* stays below with the confidence."""
        return min(rank_of(self.confidence, len(self.maxima)), len(self.maxima)) - 1

    @property
    def upper(self) -> float:
        """The maximum that d* stays below with the confidence."""
        return float(np.sort(self.maxima)[self.rank])

    @property
    def error(self) -> float:
        """The standard error of :attr:`upper` over draws of the hyperparameters, by a bootstrap over them."""
        blocks = self.maxima.reshape(-1, self.groups)
        rows = np.random.default_rng(0).integers(len(blocks), size=(200, len(blocks)))
        resampled = np.sort(blocks[rows].reshape(200, -1), axis=1)[:, self.rank]
        return float(resampled.std(ddof=1)) if np.isfinite(resampled).all() else np.inf

    @cached_property
    def bound(self) -> float:
        """The order statistic of the maxima, raised by what searches and predictions have missed."""
        last = self.predictions[-self.limits.predictions :]
        upper = self.target.raised(self.upper * self.search_shortfall, self.best)
        return upper + 0.5 * max((prediction.excess for prediction in last), default=0.0)

    @cached_property
    def raised(self) -> float:
        """The bound that the errors of predictions which failed leave credible.

        Such an error is a small share of the rise, so only a threshold far above the bound is kept.
        """
        worst = self.failed
        return self.bound if worst is None else self.bound + worst.error / self.limits.error

    @property
    def most_beyond(self) -> float:
        """By how much closed loops may leave the records, as a share of the visited range."""
        if self.coverage.pair is None:
            return self.limits.gap  # each extreme of so many coordinates would take an execution of its own
        return self.limits.beyond

    @property
    def jumps(self) -> bool:
        """Whether the distance is no smooth function of the task, so that a search may miss the largest one."""
        return self.peak_ratio > self.limits.peak_ratio or self.jump > self.limits.jump * self.bound

    # Which predictions held; ``bound`` is the distance by whose share errors are judged

    def counted(self, bound: float | None = None) -> list[CheckedPrediction]:
        """Return the predictions that count: those that failed, and those that held where they could have failed.

        A prediction of a task like an earlier one tells nothing, nor does a later one of a run that a person imported.
        """
        scale = self.bound if bound is None else bound
        return [
            each
            for each in self.predictions
            if not each.held(scale, self.limits) or (each.new and (each.stored or each.origin != "manual"))
        ]

    def own_error(self, prediction: CheckedPrediction, bound: float) -> float:
        """Return the largest error with which the prediction of a test at a drawn task holds.

        Most drawn tasks have small distances, where a share of the bound is a large error. So it is a share of the
        test's own distance or, if that is more, a multiple of the usual error.
        """
        limits = self.limits
        errors = [each.error for each in self.predictions if each.is_test and not each.is_noisy]
        own = limits.error * max(prediction.median, limits.small * bound)
        return min(limits.error * bound, max(own, limits.usual * float(np.median(errors) if errors else np.inf)))

    def holds(self, prediction: CheckedPrediction, bound: float | None = None) -> bool:
        """Return whether a prediction held; if it is one of a drawn test, also by its own distance."""
        scale = self.bound if bound is None else bound
        if prediction.is_noisy or not prediction.is_test:
            return prediction.held(scale, self.limits)
        return prediction.error <= self.own_error(prediction, scale)

    def explains(self, prediction: CheckedPrediction, bound: float | None = None) -> bool:
        """Return whether the final law has the distance that was executed; unknown ones count as explained.

        If the dynamics depend on the task, one function of state and input cannot have the distances of all tasks.
        Noise explains none of its executions, and may be any of them.
        """
        known, scale = prediction.explained, self.bound if bound is None else bound
        if prediction.is_noisy or known is None:
            return True
        return abs(prediction.distance - known) <= self.own_error(prediction, scale)

    @cached_property
    def failed(self) -> CheckedPrediction | None:
        """The one that failed most of the tests and of the last predictions that count; None if all of them held.

        Later tests outlive a test that failed only if the final law explains it.
        """
        lasting = [each for each in self.predictions if self.tests and each.is_test and not self.explains(each)]
        last = [*latest_tests(self.predictions, self.tests), *lasting, *self.counted()[-self.limits.predictions :]]
        wrong = (prediction for prediction in last if not self.holds(prediction))
        return max(wrong, key=lambda prediction: prediction.error, default=None)

    # Copies

    def needing(self, tests: int) -> Self:
        """Return it for a number of tests, or for twice as many if a parameter is idle and they are no draws.

        Only executions can tell what such a parameter changes, and one hypercube misses most boxes of two parameters.
        """
        idle = self.unsampled_parameter is not None and self.unsampled_parameter.idle
        return replace(self, tests=2 * tests if idle and tests < MANY else tests)

    def to_json(self) -> dict[str, Any]:
        """Return all attributes but the limits in types that JSON has; numbers may be infinite."""
        import msgspec  # needed by campaigns alone

        plain: dict[str, Any] = msgspec.to_builtins(self, enc_hook=lambda value: value.tolist())
        stored = {name: value for name, value in plain.items() if name not in ("settings", "target")}
        return {**stored, **self.target.to_json()}

    @classmethod
    def from_json(cls, values: Any) -> Self | None:
        """Return the evidence that :meth:`to_json` returned; None if these are not its values."""
        import msgspec

        def decoded(kind: type, value: Any) -> Any:
            return Target.from_json(values) if kind is Target else np.array(value, dtype=np.float64)

        try:
            return msgspec.convert(values and {**values, "target": None}, cls, dec_hook=decoded)
        except (msgspec.ValidationError, TypeError, ValueError):
            return None


@dataclass(frozen=True, eq=False)
class SuiteRuns(ShortRepr):
    """The tasks of a suite as a law of the distances sees them."""

    features: Array  #: of each task, such as the logarithms of its parameters ``(N, k)``
    beyond: Array  #: how far the run of M leaves the records, as a share of the recorded range ``(N,)``


@dataclass(frozen=True, eq=False)
class Learned(ShortRepr):
    """What the experiment's model and the executions predict, for kinds of certificates that need more than trials."""

    evidence: Evidence | None = None  #: evidence on d*; None if nothing can be learned, or if the kind needs none
    failure: str | None = None  #: why nothing could be learned; None if that is not known
    suite: SuiteRuns | None = None  #: without evidence, runs of M on the tasks of a suite; None if parameters are names
