"""Quantiles of what a noisy system is predicted to do, as predictions store them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

QUANTILE = 0.9  #: the share q of the executions of a task that a statement on a noisy system is about, by default
LEVELS = np.sort([*np.linspace(0.0, 1.0, 21), 0.975, 0.99, 0.995])  #: levels of the quantiles


def chance_of_more(quantiles: Sequence[float], value: float, runs: int) -> float:
    """Return the probability of more than a value under quantiles at ``LEVELS`` of so many runs; it is never 0."""
    above = 1 - float(np.interp(value, np.nan_to_num(np.asarray(quantiles), posinf=1e300), LEVELS))
    return (1 + runs * above) / (1 + runs)
