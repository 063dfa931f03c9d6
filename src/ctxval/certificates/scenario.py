r"""Scenario and sampling-and-discarding bounds, exact (the paper's Sec. IV-A; Campi and Garatti 2011 with d = 1).

Of N independent draws from the task space, discard the k largest distances; h is the largest that is left. For the
volume V = Pr(d(p) > h),

    Pr(V > eps) <= sum_{i=0}^{k} binom(N, i) eps^i (1 - eps)^(N - i),

with equality for a continuous distribution of d. The paper's sum ends at k - 1, which is too small (docs/theory.md).

An audit is the scenario bound of the independent draws among trials of any origin. It assumes nothing about how the
distance depends on the task, or about how the worst known task was found.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import scipy

from ctxval._util.checked import NonNegativeInt, PositiveInt, Probability, checked
from ctxval._util.registry import part
from ctxval.certificates.base import Certificate, CertificateKind
from ctxval.certificates.bounds import at_most
from ctxval.certificates.sample import Sample, advice_to_remeasure
from ctxval.certificates.sentences.statements import (
    ABOUT_DRAWS,
    NO_BOUND,
    UNSEEN,
    how_drawn,
    share_above,
    violations,
)
from ctxval.core.trial import Origin
from ctxval.errors import CertificateError


@part("scenario")
@dataclass(frozen=True, repr=False)
class Scenario(CertificateKind):
    """Bound on all tasks except a share of the task space, from independent draws alone (scenario optimisation, SC)."""

    name: ClassVar[str] = "scenario"
    bounds_maximum: ClassVar[bool] = False
    sorts_draws: ClassVar[bool] = True

    @checked
    def certify(self, sample: Sample, confidence: Probability = 0.95) -> Certificate:
        """Return a bound on the volume of the tasks whose distance exceeds the largest one left after discarding.

        A failed execution counts as a violation, larger than any distance, so it must be among the discarded ones.

        Raises:
            CertificateError: if the draws are not independent, or if their number was not fixed beforehand.
        """
        discarded = self._require_discard()
        foreign = [origin for origin in sample.origins if origin != "iid"]
        if foreign:
            raise CertificateError(
                f"a {self.name} bound takes independent draws alone, but {len(foreign)} of {len(sample)} trials were "
                f"chosen otherwise ({', '.join(sorted(set(foreign)))}); run --search random, or say --kind audit."
            )
        require_more(len(sample), discarded)
        plans = list(dict.fromkeys(sample.planned))
        if 0 in plans:
            raise CertificateError(
                "the draws ended with the verdict, so their number depended on their distances, which a "
                f"{self.name} bound does not allow; certify --audit N counts draws that are made from now on."
            )
        if None in plans and len(plans) > 1:
            raise CertificateError(
                f"{list(sample.planned).count(None)} of the draws were imported, and nobody knows on what their number "
                f"depended, which a {self.name} bound does not allow beside counted ones; say --kind audit, which "
                "counts the last ones alone."
            )
        if len(plans) > 1:
            raise CertificateError(
                f"the number of draws was changed from {plans[-2]} to {plans[-1]} after the first were known, which a "
                f"{self.name} bound does not allow; say --kind audit, which counts the last ones alone."
            )
        if sample.failed > discarded:
            raise CertificateError(
                f"{violations(sample)}, more than the {discarded} discarded; nothing bounds them."
                f"{advice_to_remeasure(sample)}"
            )
        n, ordered = len(sample), np.sort(np.nan_to_num(sample.distances, nan=np.inf))
        h = float(ordered[n - 1 - discarded])
        volume = volume_bound(n, discarded, 1 - confidence)
        statement = share_above(sample, volume, confidence, at_most(h), n)
        assumptions = (
            *how_drawn(sample, sample, "the trials"),
            "the number discarded was chosen before the distances were known",
            *(UNSEEN, "each task has one distance: the system is deterministic", NO_BOUND),
        )
        details = {"discarded": discarded, "failed": sample.failed}
        return self.certificate(sample, statement, h, confidence, assumptions, details, volume=volume)

    def require_usable(self, confidence: float, executions: int, beside: Iterable[Origin] = ()) -> None:
        """Require independent draws alone, the number to discard, and more trials than that.

        Raises:
            CertificateError: if trials are no independent draws.
        """
        discarded = self._require_discard()
        if any(origin != "iid" for origin in beside):
            raise CertificateError(
                f"a {self.name} bound takes independent draws alone, but there are others; say --kind audit."
            )
        require_more(executions, discarded)

    def _require_discard(self) -> int:
        return 0


@part("sampling-discarding")
@dataclass(frozen=True, repr=False)
class SamplingDiscarding(Scenario):
    """The scenario bound after the largest distances are discarded (sampling and discarding, SD)."""

    name: ClassVar[str] = "sampling-discarding"

    #: how many of the largest distances are discarded, at least 1; it must be chosen before they are known
    discard: PositiveInt | None = None

    def _require_discard(self) -> int:
        if not self.discard:
            raise CertificateError("sampling and discarding needs to know how many to discard, at least 1.")
        return self.discard


@checked
def tail(n: int, discarded: int, volume: Probability) -> float:
    """Return Pr(V > volume) after n draws of which the k largest are discarded."""
    require_more(n, discarded)
    return float(scipy.special.bdtr(discarded, n, volume))


@checked
def volume_bound(n: int, discarded: int, beta: Probability) -> float:
    """Return the least eps with ``Pr(V > eps) <= beta``."""
    require_more(n, discarded)
    return float(scipy.special.betaincinv(discarded + 1, n - discarded, 1 - beta))


@checked
def samples_needed(volume: Probability, beta: Probability, discarded: NonNegativeInt = 0) -> int:
    """Return the least N with ``Pr(V > volume) <= beta``; for k = 0, ``log(beta) / log(1 - volume)`` rounded up.

    Raises:
        CertificateError: if it is more than 2^40.
    """
    low, high = discarded, discarded + 1
    while tail(high, discarded, volume) > beta:
        low, high = high, 2 * high
        if high > 2**40:
            raise CertificateError(f"a volume of {volume:g} needs more than {2**40:g} samples.")
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if tail(middle, discarded, volume) > beta else (low, middle)
    return high


def require_more(n: int, discarded: int, what: str = "trials") -> None:
    """Require more trials than are discarded."""
    if not 0 <= discarded < n:
        raise CertificateError(f"of {n} {what}, from 0 to {max(n - 1, 0)} can be discarded, not {discarded}.")


# Independent draws among trials of any origin


def countable_draws(sample: Sample, kind: str) -> Sample:
    """Return the independent draws whose number was chosen before they were executed; ``kind`` is for messages."""
    everything, drawn = len(sample.only("iid")), sample.rows(sample.countable)
    if not everything:
        raise CertificateError(f"{kind} needs independent draws of tasks, but there is none; run certify --audit N.")
    if not len(drawn):
        raise CertificateError(
            f"the {everything} independent draws ended with the verdict, so their number depended on their distances "
            "and none counts; certify --audit N draws until there are N in all, and counts only those after the first "
            f"{everything}."
        )
    return drawn


@part("audit")
@dataclass(frozen=True, repr=False)
class Audit(CertificateKind):
    """Bound on all tasks except a share of the task space, from the independent draws among the trials."""

    name: ClassVar[str] = "audit"
    bounds_maximum: ClassVar[bool] = False
    sorts_draws: ClassVar[bool] = True

    @checked
    def certify(self, sample: Sample, confidence: Probability = 0.95) -> Certificate:
        """Return a bound on the volume of the tasks whose distance exceeds the largest one known.

        The largest distance of all trials is at least that of the draws, so the volume above it is not larger. Only
        :attr:`Sample.countable` draws count, and none may have failed.

        Raises:
            CertificateError: if a draw failed.
        """
        drawn = countable_draws(sample, "an audit")
        if drawn.failed:
            raise CertificateError(
                f"{violations(drawn)}; to audit the other tasks, start a new store whose task space excludes these "
                f"tasks.{advice_to_remeasure(drawn)}"
            )
        n, h = len(drawn), sample.best
        volume = volume_bound(n, 0, 1 - confidence)
        chosen = sample.distances[[origin != "iid" for origin in sample.origins]]
        largest = float(np.nanmax(chosen)) if np.isfinite(chosen).any() else None
        statement = share_above(sample, volume, confidence, at_most(h), n, ", the largest one found")
        assumptions = (*how_drawn(sample, drawn), *ABOUT_DRAWS)
        details = {
            "largest_found": h,
            "largest_drawn": drawn.best,
            "largest_chosen": largest,
            "exceeding": None if largest is None else int((drawn.distances > largest).sum()),
            "not_counted": len(sample.only("iid")) - n,
            "failed": sample.failed,
        }
        return self.certificate(sample, statement, h, confidence, assumptions, details, volume=volume, trials=n)
