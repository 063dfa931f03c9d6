"""Linear bets on bounded values, and the weight of a prediction in them; both follow from earlier draws alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ctxval._util.arrays import Array

_CAUTION = 0.75
"""Largest bet as a share of that with which one draw could lose everything."""

_NO_ROOM = 1e-300
"""Stands for no room at all: no draw can lose, and the bet is limited by the variance alone."""


def log_wealth_of_bets(gains: Array, wanted: Array, room: Array) -> Array:
    """Return the logarithm of the wealth after each draw, of bets on values that are bounded on one side, ``(..., N)``.

    Args:
        gains: what a bet of 1 gains with each draw, shape ``(..., N)``.
        wanted: the bets that are wanted, ``(..., N)``.
        room: the most that a bet of 1 can lose, ``(..., N)``; the bets are limited by it.
    """
    won = np.minimum(wanted, _CAUTION / np.maximum(room, _NO_ROOM)) * gains
    return np.asarray(np.cumsum(np.log1p(np.maximum(won, -_CAUTION)), axis=-1))


def weights_so_far(values: Array, predicted: Array, sums: Callable[[Array], Array]) -> Array:
    """Return for each draw the slope of values against predictions among earlier draws, from 0 to 1, ``(..., N)``.

    Args:
        values: the values, shape ``(..., N)``.
        predicted: what was predicted for them, same shape.
        sums: returns for each draw the sum over those earlier draws that count.
    """
    count = sums(np.ones(values.shape[-1]))
    of_values, of_predicted, of_products, of_squares = map(sums, (values, predicted, values * predicted, predicted**2))
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = (of_products - of_values * of_predicted / count) / (of_squares - of_predicted**2 / count)
    return np.asarray(np.where(np.isfinite(slope) & (count >= 3), np.clip(slope, 0.0, 1.0), 1.0))
