r"""Whether a certificate still holds: the statistics of later runs, in channels, and the alarm that they raise.

Each channel has one statistic of each run, such as the mean square of the residuals of a state. The runs are the units
of the test, so little is assumed of the steps within a run. The evidence is the mean over the channels of their
e-detectors. With few certified runs, its rate of false alarms is as reliable as the assumed law of the statistics;
``docs/how-to/watch.md`` shows measured rates.

For every run, an e-process bets that something has changed since this run; their sum over the runs is an e-detector.
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
inverse of this share. The expectation of each product is at most 1 if nothing has changed, so the sum over all starts,
stopped when it reaches :math:`1/\alpha`, runs for at least :math:`1/\alpha` runs on average until a false alarm (Shin,
Ramdas, Rinaldo 2023).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
import scipy

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.certificates.sentences import withdrawals
from ctxval.core.learned_numbers import Statistic
from ctxval.errors import InputError


@dataclass(frozen=True)
class ChangeSettings:
    """How later runs are compared with certified ones."""

    #: evidence from which runs are not said to agree with the certified ones: that of a single test at level 0.05
    suspected: float = 20.0
    #: alternatives c for the scale of a changed statistic, of equal weight
    scales: Array = field(default_factory=lambda: np.array([1.3, 1.6, 2.0, 3.0, 4.0, 8.0, 30.0, 100.0]))
    #: alternatives for the variance of changed coefficients, relative to what the certified runs left uncertain
    wider: tuple[float, ...] = (3.0, 10.0, 30.0, 100.0)
    #: m; more would call statistics that a floor makes equal surprising
    freedoms: Array = field(default_factory=lambda: np.geomspace(0.25, 64.0, 17))
    outliers: float = 0.005  #: share of runs that may be anything although nothing has changed
    window: int = 200  #: latest runs at which a change may have begun; fewer starts make the sum smaller


CHANGES = ChangeSettings()
"""The settings in use."""


EXCEEDED = "distances above the threshold"
"""Cause of an alarm that needs no evidence: without noise, an executed distance above the threshold is a fact."""

FEWEST = 3
"""Fewest certified runs from which later ones are judged."""


@dataclass(frozen=True, eq=False)
class KnownStatistics:
    """What is known of scaled chi-squares, in any number of cases ``(...)``."""

    #: sums, logs: sums of the values and of their logarithms, shapes ``(...)``
    sums: Array
    logs: Array
    count: int  #: how many values these are
    freedom: float | None  #: the degrees of freedom that noise gives them; None if nothing is known beforehand

    def _log_evidence(self) -> Array:
        a, K, k = 0.5 * CHANGES.freedoms, self.count, 0.0
        prior = np.zeros(len(a))
        if self.freedom is not None:
            k = 40.0  # runs that prior knowledge of noise weighs as much as
            # Standard deviation of the logarithm of m around what is known beforehand.
            prior = (
                a * k * math.log(k)
                - scipy.special.gammaln(a * k)
                - 0.5 * (np.log(CHANGES.freedoms / self.freedom) / 0.5) ** 2
            )
        scale = -a * (K + k) * np.log(self.sums + k)[..., None]
        return np.asarray(
            prior + scipy.special.gammaln(a * (K + k)) - K * scipy.special.gammaln(a) + scale + a * self.logs[..., None]
        )

    def with_value(self, value: Array) -> KnownStatistics:
        """Return what is known with one more value ``(...)``."""
        return KnownStatistics(self.sums + value, self.logs + np.log(value), self.count + 1, self.freedom)

    def log_density(self, value: Array) -> Array:
        """Return the logarithm of the predictive density of the logarithm of the next value ``(...)``."""
        after = self.with_value(value)
        return np.asarray(
            np.logaddexp.reduce(after._log_evidence(), axis=-1) - np.logaddexp.reduce(self._log_evidence(), axis=-1)
        )


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
        none, K = np.empty((len(CHANGES.scales), 0)), len(certified)
        base = KnownStatistics(np.array(math.fsum(certified)), np.log(certified).sum(), K, freedom)
        nothing = KnownStatistics(none, none, K, freedom)
        return cls(none, base, nothing, nothing)

    def after(self, value: float) -> ScaleBets:
        """Return the bets after another run."""
        squares = (CHANGES.scales**2)[:, None]
        same, changed = self._with_start(self.same), self._with_start(self.changed)
        products = _appended(self.products, 0.0)
        smaller = value / np.broadcast_to(squares, products.shape)
        ordinary = same.log_density(np.full_like(products, value)) + math.log(1 - CHANGES.outliers)
        other = changed.log_density(smaller)
        either = np.logaddexp(ordinary, other + math.log(CHANGES.outliers))
        # An outlier teaches what it would be if it were none, so that another one is as surprising.
        outlying = np.exp(other + math.log(CHANGES.outliers) - either)
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
    return np.concatenate([array, np.full((len(array), 1), value)], axis=1)[:, -CHANGES.window :]


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
        priors = known / np.array([1.0, *CHANGES.wider])[:, None, None]
        return cls(np.empty((len(CHANGES.wider), 0)), np.empty((0, k)), np.empty((0, k, k)), priors, scale)

    def after(self, gradient: Array, information: Array) -> SlopeBets:
        """Return the bets after another run, whose likelihood is ``exp(w' gradient - w' information w / 2)``."""
        products = _appended(self.products, 0.0)
        gradients = np.pad(self.gradients, ((0, 1), (0, 0)))[-CHANGES.window :]
        informations = np.pad(self.informations, ((0, 1), (0, 0), (0, 0)))[-CHANGES.window :]
        before = self._ratios(gradients, informations)
        gradients, informations = gradients + gradient / self.scale, informations + information / self.scale
        change = self._ratios(gradients, informations) - before
        bets = change - np.logaddexp(math.log(1 - CHANGES.outliers), math.log(CHANGES.outliers) + change)
        return replace(self, products=products + bets, gradients=gradients, informations=informations)

    def _ratios(self, gradients: Array, informations: Array) -> Array:
        """Return logarithms of likelihood ratios of a change, with the coefficients integrated out, ``(p, j)``."""
        known = self.priors[:, None] + informations
        right = np.broadcast_to(gradients[..., None], (*known.shape[:-1], 1))
        likelihoods = 0.5 * (gradients * np.linalg.solve(known, right)[..., 0]).sum(axis=-1)
        likelihoods += 0.5 * (np.linalg.slogdet(self.priors)[1][:, None] - np.linalg.slogdet(known)[1])
        return np.asarray(likelihoods[1:] - likelihoods[0])


@dataclass(frozen=True)
class WatchedChannel(ShortRepr):
    """One kind of statistics."""

    name: str  #: what they are of, as the subject of a sentence in the plural
    certified: tuple[float, ...]  #: those of the certified runs, each predicted from the others; positive
    freedom: float | None = None  #: the degrees of freedom that noise gives them; None if there is no noise
    #: that of all certified runs on coefficients, shape ``(k, k)``; None if there is no noise
    information: Array | None = field(default=None, compare=False)
    later: tuple[Statistic | None, ...] = ()  #: those of later runs; None for a run that does not have it
    _scales: ScaleBets | None = field(default=None, compare=False)
    _slopes: SlopeBets | None = field(default=None, compare=False)

    def after(self, statistic: Statistic | None) -> Self:
        """Return the channel after another run."""
        after = replace(self, later=(*self.later, statistic))
        if statistic is None:
            return after
        scales = (self._scales or ScaleBets.before(self.certified, self.freedom)).after(statistic.value)
        slopes = None
        if self.information is not None and statistic.gradient is not None and statistic.information is not None:
            before = self._slopes or SlopeBets.before(self.information, max(1.0, float(np.mean(self.certified))))
            slopes = before.after(statistic.gradient, statistic.information)
        return replace(after, _scales=scales, _slopes=slopes)

    def evidence(self) -> tuple[float, int]:
        """Return the logarithm of the sum over all starts, and the run, counted from 1, at which it is likeliest."""
        if self._scales is None:
            return -math.inf, 1
        of_starts = np.logaddexp.reduce(self._scales.products, axis=0) - math.log(len(CHANGES.scales))
        if self._slopes is not None:
            of_slopes = np.logaddexp.reduce(self._slopes.products, axis=0) - math.log(len(CHANGES.wider))
            of_starts = np.logaddexp(of_starts, of_slopes) - math.log(2)
        known = [k for k, statistic in enumerate(self.later) if statistic is not None][-len(of_starts) :]
        return float(np.logaddexp.reduce(of_starts)), known[int(of_starts.argmax())] + 1

    def ratio(self, since: int) -> float:
        """Return how many times as large as those certified the statistics are since a run, in root mean squares."""
        later = [statistic.value for statistic in self.later[since - 1 :] if statistic is not None]
        return math.sqrt(float(np.mean(later)) / float(np.mean(self.certified)))


@dataclass(frozen=True)
class WatchState(ShortRepr):
    """What later runs say of a certificate: plain numbers, which can be stored as JSON."""

    threshold: float  #: tau
    false_alarms: float  #: largest rate of false alarms, such as one in 1,000 runs
    channels: tuple[WatchedChannel, ...]  #: the statistics
    runs: tuple[str, ...] = ()  #: the names of the later runs
    distances: tuple[float | None, ...] = ()  #: their distances; None if they are unknown
    evidence: float = 0.0  #: the e-detector; the alarm is raised when it reaches ``1 / false_alarms``, and stays
    alarm: int | None = None  #: the run, counted from 1, at which the alarm was raised; None if there is none
    since: int | None = None  #: the run, counted from 1, from which on the change is likeliest to have acted
    cause: str | None = None  #: the name of the channel with the largest evidence, or ``EXCEEDED``
    ratio: float | None = None  #: of its statistics since then to those certified, or of the distance to the threshold

    def after(self, run: str, statistics: Mapping[str, Statistic], distance: float | None = None) -> Self:
        """Return the state after another run; a channel without a statistic of it says nothing of it.

        A run whose statistics are those of an earlier one is the same recording, which counts once: the state stays.
        """
        if any(self._is_that_of(k, statistics) for k, earlier in enumerate(self.distances) if earlier == distance):
            return self
        channels = tuple(channel.after(statistics.get(channel.name)) for channel in self.channels)
        of_channels = [channel.evidence() for channel in channels]
        logs = np.array([log for log, _ in of_channels])
        evidence = math.exp(min(700.0, float(np.logaddexp.reduce(logs)) - math.log(len(logs))))
        runs, distances = (*self.runs, run), (*self.distances, distance)
        after = replace(self, channels=channels, runs=runs, distances=distances, evidence=evidence)
        if self.expired:
            return after  # an alarm is a fact, and so is what it was raised for
        if distance is not None and distance > self.threshold and not self.has_noise:
            return replace(after, alarm=len(runs), since=len(runs), cause=EXCEEDED, ratio=distance / self.threshold)
        largest = int(logs.argmax())
        cause, since = channels[largest], of_channels[largest][1]
        alarm = len(runs) if evidence >= 1 / self.false_alarms else None
        return replace(after, alarm=alarm, since=since, cause=cause.name, ratio=cause.ratio(since))

    def _is_that_of(self, k: int, statistics: Mapping[str, Statistic]) -> bool:
        values = [(each.later[k], statistics.get(each.name)) for each in self.channels]
        pairs = [pair for pair in values if pair != (None, None)]
        return bool(pairs) and all(a and b and math.isclose(a.value, b.value, rel_tol=1e-9) for a, b in pairs)

    @property
    def expired(self) -> bool:
        """Whether the system is no longer that of the certificate."""
        return self.alarm is not None

    @property
    def has_noise(self) -> bool:
        """Whether executions of one task differ, so that a threshold is about a share of them."""
        return any(channel.freedom is not None for channel in self.channels)

    @property
    def sentence(self) -> str:
        """What the runs say, in one sentence without its full stop."""
        if self.cause == EXCEEDED and self.alarm is not None:
            distance = self.distances[self.alarm - 1]
            return withdrawals.EXCEEDED.format(run=self.alarm, distance=distance, threshold=self.threshold)
        against = {"evidence": self.evidence, "limit": 1 / self.false_alarms}
        if self.ratio is not None and (self.expired or self.evidence >= CHANGES.suspected):
            times = f"{self.ratio:.2g}" if self.ratio < 100 else f"{self.ratio:.0f}"
            text = withdrawals.CHANGED if self.expired else withdrawals.SUSPECTED
            return text.format(cause=self.cause, since=self.since, times=times, **against)
        agree = "1 run agrees" if len(self.runs) == 1 else f"{len(self.runs)} runs agree"
        return withdrawals.HOLDS.format(agree=agree, **against)

    def to_json(self) -> dict[str, Any]:
        """Return all attributes and the sentence, ready for JSON."""
        names = ("threshold", "false_alarms", "evidence", "alarm", "since", "cause", "ratio")
        of_channel = ("name", "certified", "freedom", "information")
        of_statistic = ("value", "gradient", "information")
        channels = [{name: getattr(channel, name) for name in of_channel} for channel in self.channels]
        for described, channel in zip(channels, self.channels, strict=True):
            described["later"] = [
                each and {name: getattr(each, name) for name in of_statistic} for each in channel.later
            ]
        return {
            **{name: getattr(self, name) for name in names},
            "channels": json.loads(json.dumps(channels, default=lambda array: array.tolist())),
            "runs": list(self.runs),
            "distances": list(self.distances),
            "expired": self.expired,
            "sentence": self.sentence,
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Return the state that :meth:`to_json` returned.

        Raises:
            InputError: if it is not what ``to_json`` returned.
        """

        def array(listed: Any) -> Array | None:
            return None if listed is None else np.array(listed, dtype=np.float64)

        try:
            channels = tuple(
                WatchedChannel(
                    str(each["name"]),
                    tuple(float(value) for value in each["certified"]),
                    None if each["freedom"] is None else float(each["freedom"]),
                    array(each["information"]),
                )
                for each in values["channels"]
            )
            state = cls(float(values["threshold"]), float(values["false_alarms"]), channels)
            for number, run in enumerate(values["runs"]):
                statistics = {
                    str(each["name"]): Statistic(float(s["value"]), array(s["gradient"]), array(s["information"]))
                    for each in values["channels"]
                    if (s := each["later"][number]) is not None
                }
                distance = values["distances"][number]
                state = state.after(str(run), statistics, None if distance is None else float(distance))
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(f"the state of a watch must be what to_json returned ({error!r}).") from error
        return state
