"""What a method is given to maximise, and what is written down of it."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from ctxval._util.arrays import Array
from ctxval.core.plan import Outcome
from peers.functions import Function

Suggest = Callable[[Array, Array], Array]
"""Points ``(n, d)`` and their values ``(n,)``, all in order -> the next point ``(d,)``."""


class Finished(BaseException):
    """The budget is used up, or the maximum found. No Exception: some libraries catch those of an objective."""


class Recorder:
    """A function of the unit cube that keeps what is asked of it, and the CPU time between two questions.

    Args:
        function: what is maximised.
        budget: executions until it is finished.
        enough: a value that finishes it earlier.
    """

    def __init__(self, function: Function, budget: int, enough: float = np.inf) -> None:
        self.function = function
        self.budget = budget
        self.enough = enough
        self.points: list[Array] = []
        self.values: list[float] = []
        self.outcomes: list[Outcome] = []
        self.seconds: list[float] = []
        self._asked = time.process_time()

    def __call__(self, point: Array) -> float:
        """Return the value at a point ``(d,)``, which is all that most methods are given."""
        return self.execute(point).distance

    def execute(self, point: Array) -> Outcome:
        """Return everything that an execution shows, for the methods that can use it.

        Raises:
            Finished: the budget is used up, or the value is enough.
        """
        self.seconds.append(time.process_time() - self._asked)
        inside = np.clip(np.asarray(point, dtype=np.float64), 0.0, 1.0)  # some round to just outside
        outcome = self.know(inside)
        if len(self.values) >= self.budget or outcome.distance >= self.enough:
            raise Finished
        self._asked = time.process_time()
        return outcome

    def know(self, point: Array) -> Outcome:
        """Keep what an execution at a point shows, though nothing asked for it."""
        outcome = self.function.execute(point)
        self.points.append(point)
        self.values.append(outcome.distance)
        self.outcomes.append(outcome)
        return outcome


class Suggesting:
    """A method that needs nothing but the history to suggest a point, called as all methods are.

    Args:
        start: (dimension, seed) -> Suggest.
    """

    def __init__(self, start: Callable[[int, int], Suggest]) -> None:
        self.start = start

    def __call__(self, values: Recorder, dimension: int, budget: int, seed: int) -> None:
        """Maximise, one suggestion after the other."""
        suggest = self.start(dimension, seed)
        while len(values.points) < budget:
            values(suggest(np.array(values.points).reshape(-1, dimension), np.array(values.values)))


Maximise = Callable[[Recorder, int, int, int], None]
"""(values, dimension, budget, seed): evaluates ``values`` at points of the unit cube, which keeps them in order.

Methods that build a model begin with what ``values`` knows already.
"""
