"""Bets against a threshold: what executed distances prove of a noisy system, whatever its model.

If in every task a share q of the executions stays below tau, then each execution exceeds tau with probability at most
1 - q, whatever its task and whatever came before. Before each execution, a probability pi of an excess is predicted,
from the learned noise, or from an earlier excess of the same task.
The product of ``pi / (1 - q)`` for each excess and ``(1 - pi) / q`` for each other execution is then a nonnegative
supermartingale with the first value 1, and so is the mean of two of them. It reaches ``1 / (1 - confidence)`` with
probability at most 1 - confidence (Ville 1939), at any time. So tau is falsified there, without any assumption on the
system. Half of the wealth is bet on repetitions of an excess alone: what was predicted before much was learned cannot
lose it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval.certificates.sample import executions_of
from ctxval.core.quantiles import QUANTILE, chance_of_more
from ctxval.core.trial import Trial

_BOLDEST = 0.9  # largest predicted probability that is bet on; an execution that stays below must not ruin the bets


@dataclass(frozen=True)
class Bets:
    """The bets of the trials of a noisy system against a threshold."""

    wealth: float  #: the mean of the product of all bets and that of the bets on repetitions
    #: above, executions: numbers of executions above the threshold, and of all
    above: int
    executions: int
    quantile: float = QUANTILE  #: the share q of the executions of each task that the threshold is said to bound

    def falsify(self, confidence: float) -> bool:
        """Return whether the threshold is falsified with a confidence."""
        return self.above > 0 and self.wealth >= 1 / (1 - confidence)


def bets_against(
    trials: Sequence[Trial], threshold: float, quantile: float = QUANTILE, *, noisy: bool = False
) -> Bets | None:
    """Return the bets of trials against a threshold; None if the system is not noisy.

    It is not if no execution was predicted to be, or if the last one was not, and an excess repeated to the last digit.
    It is in any case if it is said to be ``noisy``.
    """
    known = [trial for trial in trials if trial.distance is not None or trial.ended_alone is not None]
    noises = [trial.note.prediction.get("noise") for trial in trials if trial.note.prediction]
    if not any(noises) and not noisy:
        return None
    if not noisy and not noises[-1]:
        excesses = (executions_of(trial, known) for trial in known if (trial.distance or 0.0) > threshold)
        if any(len(alike) > 1 and len({each.distance for each in alike}) == 1 for alike in excesses):
            return None
    whole, repetitions, above = 1.0, 1.0, 0
    for k, trial in enumerate(known):
        before = executions_of(trial, known[:k])
        repeated = any(earlier.least > threshold for earlier in before)
        # It is repeated because it may exceed the threshold again, whatever was predicted.
        chance = _BOLDEST if repeated else float(np.clip(_predicted_chance(trial, threshold), 1 - quantile, _BOLDEST))
        exceeds = trial.least > threshold
        above += exceeds
        factor = chance / (1 - quantile) if exceeds else (1 - chance) / quantile
        whole *= factor
        repetitions *= factor if repeated else 1.0
    return Bets(0.5 * (whole + repetitions), above, len(known), quantile)


def _predicted_chance(trial: Trial, threshold: float) -> float:
    stored = trial.note.prediction or {}
    try:
        if isinstance(noise := stored.get("noise"), dict):
            quantiles = [np.inf if each is None else float(each) for each in noise["distances"]]
            return chance_of_more(quantiles, threshold, int(noise["runs"]))
        if isinstance(listed := stored.get("quantiles"), list):
            return float(np.mean([each is None or float(each) > threshold for each in listed]))
    except (KeyError, TypeError, ValueError):  # the note of a store
        pass
    return 0.5  # probability of an excess if nothing was predicted
