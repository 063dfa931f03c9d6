r"""Whether a certificate still holds: an e-detector on statistics of later runs, beside those of the certified ones.

Each channel has one positive statistic of each run, such as the mean square of the residuals of one state. The runs are
the units of the test, so nothing is assumed of the steps within a run. If nothing has changed, the statistics of the
certified runs (each predicted without itself) and of later runs are alike: scaled chi-squares with an unknown scale s
and unknown degrees of freedom m, as heavy-tailed as the certified runs say. If something has changed at run j, those
from j on have the scale :math:`c^2 s`. With both unknowns integrated out, K statistics of which n are later than j, and
:math:`S_c` their sum after the later ones are divided by :math:`c^2`, the likelihood is

.. math:: L_c = \sum_m w_m \, \Gamma(a)^{-K} \, \Gamma(a K) \, c^{-2 a n} \, S_c^{-a K} \prod_i v_i^a, \quad a = m / 2,

and the ratio :math:`\Lambda^{(j)} = \sum_c w_c L_c / L_1` is an e-process: its expectation is 1 at any time if nothing
has changed. The sum over all j is an e-detector (Shin, Ramdas, Rinaldo 2023): stopped when it reaches :math:`1 /
\alpha`, it runs for at least :math:`1 / \alpha` runs on average until a false alarm. So is the mean over channels. With
few certified runs, this is as reliable as the law of the statistics; ``docs/how-to/watch.md`` shows measured rates.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

import numpy as np
from scipy.special import gammaln, logsumexp

from ctxval._util.arrays import Array, Rows
from ctxval._util.representation import ShortRepr
from ctxval.errors import InputError

_SCALES = np.array([1.3, 1.6, 2.0, 3.0, 4.0, 8.0, 30.0, 100.0])  # c, alternatives of equal weight
_EXPECTED = 40.0  # runs that a statistic with a known law of noise weighs as much as
_FREEDOMS = np.geomspace(0.25, 64.0, 17)  # m; more would call statistics that a floor makes equal surprising
_OUTLIERS = 0.005  # share of runs that may be anything although nothing has changed: no run alone raises an alarm
_WIDER = np.array([3.0, 10.0, 30.0, 100.0])  # variances of changed coefficients beside those that are left uncertain
_WINDOW = 200  # latest runs at which a change may have begun; fewer starts make the sum smaller

FEWEST = 3
"""Fewest certified runs from which later ones are judged."""


@dataclass(frozen=True, eq=False)
class _Known:
    """What is known of scaled chi-squares, for any number of cases: sums of values and of their logarithms ``(...)``."""

    sums: Array
    logs: Array
    count: int
    freedom: float | None

    def _log_evidence(self) -> Array:
        """Return the logarithms of the likelihoods of each m ``(..., m)``, with the scale integrated out."""
        a, K, k = 0.5 * _FREEDOMS, self.count, 0.0
        prior = np.zeros(len(a))
        if self.freedom is not None:
            # Statistics of noise alone are known beforehand: near 1, with these degrees of freedom.
            k = _EXPECTED
            prior = a * k * math.log(k) - gammaln(a * k) - 0.5 * (np.log(_FREEDOMS / self.freedom) / 0.5) ** 2
        scale = -a * (K + k) * np.log(self.sums + k)[..., None]
        return np.asarray(prior + gammaln(a * (K + k)) - K * gammaln(a) + scale + a * self.logs[..., None])

    def with_value(self, value: Array) -> _Known:
        """Return what is known with one more value ``(...)``."""
        return _Known(self.sums + value, self.logs + np.log(value), self.count + 1, self.freedom)

    def log_density(self, value: Array) -> Array:
        """Return the logarithm of the predictive density of the logarithm of the next value."""
        after = self.with_value(value)
        return np.asarray(logsumexp(after._log_evidence(), axis=-1) - logsumexp(self._log_evidence(), axis=-1))


@dataclass(frozen=True, eq=False)
class Slopes:
    """What one run says of coefficients w, by which residuals depend on state and input, if there is noise.

    Its likelihood is proportional to ``exp(w' gradient - w' information w / 2)``.

    Attributes:
        gradient: shape ``(k,)``.
        information: shape ``(k, k)``.
    """

    gradient: Array
    information: Array

    def to_json(self) -> dict[str, Any]:
        """Return both, ready for JSON."""
        return {"gradient": self.gradient.tolist(), "information": self.information.tolist()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any] | None) -> Slopes | None:
        """Return what :meth:`to_json` returned, or None."""
        return values and cls(*(np.array(values[name], dtype=np.float64) for name in ("gradient", "information")))


@dataclass(frozen=True)
class Statistic:
    """The statistic of one run in a channel, and what the run says of coefficients; None if there is no noise."""

    value: float
    slopes: Slopes | None = None


@dataclass(frozen=True)
class Channel(ShortRepr):
    """One statistic of each run.

    Attributes:
        name: what it is, as the subject of a sentence in the plural.
        certified: those of the certified runs, each predicted from the others; positive.
        freedom: the degrees of freedom that noise gives it; None if there is no noise, and nothing is known beforehand.
        information: that of all certified runs on coefficients, shape ``(k, k)``; None if there is no noise.
        later: those of later runs; None for a run that does not have it.
    """

    name: str
    certified: tuple[float, ...]
    freedom: float | None = None
    information: Array | None = field(default=None, compare=False)
    later: tuple[Statistic | None, ...] = ()
    _bets: _Bets | None = field(default=None, compare=False, repr=False)
    _slopes: _SlopeBets | None = field(default=None, compare=False, repr=False)

    def after(self, statistic: Statistic | None) -> Self:
        """Return the channel after another run."""
        after = replace(self, later=(*self.later, statistic))
        if statistic is None:
            return after
        bets = (self._bets or _Bets.before(self.certified, self.freedom)).after(statistic.value)
        slopes = None
        if statistic.slopes is not None and self.information is not None:
            before = self._slopes or _SlopeBets.before(self.information, max(1.0, float(np.mean(self.certified))))
            slopes = before.after(statistic.slopes)
        return replace(after, _bets=bets, _slopes=slopes)

    def evidence(self) -> tuple[float, int]:
        """Return the logarithm of the sum over all starts, and the run, counted from 1, at which it is likeliest."""
        if self._bets is None:
            return -math.inf, 1
        of_starts = logsumexp(self._bets.products, axis=0) - math.log(len(_SCALES))
        if self._slopes is not None:
            of_slopes = logsumexp(self._slopes.products, axis=0) - math.log(len(_WIDER))
            of_starts = np.logaddexp(of_starts, of_slopes) - math.log(2)
        known = [k for k, value in enumerate(self.later) if value is not None][-len(of_starts) :]
        return float(logsumexp(of_starts)), known[int(of_starts.argmax())] + 1

    def ratio(self, since: int) -> float:
        """Return how many times as large as those certified the statistics are since a run, in root mean squares."""
        later = [statistic.value for statistic in self.later[since - 1 :] if statistic is not None]
        return math.sqrt(float(np.mean(later)) / float(np.mean(self.certified)))


@dataclass(frozen=True, eq=False)
class _Bets:
    """The bets on each scale c and each start j of a change, and what they are made from.

    Attributes:
        products: logarithms of the products of the bets, shape ``(c, j)``.
        base: what all runs show if nothing has changed.
        same, changed: what they show if nothing has changed, and if it has, for each scale and start ``(c, j)``.
    """

    products: Array
    base: _Known
    same: _Known
    changed: _Known

    @classmethod
    def before(cls, certified: Sequence[float], freedom: float | None) -> _Bets:
        """Return the bets before the first later run."""
        none = np.empty((len(_SCALES), 0))
        K = len(certified)
        base = _Known(np.array(math.fsum(certified)), np.log(certified).sum(), K, freedom)
        return cls(none, base, _Known(none, none, K, freedom), _Known(none, none, K, freedom))

    def after(self, value: float) -> _Bets:
        """Return the bets after another run."""
        squares = (_SCALES**2)[:, None]
        # A change may begin at this run.
        products, *known = (
            np.concatenate([old, np.full((len(_SCALES), 1), new)], axis=1)[:, -_WINDOW:]
            for old, new in (
                (self.products, 0.0),
                *((part, own) for each in (self.same, self.changed)
                  for part, own in ((each.sums, self.base.sums), (each.logs, self.base.logs))),
            )
        )  # fmt: skip
        same, changed = (_Known(*pair, self.base.count, self.base.freedom) for pair in (known[:2], known[2:]))
        ordinary = same.log_density(np.full_like(products, value)) + math.log(1 - _OUTLIERS)
        other = changed.log_density(value / np.broadcast_to(squares, products.shape))
        outlying = other + math.log(_OUTLIERS)
        bets = other - np.logaddexp(ordinary, outlying)
        # An outlier teaches what it would be if it were none, so that the next one is as surprising.
        share = np.exp(outlying - np.logaddexp(ordinary, outlying))
        of_base = share[:, -1].mean()
        smaller = np.exp((share[:, -1] * np.log(value / squares[:, 0])).sum() / max(share[:, -1].sum(), 1e-300))
        return _Bets(
            products + bets,
            self.base.with_value(np.array(value ** (1 - of_base) * smaller**of_base)),
            same.with_value(value * squares**-share),
            changed.with_value(value / np.broadcast_to(squares, products.shape)),
        )


@dataclass(frozen=True, eq=False)
class _SlopeBets:
    """The bets on changed coefficients, for each prior of the change and each start ``(p, j)``.

    If nothing has changed, the coefficients are 0 but for what the certified runs left uncertain. If something has, the
    prior is as many times wider as ``_WIDER`` says.

    Attributes:
        products: logarithms of the products of the bets, shape ``(p, j)``.
        gradients, informations: sums over the runs since each start, shapes ``(j, k)`` and ``(j, k, k)``.
        priors: the inverse covariances if nothing has changed, and for each prior of a change, ``(1 + p, k, k)``.
        scale: variance of the noise relative to what was learned.
    """

    products: Array
    gradients: Array
    informations: Array
    priors: Array
    scale: float

    @classmethod
    def before(cls, certified: Array, scale: float) -> _SlopeBets:
        """Return the bets before the first later run, from the information of the certified ones."""
        k = len(certified)
        known = certified / scale + 1e-9 * max(np.trace(certified), 1e-300) * np.eye(k)
        priors = known / np.array([1.0, *_WIDER])[:, None, None]
        return cls(np.empty((len(_WIDER), 0)), np.empty((0, k)), np.empty((0, k, k)), priors, scale)

    def after(self, run: Slopes) -> _SlopeBets:
        """Return the bets after another run."""
        products = np.pad(self.products, ((0, 0), (0, 1)))[:, -_WINDOW:]
        gradients = np.pad(self.gradients, ((0, 1), (0, 0)))[-_WINDOW:]
        informations = np.pad(self.informations, ((0, 1), (0, 0), (0, 0)))[-_WINDOW:]
        before = self._ratios(gradients, informations)
        gradients, informations = gradients + run.gradient / self.scale, informations + run.information / self.scale
        change = self._ratios(gradients, informations) - before
        bets = change - np.logaddexp(math.log(1 - _OUTLIERS), math.log(_OUTLIERS) + change)
        return replace(self, products=products + bets, gradients=gradients, informations=informations)

    def _ratios(self, gradients: Array, informations: Array) -> Array:
        """Return logarithms of likelihood ratios of a change, with the coefficients integrated out, ``(p, j)``."""
        known = self.priors[:, None] + informations
        solved = np.linalg.solve(known, np.broadcast_to(gradients[..., None], (len(known), *gradients.shape, 1)))[..., 0]
        likelihoods = 0.5 * (gradients * solved).sum(axis=-1) - 0.5 * np.linalg.slogdet(known)[1]
        likelihoods += 0.5 * np.linalg.slogdet(self.priors)[1][:, None]
        return np.asarray(likelihoods[1:] - likelihoods[0])


@dataclass(frozen=True)
class WatchState(ShortRepr):
    """What later runs say of a certificate: plain numbers, which can be stored as JSON.

    Attributes:
        threshold: tau.
        false_alarms: largest rate of false alarms, such as one in 1,000 runs.
        channels: the statistics.
        runs: the names of the later runs.
        evidence: the e-detector; it has raised an alarm if it was ever at least ``1 / false_alarms``.
        alarm: the run, counted from 1, at which the alarm was raised; None if the certificate still holds.
        since: the run, counted from 1, from which on the change is likeliest to have acted.
        cause: the name of the channel with the largest evidence.
        ratio: how many times as large as those certified its statistics are since that run.
    """

    threshold: float
    false_alarms: float
    channels: tuple[Channel, ...]
    runs: tuple[str, ...] = ()
    evidence: float = 0.0
    alarm: int | None = None
    since: int | None = None
    cause: str | None = None
    ratio: float | None = None

    def after(self, run: str, statistics: Mapping[str, Statistic]) -> Self:
        """Return the state after another run; a channel without a statistic of it says nothing of it."""
        channels = tuple(
            channel.after(statistics.get(channel.name)) for channel in self.channels
        )
        of_channels = [channel.evidence() for channel in channels]
        logs = np.array([log for log, _ in of_channels])
        evidence = math.exp(min(700.0, float(logsumexp(logs)) - math.log(len(logs))))
        largest = int(logs.argmax())
        since = of_channels[largest][1]
        after = replace(self, channels=channels, runs=(*self.runs, run), evidence=evidence)
        if self.expired:
            return after  # an alarm is a fact, and so is what it was raised for
        alarm, cause = len(after.runs) if evidence >= 1 / self.false_alarms else None, channels[largest]
        return replace(after, alarm=alarm, since=since, cause=cause.name, ratio=cause.ratio(since))

    @property
    def expired(self) -> bool:
        """Whether the system is no longer that of the certificate."""
        return self.alarm is not None

    @property
    def sentence(self) -> str:
        """What the runs say, in one sentence without its full stop."""
        if self.expired:
            times = f"{self.ratio:.2g}" if (self.ratio or 0) < 1000 else "more than 1000"
            return f"expired: {self.cause} since run {self.since} are {times} times those certified"
        runs = f"{len(self.runs)} run{'' if len(self.runs) == 1 else 's'}"
        agree = "agrees" if len(self.runs) == 1 else "agree"
        return f"holds: {runs} {agree} with the certified ones (evidence {self.evidence:.2g} of {1 / self.false_alarms:.4g})"

    def to_json(self) -> dict[str, Any]:
        """Return all attributes and the sentence, ready for JSON."""
        channels = [
            {
                "name": each.name,
                "certified": list(each.certified),
                "freedom": each.freedom,
                "information": None if each.information is None else each.information.tolist(),
                "later": [
                    one and {"value": one.value, "slopes": one.slopes and one.slopes.to_json()} for one in each.later
                ],
            }
            for each in self.channels
        ]
        own = {each.name: getattr(self, each.name) for each in fields(self)}
        return {**own, "channels": channels, "runs": list(self.runs), "expired": self.expired, "sentence": self.sentence}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Return the state that :meth:`to_json` returned.

        Raises:
            InputError: if these are not its values.
        """
        try:
            listed = values["channels"]
            channels = tuple(
                Channel(
                    str(each["name"]),
                    tuple(float(value) for value in each["certified"]),
                    None if each["freedom"] is None else float(each["freedom"]),
                    None if each["information"] is None else np.array(each["information"], dtype=np.float64),
                )
                for each in listed
            )
            state = cls(float(values["threshold"]), float(values["false_alarms"]), channels)
            for number, run in enumerate(values["runs"]):
                later = {str(each["name"]): each["later"][number] for each in listed}
                state = state.after(
                    str(run),
                    {
                        name: Statistic(float(one["value"]), Slopes.from_json(one["slopes"]))
                        for name, one in later.items()
                        if one is not None
                    },
                )
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(f"the state of a watch must be what to_json returned, and lacks {error}.") from error
        return state

