r"""Tests that could have failed: executions that are predicted beforehand at tasks where nobody chose to look.

A search looks where distances are large, so it may never see that the dynamics are other in some tasks. So executions
must have been predicted at the points of Latin hypercubes of ``TESTS`` points: what is other in one of ``TESTS`` equal
parts of a parameter's range is met with certainty. The tests also tell how many tasks exceed a threshold, whatever the
system is, if none of them exceeds it: a set of a share v of the tasks is missed by n independent draws with probability
``(1 - v)^n``, and by m points of a hypercube of n points in d parameters with a probability of at most

.. math:: G^{(d-1)}(1 - v)^m, \qquad G(x) = \varphi(n x) / \varphi(n), \qquad \varphi(r) = (r!)^{1/r},

with linear interpolation of :math:`\varphi` between integers and :math:`\varphi(0) = 0`; docs/theory.md has the proof.
A hypercube is chosen among many because it tests where large distances are predicted. If a share s of all hypercubes
is like it, such sets are missed with at most 1 / s times this probability. The same holds for executions of a noisy
system, each of which exceeds the threshold with a probability of its own: G is concave, so independent noise makes no
set easier to miss. From ``MANY`` tests on, tests are independent draws: these meet one part of ``TESTS`` with a
probability of 95 %.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ctxval.core.trial import Origin

TESTS = 8  # default number, and number of points of a hypercube
MANY = 22  # number of tests from which on they are independent draws
DRAWN: tuple[Origin, ...] = ("iid", "spread")  # origins of tests: independent draws, and points of hypercubes


def share_missed(spread: int, independent: int, dimension: int, confidence: float) -> float:
    """Return the share of tasks that so many tests meet with a probability of at least ``confidence``, at any time.

    The ``spread`` ones are points of hypercubes, one after the other, of which only the last may be incomplete.
    """
    low, high = 0.0, 1.0  # shares of the tasks that are not missed with certainty, and with this probability
    for _ in range(60):
        kept = (low + high) / 2
        missed = probability_missed(kept, dimension) ** spread * kept**independent
        low, high = (kept, high) if missed <= 1 - confidence else (low, kept)
    return 1 - low


def probability_missed(kept: float, dimension: int, points: int = TESTS) -> float:
    """Return G^(d-1) of the share of tasks outside of a set, which m points miss with at most its m-th power."""
    roots = np.array([0.0, *(math.factorial(r) ** (1 / r) for r in range(1, points + 1))])
    for _ in range(dimension - 1):
        kept = float(np.interp(points * kept, np.arange(points + 1), roots) / roots[-1])
    return kept


def shown_by_tests(
    origins: Sequence[Origin], dimension: int, confidence: float, *, uniform: bool, selected: float = 1.0
) -> dict[str, int | float | None]:
    """Return the number of tests with these origins, and which share of the tasks exceeds what no test exceeds.

    Points of hypercubes show nothing of tasks with a distribution, because they are uniform. They were ``selected``
    from a larger number of hypercubes, of which they are this share.
    """
    independent = origins.count("iid")
    spread = origins.count("spread") if uniform else 0
    needed = 1 - (1 - confidence) * (selected if spread else 1.0)
    share = share_missed(spread, independent, dimension, needed) if spread or independent else None
    return {"drawn": len(origins), "independent": independent, "spread": spread, "share_missed": share}
