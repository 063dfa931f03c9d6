r"""The Gaussian-process bound: the posterior of ``d* = max_p d(p)`` given all trials, however they were chosen.

The bound is an order statistic of draws of d*. Under the prior, S independent draws and the truth are exchangeable, so
the truth is at most the k-th smallest draw with probability ``k / (S + 1)``. Here groups of draws share
hyperparameters, so this holds approximately. Bayes' rule does not depend on why a task was chosen or why the campaign
stopped, so the bound holds after adaptive sampling. It rests on the prior;
:mod:`ctxval.certificates.posterior_diagnostics` finds trials that contradict it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ctxval._util.checked import PositiveFloat, Probability, checked
from ctxval._util.registry import part
from ctxval.certificates.base import Certificate, CertificateKind
from ctxval.certificates.covering import RESOLUTION, farthest_task, resolved_volume
from ctxval.certificates.forecast import Forecast, forecast
from ctxval.certificates.maxima import MOST, Maxima, draw_maxima, representative, settle_maxima
from ctxval.certificates.posterior_diagnostics import diagnose
from ctxval.certificates.sample import Sample
from ctxval.certificates.sentences import ONE_CAMPAIGN, both_outcomes, posterior_assumptions, posterior_statement
from ctxval.errors import CertificateError, InputError
from ctxval.gp.acquisition import UpperConfidenceBound, maximise
from ctxval.gp.hyperposterior import Conditioned
from ctxval.gp.surrogate import fit_surrogate


@part("posterior")
@dataclass(frozen=True, repr=False)
class Posterior(CertificateKind):
    """Bound on d* from the posterior of a Gaussian process of the distance.

    Attributes:
        stochastic: whether two executions of one task may differ; then the largest expected distance is bounded.
        resolution: largest distance from a task to its nearest trial, in diagonals of the task space; beyond it the
            bound is withdrawn. With 1 the bound is never withdrawn for this reason.
    """

    name: ClassVar[str] = "posterior"

    stochastic: bool = False
    resolution: PositiveFloat = RESOLUTION

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return :func:`certify_posterior` of the trials."""
        return certify_posterior(sample, confidence, stochastic=self.stochastic, resolution=self.resolution)

    def certify_against(
        self, sample: Sample, threshold: float, confidence: float = 0.95
    ) -> tuple[Certificate, Forecast | None]:
        """Return the certificate from enough draws for the threshold, and a forecast if its bound is above that."""
        _require_covered(sample, self.resolution)
        drawn = settle_maxima(sample, threshold, confidence, stochastic=self.stochastic)
        certificate = certify_posterior(
            sample, confidence, stochastic=self.stochastic, resolution=self.resolution, found=drawn
        )
        if certificate.doubt is not None or certificate.upper_bound <= threshold:
            return certificate, None  # a process that the trials contradict predicts nothing
        return certificate, forecast(representative(sample), drawn, threshold, confidence)


@checked
def certify_posterior(
    sample: Sample,
    confidence: Probability = 0.95,
    *,
    stochastic: bool = False,
    resolution: PositiveFloat = RESOLUTION,
    seed: int = 0,
    found: Maxima | None = None,
) -> Certificate:
    """Return the bound that d* stays below with the confidence, under the prior and given the trials.

    If the system is stochastic, the largest expected distance is bounded; ``resolution`` is that of :class:`Posterior`,
    and ``found`` are draws of d* from the same trials, if they were made before.

    Raises:
        CertificateError: if an execution failed, the trials do not allow a bound (see :func:`draw_maxima`), the
            confidence is too high for the number of draws, or more trials than are used do not cover the tasks.
    """
    used = representative(sample)
    _require_covered(sample, resolution)
    drawn = draw_maxima(sample, stochastic=stochastic, seed=seed) if found is None else found
    upper, error = drawn.upper(confidence), drawn.error(confidence)
    unordered = np.array([origin == "manual" for origin in used.origins])
    diagnosis = diagnose(
        *(drawn.conditioned, used.points, used.numbers),
        unordered=unordered,
        resolution=resolution,
        covered=sample.points,
    )
    return Certificate(
        kind="posterior",
        statement=posterior_statement(upper, error, confidence, stochastic=stochastic),
        upper_bound=upper,
        confidence=confidence,
        volume=0.0,
        trials=len(sample),
        assumptions=(
            *posterior_assumptions(sample, len(used), resolution, stochastic=stochastic),
            *sample.remarks,
            ONE_CAMPAIGN,
        ),
        details={
            "best": sample.best,
            "gap": upper - sample.best,
            "error": error,
            "draws": len(drawn.draws),
            "stochastic": stochastic,
            "resolution": {
                "diagonals": resolution,
                "of_each_range": resolution * float(np.sqrt(sample.points.shape[1])),
                "of_the_space": resolved_volume(resolution, sample.points.shape[1]),
            },
            "instantaneous": instantaneous_bound(used),
            **_summary(drawn.conditioned),
            "diagnosis": diagnosis.to_json(),
            "failures": sample.failures,
        },
        doubt=both_outcomes(sample, stochastic=stochastic) or diagnosis.doubt,
        error=error,
    )


def _require_covered(sample: Sample, resolution: float) -> None:
    """Refuse many trials that do not cover the tasks before the draws, which take long."""
    if len(sample) > MOST and (farthest := farthest_task(sample.points)) > resolution:
        raise CertificateError(
            f"some task is {farthest:.2g} of the task space's diagonal away from each of {len(sample)} trials, more "
            f"than the resolution of {resolution:g}, so the bound would be withdrawn and is not computed; an audit "
            "bounds how many tasks are worse."
        )


def _summary(conditioned: list[Conditioned]) -> dict[str, Any]:
    """Return a summary of the hyperparameters: shares of the kernels and the scales, medians of the length-scales."""
    scales = np.exp([one.hyperparameters.log_scales for one in conditioned])
    rough = float(np.mean([one.hyperparameters.nu == 1.5 for one in conditioned]))
    return {
        "kernels": {"matern-3/2": rough, "matern-5/2": 1 - rough},
        "logarithm": float(np.mean([np.isfinite(one.warp.offset) for one in conditioned])),
        "length_scales": np.median(scales, axis=0).tolist(),
    }


def instantaneous_bound(sample: Sample, beta: float = 2.0) -> dict[str, float] | None:
    """Return the largest UCB of the paper's GP with estimated hyperparameters, and its gap to the best distance found.

    It is below d* about as often as above, and costs a fortieth of a posterior bound. Returns None if fewer than two
    distances are known.
    """
    try:
        surrogate = fit_surrogate(sample.points, sample.distances)
    except InputError:
        return None
    bound = UpperConfidenceBound(surrogate.process, beta)
    best_first = sample.points[np.argsort(-sample.distances, kind="stable")]
    point = maximise(bound, sample.points.shape[1], best_first, np.random.default_rng(0))
    largest = surrogate.shift + surrogate.scale * float(bound(point[None])[0])
    return {"max_ucb": largest, "gap": largest - float(sample.distances.max()), "beta": beta}
