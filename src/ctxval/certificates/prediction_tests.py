"""Tests that could have failed: executions that are predicted beforehand at tasks where nobody chose to look.

A search looks where distances are large, so it may never see that the dynamics are other in some tasks. Before a bound
is believed, executions must have been predicted at a number of tasks that are drawn for this: tasks that leave no
interval of a task parameter without a test if it is wider than ``WIDEST``, and independent draws from the
distribution of tasks. What is other in one of eight equal parts of a parameter's range is met with certainty by the
former; eight independent draws meet it with a probability of 66 %. Other executions fill intervals too, if they were
predicted beforehand.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from ctxval._util.arrays import Array
from ctxval.core.trial import Origin

TESTS = 8  # default number
WIDEST = 0.12  # widest interval of a task parameter without a test, as a share of its range
DRAWN: tuple[Origin, ...] = ("iid", "spread")  # origins of the tasks that are drawn


def fewest_missing_tests(points: Array, drawn: int, tests: int) -> int:
    """Return the fewest executions that complete the tests; 0 if they are complete, or no tests are asked for.

    The points ``(n, d)`` are tasks that were predicted beforehand and executed; some of them were drawn as tests.
    """
    return max(tests - drawn, fewest_spread_tests(points)) if tests else 0


def fewest_spread_tests(points: Array) -> int:
    """Return the fewest tasks that leave no task parameter a wide interval without one of the points ``(n, d)``."""
    return max((sum(_needed(low, high) for low, high in _gaps(values)) for values in points.T), default=0)


def next_spread_test(points: Array, rng: np.random.Generator) -> Array:
    """Return a task in the widest gaps of all task parameters, ``(d,)``; see :func:`fewest_spread_tests`.

    A parameter without a wide gap is at one of its bounds with probability 1/2: contacts and limits lie there most
    often.
    """
    return np.array([_value_in_a_gap(values, rng) for values in points.T])


def _value_in_a_gap(values: Array, rng: np.random.Generator) -> float:
    gaps = [(low, high) for low, high in _gaps(values) if _needed(low, high)]
    if not gaps:
        return float(rng.integers(2)) if rng.random() < 0.5 else rng.random()
    low, high = gaps[rng.integers(len(gaps))]
    needed = _needed(low, high)
    # The value of the k-th of so many tests, with as much chance as leaves the others enough.
    k = int(rng.integers(1, needed + 1))
    least, most = high - (needed + 1 - k) * WIDEST, low + k * WIDEST
    return float(rng.uniform(max(least, low), min(most, high)))


def _gaps(values: Array) -> Iterator[tuple[float, float]]:
    """Yield the intervals between neighbouring values and the bounds 0 and 1."""
    return pairwise([0.0, *np.sort(values).tolist(), 1.0])


def _needed(low: float, high: float) -> int:
    """Return the fewest values between two others that leave no wide gap."""
    return max(0, int(np.ceil((high - low) / WIDEST - 1e-9)) - 1)
