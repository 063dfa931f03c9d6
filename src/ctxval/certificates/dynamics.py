r"""The bound from learned dynamics: the posterior of ``d* = max_p d(p)`` under a prior on the residual dynamics.

The residual ``r(x, u) = x' - M(x, u)`` has a Gaussian-process prior with unknown hyperparameters. Each draw r_s from
its posterior makes a system ``M + r_s``, whose largest distance d*_s is searched over all tasks. Under the prior, d*
and these S maxima are exchangeable, so d* is at most the k-th smallest one with probability ``k / (S + 1)``. Draws
that share hyperparameters make this approximate. Bayes' rule does not depend on how the tasks were chosen. If M is
rougher than the system, a linear model takes its place in r (:mod:`ctxval.learning.without_model`).

The bound lies if the prior is wrong: if a state is not recorded, or the dynamics jump. So it is withdrawn unless
predictions that were made before executions held, and unless the records cover what the closed loops visit. It is
raised by half of the largest excess of the last executions over their predictions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ctxval._util.registry import part
from ctxval.certificates.base import ONE_CAMPAIGN, Certificate, CertificateKind
from ctxval.certificates.bounds import require_probability, with_error
from ctxval.certificates.dynamics_evidence import CheckedPrediction, DynamicsEvidence
from ctxval.certificates.learned import require_learned
from ctxval.certificates.posterior import both_outcomes
from ctxval.certificates.sample import Sample, advice_to_remeasure, listed
from ctxval.core.space import TaskSpace
from ctxval.errors import CertificateError

FEWEST = 3
"""The fewest executions for a bound: the data that M was made from are no executions."""

PREDICTIONS = 3
"""Number of the last predictions that must have held."""

ACCURATE = 0.05
"""Largest difference between a distance and its prediction that held, as a share of the bound."""

AUDITED = 8
"""Number of fresh random tasks of a prediction audit."""

TOLERATED = 0.02
"""Largest excess of an audited distance over the 0.95 quantile of its prediction, as a share of the bound."""

GAP = 0.25
"""Largest gap of the records in a state or an input, as a share of the range that closed loops visit."""

BEYOND = 0.02
"""Largest excess of a state or an input over its largest record, or below its smallest one, as a share of that range.
Contacts, end stops and saturation lie beyond what is recorded more often than between records. With too many
coordinates for a comparison of pairs, it is the same as ``GAP``: each extreme would take an execution of its own."""

PAIR_GAP = 0.5
"""The same for two of them together."""

NOISE = 0.01
"""Largest learned variance of noise, as a share of the mean square of the residual."""

LEFT_OUT = 0.5
"""Largest share of the posterior variance that the draws may leave out between their pivots."""

SHARP = 0.05
"""Largest share by which a large predicted distance may exceed the median of those of nearly the same tasks."""

JUMP = 0.01
"""Largest jump of the predicted distance between nearly equal tasks, as a share of the bound."""

DENSE = 2
"""Largest number of task parameters in which deeper searches may find the largest distance in spite of jumps."""

AGREE = 0.05
"""Largest share by which the results of two deeper searches may differ, and by which they may exceed the usual one."""

TESTED = 0.8
"""Least share of the largest distance on the posterior mean that must have been executed: the bound is tested there."""

MATTERS = 0.3
"""Least distance, as a share of the bound, at which a prediction must have held."""

_RAISE = 0.5
"""Share of the largest excess over predictions by which the bound is raised."""


@part("dynamics")
@dataclass(frozen=True, repr=False)
class Dynamics(CertificateKind):
    """Bound on d* from posterior draws of the residual dynamics, which are learned from the executed trajectories.

    Attributes:
        stochastic: whether two executions of one task may differ; it must be False.

    Raises:
        CertificateError: if the system is declared stochastic.
    """

    name: ClassVar[str] = "dynamics"
    needs_model: ClassVar[bool] = True
    evidence: ClassVar[str] = "by a prior on the dynamics"

    stochastic: bool = False

    def __post_init__(self) -> None:
        if self.stochastic:
            raise CertificateError(
                "the dynamics bound is for deterministic systems, and this one is declared stochastic: use --kind "
                "posterior or an audit."
            )

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return :func:`certify_dynamics` of the trials and of what is learned from their trajectories.

        Raises:
            CertificateError: if the experiment is not loaded, an execution failed, or no dynamics can be learned.
        """
        learned = require_learned(sample, self.name)
        require_executions(sample)
        evidence = learned.dynamics(confidence)
        if evidence is None:
            raise CertificateError(
                "no dynamics can be learned: there are no recorded trajectories, or M explains all of them, or no "
                "controller can be designed."
            )
        return certify_dynamics(sample, evidence, confidence)

    @classmethod
    def rests_on(cls, certificate: Certificate, space: TaskSpace | None = None) -> list[str]:
        """Return what it assumes about the system."""
        return [
            "the recorded state being complete",
            "the system being deterministic and not changing with time",
            f"its dynamics being like what was seen, to a resolution of {_texts(certificate.details['resolution'])}",
        ]

    @classmethod
    def support(cls, certificate: Certificate, threshold: float) -> str:
        """Return what speaks for a threshold although the certificate is withdrawn; empty if nothing does."""
        details = certificate.details
        largest = details["largest_draw"]
        predictions = details["predictions"]
        if largest is None or largest > threshold or not predictions["held"]:
            return ""
        return (
            f"supported by the model: no draw of the learned dynamics exceeds {threshold:.6g} in a search of "
            f"{details['evaluations']} closed loops; {predictions['held']} of the last {predictions['last_ones']} "
            "predictions held"
        )


def require_executions(sample: Sample) -> None:
    """Check that the trials allow a bound from learned dynamics.

    Raises:
        CertificateError: if an execution failed or could not be measured, or if all distances are 0.
    """
    failed = [number for number, distance in zip(sample.numbers, sample.distances, strict=True) if np.isnan(distance)]
    if failed:
        raise CertificateError(
            f"{listed(failed)} failed or has no distance, so d* is not bounded there; execute the task again, or audit."
            f"{advice_to_remeasure(sample)}"
        )
    if not sample.best > 0:
        raise CertificateError("all distances are 0, so no prediction of a distance was tested.")


def certify_dynamics(sample: Sample, evidence: DynamicsEvidence, confidence: float = 0.95) -> Certificate:
    """Return the bound that d* stays below with the confidence, under the prior on the dynamics.

    Args:
        sample: trials of any origin.
        evidence: what the learned dynamics say, from the same trials.
        confidence: the probability with which the bound holds.

    Raises:
        CertificateError: if the confidence is too high for the number of draws, or draws diverge.
    """
    require_probability("confidence", confidence)
    draws = len(evidence.maxima)
    if np.ceil((draws + 1) * confidence - 1e-9) > draws:
        raise CertificateError(f"a confidence of {confidence:g} needs more than the {draws} draws of the dynamics.")
    raised, error = bound_of(evidence, sample.best, confidence), evidence.error(confidence)
    if not np.isfinite(raised + error):
        raise CertificateError(
            "the dynamics give no bound: the closed loops of some draws diverge, or an execution could not be "
            "predicted. More executions narrow the draws."
        )
    return Certificate(
        kind="dynamics",
        statement=(
            f"With probability {confidence} under the prior on the residual dynamics, d* is at most "
            f"{with_error(raised, error)}."
        ),
        upper_bound=raised,
        confidence=confidence,
        volume=0.0,
        trials=len(sample),
        assumptions=(*_assumptions(evidence), *sample.remarks, ONE_CAMPAIGN),
        details=_details(sample, evidence, raised, error),
        doubt=both_outcomes(sample, stochastic=False) or doubt_of(evidence, sample.best, raised),
        error=error,
    )


def bound_of(evidence: DynamicsEvidence, best: float, confidence: float) -> float:
    """Return the bound: the order statistic of the maxima, raised by what searches and predictions have missed.

    Args:
        evidence: what the learned dynamics say.
        best: the largest executed distance.
        confidence: the probability with which the bound holds.
    """
    excess = max((one.excess for one in evidence.predictions[-PREDICTIONS:]), default=0.0)
    return max(evidence.upper(confidence) * evidence.missed, best) + _RAISE * excess


def held(prediction: CheckedPrediction, bound: float) -> bool:
    """Return whether an execution agrees with its prediction, as far as it matters for a bound.

    A vague prediction that covers the distance does not suffice: hidden states make predictions vague.
    """
    return abs(prediction.distance - prediction.median) <= ACCURATE * bound


def counted(evidence: DynamicsEvidence, bound: float) -> list[CheckedPrediction]:
    """Return the predictions that count: those that failed, and those that held where they could have failed.

    A prediction of a task like an earlier one tells nothing. Nor does one of a run that a person chose to import, if it
    was made afterwards.
    """
    return [one for one in evidence.predictions if not held(one, bound) or (one.new and (one.stored or not one.chosen))]


def doubt_of(evidence: DynamicsEvidence, best: float, bound: float) -> str | None:
    """Return why the bound is withdrawn, and what would help; None if it is not.

    Args:
        evidence: what the learned dynamics say.
        best: the largest executed distance.
        bound: the bound.
    """
    checked = counted(evidence, bound)
    last = checked[-PREDICTIONS:]
    failed = [one for one in last if not held(one, bound)]
    if evidence.executions < FEWEST:
        return (
            f"the dynamics are learned from {evidence.executions} executed trajectories, and the bound needs at least "
            f"{FEWEST}; execute more tasks"
        )
    if evidence.unplanned:
        return (
            f"for {100 * evidence.unplanned:.2g} % of the tasks no controller can be designed, or the model diverges: "
            "nothing is known there; make the task space smaller, so that every task can be executed"
        )
    exceeding = [one for one in evidence.predictions if one.audit and one.distance > one.upper + TOLERATED * bound]
    if exceeding:
        return (
            f"the prediction audit failed: the distance of trial {exceeding[0].trial} is {exceeding[0].distance:.4g}, "
            f"and at most {exceeding[0].upper:.4g} was predicted. A state that is not recorded or a jump is the likely "
            "cause: record more states, or use --kind posterior or an audit"
        )
    if failed:
        return _failed_predictions(failed, len(last))
    if len(checked) < PREDICTIONS:
        return (
            f"{len(checked)} executions of different tasks were predicted from earlier ones, and the bound needs "
            f"{PREDICTIONS} predictions that hold; execute more tasks"
        )
    if evidence.noise > NOISE:
        return (
            f"noise is learned with {100 * evidence.noise:.2g} % of the variance of the residual, and at most "
            f"{100 * NOISE:g} % is allowed: the system is not deterministic in the recorded state and input; record "
            "more states or reduce the noise, or use --kind posterior with --stochastic"
        )
    if evidence.left_out > LEFT_OUT:
        return (
            f"the draws of the dynamics leave out {100 * evidence.left_out:.0f} % of the largest variance, more than "
            f"{100 * LEFT_OUT:g} %; more executions reduce this variance"
        )
    return uncovered(evidence) or untested(evidence, best, bound) or _jumps(evidence, bound)


def _jumps(evidence: DynamicsEvidence, bound: float) -> str | None:
    """Return that the distance is no smooth function of the task, so that a search may miss the largest one."""
    if evidence.dense:
        return _disagree(evidence)
    if evidence.sharpness > SHARP:
        what = f"one of the largest predicted distances falls by {100 * evidence.sharpness:.0f} %"
    elif evidence.jump > JUMP * bound:
        what = f"the predicted distance jumps by up to {100 * evidence.jump / bound:.2g} % of the bound"
    else:
        return None
    return (
        f"{what} if a task changes by a thousandth of its ranges, so a search may miss the largest distance: the "
        "controllers change abruptly from task to task, as those of a model with kinks do, or the closed loop does; "
        "use a smoother model, or an audit"
    )


def _disagree(evidence: DynamicsEvidence) -> str | None:
    """Return that deeper searches find different distances; None if they agree."""
    share = max(evidence.missed - 1, evidence.disagreement)
    if share <= AGREE:
        return None
    return (
        f"searches of the learned dynamics find largest distances that differ by {100 * share:.0f} %, because the "
        "controllers or the closed loop change abruptly from task to task; an execution of the task of the largest one "
        "helps (--until-decided executes it), or use a smoother model, or an audit"
    )


def _failed_predictions(failed: Sequence[CheckedPrediction], last: int) -> str:
    worst = max(failed, key=lambda one: abs(one.distance - one.median))
    return (
        f"of the last {last} predictions {len(failed)} failed (trial {worst.trial}: distance {worst.distance:.4g} "
        f"where {worst.median:.4g} was predicted); {PREDICTIONS} must hold in a row. After few executions, more of "
        "them help. If predictions go on failing, a state that is not recorded, a jump such as a contact or dry "
        "friction, or noise is the likely cause: record more states, or use --kind posterior or an audit"
    )


def uncovered(evidence: DynamicsEvidence) -> str | None:
    """Return what the records and executions do not cover; None if nothing."""
    coverage, untried = evidence.coverage, evidence.untried
    if coverage.beyond.size > (GAP if coverage.pair is None else BEYOND):
        gap, what = coverage.beyond, "of its range beyond all records of"
    elif coverage.marginal.size > GAP:
        gap, what = coverage.marginal, "of its range away from every record of"
    elif coverage.pair is not None and coverage.pair.size > PAIR_GAP:
        gap, what = coverage.pair, "of their ranges away from every record of"
    elif untried is not None and untried.gap > GAP:
        return (
            f"the parameter {untried.name} hardly changes the closed loops of the model, so what it changes in the "
            "system cannot be learned from states and inputs, and some of its values are "
            f"{100 * untried.gap:.0f} % of its range away from every executed one; an execution there helps "
            "(--until-decided executes it)"
        )
    else:
        return None
    return (
        f"closed loops of the tasks lead {100 * gap.size:.2g} % {what} {' and '.join(gap.coordinates)}, such as to "
        f"{_texts(gap.place)}; an execution of a task that leads there helps (--until-decided executes it)"
    )


def untested(evidence: DynamicsEvidence, best: float, bound: float) -> str | None:
    """Return that the bound is not tested where distances are large; None if it is.

    Args:
        evidence: what the learned dynamics say.
        best: the largest executed distance.
        bound: the bound.
    """
    if best < TESTED * evidence.highest:
        return (
            f"the largest distance is predicted to be {evidence.highest:.4g}, but the largest executed one is "
            f"{best:.4g}: the prediction is not tested where it matters; an execution of that task helps "
            "(--until-decided executes it)"
        )
    if not any(one.distance >= MATTERS * bound and held(one, bound) for one in counted(evidence, bound)):
        return (
            f"no prediction held at a distance of at least {100 * MATTERS:g} % of the bound: small distances hardly "
            "test it; an execution of another task with a large distance helps (--until-decided executes it)"
        )
    return None


def _prior(evidence: DynamicsEvidence) -> str:
    if evidence.without_model:
        return (
            "a smooth function and a linear model explain the records far better than one and M, so the system is "
            "learned without M: its difference from the linear model that fits best is a draw from a Gaussian process, "
            "a Matern kernel of smoothness 3/2, 5/2 or 9/2 that may grow with the inputs, plus a linear function"
        )
    return (
        "the residual x' - M(x, u) is a draw from a Gaussian process: a Matern kernel of smoothness 3/2 or 5/2 that "
        "may grow with the inputs, plus a linear function"
    )


def _assumptions(evidence: DynamicsEvidence) -> tuple[str, ...]:
    coordinates = len(evidence.coverage.resolution)
    joint = (
        f"with {coordinates} coordinates of state and input, the records cover each one alone and not all "
        "combinations: what happens only at a combination that was never visited, such as a contact in a corner, is "
        "not covered"
        if evidence.coverage.pair is None
        else "what happens only at a combination of three or more coordinates that was never visited is not covered"
    )
    return (
        "the recorded state is complete: the next state depends on it and on the input alone",
        "the system is deterministic, and its dynamics do not change with time or with the task",
        f"{_prior(evidence)}; its hyperparameters are unknown and integrated over",
        "the residual is like what was seen, to a resolution in state and input of "
        f"{_texts(evidence.coverage.resolution)} (in the units of the system)",
        joint,
        f"the search of {evidence.evaluations} closed loops on the learned dynamics found the largest distance of each "
        "draw",
        "how the tasks were chosen and when the campaign stopped does not matter",
    )


def _details(sample: Sample, evidence: DynamicsEvidence, bound: float, error: float) -> dict[str, Any]:
    finite, last = evidence.maxima[np.isfinite(evidence.maxima)], counted(evidence, bound)[-PREDICTIONS:]
    coverage = evidence.coverage
    return {
        "best": sample.best,
        "gap": bound - sample.best,
        "error": error,
        "executions": evidence.executions,
        "draws": len(evidence.maxima),
        "largest_draw": float(finite.max()) if len(finite) == len(evidence.maxima) else None,
        "median_draw": float(np.median(finite)) if len(finite) else None,
        "evaluations": evidence.evaluations,
        "predictions": {
            "made": len(evidence.predictions),
            "stored_beforehand": sum(one.stored for one in evidence.predictions),
            "last_ones": len(last),
            "held": sum(held(one, bound) for one in last),
            "audited": sum(one.audit for one in evidence.predictions),
        },
        "checked": [{**one.to_json(), "held": bool(held(one, bound))} for one in evidence.predictions],
        "coverage_gap": coverage.marginal.size,
        "beyond_the_records": coverage.beyond.size,
        "coverage_gap_of_pairs": None if coverage.pair is None else coverage.pair.size,
        "largest_gap_at": coverage.marginal.place,
        "resolution": coverage.resolution,
        "noise": evidence.noise,
        "without_model": evidence.without_model,
        "sharpness": evidence.sharpness,
        "jump": evidence.jump,
        "missed": evidence.missed,
        "disagreement": evidence.disagreement,
        "variance_left_out": evidence.left_out,
        "failures": sample.failures,
    }


def _texts(values: dict[str, float]) -> str:
    """Return numbers with their names; the unit of a label ``name [unit]`` follows its number."""
    parts = ((*name.partition(" [")[::2], value) for name, value in values.items())
    return ", ".join(f"{name} {value:.2g} {unit.removesuffix(']')}".rstrip() for name, unit, value in parts)
