"""Global optimisers of scipy, with their defaults."""

from __future__ import annotations

from scipy.optimize import direct, dual_annealing

from peers.recorder import Recorder

ENOUGH = 10**9
"""Of whatever would end them before the budget does."""


def annealing(values: Recorder, dimension: int, budget: int, seed: int) -> None:
    """Maximise by dual annealing, local searches included."""
    dual_annealing(lambda p: -values(p), [(0.0, 1.0)] * dimension, maxiter=ENOUGH, maxfun=ENOUGH, rng=seed)


def rectangles(values: Recorder, dimension: int, budget: int, seed: int) -> None:
    """Maximise by dividing rectangles, locally biased; nothing in it is random."""
    bounds = [(0.0, 1.0)] * dimension
    # It reserves memory for all evaluations and iterations that it may make.
    direct(lambda p: -values(p), bounds, maxfun=100 * budget, maxiter=10 * budget, vol_tol=0.0, len_tol=0.0)
