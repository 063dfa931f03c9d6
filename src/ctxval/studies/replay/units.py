"""Recordings in the units that a model takes: converted if both state them, and otherwise measured by its errors."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval._util.texts import enumerated
from ctxval.core.labels import factors_between, labels_of, units_of
from ctxval.core.model import Model, require_time_step
from ctxval.core.trajectory import Trajectory
from ctxval.data.recordings import Recordings
from ctxval.errors import InputError
from ctxval.studies.replay.accuracy import Windows, normalised, root_mean_square, stepped

_FACTORS = {180 / np.pi: "rad and deg", 1000.0: "two units such as m and mm", 100.0: "two units such as 1 and %"}


def in_units_of(model: Model, recordings: Recordings) -> Recordings:
    """Return recordings in the order and the units of the states and inputs that a model states.

    Raises:
        InputError: if the model has another time step, if two units cannot be converted, or if units are not stated and
            the errors of the model show that they differ: another unit makes them small.
    """
    require_time_step(model, recordings.dt, "the recording")
    named, notes = list[dict[str, str]](), list(recordings.notes)
    places, factors, unknown = list[list[int]](), list[Array](), list[bool]()
    for known, recorded in zip(units_of(model), (recordings.states, recordings.inputs), strict=True):
        wanted = known if len(known) == len(recorded) else recorded
        order = list(wanted) if wanted.keys() == recorded.keys() else list(recorded)
        places.append([list(recorded).index(name) for name in order])
        ordered = {name: recorded[name] for name in order}
        factors.append(np.array(factors_between(ordered, wanted)))
        for label, other, factor in zip(labels_of(ordered), labels_of(wanted), factors[-1], strict=True):
            if factor != 1:
                notes.append(f"{label} is converted to {other}, as the model takes it")
        named.append({name: mine or unit for (name, unit), mine in zip(ordered.items(), wanted.values(), strict=True)})
        stated = known.values() if wanted is known else [""] * len(recorded)
        unknown += [not (unit and mine) for unit, mine in zip(ordered.values(), stated, strict=True)]

    def converted(run: Trajectory) -> Trajectory:
        x, u = (
            part[:, rows] * each for part, rows, each in zip((run.states, run.inputs), places, factors, strict=True)
        )
        return replace(run, states=x, inputs=u)

    runs = tuple(replace(run, trajectory=converted(run.trajectory)) for run in recordings.runs)
    whole = replace(recordings, runs=runs, states=named[0], inputs=named[1], notes=tuple(notes))
    _require_scales(model, whole, np.array(unknown))
    return whole


def _require_scales(model: Model, recordings: Recordings, unknown: Mask) -> None:
    """Refuse recordings that the model predicts only if those of unknown units are divided by a factor of two units."""
    where = Windows.of(recordings, 0, 1, 500)
    if not len(where) or (usual := _error(model, where, 1.0, 1.0)) < 0.5:
        return
    n, names = len(recordings.states), [*recordings.states, *recordings.inputs]
    groups = [np.arange(len(names)) < n, *(np.arange(len(names)) == k for k in range(len(names)))]
    tried = dict[tuple[int, float], float]()
    for number, group in enumerate(groups):
        if (group & unknown).any():
            for factor in chain(_FACTORS, (1 / factor for factor in _FACTORS)):
                scale = np.where(group, factor, 1.0)
                tried[number, factor] = _error(model, where, scale[:n], scale[n:])
    least = min(tried.values(), default=usual)
    if least < 0.35 and least < 0.35 * usual:
        # Of factors that explain as much, the first: a linear model takes states times k as inputs divided by k.
        (number, factor), error = next((key, each) for key, each in tried.items() if each <= 1.05 * least)
        between = _FACTORS[min(_FACTORS, key=lambda known: abs(np.log(known) - abs(np.log(factor))))]
        which = "all states" if number == 0 else names[number - 1]
        raise InputError(
            f"the model errs by {100 * usual:.3g} % of the recorded change, and by {100 * error:.3g} % if {which} of "
            f"the recordings are divided by {factor:.4g}, as between {between}: state the units of "
            f"{enumerated(names, 6)} in the headers or in a mapping (unit, recorded), for the model and the recordings."
        )


def _error(model: Model, where: Windows, x: Array | float, u: Array | float) -> float:
    """Return the one-step error as a share of the changes, if states and inputs are divided by these factors."""
    start, reached = where.states() / x, where.states(1) / x
    errors = normalised(stepped(model, start, where.inputs() / u) - reached, reached - start)
    error = float(root_mean_square(errors[:, None])[0])
    return error if np.isfinite(error) else np.inf
