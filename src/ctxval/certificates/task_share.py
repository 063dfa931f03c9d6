r"""What executions prove of the share of tasks whose distance exceeds a threshold, whatever the system is.

If at most a share p of the tasks exceeds tau, an independent draw of a task exceeds it with probability at most p. Few
draws would meet one, so tasks are also drawn where learned dynamics predict distances above tau: of N new independent
draws, K are predicted to exceed it, and one of these K is executed. It exceeds tau with probability ``J / K`` if J of
them do, and the expected value of J is at most ``p N``, so that

.. math:: 1 - \lambda + \lambda \frac{K}{p N} 1\{d > \tau\}, \qquad 0 \le \lambda < 1,

has an expected value of at most 1, whatever predicted the K tasks and however K comes out; :math:`\lambda` follows from
earlier executions. An independent draw is the case K = N. The product over all such executions is a nonnegative
supermartingale, which reaches ``1 / (1 - confidence)`` with probability at most 1 - confidence (Ville 1939). So the
statement that at most a share p exceeds tau is falsified there, at any time and without assumptions on the system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ctxval._util.checked import Must
from ctxval.core.trial import Trial

Share = Annotated[float, Must("a share of the tasks from 0.5 to 1", lambda value: 0.5 <= value <= 1)]


@dataclass(frozen=True)
class BetSettings:
    """How much is bet; no bet ruins the wealth."""

    holds: float = 0.9  #: probability that is bet on for a task whose predicted distance exceeds the threshold
    boldest: float = 0.9  #: largest share of the wealth that is bet
    drawn: float = 2.0  #: share of the wealth that is bet on an independent draw, as a multiple of 1 - share


BETS = BetSettings()
"""The settings in use."""


@dataclass(frozen=True)
class ShareBets:
    """The bets of executions against the statement that a share of the tasks stays below a threshold."""

    wealth: float  #: the product of the bets; 1 without any
    above: int  #: the number of these executions that exceed the threshold
    executions: int  #: the number of these executions
    least: float  #: the share of the tasks that exceeds the threshold at least, with the confidence; 0 if none is known
    share: float  #: the share of the tasks that is said to stay below the threshold

    def falsify(self, confidence: float) -> bool:
        """Return whether the statement is falsified with a confidence."""
        return self.wealth >= 1 / (1 - confidence)


def bet_on(predicted: float, share: float) -> float:
    """Return the share of the wealth to bet on a task among those, a share of all, whose distances exceed tau on M_hat.

    It is that of the largest growth (Kelly 1956) if such a task exceeds tau with a probability of 0.9.
    """
    chance = min((1 - share) / max(predicted, 1e-12), 1.0)  # if at most a share 1 - share exceeds tau
    return float(np.clip((BETS.holds - chance) / max(1 - chance, 1e-12), 0.0, BETS.boldest))


def bets_on_share(trials: Sequence[Trial], threshold: float, share: float, confidence: float) -> ShareBets:
    """Return the bets of the executed trials against "at least a share of the tasks stays below a threshold"."""
    ended = [trial for trial in trials if trial.state != "open"]  # one that failed has no distance, and counts as below
    bets = [(trial, bet) for trial in ended if (bet := _bet_of(trial, threshold, share)) is not None]
    above = np.array([trial.least > threshold for trial, _ in bets], dtype=bool)
    stakes, shares = np.array([bet for _, bet in bets]).reshape(-1, 2).T

    def log_wealth(p: float) -> float:
        return float(np.log(1 - stakes + stakes * shares / p * above).sum())

    needed, low, high = -np.log(1 - confidence), 1e-12, 1.0
    for _ in range(60):  # it falls as p grows
        middle = np.sqrt(low * high)
        low, high = (middle, high) if log_wealth(middle) >= needed else (low, middle)
    least = float(low) if log_wealth(low) >= needed else 0.0
    return ShareBets(float(np.exp(log_wealth(1 - share))), int(above.sum()), len(bets), least, share)


def _bet_of(trial: Trial, threshold: float, share: float) -> tuple[float, float] | None:
    """Return the share of the wealth that is bet on a trial, and K / N; None if its task was not drawn for a bet."""
    stated, part, stake = trial.note.predicted_above or (None, 0.0, 0.0)
    if stated == threshold:
        return stake, part
    return (BETS.drawn * (1 - share), 1.0) if trial.origin == "iid" else None
