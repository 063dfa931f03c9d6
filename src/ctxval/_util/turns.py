"""Angles that jump by a whole turn, because they are kept within one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctxval._util.arrays import Array, Mask

TURNS = (2 * np.pi, 360.0)


def turns(columns: Sequence[Array]) -> tuple[float, list[Mask]]:
    """Return the turn by which a recorded state jumps and otherwise hardly changes, and the steps of each run with it.

    The turn is 0 if there is none. Columns are the state in each run, shape ``(H + 1,)``.
    """
    steps = [np.diff(column) for column in columns]
    every, span = np.abs(np.concatenate(steps)), float(np.ptp(np.concatenate(columns)))
    for turn in TURNS:
        jumps = [np.abs(np.abs(step) - turn) < 0.25 * turn for step in steps]
        others = every[np.abs(every - turn) >= 0.25 * turn]
        if any(jump.any() for jump in jumps) and span <= 1.05 * turn and others.max(initial=0.0) < 0.4 * turn:
            return turn, jumps
    return 0.0, [np.zeros(len(step), dtype=bool) for step in steps]
