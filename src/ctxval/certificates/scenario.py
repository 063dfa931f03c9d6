r"""Scenario and sampling-and-discarding bounds, exact (the paper's Sec. IV-A; Campi and Garatti 2011 with d = 1).

Of N independent draws from the task space, discard the k largest distances; h is the largest that is left. The volume
V = Pr(d(p) > h) then has, for a continuous distribution of d, the law of the (k+1)-th smallest of N uniform draws,
Beta(k + 1, N - k), so that

    Pr(V > eps) = sum_{i=0}^{k} binom(N, i) eps^i (1 - eps)^(N - i),

and for any distribution Pr(V > eps) is at most that. The paper's sum ends at k - 1, which is too small a probability:
already for k = 0 it would be empty, and claim that one draw bounds everything.
"""

from __future__ import annotations

import numpy as np
from scipy.special import bdtr, betaincinv

from ctxval.certificates.base import ONE_CAMPAIGN, Certificate, Sample, at_most, listed, remeasure, require_probability
from ctxval.errors import CertificateError

_MOST_SAMPLES = 2**40

_UNSEEN = (
    "M was not learned from these tasks, nor chosen after seeing them: a model that is retrained on them needs a new "
    "store and fresh draws"
)


def tail(n: int, discarded: int, volume: float) -> float:
    """Return Pr(V > volume) after n draws of which the k largest are discarded.

    Raises:
        CertificateError: k is negative or not below n, or the volume not a probability.
    """
    _require_counts(n, discarded)
    return float(bdtr(discarded, n, require_probability("volume", volume)))


def volume_bound(n: int, discarded: int, beta: float) -> float:
    """Return the least eps with ``Pr(V > eps) <= beta``.

    Raises:
        CertificateError: k is negative or not below n, or beta not a probability.
    """
    _require_counts(n, discarded)
    return float(betaincinv(discarded + 1, n - discarded, 1 - require_probability("beta", beta)))


def samples_needed(volume: float, beta: float, discarded: int = 0) -> int:
    """Return the least N with ``Pr(V > volume) <= beta``; for k = 0 it is ``log(beta) / log(1 - volume)``, rounded up.

    Raises:
        CertificateError: volume or beta are not probabilities, or N would be beyond all use.
    """
    require_probability("beta", beta)
    low, high = discarded, discarded + 1
    while tail(high, discarded, volume) > beta:
        low, high = high, 2 * high
        if high > _MOST_SAMPLES:
            raise CertificateError(f"a volume of {volume:g} needs more than {_MOST_SAMPLES:g} samples.")
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if tail(middle, discarded, volume) > beta else (low, middle)
    return high


def certify_scenario(sample: Sample, confidence: float = 0.95, discarded: int = 0) -> Certificate:
    """Bound the volume of the tasks whose distance exceeds the largest one left after discarding.

    A failed execution counts as a violation, larger than any distance, so it must be among the discarded.

    Args:
        sample: independent uniform draws alone.
        confidence: 1 - beta.
        discarded: k; 0 is scenario optimisation. It must be chosen before the distances are looked at.

    Raises:
        CertificateError: a trial is no independent draw, the number of draws depended on their distances, too few are
            left, or more failed than are discarded.
    """
    beta = 1 - require_probability("confidence", confidence)
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
            f"{_violations(sample)}, more than the {discarded} discarded; nothing bounds them.{remeasure(sample)}"
        )
    ordered = np.sort(np.nan_to_num(sample.distances, nan=np.inf))
    h = float(ordered[len(sample) - 1 - discarded])
    volume = volume_bound(len(sample), discarded, beta)
    return Certificate(
        kind=_name(discarded),
        statement=(
            f"With confidence {confidence}, at most {at_most(100 * volume, 3)} % of the task space "
            f"has a distance above {at_most(h)}."
        ),
        upper_bound=h,
        confidence=confidence,
        volume=volume,
        trials=len(sample),
        assumptions=(
            f"the trials are independent and uniform over the task space, and {_number(sample, len(sample))}",
            "the number discarded was chosen before the distances were known",
            _UNSEEN,
            "each task has one distance: the system is deterministic",
            "nothing is said of how large the distance is in the volume left out: this is no bound on d*",
            *sample.remarks,
            ONE_CAMPAIGN,
        ),
        details={"discarded": discarded, "failed": sample.failed, "failures": sample.failures},
    )


def certify_audit(sample: Sample, confidence: float = 0.95) -> Certificate:
    """Bound the volume of the tasks that are worse than the worst one known, by the independent draws among the trials.

    The volume above the largest of N independent draws is bounded whatever the distance is like, and that above the
    largest of all trials, however chosen, is not larger. If the number of draws was raised after some were known, only
    those that were decided on last count, as their number was chosen before they were executed.

    Args:
        sample: trials of any origin, some of them independent draws.
        confidence: 1 - beta.

    Raises:
        CertificateError: there is no independent draw, their number depended on their distances, or an execution of
            one failed.
    """
    beta = 1 - require_probability("confidence", confidence)
    everything = sample.only("iid")
    if not len(everything):
        raise CertificateError("an audit needs independent draws of tasks, and there is none; run certify --audit N.")
    drawn = _last_decided_on(everything)
    if not len(drawn):
        raise CertificateError(
            f"the {len(everything)} independent draws ended with the verdict (--until-decided), so their number "
            f"depended on their distances and none counts; certify --audit N draws until there are N in all, and "
            f"counts those beyond the {len(everything)}."
        )
    if drawn.failed:
        raise CertificateError(
            f"{_violations(drawn)}; a new store of a task space without such tasks can be audited, and says nothing of "
            f"them.{remeasure(drawn)}"
        )
    volume, h = volume_bound(len(drawn), 0, beta), sample.best
    return Certificate(
        kind="audit",
        statement=(
            f"With confidence {confidence}, at most {at_most(100 * volume, 3)} % of the task space "
            f"has a distance above {at_most(h)}, the largest one found."
        ),
        upper_bound=h,
        confidence=confidence,
        volume=volume,
        trials=len(drawn),
        assumptions=(
            f"the audited tasks are independent and uniform over the task space, and {_number(drawn, len(everything))}",
            *_not_counted(everything, drawn),
            _UNSEEN,
            "each task has one distance: the system is deterministic",
            "nothing is assumed of how the distance depends on the task",
            "nothing is said of how large the distance is in the volume left out: this is no bound on d*",
            *sample.remarks,
            ONE_CAMPAIGN,
        ),
        details={
            **{"largest_found": h, **_against_the_search(sample, drawn)},
            **{"not_counted": len(everything) - len(drawn), "failed": sample.failed, "failures": sample.failures},
        },
    )


def _last_decided_on(drawn: Sample) -> Sample:
    """Return the draws whose number was decided on last, without those that the verdict was to end."""
    plans = [planned for planned in drawn.planned if planned != 0]
    return drawn.rows([row for row, planned in enumerate(drawn.planned) if plans and planned == plans[-1]])


def _not_counted(everything: Sample, drawn: Sample) -> tuple[str, ...]:
    missing = len(everything) - len(drawn)
    if not missing:
        return ()
    return (
        f"{missing} other independent draws do not count: the number of draws was changed, or the verdict ended them, "
        "after they were known",
    )


def _number(sample: Sample, drawn: int) -> str:
    """Return what is known of when the number of draws was chosen, of which there are so many in all."""
    planned = sample.planned[-1] if len(sample) else None
    if planned is None:
        return "their number was chosen before they were executed (the store does not know when)"
    if planned > drawn:
        return f"their number did not depend on their distances, although {planned} were planned and {drawn} are known"
    return "their number was chosen before they were executed"


def _require_one_number(sample: Sample, kind: str) -> None:
    """Refuse draws whose number was chosen after some of them were known.

    Raises:
        CertificateError: it was.
    """
    plans = list(dict.fromkeys(planned for planned in sample.planned if planned is not None))
    if 0 in plans:
        raise CertificateError(
            f"the draws ended with the verdict (--until-decided), so their number depended on their distances, which a "
            f"{kind} bound does not allow; certify --audit N counts draws that are made from now on."
        )
    if len(plans) > 1:
        raise CertificateError(
            f"the number of draws was changed from {plans[-2]} to {plans[-1]} after the first were known, which a "
            f"{kind} bound does not allow; say --kind audit, which counts the last ones alone."
        )


def _violations(sample: Sample) -> str:
    numbers = [*sample.numbers_of("failed"), *sample.numbers_of("unmeasured")]
    return (
        f"{sample.failed} of {len(sample)} executions of independent draws have no distance and count as violations, "
        f"larger than any distance ({listed(numbers)})"
    )


def _against_the_search(sample: Sample, drawn: Sample) -> dict[str, float | int | None]:
    """Return the largest distances that were drawn and that were found otherwise, and how many draws exceed these."""
    chosen = sample.distances[[origin != "iid" for origin in sample.origins]]
    if not np.isfinite(chosen).any():
        return {"largest_drawn": drawn.best, "largest_chosen": None, "exceeding": None}
    largest = float(np.nanmax(chosen))
    return {
        "largest_drawn": drawn.best,
        "largest_chosen": largest,
        "exceeding": int((drawn.distances > largest).sum()),
    }


def _name(discarded: int) -> str:
    return "sampling-discarding" if discarded else "scenario"


def _require_counts(n: int, discarded: int) -> None:
    if not 0 <= discarded < n:
        raise CertificateError(f"of {n} trials, from 0 to {max(n - 1, 0)} can be discarded, not {discarded}.")
