"""The figure of the Dubins car: largest distance found against samples, medians over trials."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.arrays import Array
from ctxval.reproduce.jobs import Job, Results, distances_of
from ctxval.reproduce.study import BLACK, TECHNIQUES, Claim, Columns, Scale, new_figure, running_estimate, spread

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_RANDOM = 500
"""Executions of the passive searches."""
_ACTIVE = 100
"""Executions of the active searches."""


class DubinsMedians:
    """The paper's Fig. 5: the largest distance found, 1/H ||xi_S - xi_M||_2 as printed, against executions."""

    name = "dubins"
    title = "Dubins car: largest distance found"
    case = "dubins"

    def _budget(self, search: str) -> int:
        return _ACTIVE if search == "gp-ucb" else _RANDOM

    def _job(self, search: str, seed: int) -> Job:
        return Job("search", "dubins", seed, search=search, budget=self._budget(search))

    def jobs(self, scale: Scale) -> list[Job]:
        """Return one campaign for each technique and trial, and the best-known values."""
        seeds = range(scale.trials)
        return [self._job(search, seed) for search in TECHNIQUES for seed in seeds] + [
            Job("truth", "dubins", seed) for seed in seeds
        ]

    def estimates(self, results: Results, scale: Scale, search: str) -> Array:
        """Return the estimates of d*, shape ``(trials, budget)``."""
        jobs = [self._job(search, seed) for seed in range(scale.trials)]
        return np.array([running_estimate(distances_of(results[job]), search) for job in jobs])

    def draw(self, results: Results, scale: Scale) -> Figure:
        """Return a figure of the medians with their quartiles, and the median of the best-known values."""
        figure = new_figure()
        axes = figure.add_subplot()
        for search, (label, colour, line, marker) in TECHNIQUES.items():
            low, median, high = np.percentile(self.estimates(results, scale, search), [25, 50, 75], axis=0)
            counts = np.arange(1, len(median) + 1)
            every = max(1, len(median) // 10)
            axes.fill_between(counts, low, high, color=colour, alpha=0.2, linewidth=0)
            axes.plot(counts, median, color=colour, linestyle=line, marker=marker, markevery=every, label=label)
        best = np.median([results[Job("truth", "dubins", seed)]["distance"] for seed in range(scale.trials)])
        axes.axhline(float(best), color=BLACK, linewidth=1, linestyle="-.", label="best-known value (median)")
        axes.set_xlabel("executions of S")
        axes.set_ylabel(r"largest distance $\frac{1}{H}\|\xi_S - \xi_M\|_2$ [m, rad]")
        axes.grid(alpha=0.25)
        figure.legend(loc="outside upper center", ncols=2, fontsize=8)
        return figure

    def data(self, results: Results, scale: Scale) -> Columns:
        """Return the medians; the cells after the end of a budget are empty."""
        names: list[str] = ["executions"]
        values: list[list[float | str]] = [list(range(1, _RANDOM + 1))]
        for search in TECHNIQUES:
            median = np.median(self.estimates(results, scale, search), axis=0)
            names.append(f"{search}_median")
            values.append([*median.tolist(), *[""] * (_RANDOM - len(median))])
        return Columns(names, values)

    def claims(self, results: Results, scale: Scale) -> list[Claim]:
        """Return the paper's claims about the Dubins car, with the measured numbers."""
        final = {search: self.estimates(results, scale, search)[:, -1] for search in TECHNIQUES}
        truths = np.array([results[Job("truth", "dubins", seed)]["distance"] for seed in range(scale.trials)])
        ucb, sc, sd = final.values()
        share = spread(100 * ucb / truths)
        low, high = float(np.median(sc)), float(np.median(ucb))
        wins = int((ucb > sc).sum())
        return [
            Claim(
                "CuSTOM is at its maximum in 100 samples",
                f"after {_ACTIVE} executions GP-UCB is at {share[0]:.0f} % (from {share[1]:.0f} to {share[2]:.0f} %) "
                "of the best-known value",
                "yes" if share[0] > 95 else "partly",
                "" if share[0] > 95 else "its maximum is not the maximum: a large search finds more",
            ),
            Claim(
                "CuSTOM is above SC and SD even at 500 samples",
                f"median {high:.4g} after {_ACTIVE}, against SC {low:.4g} and SD {np.median(sd):.4g} after {_RANDOM}; "
                f"above SC in {wins} of {scale.trials} trials",
                "yes" if high > low and wins > scale.trials / 2 else "no",
            ),
            Claim(
                "a threshold exists at which SC and SD certify falsely",
                f"any between {low:.4g} and {np.median(truths):.4g}: SC and SD stay below it, and d* does not",
                "yes" if low < float(np.median(truths)) else "no",
            ),
        ]
