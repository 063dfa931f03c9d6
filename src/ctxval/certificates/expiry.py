"""Whether a certificate still holds: the statistics of later runs, in channels, and the alarm that they raise.

Each channel has one statistic of each run, such as the mean square of the residuals of a state. The runs are the units
of the test, so little is assumed of the steps within a run. The evidence is the mean over the channels of their
e-detectors (:mod:`ctxval.certificates.change_bets`). With few certified runs, its rate of false alarms is as reliable
as the assumed law of the statistics; ``docs/how-to/watch.md`` shows measured rates.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from scipy.special import logsumexp

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.certificates.change_bets import SCALES, WIDER, ScaleBets, SlopeBets
from ctxval.certificates.sentences import withdrawals
from ctxval.errors import InputError

EXCEEDED = "distances above the threshold"
"""Cause of an alarm that needs no evidence: without noise, an executed distance above the threshold is a fact."""

SUSPECTED = 20.0
"""Evidence from which runs are not said to agree with the certified ones: that of a single test at level 0.05."""

FEWEST = 3
"""Fewest certified runs from which later ones are judged."""


@dataclass(frozen=True, eq=False)
class Statistic:
    """The statistic of one run in a channel."""

    value: float  #: positive
    #: gradient, information: what the run says of coefficients w, whose likelihood is proportional to ``exp(w' gradient
    #: - w' information w / 2)``, shapes ``(k,)`` and ``(k, k)``; None if there is no noise
    gradient: Array | None = None
    information: Array | None = None


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
        of_starts = logsumexp(self._scales.products, axis=0) - math.log(len(SCALES))
        if self._slopes is not None:
            of_slopes = logsumexp(self._slopes.products, axis=0) - math.log(len(WIDER))
            of_starts = np.logaddexp(of_starts, of_slopes) - math.log(2)
        known = [k for k, statistic in enumerate(self.later) if statistic is not None][-len(of_starts) :]
        return float(logsumexp(of_starts)), known[int(of_starts.argmax())] + 1

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
    #: the run, counted from 1, at which the alarm was raised; None if the certificate still holds
    alarm: int | None = None
    since: int | None = None  #: the run, counted from 1, from which on the change is likeliest to have acted
    cause: str | None = None  #: the name of the channel with the largest evidence, or ``EXCEEDED``
    #: how many times as large as those certified its statistics are since that run, or the distance as a multiple of
    #: the threshold
    ratio: float | None = None

    def after(self, run: str, statistics: Mapping[str, Statistic], distance: float | None = None) -> Self:
        """Return the state after another run; a channel without a statistic of it says nothing of it."""
        channels = tuple(channel.after(statistics.get(channel.name)) for channel in self.channels)
        of_channels = [channel.evidence() for channel in channels]
        logs = np.array([log for log, _ in of_channels])
        evidence = math.exp(min(700.0, float(logsumexp(logs)) - math.log(len(logs))))
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
        if self.ratio is not None and (self.expired or self.evidence >= SUSPECTED):
            times = f"{self.ratio:.2g}" if self.ratio < 100 else f"{self.ratio:.0f}"
            text = withdrawals.CHANGED if self.expired else withdrawals.SUSPECTED
            return text.format(cause=self.cause, since=self.since, times=times, **against)
        agree = "1 run agrees" if len(self.runs) == 1 else f"{len(self.runs)} runs agree"
        return withdrawals.HOLDS.format(agree=agree, **against)

    def to_json(self) -> dict[str, Any]:
        """Return all attributes and the sentence, ready for JSON."""
        names = ("threshold", "false_alarms", "evidence", "alarm", "since", "cause", "ratio")
        channels = [
            {
                **{name: getattr(channel, name) for name in ("name", "certified", "freedom", "information")},
                "later": [statistic and vars(statistic) for statistic in channel.later],
            }
            for channel in self.channels
        ]
        plain: dict[str, Any] = {
            **{name: getattr(self, name) for name in names},
            "channels": json.loads(json.dumps(channels, default=lambda array: array.tolist())),
            "runs": list(self.runs),
            "distances": list(self.distances),
            "expired": self.expired,
            "sentence": self.sentence,
        }
        return plain

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Return the state that :meth:`to_json` returned; an InputError if these are not its values."""

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
