"""The certificate of a verdict if none is named: the posterior bound, or the bound from learned dynamics."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import scipy

from ctxval._util.arrays import Array
from ctxval._util.checked import NonNegativeInt, PositiveFloat, Probability
from ctxval._util.registry import part
from ctxval._util.representation import counted
from ctxval.certificates.base import Certificate, CertificateKind
from ctxval.certificates.bounds import percent
from ctxval.certificates.covering import RESOLUTION, covering, farthest_task
from ctxval.certificates.dynamics import Dynamics
from ctxval.certificates.limits import LIMITS
from ctxval.certificates.posterior import DistanceBound
from ctxval.certificates.prediction_tests import DRAWN, TESTS, shown_by_tests
from ctxval.certificates.predictions import mostly_fail
from ctxval.certificates.remaining import RemainingTasks
from ctxval.certificates.sample import SAME, Sample
from ctxval.certificates.sentences.statements import (
    EXECUTED_AGAIN,
    INDEPENDENT_REPEATS,
    LAW_OF_DISTANCES,
    suite_statement,
)
from ctxval.certificates.sentences.verdicts import supported as supported_by
from ctxval.certificates.task_share import Share
from ctxval.core.quantiles import QUANTILE
from ctxval.core.target import Largest, Target
from ctxval.errors import CertificateError


@part("suite")
@dataclass(frozen=True, repr=False)
class WholeSuite(CertificateKind):
    """The largest distance of a suite of tasks, all of which were executed.

    If tasks are repeated, it is a bound on a quantile of the executions of each task, without any law of the noise. For
    ``auto``, it is also a bound by a law of the distances if no dynamics can be learned and tasks are left
    (:mod:`~ctxval.certificates.remaining`).
    """

    name: ClassVar[str] = "suite"
    takes_suites: ClassVar[bool] = True

    quantile: Probability = QUANTILE  #: the share of the executions of each task that a bound with repeats is about
    tests: NonNegativeInt = TESTS  #: executions of drawn tasks that a law of the distances needs

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return the certificate; the largest executed distance is the largest of all.

        Raises:
            CertificateError: if a task of the suite has no distance.
        """
        members, missing = sample.members, sample.not_executed
        left = RemainingTasks(sample, self.tests)
        if missing and left.can_be_bounded:
            return self._of_remaining(left, confidence)
        if missing:
            raise CertificateError(
                f"{missing} of {counted(len(members), 'task')} of the suite have no distance yet, so the largest "
                "one is not known; `ctxval run` executes them."
            )
        if sample.repeats > 1:
            return self._of_repeats(sample, confidence)
        h, assumptions = sample.best, (EXECUTED_AGAIN, *sample.remarks)
        statement = f"All {sample.tasks} tasks of the suite were executed, and their largest distance is {h:.6g}."
        details = {"best": h, "tasks": sample.tasks, "failures": sample.failures}
        return Certificate(self.name, statement, h, confidence, 0.0, len(sample), assumptions, details)

    def _of_remaining(self, left: RemainingTasks, confidence: float) -> Certificate:
        """Return the bound by the law of the distances, or the largest executed distance if that is more."""
        sample, withdrawal = left.sample, left.withdrawal()
        h, missing = max(sample.best, left.law.bound(confidence)), len(left.rows)
        details = {
            "best": sample.best,
            "tasks": sample.tasks,
            "not_executed": missing,
            "freedom": left.law.freedom,
            "beyond_the_records": float(left.beyond.max()),
            "evidence_against": left.against,
            "missed_by_tests": left.missed_by_tests(confidence),
            "tests": {"drawn": len(left.drawn), "share_missed": None, "largest_error": None},
        }
        return self.certificate(
            sample,
            suite_statement(h, confidence, len(sample.members), missing),
            h,
            confidence,
            (LAW_OF_DISTANCES, EXECUTED_AGAIN),
            details,
            **({} if withdrawal is None else dict(zip(("withdrawn_by", "doubt"), withdrawal, strict=True))),
        )

    def _of_repeats(self, sample: Sample, confidence: float) -> Certificate:
        """Return the bound by order statistics: how many of n executions lie below a quantile is binomial."""
        doubtful, known = (1 - confidence) / len(sample.members), np.isfinite(sample.distances)
        same = np.abs(sample.points[known][:, None] - sample.members).max(axis=-1) <= SAME
        repeats = [np.sort(sample.distances[known][of_task]) for of_task in same.T]
        fewest, q = min(map(len, repeats)), self.quantile
        needed = int(np.ceil(np.log(doubtful) / np.log(q)))
        shown = {"quantile": q, "repeats": fewest, "repeats_needed": needed, "share_shown": doubtful ** (1 / fewest)}
        if fewest < needed:
            raise CertificateError(
                f"{counted(fewest, 'execution')} of each task can show, with {percent(confidence)} confidence, that "
                f"{100 * shown['share_shown']:.3g} % of all its executions stay below a threshold; {needed} are needed "
                f"for {100 * q:g} % (at most {sample.repeats} are allowed: repeats of the suite)."
            )
        ranks = [int((scipy.special.bdtr(np.arange(len(each)), len(each), q) < 1 - doubtful).sum()) for each in repeats]
        upper = float(max(each[rank] for each, rank in zip(repeats, ranks, strict=True)))
        statement = (
            f"In each of {counted(len(repeats), 'task')} of the suite, at least {100 * q:g} % of all executions stay "
            f"at or below {upper:.6g}, by at least {fewest} executions of each."
        )
        details = {"best": sample.best, "tasks": sample.tasks, "failures": sample.failures, **shown}
        assumptions = (INDEPENDENT_REPEATS, *sample.remarks)
        return Certificate(self.name, statement, upper, confidence, 0.0, len(sample), assumptions, details)


@part("auto")
@dataclass(frozen=True, repr=False)
class Automatic(CertificateKind):
    """The bound from learned dynamics if it keeps the threshold, otherwise the posterior bound of the distance.

    For a suite of tasks, it is the bound from learned dynamics until all tasks were executed. The dynamics bound is
    tried only if the experiment is loaded and the resolution is the usual one. If neither keeps the threshold, the
    certificate is the one that is nearer to a decision.
    """

    name: ClassVar[str] = "auto"
    needs_model: ClassVar[bool] = True
    takes_suites: ClassVar[bool] = True
    sorts_draws: ClassVar[bool] = True  # its draws are tests, and count at any time

    resolution: PositiveFloat = RESOLUTION  #: as for the posterior bound
    tests: NonNegativeInt = TESTS  #: executions at drawn tasks; those for learned dynamics must be predicted beforehand
    quantile: Probability = QUANTILE  #: the share of the executions of each task that a bound with noise is about
    share: Share = 1.0  #: the share of the tasks that the bound is about; 1 for the largest distance

    def needs_evidence(self, sample: Sample) -> bool:
        """Return whether the dynamics bound is tried: a resolution of one's own asks for the posterior bound."""
        usual = self.resolution == RESOLUTION and len(sample) >= LIMITS.fewest and not sample.failed
        return usual and sample.not_executed != 0

    def without_dynamics(self, target: Target, suite: Array | None) -> CertificateKind:
        """Return the kind that judges the distances of tasks ``(n, d)`` alone; of noise or a share, none does."""
        match target:
            case Largest() if suite is None:
                return DistanceBound(self.resolution)
            case Largest():
                return WholeSuite(self.quantile, self.tests)
        return Dynamics(self.tests, self.quantile, self.share)

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return the first certificate that keeps the threshold, or else the one that is nearer to a decision.

        Without a threshold, it is the dynamics bound or, if that is withdrawn or refused, the posterior bound. If
        neither decides, and more than 100 executions would come near to every task, it is the dynamics bound as long
        as its predictions hold.
        """
        threshold, other = sample.threshold, self.without_dynamics(self.target, sample.suite)
        by_dynamics = None
        if sample.learned is not None and self.needs_evidence(sample):
            with suppress(CertificateError):
                by_dynamics = Dynamics(self.tests, self.quantile, self.share).certify(sample, confidence)
                if by_dynamics.target.is_noisy or _decides(by_dynamics, threshold):
                    return by_dynamics  # the posterior bound of the distance is about systems without noise
        if not isinstance(other, DistanceBound):
            return by_dynamics or other.certify(sample, confidence)
        preferred = False
        if by_dynamics is not None:
            preferred = _decides(by_dynamics, None) or bool(threshold and supported_by(by_dynamics, threshold))
            # Predictions that hold decide sooner than executions next to every task, if that takes more than 100.
            if not mostly_fail([each["held"] for each in by_dynamics.details["checked"]]):
                preferred = preferred or covering(sample.points, self.resolution, 100) is None
            if preferred and farthest_task(sample.points) > self.resolution:
                return by_dynamics  # the posterior bound, which takes seconds, would be withdrawn
        try:
            certificate = other.certify(sample, confidence)
        except CertificateError:
            if by_dynamics is None:
                raise
            return by_dynamics
        # Tests at drawn tasks may be missing for it, too.
        origins = [origin for origin in sample.origins if self.tests and origin in DRAWN]
        dimension, uniform = sample.points.shape[1], sample.is_uniform
        shown = shown_by_tests(origins, dimension, confidence, uniform=uniform, selected=sample.selected)
        details = {**certificate.details, "tests": {**shown, "largest_error": None}}
        certificate, missing = replace(certificate, details=details), self.missing_tests(sample)
        if certificate.doubt is None and missing:
            doubt = (
                f"at least {missing} more {'task' if missing == 1 else 'tasks'} drawn over the whole task space must "
                "be executed (`ctxval run` executes them)"
            )
            certificate = replace(certificate, doubt=doubt, withdrawn_by="tests_missing")
        if by_dynamics is None or _decides(certificate, threshold):
            return certificate
        if preferred:
            return by_dynamics
        suspect = by_dynamics.details["suspect"]
        return replace(certificate, details={**certificate.details, "suspect": suspect})

    def missing_tests(self, sample: Sample) -> int:
        """Return the number of executions after which the posterior bound has seen tasks of the whole space."""
        drawn = [origin in DRAWN for origin in sample.origins]
        return max(self.tests - int((np.isfinite(sample.distances) & drawn).sum()), 0)


def _decides(certificate: Certificate, threshold: float | None) -> bool:
    """Return whether a certificate keeps a threshold; without one, whether no failed prediction raises its bound."""
    if threshold is not None:
        return certificate.covers(threshold)
    return certificate.doubt is None and certificate.details.get("raised_from") is None
