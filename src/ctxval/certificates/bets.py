"""Linear bets on bounded values, and the weight of a prediction in them; both follow from earlier draws alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ctxval._util.arrays import Array

_CAUTION = 0.75
"""Largest bet as a share of that with which one draw could lose everything."""


def log_wealth_of_bets(gains: Array, wanted: Array, room: Array) -> Array:
    """Return the logarithm of the wealth after each draw, of bets on values that are bounded on one side, ``(..., N)``.

    A bet of 1 gains ``gains`` with each draw and can lose ``room`` at most, which limits the bets that are wanted.
    """
    # With no room at all no draw can lose, and the bet is limited by the variance alone.
    won = np.minimum(wanted, _CAUTION / np.maximum(room, 1e-300)) * gains
    return np.asarray(np.cumsum(np.log1p(np.maximum(won, -_CAUTION)), axis=-1))


def weights_so_far(values: Array, predicted: Array, sums: Callable[[Array], Array]) -> Array:
    """Return for each draw the slope of values against predictions among earlier draws, from 0 to 1, ``(..., N)``.

    ``sums`` returns for each draw the sum over those earlier draws that count.
    """
    count = sums(np.ones(values.shape[-1]))
    of_values, of_predicted, of_products, of_squares = map(sums, (values, predicted, values * predicted, predicted**2))
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = (of_products - of_values * of_predicted / count) / (of_squares - of_predicted**2 / count)
    return np.asarray(np.where(np.isfinite(slope) & (count >= 3), np.clip(slope, 0.0, 1.0), 1.0))
