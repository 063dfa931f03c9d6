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
from ctxval.certificates.base import ONE_CAMPAIGN, Certificate, CertificateKind
from ctxval.certificates.bounds import with_error
from ctxval.certificates.covering import RESOLUTION, farthest_task, resolved_volume
from ctxval.certificates.forecast import Forecast, forecast
from ctxval.certificates.maxima import MOST, Maxima, draw_maxima, representative, settle_maxima
from ctxval.certificates.posterior_diagnostics import diagnose
from ctxval.certificates.sample import Sample
from ctxval.core.space import TaskSpace
from ctxval.errors import CertificateError, InputError
from ctxval.gp.acquisition import UpperConfidenceBound, maximise
from ctxval.gp.hyperposterior import Conditioned
from ctxval.gp.surrogate import fit_surrogate

_NAMED = 3
"""Largest number of task parameters for which the resolution is stated in the units of each."""


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
    evidence: ClassVar[str] = "by a prior on the distance"

    stochastic: bool = False
    resolution: PositiveFloat = RESOLUTION

    def certify(self, sample: Sample, confidence: float = 0.95) -> Certificate:
        """Return :func:`certify_posterior` of the trials."""
        return self.certify_by(None, sample, confidence)

    def certify_by(self, found: Maxima | None, sample: Sample, confidence: float) -> Certificate:
        """Return the certificate from draws of d* that were made from the same trials; if None, draw them."""
        return certify_posterior(
            sample, confidence, stochastic=self.stochastic, resolution=self.resolution, found=found
        )

    def certify_against(
        self, sample: Sample, threshold: float, confidence: float = 0.95
    ) -> tuple[Certificate, Forecast | None]:
        """Return the certificate from enough draws for the threshold, and a forecast if its bound is above that."""
        _require_covered(sample, self.resolution)
        found = settle_maxima(sample, threshold, confidence, stochastic=self.stochastic)
        certificate = self.certify_by(found, sample, confidence)
        if certificate.doubt is not None or certificate.upper_bound <= threshold:
            return certificate, None  # a process that the trials contradict predicts nothing
        return certificate, forecast(representative(sample), found, threshold, confidence)

    @classmethod
    def rests_on(cls, certificate: Certificate, space: TaskSpace | None = None) -> list[str]:
        """Return what it assumes about the distance."""
        resolution = certificate.details.get("resolution")
        smooth = "the distance being as smooth between the trials as at them, also in regions without any trial"
        if resolution is not None and resolution["of_each_range"] < 1:
            smooth = (
                f"the distance being as smooth between the trials as at them, to a resolution of "
                f"{_lengths(resolution, space)} (a peak inside a gap of that radius, {_share(resolution)} of the task "
                "space, may be missed)"
            )
        if certificate.details.get("stochastic"):
            return [
                smooth,
                "the noise that you declared being normal and alike everywhere (it is the expected distance that is "
                "bounded: single executions may exceed it)",
            ]
        return [smooth, "each task having one distance, however often it is executed"]

    @classmethod
    def qualification(cls, certificate: Certificate, space: TaskSpace | None = None) -> str:
        """Return the end of a sentence that names a resolution other than the default; empty if it is the default."""
        resolution = certificate.details.get("resolution")
        if resolution is None or resolution["diagonals"] == RESOLUTION:
            return ""
        diagonals = f"{resolution['diagonals']:g} diagonals; usual: {RESOLUTION:g}"
        if resolution["of_each_range"] >= 1:
            return f", whole regions without a trial taken to be like the rest ({diagonals})"
        return (
            f", to a resolution of {_lengths(resolution, space)}, {_share(resolution)} of the task space ({diagonals})"
        )


def _lengths(resolution: dict[str, float], space: TaskSpace | None) -> str:
    """Return a resolution in the units of the task parameters, if they are few and known."""
    share = resolution["of_each_range"]
    if space is None or space.dimension > _NAMED:
        return f"{share:.2g} of each parameter's range"
    return " and ".join(
        f"{share * width:.2g} {space.units[name.partition('[')[0]]}".rstrip() + f" in {name}"
        for name, width in zip(space.names, space.high - space.low, strict=True)
    )


def _share(resolution: dict[str, float]) -> str:
    percent = 100 * resolution["of_the_space"]
    return f"{percent:.0f} %" if percent >= 10 else f"{percent:.2g} %"


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

    Args:
        sample: trials of any origin.
        confidence: 1 - eps, the probability with which the bound holds.
        stochastic: whether two executions of one task may differ; then the largest expected distance is bounded.
        resolution: largest distance from a task to its nearest trial, in diagonals of the task space; beyond it the
            bound is withdrawn. With 1 the bound is never withdrawn for this reason.
        seed: seed of the draws.
        found: draws of d* from the same trials, if they were made before.

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
        statement=_statement(upper, error, confidence, stochastic),
        upper_bound=upper,
        confidence=confidence,
        volume=0.0,
        trials=len(sample),
        assumptions=(*_assumptions(stochastic, resolution), *_left_out(sample, used), *sample.remarks, ONE_CAMPAIGN),
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
        doubt=both_outcomes(sample, stochastic) or diagnosis.doubt,
        error=error,
    )


def _statement(upper: float, error: float, confidence: float, stochastic: bool) -> str:
    what, bound = "the largest expected distance" if stochastic else "d*", with_error(upper, error)
    return (
        f"With probability {confidence} under the prior, given the trials, {what} is at most "
        f"{bound}{_STANDARD_ERROR if '±' in bound else ''}."
    )


_STANDARD_ERROR = " (plus or minus one standard error of the random draws that it is computed from)"


def both_outcomes(sample: Sample, stochastic: bool) -> str | None:
    """Return why the bound is withdrawn if a failed task later succeeded for no stated reason; None if none did."""
    unexplained = [one for one in sample.made_good if one.because is None]
    if not unexplained:
        return None
    first = unexplained[0]
    what = (
        "a failure has no distance, so that nothing is known of the expected one there"
        if stochastic
        else "the system is not deterministic there"
    )
    return (
        f"trial {first.trial} failed and trial {first.by} executed the same task with success, for no stated reason: "
        f"{what}, and the bound is withdrawn; if the cause was removed in between, execute the task once more and say "
        f'so: ctxval ask STORE --again {first.trial} --because "what was changed"'
    )


def _require_covered(sample: Sample, resolution: float) -> None:
    """Refuse many trials that do not cover the tasks before the draws, which take long."""
    if len(sample) > MOST and (farthest := farthest_task(sample.points)) > resolution:
        raise CertificateError(
            f"some task is {farthest:.2g} of the task space's diagonal away from each of {len(sample)} trials, more "
            f"than the resolution of {resolution:g}, so the bound would be withdrawn and is not computed; an audit "
            "bounds how many tasks are worse."
        )


def _left_out(sample: Sample, used: Sample) -> tuple[str, ...]:
    if len(used) == len(sample):
        return ()
    return (
        f"the process is conditioned on {len(used)} of the {len(sample)} trials, the largest distances, the latest and "
        "well-spread ones, because all would take too long; the others would hardly raise the bound",
    )


def _assumptions(stochastic: bool, resolution: float) -> tuple[str, ...]:
    noise = (
        "executions of one task differ by independent normal noise of one size"
        if stochastic
        else "each task has one distance: the system is deterministic"
    )
    what = "expected distance" if stochastic else "distance, or its logarithm,"
    return (
        f"the {what} is a draw from a Gaussian process: a constant mean, a Matern kernel of "
        "smoothness 3/2 or 5/2, one length-scale for each parameter, all of them unknown and integrated over",
        f"it is as rough in one part of the task space as in another, as far as {resolution:g} of its diagonal from "
        "the trials: a peak in a gap between them, of which no trial shows a trace, is not covered; audit for that",
        noise,
        "how the tasks were chosen and when the campaign stopped does not matter",
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

    Args:
        sample: the trials.
        beta: confidence parameter of the UCB.
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
