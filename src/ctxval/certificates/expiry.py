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

_SCALES = np.array([1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 30.0, 100.0])  # c, alternatives of equal weight
_FREEDOMS = np.geomspace(0.25, 64.0, 17)  # m; more would call statistics that a floor makes equal surprising
_OUTLIERS = 0.005  # share of runs that may be anything although nothing has changed: no run alone raises an alarm
_WINDOW = 200  # latest runs at which a change may have begun; fewer starts make the sum smaller

FEWEST = 3
"""Fewest certified runs from which later ones are judged."""


@dataclass(frozen=True, eq=False)
class _Known:
    """What is known of scaled chi-squares, for any number of cases: sums of values and of their logarithms ``(...)``."""

    sums: Array
    logs: Array
    count: int

    def _log_evidence(self) -> Array:
        """Return the logarithms of the likelihoods of each m ``(..., m)``, with the scale integrated out."""
        a, K = 0.5 * _FREEDOMS, self.count
        return np.asarray(
            gammaln(a * K) - K * gammaln(a) - a * K * np.log(self.sums)[..., None] + a * self.logs[..., None]
        )

    def with_value(self, value: Array) -> _Known:
        """Return what is known with one more value ``(...)``."""
        return _Known(self.sums + value, self.logs + np.log(value), self.count + 1)

    def log_density(self, value: Array) -> Array:
        """Return the logarithm of the predictive density of the logarithm of the next value."""
        after = self.with_value(value)
        return np.asarray(logsumexp(after._log_evidence(), axis=-1) - logsumexp(self._log_evidence(), axis=-1))


@dataclass(frozen=True)
class Channel(ShortRepr):
    """One statistic of each run.

    Attributes:
        name: what it is, as the subject of a sentence in the plural.
        certified: those of the certified runs, each predicted from the others; positive.
        later: those of later runs; None for a run that does not have it.
    """

    name: str
    certified: tuple[float, ...]
    later: tuple[float | None, ...] = ()
    _bets: _Bets | None = field(default=None, compare=False, repr=False)

    def after(self, value: float | None) -> Self:
        """Return the channel after another run."""
        later = (*self.later, value)
        if value is None:
            return replace(self, later=later)
        return replace(self, later=later, _bets=(self._bets or _Bets.before(self.certified)).after(value))

    def evidence(self) -> tuple[float, int]:
        """Return the logarithm of the sum over all starts, and the run, counted from 1, at which it is likeliest."""
        if self._bets is None:
            return -math.inf, 1
        of_starts = logsumexp(self._bets.products, axis=0) - math.log(len(_SCALES))
        known = [k for k, value in enumerate(self.later) if value is not None][-len(of_starts) :]
        return float(logsumexp(of_starts)), known[int(of_starts.argmax())] + 1

    def ratio(self, since: int) -> float:
        """Return how many times as large as those certified the statistics are since a run, in root mean squares."""
        later = [value for value in self.later[since - 1 :] if value is not None]
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
    def before(cls, certified: Sequence[float]) -> _Bets:
        """Return the bets before the first later run."""
        none = np.empty((len(_SCALES), 0))
        K = len(certified)
        base = _Known(np.array(math.fsum(certified)), np.log(certified).sum(), K)
        return cls(none, base, _Known(none, none, K), _Known(none, none, K))

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
        same, changed = (_Known(*pair, self.base.count) for pair in (known[:2], known[2:]))
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

    def after(self, run: str, statistics: Mapping[str, float]) -> Self:
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
            {"name": each.name, "certified": list(each.certified), "later": list(each.later)} for each in self.channels
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
            channels = tuple(
                Channel(str(each["name"]), _numbers(each["certified"]), tuple(each["later"]))
                for each in values["channels"]
            )
            state = cls(float(values["threshold"]), float(values["false_alarms"]), channels)
            for number, run in enumerate(values["runs"]):
                state = state.after(run, {c.name: c.later[number] for c in channels if c.later[number] is not None})
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(f"the state of a watch must be what to_json returned, and lacks {error}.") from error
        return state


def _numbers(values: Sequence[Any]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
