"""What an experiment's model predicts, as numbers: the input of kinds that need more than trials."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.certificates.bounds import rank_of
from ctxval.certificates.explained import ExplainedExecution
from ctxval.certificates.prediction_tests import MANY, TESTS
from ctxval.core.coverage import (
    StateInputCoverage,
    StateInputGap,
    UnsampledCorner,
    UnsampledParameter,
    UntestedRest,
    UnvisitedRegion,
)
from ctxval.core.learned_numbers import PushedDistances
from ctxval.core.quantiles import LEVELS, QUANTILE, chance_of_more
from ctxval.core.trial import Origin


@dataclass(frozen=True)
class CheckedPrediction(ShortRepr):
    """A prediction from earlier executions only, compared with the execution."""

    trial: int  #: the number of the trial
    rank: float  #: share of the predicted distances that are below the executed one; NaN if nothing was predicted
    median: float  #: median of the predicted distances; infinity if nothing was predicted
    upper: float  #: 0.95 quantile of the predicted distances; infinity if more draws than that diverged
    distance: float  #: the executed distance
    z2: float = np.nan  #: squared standardised error, the larger one of trajectory and distance; NaN if it is not known
    stored: bool = True  #: whether the prediction was stored before the execution; if not, it was computed afterwards
    new: bool = True  #: whether the task differs from those that were executed before
    origin: Origin = "acquisition"  #: the reason why the task was chosen
    point: tuple[float, ...] = ()  #: the task, a point of the unit cube ``(d,)``
    quantiles: tuple[float, ...] = ()  #: those of the predicted distances at ``quantiles.LEVELS``; empty without noise
    runs: int = 0  #: the number of predicted distances that these are of
    p_values: tuple[float, ...] = ()  #: chances of more than statistics of the trajectory; empty without noise
    explained: float | None = None  #: the distance of the task on what all executions teach; None if it is not known
    negligible: float = 0.0  #: the largest difference from the prediction by errors of M that are not learned

    @property
    def is_noisy(self) -> bool:
        """Whether it predicts what noise does."""
        return len(self.quantiles) > 0

    def chance_of_more(self, distance: float) -> float:
        """Return the predicted probability that an execution exceeds a distance; it is never 0."""
        return chance_of_more(self.quantiles, distance, self.runs)

    @property
    def excess(self) -> float:
        """How far the distance exceeds the median, or the 0.9 quantile with noise; infinity without a prediction."""
        if self.is_noisy:
            return max(self.distance - float(np.interp(0.9, LEVELS, self.quantiles)), 0.0)
        return max(self.distance - self.median - self.negligible, 0.0) if np.isfinite(self.median) else np.inf

    @property
    def error(self) -> float:
        """The difference between distance and median that is not negligible; infinity if nothing was predicted."""
        return max(abs(self.distance - self.median) - self.negligible, 0.0) if np.isfinite(self.median) else np.inf

    def to_json(self) -> dict[str, Any]:
        """Return all attributes but the quantiles, ready for JSON: numbers that are not finite are None."""
        plain = {name: value for name, value in asdict(self).items() if name not in ("quantiles", "runs")}
        unknown = [name for name, value in plain.items() if isinstance(value, float) and not np.isfinite(value)]
        return {**plain, **dict.fromkeys(unknown)}


@dataclass(frozen=True, eq=False)
class DynamicsEvidence(ShortRepr):
    """What draws of the learned dynamics say about the largest distance."""

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
    quantile: float | None = None  #: share of the executions of a task that are below the maxima; None without noise
    lags: int = 0  #: number of earlier records and inputs that the learned dynamics depend on
    actuator: tuple[float, float] | None = None  #: delay and time constant of inputs in steps; None if they act at once
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
    untested_rest: UntestedRest | None = None  #: where friction at rest was not tested; None without it
    #: the largest distance under errors of M as small as all that were recorded; 0 if such errors are learned
    negligible: float = 0.0

    def rank(self, confidence: float) -> int:
        """Return the row, in ascending order, of the maximum that d* stays below with this probability."""
        return min(rank_of(confidence, len(self.maxima)), len(self.maxima)) - 1

    def upper(self, confidence: float) -> float:
        """Return the maximum that d* stays below with this probability."""
        return float(np.sort(self.maxima)[self.rank(confidence)])

    def error(self, confidence: float) -> float:
        """Return the standard error of :meth:`upper` over draws of the hyperparameters, by a bootstrap over them."""
        blocks = self.maxima.reshape(-1, self.groups)
        rows = np.random.default_rng(0).integers(len(blocks), size=(200, len(blocks)))
        resampled = np.sort(blocks[rows].reshape(200, -1), axis=1)[:, self.rank(confidence)]
        return float(resampled.std(ddof=1)) if np.isfinite(resampled).all() else np.inf

    def needing(self, tests: int) -> Self:
        """Return the same for so many tests, or for twice as many if a parameter is idle and they are no draws.

        Only executions can tell what such a parameter changes, and one hypercube misses most boxes of two parameters.
        """
        idle = self.unsampled_parameter is not None and self.unsampled_parameter.idle
        return replace(self, tests=2 * tests if idle and tests < MANY else tests)

    def to_json(self) -> dict[str, Any]:
        """Return all attributes in types that JSON has; numbers may be infinite."""
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self), default=lambda value: value.tolist()))
        return plain

    @classmethod
    def from_json(cls, values: Any) -> Self | None:
        """Return the evidence that :meth:`to_json` returned; None if these are not its values."""
        try:
            coverage, untried, corner, pocket = (
                values[name] for name in ("coverage", "unsampled_parameter", "unsampled_corner", "unvisited_region")
            )
            tuples = ("point", "quantiles", "p_values")
            gaps = {
                name: gap and StateInputGap(**{**gap, "coordinates": tuple(gap["coordinates"])})
                for name, gap in coverage.items()
                if name in ("marginal", "beyond", "pair")
            }
            parts = {
                **{name: np.array(values[name], dtype=np.float64) for name in ("maxima", "points", "local_maxima")},
                **{name: values[name] and tuple(values[name]) for name in ("actuator", "suspect")},
                "predictions": tuple(
                    CheckedPrediction(**{**each, **{name: tuple(each[name]) for name in tuples}})
                    for each in values["predictions"]
                ),
                "coverage": StateInputCoverage(**{**coverage, **gaps, "task": np.array(coverage["task"])}),
                "unsampled_parameter": untried and UnsampledParameter(**{**untried, "task": np.array(untried["task"])}),
                "unsampled_corner": corner and UnsampledCorner(**{**corner, "task": np.array(corner["task"])}),
                "pushed": values["pushed"] and PushedDistances.from_json(values["pushed"]),
                "unvisited_region": pocket
                and UnvisitedRegion(**{**pocket, "tasks": tuple(map(tuple, pocket["tasks"]))}),
                "untested_rest": (rest := values["untested_rest"])
                and UntestedRest(**{**rest, "tasks": tuple(map(tuple, rest["tasks"]))}),
                "physical": tuple(values["physical"]),
                "executed": tuple(
                    ExplainedExecution(
                        **{**each, **{name: tuple(each[name]) for name in ("point", "quantiles", "p_values")}}
                    )
                    for each in values["executed"]
                ),
                **{name: values[name] and tuple(values[name]) for name in ("influential", "drift")},
            }
            return cls(**{**values, **parts})
        except (AttributeError, KeyError, TypeError, ValueError):
            return None


@runtime_checkable
class LearnedDistance(Protocol):
    """Predictions of the distance that are learned from trials and from the data that the model was made from."""

    def expected(self, points: Array, before: int) -> Array:
        """Return distances ``(m,)``, or NaN, at points ``(m, d)`` of the unit cube, predicted from earlier trials."""

    def dynamics(self, confidence: float, quantile: float = QUANTILE) -> DynamicsEvidence | None:
        """Return what the dynamics learned from all trials say about d*; None if nothing can be learned.

        The confidence sets the least number of posterior samples. Users' code raises a CertificateError.
        """

    def tasks(self, count: int, seed: int) -> Array:
        """Return draws from the distribution of tasks, independent of trials: points ``(count, d)``."""
