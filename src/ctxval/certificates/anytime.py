r"""An anytime audit: independent draws bound the volume above a threshold, valid at any stopping time.

Let k of n independent draws exceed the threshold. Against the hypothesis that at least a share eps of the tasks does,

    E_n(eps) = w 1{k = 0} (1 - eps)^(-n) + (1 - w) B(k+1, n-k+1) I_eps(k+1, n-k+1) / (eps^(k+1) (1 - eps)^(n-k))

is a supermartingale: the mixture, over q = 0 and a uniform q in [0, eps], of likelihood ratios of the shares q and eps.
Ville's inequality gives Pr(sup_n E_n(p) >= 1 / beta) <= beta for the true share p (docs/theory.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import scipy

from ctxval._util.arrays import Array, Mask
from ctxval._util.checked import Probability, checked
from ctxval._util.registry import part
from ctxval.certificates.base import Certificate, CertificateKind
from ctxval.certificates.sample import Sample
from ctxval.certificates.sentences.statements import ABOUT_DRAWS, distributed, share_above
from ctxval.errors import CertificateError

_NO_VIOLATION = 0.75
"""Weight w of q = 0. Without a violation, at most a share log(1/w) / log(1/beta) more draws are needed."""


@part("anytime")
@dataclass(frozen=True, repr=False)
class AnytimeAudit(CertificateKind):
    """Bound on the volume above a threshold, from independent draws that may be continued after looking at them."""

    name: ClassVar[str] = "anytime"
    bounds_maximum: ClassVar[bool] = False
    uses_threshold: ClassVar[bool] = True
    sorts_draws: ClassVar[bool] = True  # all of them count, whenever they end

    @checked
    def certify(self, sample: Sample, confidence: Probability = 0.95) -> Certificate:
        """Bound the volume above the threshold, which was fixed before the draws; failed draws violate it.

        Raises:
            CertificateError: if there is no threshold, or no independent draw.
        """
        if sample.threshold is None:
            what = "an anytime audit bounds the volume above a threshold"
            raise CertificateError(f"{what}, so it needs one (--threshold).")
        threshold, drawn = float(sample.threshold), sample.only("iid")
        n, limit = len(drawn), f"{threshold:.6g}"
        if not n:
            raise CertificateError(
                "an anytime audit needs independent draws of tasks, and there is none; use --audit N."
            )
        violating = ~(drawn.distances <= threshold)  # also where no distance is known
        volume = anytime_volume(violating, 1 - confidence)
        remark = " or fail, however often this was looked at and continued"
        statement = share_above(sample, volume, confidence, limit, n, remark)
        audited = f"the audited tasks are independent and {distributed(sample)}"
        fixed = f"the threshold {limit} was fixed before any of them was known"
        assumptions = (audited, fixed, *ABOUT_DRAWS)
        details = {
            "violations": int(violating.sum()),
            "largest_drawn": drawn.best if np.isfinite(drawn.best) else None,
            "failed": drawn.failed,
        }
        return self.certificate(sample, statement, threshold, confidence, assumptions, details, volume=volume, trials=n)


def anytime_volume(violating: Mask, beta: float) -> float:
    """Return the least volume that draws ``(n,)`` reject at one of the times that there were, 1 if they reject none."""

    def excess(volume: float, n: int, violations: int) -> float:
        return float(log_e_value(n, violations, np.array(volume)) + np.log(beta))

    least, high, counts = 1.0, 1 - 1e-9, np.cumsum(violating)
    # Between violations more draws only lower the volume, so that the last moment before each of them is enough.
    for end in np.flatnonzero(np.append(violating[1:], True)).tolist():
        n, violations = end + 1, int(counts[end])
        if violations < n and excess(high, n, violations) >= 0:
            root = scipy.optimize.brentq(excess, max(violations / n, 1e-12), high, args=(n, violations), xtol=1e-12)
            least = min(least, root * (1 + 1e-9))
    return least


def log_e_value(n: int, violations: int, volume: Array) -> Array:
    """Return ``log E_n`` against the hypothesis that at least this volume violates, shape of ``volume``."""
    k, held = violations, n - violations
    with np.errstate(divide="ignore"):
        uniform = (
            np.log1p(-_NO_VIOLATION)
            + scipy.special.betaln(k + 1, held + 1)
            + np.log(scipy.special.betainc(k + 1, held + 1, volume))
        )
        uniform = uniform - (k + 1) * np.log(volume) - held * np.log1p(-volume)
    if k:
        return np.asarray(uniform)
    return np.asarray(np.logaddexp(np.log(_NO_VIOLATION) - n * np.log1p(-volume), uniform))
