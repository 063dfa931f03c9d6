r"""Scenario and sampling-and-discarding bounds, exact (the paper's Sec. IV-A; Campi and Garatti 2011 with d = 1).

Of N independent draws from the task space, discard the k largest distances; h is the largest that is left. The volume
V = Pr(d(p) > h) then has, for a continuous distribution of d, the law of the (k+1)-th smallest of N uniform draws,
Beta(k + 1, N - k), so that

    Pr(V > eps) = sum_{i=0}^{k} binom(N, i) eps^i (1 - eps)^(N - i),

and for any distribution Pr(V > eps) is at most that. The paper's sum ends at k - 1, which is too small: for k = 0 it
would be empty, so a single draw would bound d on the whole task space.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.special import bdtr, betaincinv

from ctxval._util.checked import NonNegativeInt, PositiveInt, Probability, checked
from ctxval._util.registry import part
from ctxval.certificates.base import ONE_CAMPAIGN, Certificate, CertificateKind
from ctxval.certificates.bounds import at_most, drawn_from, of_tasks
from ctxval.certificates.sample import Sample, advice_to_remeasure, listed
from ctxval.core.space import TaskSpace
from ctxval.core.trial import Origin
from ctxval.errors import CertificateError

_MOST_SAMPLES = 2**40
"""Largest number of draws that :func:`samples_needed` returns."""

UNSEEN = (
    "M was not learned from these tasks, nor chosen after seeing them: a model that is retrained on them needs a new "
    "store and fresh draws"
)
"""The assumption that all bounds from independent draws share."""

ABOUT_DRAWS = (
    UNSEEN,
    "each task has one distance: the system is deterministic",
    "nothing is assumed of how the distance depends on the task",
    "nothing is said of how large the distance is in the volume left out: this is no bound on d*",
)
"""Assumptions and limits of the statements by independent draws among trials of any origin."""


class _ByDraws(CertificateKind):
    """A bound from independent draws alone."""

    bounds_maximum: ClassVar[bool] = False

    def require_audit_helps(self, origins: Iterable[Origin]) -> None:
        """Refuse trials that are no independent draws."""
        if any(origin != "iid" for origin in origins):
            raise CertificateError(
                f"a {self.name} bound takes independent draws alone, but there are others; say --kind audit."
            )

    @classmethod
    def rests_on(cls, certificate: Certificate, space: TaskSpace | None = None) -> list[str]:
        """Return what it assumes about the draws."""
        return rests_on_draws(certificate)


@part("scenario")
@dataclass(frozen=True, repr=False)
class Scenario(_ByDraws):
    """Bound on all tasks except a share of the task space, from independent draws alone (scenario optimisation, SC)."""

    name: ClassVar[str] = "scenario"

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return :func:`certify_scenario` of the trials."""
        return certify_scenario(sample, confidence)


@part("sampling-discarding")
@dataclass(frozen=True, repr=False)
class SamplingDiscarding(_ByDraws):
    """The scenario bound after the largest distances are discarded (sampling and discarding, SD).

    Attributes:
        discard: how many of the largest distances are discarded, at least 1; it must be chosen before they are known.
    """

    name: ClassVar[str] = "sampling-discarding"

    discard: PositiveInt | None = None

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return :func:`certify_scenario` of the trials."""
        return certify_scenario(sample, confidence, self._require_discard())

    def require_audit_helps(self, origins: Iterable[Origin]) -> None:
        """Refuse trials that are no independent draws, and require the number to discard.

        Raises:
            CertificateError: if there is such a trial, or the number is missing.
        """
        self._require_discard()
        super().require_audit_helps(origins)

    def require_usable(self, confidence: float, executions: int) -> None:
        """Require the number to discard, and more trials than that.

        Raises:
            CertificateError: if the number is missing, or not below that of the trials.
        """
        _require_counts(executions, self._require_discard())

    def _require_discard(self) -> int:
        if not self.discard:
            raise CertificateError("sampling and discarding needs to know how many to discard, at least 1.")
        return self.discard


def rests_on_draws(certificate: Certificate) -> list[str]:
    """Return what a validation by independent draws rests on."""
    return [
        "tasks that were drawn independently, and from which M was not learned (how large the distance is in the "
        f"{at_most(100 * certificate.volume, 3)} % that are left out is not known)"
    ]


@checked
def tail(n: int, discarded: int, volume: Probability) -> float:
    """Return Pr(V > volume) after n draws of which the k largest are discarded.

    Raises:
        CertificateError: if k is negative or not below n.
    """
    _require_counts(n, discarded)
    return float(bdtr(discarded, n, volume))


@checked
def volume_bound(n: int, discarded: int, beta: Probability) -> float:
    """Return the least eps with ``Pr(V > eps) <= beta``.

    Raises:
        CertificateError: if k is negative or not below n.
    """
    _require_counts(n, discarded)
    return float(betaincinv(discarded + 1, n - discarded, 1 - beta))


@checked
def samples_needed(volume: Probability, beta: Probability, discarded: NonNegativeInt = 0) -> int:
    """Return the least N with ``Pr(V > volume) <= beta``; for k = 0 it is ``log(beta) / log(1 - volume)``, rounded up.

    Raises:
        CertificateError: if N would be above 2^40.
    """
    low, high = discarded, discarded + 1
    while tail(high, discarded, volume) > beta:
        low, high = high, 2 * high
        if high > _MOST_SAMPLES:
            raise CertificateError(f"a volume of {volume:g} needs more than {_MOST_SAMPLES:g} samples.")
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if tail(middle, discarded, volume) > beta else (low, middle)
    return high


@checked
def certify_scenario(sample: Sample, confidence: Probability = 0.95, discarded: NonNegativeInt = 0) -> Certificate:
    """Return a bound on the volume of the tasks whose distance exceeds the largest one left after discarding.

    A failed execution counts as a violation, larger than any distance, so it must be among the discarded ones.

    Args:
        sample: independent uniform draws alone.
        confidence: 1 - beta, the probability with which the statement holds.
        discarded: k, the number of the largest distances to discard; 0 is scenario optimisation. It must be chosen
            before the distances are known.

    Raises:
        CertificateError: if a trial is no independent draw, the number of draws depended on their distances, k is
            not below the number of draws, or more executions failed than are discarded.
    """
    beta = 1 - confidence
    foreign = [origin for origin in sample.origins if origin != "iid"]
    if foreign:
        raise CertificateError(
            f"a {_name(discarded)} bound takes independent draws alone, but {len(foreign)} of {len(sample)} trials "
            f"were chosen otherwise ({', '.join(sorted(set(foreign)))}); run --search random, or say --kind audit."
        )
    _require_counts(len(sample), discarded)
    _require_one_number(sample, _name(discarded))
    if sample.failed > discarded:
        raise CertificateError(
            f"{violations(sample)}, more than the {discarded} discarded; nothing bounds them."
            f"{advice_to_remeasure(sample)}"
        )
    ordered = np.sort(np.nan_to_num(sample.distances, nan=np.inf))
    h = float(ordered[len(sample) - 1 - discarded])
    volume = volume_bound(len(sample), discarded, beta)
    return Certificate(
        kind=_name(discarded),
        statement=(
            f"With confidence {confidence}, at most {at_most(100 * volume, 3)} % "
            f"{of_tasks(sample.distribution)} has a distance above {at_most(h)}."
        ),
        upper_bound=h,
        confidence=confidence,
        volume=volume,
        trials=len(sample),
        assumptions=(
            f"the trials are independent and {drawn_from(sample.distribution)}, and "
            f"{when_planned(sample, len(sample))}",
            "the number discarded was chosen before the distances were known",
            UNSEEN,
            "each task has one distance: the system is deterministic",
            "nothing is said of how large the distance is in the volume left out: this is no bound on d*",
            *sample.remarks,
            ONE_CAMPAIGN,
        ),
        details={"discarded": discarded, "failed": sample.failed, "failures": sample.failures},
        distribution=sample.distribution,
    )


def when_planned(sample: Sample, drawn: int) -> str:
    """Return, as a clause of an assumption, when the number of draws was chosen.

    Args:
        sample: the draws that count.
        drawn: number of all independent draws.
    """
    planned = sample.planned[-1] if len(sample) else None
    if planned is None:
        return "their number was chosen before they were executed (the store does not know when)"
    if planned > drawn:
        return f"their number did not depend on their distances, although {planned} were planned and {drawn} are known"
    return "their number was chosen before they were executed"


def _require_one_number(sample: Sample, kind: str) -> None:
    """Refuse draws whose number depended on their distances."""
    plans = list(dict.fromkeys(planned for planned in sample.planned if planned is not None))
    if 0 in plans:
        raise CertificateError(
            "the draws ended with the verdict, so their number depended on their distances, which a "
            f"{kind} bound does not allow; certify --audit N counts draws that are made from now on."
        )
    if len(plans) > 1:
        raise CertificateError(
            f"the number of draws was changed from {plans[-2]} to {plans[-1]} after the first were known, which a "
            f"{kind} bound does not allow; say --kind audit, which counts the last ones alone."
        )


def violations(sample: Sample) -> str:
    """Return a clause that draws without a distance count as violations, with their numbers."""
    numbers = [*sample.numbers_of("failed"), *sample.numbers_of("unmeasured")]
    return (
        f"{sample.failed} of {len(sample)} executions of independent draws have no distance and count as violations, "
        f"larger than any distance ({listed(numbers)})"
    )


def _name(discarded: int) -> str:
    return "sampling-discarding" if discarded else "scenario"


def _require_counts(n: int, discarded: int) -> None:
    if not 0 <= discarded < n:
        raise CertificateError(f"of {n} trials, from 0 to {max(n - 1, 0)} can be discarded, not {discarded}.")
