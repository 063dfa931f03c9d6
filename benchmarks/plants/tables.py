"""Piecewise linear tables, as Simulink and flight simulators read them; outside of a table its last slope goes on."""

from __future__ import annotations

import numpy as np

from ctxval._util.arrays import Array


def linear(x: Array, grid: Array, table: Array) -> Array:
    """Return the values of tables over one variable.

    Args:
        x: shape ``(...)``.
        grid: rising, shape ``(k,)``.
        table: shape ``(k,)``, or ``(k, c)`` for several tables at once.
    """
    row, share = _cell(x, grid)
    share = share[(..., *[None] * (table.ndim - 1))]
    return np.asarray(table[row] + share * (table[row + 1] - table[row]))


def bilinear(x: Array, y: Array, rows: Array, columns: Array, table: Array) -> Array:
    """Return the values of a table over two variables, linear in each of them.

    Args:
        x, y: shapes that broadcast.
        rows, columns: the grids of x and y, rising, shapes ``(k,)`` and ``(m,)``.
        table: shape ``(k, m)``.
    """
    row, down = _cell(x, rows)
    column, across = _cell(y, columns)
    above = table[row, column] + across * (table[row, column + 1] - table[row, column])
    below = table[row + 1, column] + across * (table[row + 1, column + 1] - table[row + 1, column])
    return np.asarray(above + down * (below - above))


def _cell(x: Array, grid: Array) -> tuple[Array, Array]:
    """Return the index of the cell of each value, and where it is in the cell."""
    row = np.clip(np.searchsorted(grid, x, side="right") - 1, 0, len(grid) - 2)
    return row, (x - grid[row]) / (grid[row + 1] - grid[row])
