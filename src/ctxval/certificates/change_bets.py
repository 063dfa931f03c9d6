r"""Bets that something has changed since a run, for every run: e-processes, whose sum over the runs is an e-detector.

Statistics of runs are positive. If nothing has changed, those of the certified runs, each predicted from the others,
and those of later runs are alike: scaled chi-squares with an unknown scale s and unknown degrees of freedom m. If
something has changed at run j, those from j on have the scale :math:`c^2 s`. The bet on run k is the ratio of the two
predictive densities, given all runs before. With v the K known statistics, and s integrated out, the evidence is

.. math:: L_m = \Gamma(a)^{-K} \, \Gamma(a K) \, \Big(\sum_i v_i\Big)^{-a K} \prod_i v_i^a, \quad a = m / 2,

and m is summed over. If a statistic is one of noise, its scale is near 1 and its m is known beforehand, up to priors.

Noise hides a small change in any single run, but not that it is the same in all runs. So the coefficients by which the
residuals of a run depend on state and input are bet on too: they are 0, up to what the certified runs left uncertain,
or they come from a wider prior. Both likelihoods are known in closed form.

A share of the runs may be anything although nothing has changed. So no run multiplies a product by more than the
inverse of this share. The expectation of each product is
at most 1 if nothing has changed, so the sum over all starts, stopped when it reaches :math:`1/\alpha`, runs for at
least :math:`1/\alpha` runs on average until a false alarm (Shin, Ramdas, Rinaldo 2023).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln, logsumexp

from ctxval._util.arrays import Array

SCALES = np.array([1.3, 1.6, 2.0, 3.0, 4.0, 8.0, 30.0, 100.0])
"""Alternatives c for the scale of a changed statistic, of equal weight."""

WIDER = np.array([3.0, 10.0, 30.0, 100.0])
"""Alternatives for the variance of changed coefficients, relative to what the certified runs left uncertain."""

_FREEDOMS = np.geomspace(0.25, 64.0, 17)  # m; more would call statistics that a floor makes equal surprising
_OUTLIERS = 0.005  # share of runs that may be anything although nothing has changed
_WINDOW = 200  # latest runs at which a change may have begun; fewer starts make the sum smaller


@dataclass(frozen=True, eq=False)
class KnownStatistics:
    """What is known of scaled chi-squares, in any number of cases ``(...)``."""

    #: sums, logs: sums of the values and of their logarithms, shapes ``(...)``
    sums: Array
    logs: Array
    count: int  #: how many values these are
    freedom: float | None  #: the degrees of freedom that noise gives them; None if nothing is known beforehand

    def _log_evidence(self) -> Array:
        a, K, k = 0.5 * _FREEDOMS, self.count, 0.0
        prior = np.zeros(len(a))
        if self.freedom is not None:
            k = 40.0  # runs that prior knowledge of noise weighs as much as
            # Standard deviation of the logarithm of m around what is known beforehand.
            prior = a * k * math.log(k) - gammaln(a * k) - 0.5 * (np.log(_FREEDOMS / self.freedom) / 0.5) ** 2
        scale = -a * (K + k) * np.log(self.sums + k)[..., None]
        return np.asarray(prior + gammaln(a * (K + k)) - K * gammaln(a) + scale + a * self.logs[..., None])

    def with_value(self, value: Array) -> KnownStatistics:
        """Return what is known with one more value ``(...)``."""
        return KnownStatistics(self.sums + value, self.logs + np.log(value), self.count + 1, self.freedom)

    def log_density(self, value: Array) -> Array:
        """Return the logarithm of the predictive density of the logarithm of the next value ``(...)``."""
        after = self.with_value(value)
        return np.asarray(logsumexp(after._log_evidence(), axis=-1) - logsumexp(self._log_evidence(), axis=-1))


@dataclass(frozen=True, eq=False)
class ScaleBets:
    """The bets on each scale c and each start j of a change, and what they are made from."""

    products: Array  #: logarithms of the products of the bets, shape ``(c, j)``
    base: KnownStatistics  #: what all runs show if nothing has changed
    #: same, changed: what they show if nothing has changed, and if it has, for each scale and start ``(c, j)``
    same: KnownStatistics
    changed: KnownStatistics

    @classmethod
    def before(cls, certified: Sequence[float], freedom: float | None) -> ScaleBets:
        """Return the bets before the first later run."""
        none, K = np.empty((len(SCALES), 0)), len(certified)
        base = KnownStatistics(np.array(math.fsum(certified)), np.log(certified).sum(), K, freedom)
        nothing = KnownStatistics(none, none, K, freedom)
        return cls(none, base, nothing, nothing)

    def after(self, value: float) -> ScaleBets:
        """Return the bets after another run."""
        squares = (SCALES**2)[:, None]
        same, changed = self._with_start(self.same), self._with_start(self.changed)
        products = _appended(self.products, 0.0)
        smaller = value / np.broadcast_to(squares, products.shape)
        ordinary = same.log_density(np.full_like(products, value)) + math.log(1 - _OUTLIERS)
        other = changed.log_density(smaller)
        either = np.logaddexp(ordinary, other + math.log(_OUTLIERS))
        # An outlier teaches what it would be if it were none, so that another one is as surprising.
        outlying = np.exp(other + math.log(_OUTLIERS) - either)
        of_start = outlying[:, -1]
        usual = math.log(value) - of_start.mean() * (of_start @ np.log(squares[:, 0])) / max(of_start.sum(), 1e-300)
        return ScaleBets(
            products + other - either,
            self.base.with_value(np.exp(usual)),
            same.with_value(value * squares**-outlying),
            changed.with_value(smaller),
        )

    def _with_start(self, known: KnownStatistics) -> KnownStatistics:
        sums, logs = _appended(known.sums, self.base.sums), _appended(known.logs, self.base.logs)
        return KnownStatistics(sums, logs, self.base.count, self.base.freedom)


def _appended(array: Array, value: float | Array) -> Array:
    return np.concatenate([array, np.full((len(array), 1), value)], axis=1)[:, -_WINDOW:]


@dataclass(frozen=True, eq=False)
class SlopeBets:
    """The bets on changed coefficients, for each prior of the change and each start ``(p, j)``."""

    products: Array  #: logarithms of the products of the bets, shape ``(p, j)``
    #: gradients, informations: sums over the runs since each start, shapes ``(j, k)`` and ``(j, k, k)``
    gradients: Array
    informations: Array
    priors: Array  #: the inverse covariances if nothing has changed, and for each prior of a change, ``(1 + p, k, k)``
    scale: float  #: variance of the noise relative to what was learned

    @classmethod
    def before(cls, certified: Array, scale: float) -> SlopeBets:
        """Return the bets before the first later run, from the information ``(k, k)`` of the certified ones."""
        k = len(certified)
        known = certified / scale + 1e-9 * max(float(np.trace(certified)), 1e-300) * np.eye(k)
        priors = known / np.array([1.0, *WIDER])[:, None, None]
        return cls(np.empty((len(WIDER), 0)), np.empty((0, k)), np.empty((0, k, k)), priors, scale)

    def after(self, gradient: Array, information: Array) -> SlopeBets:
        """Return the bets after another run, whose likelihood is ``exp(w' gradient - w' information w / 2)``."""
        products = _appended(self.products, 0.0)
        gradients = np.pad(self.gradients, ((0, 1), (0, 0)))[-_WINDOW:]
        informations = np.pad(self.informations, ((0, 1), (0, 0), (0, 0)))[-_WINDOW:]
        before = self._ratios(gradients, informations)
        gradients, informations = gradients + gradient / self.scale, informations + information / self.scale
        change = self._ratios(gradients, informations) - before
        bets = change - np.logaddexp(math.log(1 - _OUTLIERS), math.log(_OUTLIERS) + change)
        return replace(self, products=products + bets, gradients=gradients, informations=informations)

    def _ratios(self, gradients: Array, informations: Array) -> Array:
        """Return logarithms of likelihood ratios of a change, with the coefficients integrated out, ``(p, j)``."""
        known = self.priors[:, None] + informations
        right = np.broadcast_to(gradients[..., None], (*known.shape[:-1], 1))
        likelihoods = 0.5 * (gradients * np.linalg.solve(known, right)[..., 0]).sum(axis=-1)
        likelihoods += 0.5 * (np.linalg.slogdet(self.priors)[1][:, None] - np.linalg.slogdet(known)[1])
        return np.asarray(likelihoods[1:] - likelihoods[0])
