"""The four figures of the running example: frameworks, trajectories, techniques, and the converged GP."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ctxval import cases, plot
from ctxval._util.arrays import Array
from ctxval.core.trajectory import Trajectory
from ctxval.gp.surrogate import Surrogate, fit_surrogate
from ctxval.reproduce.frameworks import closed_loops
from ctxval.reproduce.jobs import Job, Result, Results, distances_of
from ctxval.reproduce.study import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    TECHNIQUES,
    Claim,
    Columns,
    Scale,
    executions_within,
    new_figure,
    running_estimate,
    spread,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN = 0
"""The seed of figures that show a single trial."""

_BUDGET = 100
_CONVERGED = 25


class Frameworks:
    """The paper's Fig. 1: the distance in each framework over the goal angle."""

    name = "frameworks"
    title = "Pendulum: four frameworks"
    case = "pendulum"

    def jobs(self, scale: Scale) -> list[Job]:
        """Return one run for each trial."""
        return [Job("frameworks", "pendulum", seed, budget=scale.of(1001)) for seed in range(scale.trials)]

    def draw(self, results: Results, scale: Scale) -> Figure:
        """Return a figure of the four profiles of the first trial."""
        found = results[self.jobs(scale)[SHOWN]]
        goals = np.array(found["goals"])
        figure = new_figure()
        axes = figure.add_subplot()
        for label, values, colour, line in (
            ("OLDT: open loop, trajectories", np.full(len(goals), found["oldt"][0]), GREEN, "-."),
            ("OLCD: open loop, final states", np.full(len(goals), found["olcd"][0]), PINK, ":"),
            ("CCDT: closed loop, trajectories", found["ccdt"], ORANGE, "--"),
            ("CuSTOM: closed loop, final states", found["custom"], BLUE, "-"),
        ):
            axes.semilogy(goals, np.maximum(values, 1e-3), color=colour, linestyle=line, linewidth=1.8, label=label)
        axes.set_xlabel("goal angle [rad]")
        axes.set_ylabel("distance between M and S [rad, rad/s]\n(below 0.001 drawn at 0.001)")
        axes.grid(alpha=0.25)
        figure.legend(loc="outside upper center", ncols=2, fontsize=8)
        return figure

    def data(self, results: Results, scale: Scale) -> Columns:
        """Return the profiles of the first trial."""
        found = results[self.jobs(scale)[SHOWN]]
        count = len(found["goals"])
        flat = [[found["oldt"][0]] * count, [found["olcd"][0]] * count]
        return Columns(
            ["goal_rad", "oldt", "olcd", "ccdt", "custom"], [found["goals"], *flat, found["ccdt"], found["custom"]]
        )

    def claims(self, results: Results, scale: Scale) -> list[Claim]:
        """Return the paper's claims about the profiles, with the measured numbers."""
        trials = [results[job] for job in self.jobs(scale)]
        return [_worst_goal(trials), _two_regions(trials), _ccdt_maximum(trials), _open_loop_is_higher(trials)]


def _worst_goal(trials: list[Result]) -> Claim:
    worst = spread([max(found["custom"]) for found in trials])
    at = [abs(found["goals"][int(np.argmax(found["custom"]))]) for found in trials]
    return Claim(
        "worst distance 0.3 rad near a goal of 2 rad",
        f"{worst[0]:.3f} (from {worst[1]:.3f} to {worst[2]:.3f}) at |goal| from {min(at):.2f} to {max(at):.2f} rad",
        "partly",
        "the size agrees; the place depends on the cost, the data and dt, none of which the paper gives",
    )


def _two_regions(trials: list[Result]) -> Claim:
    ratios = []
    for found in trials:
        goals, values = np.array(found["goals"]), np.array(found["custom"])
        peaks = sorted([values[goals < 0].max(), values[goals > 0].max()])
        ratios.append(100 * (1 - peaks[0] / peaks[1]))
    median, low, high = spread(ratios)
    return Claim(
        "the profile is asymmetric, and poor around pi/2 and -pi/2",
        f"one peak on each side of 0; the lower one is {median:.0f} % lower (from {low:.0f} to {high:.0f} %)",
        "yes",
    )


def _ccdt_maximum(trials: list[Result]) -> Claim:
    goals = [found["goals"][int(np.argmax(found["ccdt"]))] for found in trials]
    values = spread([max(found["ccdt"]) for found in trials])
    near_side = []
    for found in trials:
        angles, ccdt = np.array(found["goals"]), np.array(found["ccdt"])
        near_side.append(float(angles[angles >= 0][ccdt[angles >= 0].argmax()]))
    return Claim(
        "CCDT is largest near a goal of 0.04 rad",
        f"largest at goals from {min(goals):.2f} to {max(goals):.2f} rad, where it is {values[0]:.2f}; among goals "
        f"from 0 to pi, at {min(near_side):.2f} to {max(near_side):.2f} rad",
        "yes" if max(abs(goal) for goal in goals) < 0.5 else "partly" if max(near_side) < 0.5 else "no",
        "CCDT grows with the length of the swing. We measure the angle along the line, where the goal farthest from "
        "the start at pi is -pi; on the paper's circle [-pi, pi) it is 0",
    )


def _open_loop_is_higher(trials: list[Result]) -> Claim:
    oldt, olcd = ([found[name][0] for found in trials] for name in ("oldt", "olcd"))
    over = [min(o / max(f["ccdt"]), c / max(f["custom"])) for o, c, f in zip(oldt, olcd, trials, strict=True)]
    gaps = [100 * (1 - np.median(found[name]) / found[name][0]) for found in trials for name in ("oldt", "olcd")]
    return Claim(
        "OLDT and OLCD are flat, and much higher than CCDT and CuSTOM",
        f"OLDT {spread(oldt)[0]:.1f}, OLCD {spread(olcd)[0]:.1f} with |u| <= {trials[0]['bound']:g} N m: at least "
        f"{min(over):.0f} times the closed-loop maximum; median restart within {max(gaps):.1f} % of the best",
        "yes" if min(over) > 2 else "no",
        "the bound on u is ours: without one there is no maximum",
    )


class Trajectories:
    """The paper's Fig. 2: the closed loops of M and S at the goal with the largest CCDT distance."""

    name = "trajectories"
    title = "Pendulum: closed-loop trajectories"
    case = "pendulum"

    def jobs(self, scale: Scale) -> list[Job]:
        """Return the run from which the goal with the largest CCDT distance is read."""
        return Frameworks().jobs(scale)[SHOWN : SHOWN + 1]

    def _loops(self, results: Results, scale: Scale) -> tuple[float, Trajectory, Trajectory]:
        found = results[self.jobs(scale)[0]]
        goal = found["goals"][int(np.argmax(found["ccdt"]))]
        validation = cases.by_name("pendulum", SHOWN).validation
        return goal, *closed_loops(validation, validation.task(validation.space.parameters([goal])))

    def draw(self, results: Results, scale: Scale) -> Figure:
        """Return a figure of the trajectories of M and S."""
        goal, model, system = self._loops(results, scale)
        figure = plot.trajectories(model, system, states=("angle [rad]", "rate [rad/s]"), inputs=("torque [N m]",))
        figure.suptitle(f"goal {goal:.2f} rad, where CCDT is largest", fontsize=10)
        return figure

    def data(self, results: Results, scale: Scale) -> Columns:
        """Return both trajectories."""
        _, model, system = self._loops(results, scale)
        names = ["t_s", "model_angle_rad", "model_rate_rad_per_s", "system_angle_rad", "system_rate_rad_per_s"]
        return Columns(names, [model.times.tolist(), *model.states.T.tolist(), *system.states.T.tolist()])

    def claims(self, results: Results, scale: Scale) -> list[Claim]:
        """Return the paper's claim about the trajectories, with the measured numbers."""
        goal, model, system = self._loops(results, scale)
        gap = np.abs(system.states - model.states)
        return [
            Claim(
                "at the goal where CCDT is largest, M and S move differently but reach the same final state",
                f"at {goal:.2f} rad they are up to {gap.max():.2f} apart on the way and {gap[-1].sum():.3f} at the end",
                "yes" if gap[-1].sum() < 0.3 * gap.max() else "no",
            )
        ]


class Techniques:
    """The paper's Fig. 3: the error of the estimated d* against samples, for the three techniques."""

    name = "techniques"
    title = "Pendulum: three techniques"
    case = "pendulum"

    def jobs(self, scale: Scale) -> list[Job]:
        """Return one campaign for each technique and trial, and the truths."""
        seeds = range(scale.trials)
        searches = [
            Job("search", "pendulum", seed, search=name, budget=_BUDGET) for name in TECHNIQUES for seed in seeds
        ]
        return searches + [Job("truth", "pendulum", seed) for seed in seeds]

    def errors(self, results: Results, scale: Scale, search: str) -> Array:
        """Return the errors in per cent, shape ``(trials, budget)``."""
        rows = []
        for seed in range(scale.trials):
            truth = results[Job("truth", "pendulum", seed)]["distance"]
            found = distances_of(results[Job("search", "pendulum", seed, search=search, budget=_BUDGET)])
            rows.append(100 * (1 - running_estimate(found, search) / truth))
        return np.array(rows)

    def draw(self, results: Results, scale: Scale) -> Figure:
        """Return a figure of the median errors with their quartiles."""
        figure = new_figure()
        axes = figure.add_subplot()
        counts = np.arange(1, _BUDGET + 1)
        for search, (label, colour, line, marker) in TECHNIQUES.items():
            errors = np.maximum(self.errors(results, scale, search), 1e-3)
            low, median, high = np.percentile(errors, [25, 50, 75], axis=0)
            axes.fill_between(counts, low, high, color=colour, alpha=0.2, linewidth=0)
            axes.semilogy(
                counts, median, color=colour, linestyle=line, marker=marker, markevery=10, markersize=5, label=label
            )
        axes.axvline(5.5, color=GREY, linewidth=1)
        axes.annotate("five common first samples", (5.7, 60), fontsize=7, color=BLACK)
        axes.axhline(1, color=GREY, linewidth=0.8, linestyle=":")
        axes.set_xlabel("executions of S")
        axes.set_ylabel("error of the estimated d* [%], median and quartiles\n(below 0.001 % drawn at 0.001 %)")
        axes.set_ylim(1e-3, 110)
        axes.grid(alpha=0.25)
        figure.legend(loc="outside upper center", ncols=3, fontsize=8)
        return figure

    def data(self, results: Results, scale: Scale) -> Columns:
        """Return medians and quartiles."""
        names, values = ["executions"], [list(range(1, _BUDGET + 1))]
        for search in TECHNIQUES:
            quartiles = np.percentile(self.errors(results, scale, search), [25, 50, 75], axis=0)
            names += [f"{search}_{part}_percent" for part in ("lower_quartile", "median", "upper_quartile")]
            values += quartiles.tolist()
        return Columns(names, values)

    def claims(self, results: Results, scale: Scale) -> list[Claim]:
        """Return the paper's claims about the three techniques, with the measured numbers."""
        within = [
            executions_within(
                distances_of(results[Job("search", "pendulum", seed, search="gp-ucb", budget=_BUDGET)]),
                "gp-ucb",
                results[Job("truth", "pendulum", seed)]["distance"],
                1.0,
            )
            for seed in range(scale.trials)
        ]
        errors = {search: np.median(self.errors(results, scale, search), axis=0) for search in TECHNIQUES}
        median, low, high = spread(within)
        ucb, sc, sd = errors.values()
        return [
            Claim(
                "CuSTOM is within 1 % after 3 samples beyond five common first ones, and at 0 % by 20",
                f"within 1 % after {median - 5:g} beyond the five (from {low - 5:g} to {high - 5:g}); median error at "
                f"20: {ucb[19]:.4f} %",
                "yes" if median <= 8 and ucb[19] < 0.05 else "partly",
            ),
            Claim(
                "SC is within 2.5 % only after 60 samples",
                f"median error {sc[19]:.2f} % at 20, {sc[59]:.2f} % at 60",
                "yes" if sc[19] > 2.5 else "partly",
                "" if sc[19] > 2.5 else "our peaks are broad, so random samples fall near the maximum sooner",
            ),
            Claim(
                "SD is not close even after 100 samples",
                f"median error {sd[59]:.1f} % at 60, {sd[99]:.1f} % at 100",
                "yes" if sd[99] > 1 else "no",
            ),
        ]


class ConvergedGP:
    """The paper's Fig. 4: the converged GP over the true distance."""

    name = "converged-gp"
    title = "Pendulum: converged GP"
    case = "pendulum"

    def _campaign(self) -> Job:
        return Job("search", "pendulum", SHOWN, search="gp-ucb", budget=_CONVERGED)

    def _curve(self) -> Job:
        return Job("profile", "pendulum", SHOWN, budget=801)

    def jobs(self, scale: Scale) -> list[Job]:
        """Return one campaign and the true profile."""
        return [self._campaign(), self._curve()]

    def _fit(self, results: Results) -> tuple[Array, Array, Surrogate]:
        found = results[self._campaign()]
        points, values = np.array(found["points"]), np.array(found["distances"])
        space = cases.by_name("pendulum", SHOWN).validation.space
        return points[:, 0], values, fit_surrogate(space.to_unit(points), values)

    def draw(self, results: Results, scale: Scale) -> Figure:
        """Return a figure of the GP with its band, the truth, the samples and the maximum."""
        x, y, _ = self._fit(results)
        columns = self.data(results, scale)
        goals, truth, mean, deviation = (np.array(column) for column in columns.values)
        figure = new_figure()
        axes = figure.add_subplot()
        band = 1.96 * deviation
        axes.fill_between(
            goals, mean - band, mean + band, color=GREY, alpha=0.5, linewidth=0, label="95 % band of the GP"
        )
        axes.plot(goals, mean, color=BLUE, linewidth=1.8, label="GP mean")
        axes.plot(goals, truth, color="#D55E00", linestyle="--", linewidth=1.6, label="true distance")
        axes.plot(
            x[:5], y[:5], "o", markerfacecolor="white", markeredgecolor=BLACK, markersize=5, label="first samples"
        )
        axes.plot(x[5:], y[5:], "o", color=BLACK, markersize=5, label="acquired samples")
        axes.plot(
            x[y.argmax()], y.max(), "*", color=ORANGE, markeredgecolor=BLACK, markersize=14, label="maximum found"
        )
        axes.set_xlabel("goal angle [rad]")
        axes.set_ylabel("distance [rad]")
        figure.legend(loc="outside upper center", ncols=3, fontsize=8)
        return figure

    def data(self, results: Results, scale: Scale) -> Columns:
        """Return truth, mean and standard deviation over the goals."""
        _, _, surrogate = self._fit(results)
        curve = results[self._curve()]
        space = cases.by_name("pendulum", SHOWN).validation.space
        mean, deviation = surrogate.predict(space.to_unit(np.array(curve["points"])[:, None]))
        names = ["goal_rad", "true_distance", "gp_mean", "gp_standard_deviation"]
        return Columns(names, [curve["points"], curve["distances"], mean.tolist(), deviation.tolist()])

    def claims(self, results: Results, scale: Scale) -> list[Claim]:
        """Return the paper's claim about the converged GP, with the measured numbers."""
        goals, truth, mean, deviation = (np.array(column) for column in self.data(results, scale).values)
        inside = np.abs(truth - mean) <= 1.96 * deviation + 1e-9
        near = np.abs(goals - goals[truth.argmax()]) < 0.3
        gap = 100 * np.abs(mean - truth)[near].max() / truth.max()
        return [
            Claim(
                "the GP does not hold the whole truth in its 95 % band, but it holds the region of the maximum",
                f"{100 * inside.mean():.0f} % of the goals are inside the band; within 0.3 rad of the maximum the mean "
                f"is at most {gap:.2f} % of d* off",
                "yes" if gap < 5 and not inside.all() else "no",
            )
        ]
