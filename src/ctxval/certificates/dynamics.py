r"""The bound from learned dynamics: the posterior of ``d* = max_p d(p)`` under a prior on the residual dynamics.

The residual ``r(x, u) = x' - M(x, u)`` has a Gaussian-process prior with unknown hyperparameters. Each draw r_s from
its posterior makes a system ``M + r_s``, whose largest distance d*_s is searched over all tasks. Under the prior, d*
and these S maxima are exchangeable, so d* is at most the k-th smallest one with probability ``k / (S + 1)``. Draws
that share hyperparameters make this approximate. If M is rougher than the system, a linear model takes its place in r
(:mod:`ctxval.learning.residual_data`).

The bound lies if the prior is wrong: if a state is not recorded, or the dynamics jump. So
:mod:`ctxval.certificates.checks` withdraws it unless predictions held that were made before executions,
and unless the records cover what the closed loops visit, and raises it if predictions failed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

import numpy as np

from ctxval._util.checked import NonNegativeInt, Probability
from ctxval._util.registry import part
from ctxval.certificates.anytime import anytime_volume
from ctxval.certificates.base import Certificate, CertificateKind
from ctxval.certificates.bounds import rank_within
from ctxval.certificates.checks import fewest_missing, withdrawals
from ctxval.certificates.covering import largest_empty_box
from ctxval.certificates.evidence import Evidence
from ctxval.certificates.explained import share_supported
from ctxval.certificates.forecast import Forecast
from ctxval.certificates.prediction_tests import TESTS, shown_by_tests
from ctxval.certificates.predictions import latest_tests
from ctxval.certificates.sample import Sample, advice_to_remeasure, listed, require_learned
from ctxval.certificates.sentences import statements
from ctxval.certificates.sentences.withdrawals import AUDIT
from ctxval.certificates.task_share import Share
from ctxval.core.quantiles import QUANTILE
from ctxval.core.trial import Origin
from ctxval.errors import CertificateError

# Attributes of the evidence that are numbers of the certificate as well.
_COPIED = (
    *("noise", "lags", "acting", "physical", "suspect", "without_model", "without_data", "estimated"),
    *("friction", "parameters", "peak_ratio", "jump", "search_shortfall", "disagreement", "negligible"),
)
MOST_DRAWS = 400  # posterior samples of the dynamics, which limit the confidence


@part("dynamics")
@dataclass(frozen=True, repr=False)
class Dynamics(CertificateKind):
    """Bound on d* from posterior draws of the residual dynamics, which are learned from the executed trajectories."""

    name: ClassVar[str] = "dynamics"
    needs_model: ClassVar[bool] = True
    takes_suites: ClassVar[bool] = True

    tests: NonNegativeInt = TESTS  #: number of executions that must have been predicted beforehand at drawn tasks
    quantile: Probability = QUANTILE  #: the share of the executions of each task that a bound with noise is about
    share: Share = 1.0  #: the share of the tasks that the bound is about; 1 for the largest distance

    def require_usable(self, confidence: float, executions: int, beside: Iterable[Origin] = ()) -> None:
        """Refuse a confidence that needs too many draws of the dynamics."""
        rank_within(confidence, MOST_DRAWS)

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return :func:`certify_dynamics` of the trials and of what is learned from their trajectories.

        If it does not keep the threshold, it forecasts the fewest executions that can decide.

        Raises:
            CertificateError: if no dynamics can be learned, or a trial has no distance.
        """
        threshold = sample.threshold
        learned = require_learned(sample, self.name)
        unknown = [sample.numbers[row] for row in np.flatnonzero(np.isnan(sample.distances)).tolist()]
        if unknown:
            raise CertificateError(
                f"{listed(unknown)} failed or gave no distance, so d* is not bounded there; execute the task again, or "
                f"audit.{advice_to_remeasure(sample)}"
            )
        evidence = learned.evidence
        if self.share < 1 and (evidence is not None and evidence.target.is_noisy):
            raise CertificateError("no share of the tasks is bounded if the system is noisy; leave the share out.")
        if not (sample.best > 0 or (evidence is not None and evidence.negligible)):
            raise CertificateError(
                "all distances are 0, so no prediction of a distance was tested. Check that the distance compares what "
                f"differs; {AUDIT}."
            )
        if evidence is None and learned.failure is not None:
            raise CertificateError(f"no dynamics can be learned: {learned.failure.rstrip('.')}.")
        if evidence is None:
            raise CertificateError(
                "no dynamics can be learned: there are no recorded trajectories, or M explains all of them, or no "
                "controller can be designed."
            )
        evidence = replace(evidence.needing(self.tests), best=sample.best, confidence=confidence, threshold=threshold)
        certificate = certify_dynamics(sample, evidence)
        if threshold is None or certificate.covers(threshold):
            return certificate
        if evidence.raised > threshold and certificate.withdrawn_by == "tests_missing":
            # Missing tests matter only to a bound that suffices.
            certificate = replace(certificate, doubt=None, withdrawn_by=None)
        kept = float((evidence.maxima <= threshold).mean())
        return replace(certificate, expected=Forecast(fewest_missing(evidence), kept))

    def needs_evidence(self, sample: Sample) -> bool:
        """Return whether all trials have a distance."""
        return not sample.failed


def draws_for(confidence: float) -> int:
    """Return the number of draws of the dynamics that a bound with this confidence needs."""
    return min(MOST_DRAWS, int(np.ceil(confidence / (1 - confidence))))


def certify_dynamics(sample: Sample, evidence: Evidence) -> Certificate:
    """Return the bound that d* stays below with the confidence of the evidence, which is of the same trials.

    Raises:
        CertificateError: if some draws diverge, or an execution could not be predicted.
    """
    confidence, upper, error = evidence.confidence, evidence.raised, evidence.error
    rank_within(confidence, len(evidence.maxima))
    if not np.isfinite(upper + error):
        raise CertificateError(
            "the dynamics give no bound: the closed loops of some posterior samples diverge, or an execution could not "
            "be predicted. More executions narrow them."
        )
    finite, target = evidence.maxima[np.isfinite(evidence.maxima)], evidence.target
    last = evidence.counted()[-evidence.limits.predictions :]
    tests = latest_tests(evidence.predictions, evidence.tests)
    drawn = [test.origin for test in tests]
    coverage, worst, opened = evidence.coverage, evidence.failed, withdrawals(evidence)
    differing = sample.differing(1e-6 * evidence.bound)
    doubt, withdrawn_by = statements.both_outcomes(sample, stochastic=False), "executions_differ"
    # Two executions of one task must not differ by more than a prediction may be wrong.
    unlike = max(evidence.limits.error * evidence.bound, evidence.negligible)
    if doubt is None and not target.is_noisy and (rows := sample.differing(unlike)) is not None:
        doubt = (
            f"{statements.two_distances(sample, rows)} in the recorded state, or was changed in between, so the bound "
            "is withdrawn; record more states, use --kind posterior, or use a new store after a change"
        )
    if doubt is None and opened:
        doubt, withdrawn_by = str(opened[0]), opened[0].code
    of_tasks: dict[str, Any] = {"empty_box": None, "tasks": sample.tasks, "not_executed": sample.not_executed}
    if sample.suite is None:
        empty = largest_empty_box(sample.points)
        of_tasks = {"empty_box": empty and asdict(empty)}
    statement = statements.dynamics_statement(upper, error, confidence, evidence)
    level = upper if sample.threshold is None else sample.threshold
    above = sum(each.distance > level for each in evidence.executed)
    alone, of_share = dict[str, Any](), dict[str, Any]()
    if target.share < 1:
        alone, of_share = _tests_alone(sample, level, confidence), {"of_mean": evidence.highest}
    copied = {name: getattr(evidence, name) for name in _COPIED}
    details = {
        "best": sample.best,
        **of_tasks,
        "gap": upper - sample.best,
        "raised_from": None if worst is None else evidence.bound,
        "raised_by_trial": None if worst is None else worst.trial,
        "error": error,
        "executions": evidence.executions,
        **target.to_json(),
        **of_share,
        "draws": len(evidence.maxima),
        **({"thinking": {"replaced": list(evidence.replaced)}} if evidence.replaced else {}),
        "largest_draw": float(finite.max()) if len(finite) == len(evidence.maxima) else None,
        "median_draw": float(np.median(finite)) if len(finite) else None,
        "evaluations": evidence.evaluations,
        "predictions": {
            "made": len(evidence.predictions),
            "stored_beforehand": sum(prediction.stored for prediction in evidence.predictions),
            "last_ones": len(last),
            "held": sum(prediction.held(evidence.bound, evidence.limits) for prediction in last),
        },
        "tests": {
            **shown_by_tests(
                drawn, sample.points.shape[1], confidence, uniform=sample.is_uniform, selected=sample.selected
            ),
            "largest_error": max((test.error for test in tests), default=None),
            **alone,
        },
        "checked": [{**each.to_json(), "held": bool(evidence.holds(each))} for each in evidence.predictions],
        "open_checks": [each.to_json() for each in opened],
        "coverage_gap": coverage.marginal.size,
        "beyond_the_records": coverage.beyond.size,
        "coverage_gap_of_pairs": None if coverage.pair is None else coverage.pair.size,
        "largest_gap_at": coverage.marginal.place,
        "resolution": coverage.resolution,
        **{name: list(value) if isinstance(value, tuple) else value for name, value in copied.items()},
        "share_supported": share_supported(evidence.executions, above, confidence) if target.is_noisy else None,
        "variance_left_out": evidence.left_out,
        "unvisited_region": evidence.unvisited_region and asdict(evidence.unvisited_region),
        "untested_rest": evidence.untested_rest and asdict(evidence.untested_rest),
        "pushed": evidence.pushed and evidence.pushed.to_json(),
        "differing": None if differing is None else [sample.numbers[row] for row in differing],
    }
    return Dynamics().certificate(
        sample,
        statement,
        upper,
        confidence,
        statements.dynamics_assumptions(evidence),
        details,
        doubt=doubt,
        withdrawn_by=None if doubt is None else withdrawn_by,
        error=error,
        volume=target.volume,
    )


def _tests_alone(sample: Sample, level: float, confidence: float) -> dict[str, float | None]:
    """Return which share of the tasks exceeds a level at most, by all independent draws, and how many of these do."""
    above = ~(sample.only("iid").distances <= level)
    missed = anytime_volume(above, 1 - confidence) if len(above) else None
    return {"share_missed": missed, "above": int(above.sum())}
