"""Figures of a campaign. The functions only read results and never execute anything.

A function that draws one plot has the argument ``ax`` and returns the matplotlib axes. By default, these are new axes
of ``matplotlib.pyplot``, so that notebooks and ``pyplot.show()`` show them. A function that draws several panels
returns a figure. Names and units are those of the validation. A campaign must have at least one distance, and two for
a surrogate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.files import MADE_BY, written_whole
from ctxval._util.representation import task_text
from ctxval.core.labels import labels_of
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial, Trials
from ctxval.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ctxval.campaign.campaign import Campaign

# Okabe and Ito's colours survive colour blindness; the line styles and the markers survive grey print.
_BLUE, _ORANGE, _BLACK, _GREY = "#0072B2", "#D55E00", "#000000", "#B0B0B0"

Limit = float | None
"""A threshold tau, or a bound on d*, which is drawn as a line; None if there is none."""


def overview(campaign: Campaign, *, threshold: Limit = None, bound: Limit = None, ax: Axes | None = None) -> Axes:
    """Draw the most informative single plot of a campaign.

    It is the surrogate if there is one task parameter and two distances are known, and :func:`convergence` otherwise.
    """
    space = campaign.validation.space
    if space.dimension == 1 and space.members is None and len(campaign.completed) >= 2:
        return surrogate_slice(campaign, threshold=threshold, bound=bound, ax=ax)
    return convergence(campaign, threshold=threshold, bound=bound, ax=ax)


def convergence(campaign: Campaign, *, threshold: Limit = None, bound: Limit = None, ax: Axes | None = None) -> Axes:
    """Draw the distance of each trial and the largest distance so far, and mark the trials without a distance."""
    from matplotlib.ticker import MaxNLocator

    _worst(campaign)
    axes = _axes(ax)
    known, last = campaign.trials.completed, len(campaign.trials) - 1
    so_far = np.maximum.accumulate(known.distances)
    axes.step([*known.numbers, last], [*so_far, so_far[-1]], where="post", color=_BLUE, lw=1.8, label="largest so far")
    _draw_samples(axes, campaign, lambda trial: trial.number)
    without = campaign.trials.in_state("failed", "unmeasured").numbers
    if without:
        bottom = axes.get_xaxis_transform()
        axes.plot(without, [0.03] * len(without), "x", color=_ORANGE, transform=bottom, label="no distance is known")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlim(-0.3, max(last, 1) + 0.3)
    axes.set_xlabel("trial")
    return _finished(axes, campaign, threshold, bound)


def surrogate_slice(
    campaign: Campaign, axis: int = 0, *, threshold: Limit = None, bound: Limit = None, ax: Axes | None = None
) -> Axes:
    """Draw the Gaussian process along one task parameter, through the worst executed task, with its 95 % band.

    Args:
        axis: index of the scalar task parameter, from 0.
    """
    space = campaign.validation.space
    if space.members is not None:
        raise InputError("a suite has no curve of the distance between its tasks; plot.convergence shows them.")
    if not 0 <= axis < space.dimension:
        raise InputError(f"axis must be from 0 to {space.dimension - 1}, one of {', '.join(space.names)}, got {axis}.")
    axes, worst = _axes(ax), _worst(campaign)
    unit = np.tile(worst.unit_point, (401, 1))
    unit[:, axis] = np.linspace(0, 1, len(unit))
    x = space.from_unit(unit)[:, axis]
    mean, deviation = campaign.surrogate().predict(unit)
    # A distance is never below 0, but the Gaussian process does not know it.
    low, high = (np.maximum(mean + sign * 1.96 * deviation, 0.0) for sign in (-1, 1))
    axes.fill_between(x, low, high, color=_GREY, alpha=0.6, linewidth=0, label="95 % band of the GP")
    axes.plot(x, np.maximum(mean, 0.0), color=_BLUE, linewidth=1.8, label="GP mean")
    if space.dimension == 1:
        _draw_samples(axes, campaign, lambda trial: space.from_unit(trial.unit_point)[axis])
    at, label = (space.from_unit(worst.unit_point)[axis], campaign.trials.largest), "worst task executed"
    axes.plot(*at, "*", color=_ORANGE, markeredgecolor=_BLACK, markersize=14, label=label)
    axes.set_xlabel(space.labels[axis])
    return _finished(axes, campaign, threshold, bound)


def _finished(axes: Axes, campaign: Campaign, threshold: Limit, bound: Limit) -> Axes:
    """Label the axis of the distance, and draw the threshold and the bound as lines, which also differ in style."""
    units = campaign.validation.labels.units
    axes.set_ylabel(f"distance [{units}]" if units else "distance")
    if threshold is not None:
        axes.axhline(threshold, color=_ORANGE, linestyle="-.", linewidth=1.4, label=f"threshold {threshold:.4g}")
    if bound is not None:
        axes.axhline(bound, color=_BLACK, linestyle=":", linewidth=1.6, label="bound on d*")
    axes.legend(loc="best", fontsize=8, framealpha=0.9)
    return axes


def _draw_samples(axes: Axes, campaign: Campaign, place: Callable[[Trial], float]) -> None:
    """Draw the known distances of the trials, with a different marker for each origin."""
    styles = (
        ("initial samples", ("iid", "spread", "initial", "manual"), "white"),
        ("covering samples", ("covering",), _GREY),
        ("acquired samples", ("acquisition",), _BLACK),
    )
    for label, origins, face in styles:
        trials = Trials(trial for trial in campaign.completed if trial.origin in origins)
        if trials:
            x, y = [place(trial) for trial in trials], trials.distances
            axes.plot(x, y, "o", markersize=5, markerfacecolor=face, markeredgecolor=_BLACK, label=label)


def worst_trajectories(campaign: Campaign) -> Figure:
    """Draw the trajectories of M and of S for the worst executed task."""
    worst = _worst(campaign)
    model, system = campaign.trajectories(worst)
    if model is None or system is None:
        raise InputError(f"the trajectories of trial {worst.number} are not in the store.")
    validation = campaign.validation
    space = validation.space
    reference = validation.task(space.parameters(space.from_unit(worst.unit_point))).reference
    states, inputs = map(labels_of, validation.names(model.states.shape[-1], model.inputs.shape[-1]))
    figure = trajectories(model, system, reference=reference, states=states, inputs=inputs)
    distance = f"{campaign.trials.largest:.4g} {validation.labels.units}".rstrip()
    figure.suptitle(f"worst task executed: {task_text(worst.parameters)} (distance {distance})", fontsize=10)
    return figure


def trajectories(
    model: Trajectory,
    system: Trajectory,
    *,
    reference: Array | None = None,
    states: Sequence[str] = (),
    inputs: Sequence[str] = (),
) -> Figure:
    """Draw two trajectories of one task over time, one panel for each state and input.

    The reference of the states, ``(H + 1, n)``, is drawn for a state if it is not zero everywhere.
    """
    from matplotlib.figure import Figure  # imported here: loading it takes longer than a short campaign

    states = states or [f"state {i}" for i in range(model.states.shape[-1])]
    inputs = inputs or [f"input {i}" for i in range(model.inputs.shape[-1])]
    names = [*states, *inputs]
    figure = Figure(figsize=(6.4, 1.0 + 1.7 * len(names)), layout="constrained")
    styles = (system, _ORANGE, "-", 1.8, "system S"), (model, _BLUE, "--", 1.6, "model M")
    for row, name in enumerate(names):
        axes = figure.add_subplot(len(names), 1, row + 1, sharex=figure.axes[0] if row else None)
        if reference is not None and row < len(states) and reference[:, row].any():
            axes.plot(model.times, reference[:, row], color=_BLACK, linestyle=":", linewidth=1.2, label="reference")
        for run, color, style, width, label in styles:
            values = run.states[:, row] if row < len(states) else run.inputs[:, row - len(states)]
            axes.plot(run.times[: len(values)], values, style, color=color, linewidth=width, label=label)
        axes.set_ylabel(name)
        axes.grid(alpha=0.25)
    figure.axes[-1].set_xlabel("time [s]")
    figure.axes[0].legend(loc="best", fontsize=8, framealpha=0.9)
    return figure


def save(figure: Figure, path: str | Path) -> Path:
    """Write a figure as PNG or SVG; the suffix of the path decides."""
    metadata = {"Software" if Path(path).suffix.lower() == ".png" else "Creator": MADE_BY}
    try:
        with written_whole(path) as file:
            figure.savefig(file, dpi=150, format=Path(path).suffix[1:] or "png", metadata=metadata)
    except ValueError as error:
        raise InputError(f"the figure {path} cannot be written: {error}.") from error
    return Path(path)


def _axes(ax: Axes | None) -> Axes:
    """Return the given axes, or new ones of pyplot."""
    if ax is not None:
        return ax
    from matplotlib import pyplot

    return pyplot.subplots(layout="constrained")[1]


def _worst(campaign: Campaign) -> Trial:
    if campaign.worst is None:
        raise InputError("there is nothing to draw: no distance is known yet.")
    return campaign.worst
