"""The figure of the linear systems: executions until within 5 % against the dimension of the task space."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.arrays import Array
from ctxval.reproduce.jobs import Job, Results, distances_of
from ctxval.reproduce.study import (
    TECHNIQUES,
    Claim,
    Columns,
    Scale,
    agreement,
    counted,
    draw_executions,
    executions_within,
    new_figure,
    spread,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PERCENT = 5.0
_RANDOM = 20_000  # executions of the passive searches
_ACTIVE = 100  # executions of the active searches
_STATES = tuple(range(1, 11))


class LinearComplexity:
    """The paper's Fig. 8: the effect of the dimension of the task space."""

    name = "linear"
    title = "Linear systems: executions until within 5 %"
    case = "linear"

    def _budget(self, search: str, scale: Scale) -> int:
        return _ACTIVE if search == "gp-ucb" else scale.of(_RANDOM)

    def _job(self, search: str, states: int, seed: int, scale: Scale) -> Job:
        budget = self._budget(search, scale)
        return Job("search", "linear", seed, (("dim", states),), search, budget)

    def jobs(self, scale: Scale) -> list[Job]:
        """Return one campaign for each technique, dimension and trial, and the exact truths."""
        pairs = [(states, seed) for states in _STATES for seed in range(scale.trials)]
        # SD uses the same samples as SC, so one run serves both.
        searches = [self._job(name, *pair, scale) for name in ("gp-ucb", "random") for pair in pairs]
        return searches + [Job("truth", "linear", seed, (("dim", states),)) for states, seed in pairs]

    def executions(self, results: Results, scale: Scale, search: str) -> Array:
        """Return the executions until within 5 % of d*, shape ``(dimensions, trials)``; infinity for never."""
        ran = "gp-ucb" if search == "gp-ucb" else "random"
        rows = []
        for states in _STATES:
            row = []
            for seed in range(scale.trials):
                truth = results[Job("truth", "linear", seed, (("dim", states),))]["distance"]
                found = distances_of(results[self._job(ran, states, seed, scale)])
                row.append(executions_within(found, search, truth, _PERCENT))
            rows.append(row)
        return np.array(rows)

    def draw(self, results: Results, scale: Scale) -> Figure:
        """Return a figure of the medians; an open triangle at the budget means that the median never gets there."""
        figure = new_figure()
        axes = figure.add_subplot()
        rows = {search: self.executions(results, scale, search) for search in TECHNIQUES}
        medians = {search: np.array([spread(row)[0] for row in found]) for search, found in rows.items()}
        budgets = {search: self._budget(search, scale) for search in TECHNIQUES}
        draw_executions(axes, 2.0 * np.array(_STATES), medians, budgets, dodge=0.25)
        axes.set_xlabel("dimension of the task space")
        axes.set_ylabel(f"executions until within {_PERCENT:g} % of d*, median")
        axes.set_xticks(2 * np.array(_STATES))
        figure.legend(loc="outside upper center", ncols=2, fontsize=8)
        return figure

    def data(self, results: Results, scale: Scale) -> Columns:
        """Return median, smallest and largest value for each technique and dimension."""
        names: list[str] = ["dimension"]
        values: list[list[float]] = [[2.0 * states for states in _STATES]]
        for search in TECHNIQUES:
            spreads = np.array([spread(row) for row in self.executions(results, scale, search)])
            names += [f"{search}_{part}" for part in ("median", "min", "max")]
            values += spreads.T.tolist()
        return Columns(names, values)

    def claims(self, results: Results, scale: Scale) -> list[Claim]:
        """Return the paper's claim about the dimension, with the measured numbers."""
        said = {}
        for search in TECHNIQUES:
            medians = [spread(row)[0] for row in self.executions(results, scale, search)]
            said[search] = (medians[0], medians[4], medians[-1])
        texts = [
            f"{TECHNIQUES[search][0]}: " + ", ".join(counted(value, self._budget(search, scale)) for value in row)
            for search, row in said.items()
        ]
        ucb, sc = said["gp-ucb"], said["random"]
        # At most linear growth.
        return [
            Claim(
                "growth with the dimension is modest for CuSTOM, drastic for SC and SD (within 5 %)",
                f"executions in 2-D, 10-D, 20-D: {'; '.join(texts)}",
                agreement(ucb[2] / ucb[0] <= 10 and sc[2] / sc[0] > 10 * ucb[2] / ucb[0], sc[2] > ucb[2]),
            )
        ]
