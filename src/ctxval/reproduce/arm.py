"""The two figures of the robotic arm: sample complexity, and the three learned models compared."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.arrays import Array
from ctxval.cases import arm
from ctxval.core.soundness import MISSED
from ctxval.reproduce.jobs import Job, Result, Results, distances_of
from ctxval.reproduce.study import (
    BLUE,
    GREEN,
    ORANGE,
    TECHNIQUES,
    Claim,
    Columns,
    Scale,
    agreement,
    counted,
    draw_executions,
    executions_within,
    new_figure,
    running_estimate,
    spread,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_RANDOM = 500  # executions of the passive searches
_ACTIVE = 60  # executions of the active searches
_PERCENTS = (20.0, 15.0, 10.0, 5.0, 2.0, 1.0)
_SHOWN = 0

MODELS = {
    "gp": ("Gaussian process", BLUE, "-", "o"),
    "fnn": ("feedforward network", ORANGE, "--", "s"),
    "linear": ("linear", GREEN, ":", "^"),
}
"""The paper's three models: label, colour, line, marker."""


def _options(model: str) -> tuple[tuple[str, str], ...]:
    return (("model", model),)


def _search(model: str, search: str, seed: int) -> Job:
    budget = _ACTIVE if search == "gp-ucb" else _RANDOM
    return Job("search", "arm", seed, _options(model), search, budget)


def _truth(model: str, seed: int) -> Job:
    return Job("truth", "arm", seed, _options(model))


class ArmSamples:
    """The paper's Fig. 6: executions until the estimate is within some per cent of d*, for the network as the model."""

    name = "arm-samples"
    title = "Arm: executions until within some per cent of d*"
    case = "arm"

    def jobs(self, scale: Scale) -> list[Job]:
        """Return one campaign for each technique and trial, and the truths."""
        seeds = range(scale.trials)
        # SD uses the same samples as SC, so one run serves both.
        searches = [_search("fnn", name, seed) for name in ("gp-ucb", "random") for seed in seeds]
        return searches + [_truth("fnn", seed) for seed in seeds]

    def executions(self, results: Results, scale: Scale, search: str) -> Array:
        """Return the numbers of executions, shape ``(percents, trials)``; infinity if the estimate never gets there."""
        ran = "gp-ucb" if search == "gp-ucb" else "random"
        rows = []
        for percent in _PERCENTS:
            found = [
                (distances_of(results[_search("fnn", ran, seed)]), results[_truth("fnn", seed)]["distance"])
                for seed in range(scale.trials)
            ]
            rows.append([executions_within(distances, search, truth, percent) for distances, truth in found])
        return np.array(rows)

    def draw(self, results: Results, scale: Scale) -> Figure:
        """Return a figure of the medians; an open triangle at the budget means that the median never gets there."""
        figure = new_figure()
        axes = figure.add_subplot()
        rows = {search: self.executions(results, scale, search) for search in TECHNIQUES}
        medians = {search: np.array([spread(row)[0] for row in found]) for search, found in rows.items()}
        budgets = {search: _ACTIVE if search == "gp-ucb" else _RANDOM for search in TECHNIQUES}
        draw_executions(axes, np.array(_PERCENTS), medians, budgets, dodge=0.3)
        axes.invert_xaxis()
        axes.set_xlabel("within so many per cent of d*")
        axes.set_ylabel("executions of S, median")
        figure.legend(loc="outside upper center", ncols=2, fontsize=8)
        return figure

    def data(self, results: Results, scale: Scale) -> Columns:
        """Return median, smallest and largest value for each technique."""
        names: list[str] = ["percent"]
        values: list[list[float]] = [list(_PERCENTS)]
        for search in TECHNIQUES:
            spreads = np.array([spread(row) for row in self.executions(results, scale, search)])
            names += [f"{search}_{part}" for part in ("median", "min", "max")]
            values += spreads.T.tolist()
        return Columns(names, values)

    def claims(self, results: Results, scale: Scale) -> list[Claim]:
        """Return the paper's claim about the executions, with the measured numbers."""
        at_two = _PERCENTS.index(2.0)
        ucb = spread(self.executions(results, scale, "gp-ucb")[at_two])
        sc = spread(self.executions(results, scale, "random")[at_two])
        return [
            Claim(
                "CuSTOM is within 2 % of d* in under 50 executions, far ahead of the baselines",
                f"median {counted(ucb[0], _ACTIVE)} (from {counted(ucb[1], _ACTIVE)} to {counted(ucb[2], _ACTIVE)}); "
                f"SC {counted(sc[0], _RANDOM)}",
                agreement(ucb[0] < 50 and sc[0] > ucb[0], sc[0] > ucb[0]),
                "the distance of the network, piecewise linear inside, has many kinks and narrow peaks; with the other "
                "two models it takes fewer",
            )
        ]


class ArmModels:
    """The paper's Fig. 7: the largest distances that GP-UCB finds for each of the three models, with the truths."""

    name = "arm-models"
    title = "Arm: three learned models"
    case = "arm"

    def jobs(self, scale: Scale) -> list[Job]:
        """Return one campaign for each model and trial, the truths, and the final distances from the targets."""
        pairs = [(model, seed) for model in MODELS for seed in range(scale.trials)]
        campaigns = [_search(model, "gp-ucb", seed) for model, seed in pairs]
        return campaigns + [_truth(*pair) for pair in pairs] + [self._aspects(*pair) for pair in pairs]

    def _aspects(self, model: str, seed: int) -> Job:
        return Job("aspects", "arm", seed, _options(model), budget=21)

    def draw(self, results: Results, scale: Scale) -> Figure:
        """Return a figure of the first trial: the distance found against executions, and the truths."""
        figure = new_figure()
        axes = figure.add_subplot()
        for model, (label, colour, line, marker) in MODELS.items():
            estimates = running_estimate(distances_of(results[_search(model, "gp-ucb", _SHOWN)]), "gp-ucb")
            counts = np.arange(1, len(estimates) + 1)
            axes.plot(counts, estimates, color=colour, linestyle=line, marker=marker, markevery=6, label=label)
            truth = results[_truth(model, _SHOWN)]["distance"]
            axes.axhline(truth, color=colour, linewidth=1, linestyle=(0, (6, 4)))
        axes.plot([], [], color="#000000", linewidth=1, linestyle=(0, (6, 4)), label="true d* (exhaustive search)")
        axes.set_xlabel("executions of S")
        axes.set_ylabel("largest distance found [m]")
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.25)
        figure.legend(loc="outside upper center", ncols=2, fontsize=8)
        return figure

    def data(self, results: Results, scale: Scale) -> Columns:
        """Return, for each model and trial, d* and the final distances of model and system from their targets."""
        rows: list[tuple[str, float, float, float, float, float, float]] = []
        for model in MODELS:
            for seed in range(scale.trials):
                aspects = results[self._aspects(model, seed)]
                rows.append(
                    (
                        model,
                        float(seed),
                        results[_truth(model, seed)]["distance"],
                        *(
                            float(f(aspects[side]))
                            for side in ("model_error", "system_error")
                            for f in (np.median, np.max)
                        ),
                    )
                )
        names = ["model", "seed", "d_star_m"]
        names += [f"{side}_to_target_{part}_m" for side in ("model", "system") for part in ("median", "max")]
        return Columns(names, [list(column) for column in zip(*rows, strict=True)])

    def claims(self, results: Results, scale: Scale) -> list[Claim]:
        """Return the paper's claims about the three models, under both measures, with the measured numbers."""
        seeds = range(scale.trials)
        worst = {m: [results[_truth(m, s)]["distance"] for s in seeds] for m in MODELS}
        aspects: dict[str, list[Result]] = {m: [results[self._aspects(m, s)] for s in seeds] for m in MODELS}
        reached = {m: [float(np.median(a["system_error"])) for a in aspects[m]] for m in MODELS}
        own = {m: [float(np.median(a["model_error"])) for a in aspects[m]] for m in MODELS}
        missed, near = [spread(own[m])[0] for m in MODELS], MISSED * float(np.ptp(arm.Settings().z))
        within = {
            m: [
                executions_within(distances_of(results[_search(m, "gp-ucb", s)]), "gp-ucb", worst[m][s], 2.0)
                for s in seeds
            ]
            for m in MODELS
        }
        return [
            Claim(
                "CuSTOM finds d* within a few samples for every model",
                "within 2 % after "
                + ", ".join(f"{counted(spread(within[m])[0], _ACTIVE)} ({MODELS[m][0]})" for m in MODELS),
                agreement(max(spread(row)[0] for row in within.values()) < 50, spread(within["gp"])[0] < 50),
            ),
            _order("by d*, the distance between M and S", "the GP is the best model, the linear one the worst", worst),
            _order(
                "by the system's distance to its target (median over the table)",
                "... in the sense that its controller takes the system closest to the target",
                reached,
            ),
            Claim(
                "the model itself performs its tasks (Remark 1, Aspect 1)",
                "the model itself ends "
                + ", ".join(f"{1000 * spread(own[m])[0]:.2f} mm ({MODELS[m][0]})" for m in MODELS)
                + f" from its target, median over the table; {1000 * near:.0f} mm are {100 * MISSED:g} % of its side",
                agreement(max(missed) < near, min(missed) < near),
                "the other models do not even complete their own tasks, so that d* of these says little",
            ),
        ]


def _order(measure: str, paper: str, values: dict[str, list[float]]) -> Claim:
    medians = {model: spread(found)[0] for model, found in values.items()}
    ordered = sorted(medians, key=lambda model: medians[model])
    best, worst = ordered[0] == "gp", ordered[-1] == "linear"
    said = ", ".join(f"{MODELS[model][0]} {1000 * medians[model]:.1f} mm" for model in ordered)
    return Claim(paper, f"{measure}, best first: {said}", agreement(best and worst, best or worst))
