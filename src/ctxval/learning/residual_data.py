"""Residuals of recorded transitions, standardised for regression: those of M, or of a linear model in its place.

The residual ``S - M`` is as rough as the rougher one of S and M. The kinks of a network, or the waves of a Gaussian
process between its data, make it rough although S is smooth. Such a residual takes many executions to learn, and S
itself only few. The data decide: both models explain the same recorded transitions, with some probability density.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows
from ctxval.core.model import Model, predicted_steps
from ctxval.core.state_geometry import PLAIN, StateGeometry, geometry_of
from ctxval.core.trajectory import Transitions
from ctxval.learning.hyperparameters import FAMILIES, Climbs, ResidualKernel, climbed, learning_rows
from ctxval.learning.settling import SettlingModel
from ctxval.models.increments import standard_deviations, standardised_pairs
from ctxval.models.linear import Linear

NEGLIGIBLE = 1e-7  # a residual below this share of the state's typical change is rounding


def epsilons(values: Array) -> Array:
    """Return the relative errors of rounding ``(n,)`` of values ``(N, n)``, which may be of single precision."""
    with np.errstate(over="ignore"):
        single = (values == values.astype(np.float32)).all(axis=0)
    return np.asarray(np.where(single, np.finfo(np.float32).eps, np.finfo(np.float64).eps))


def floors(states: Array, changes: Array, epsilon: float = 0.0) -> Array:
    """Return the residuals ``(n,)`` that are rounding, for next states ``(N, n)`` that changed by so much.

    States that are estimated from outputs are rounded by at least the ``epsilon`` of these.
    """
    # Up to 16 rounding errors of a state may add up in one step.
    rounding = 16 * np.maximum(epsilons(states), epsilon) * np.abs(states).max(axis=0)
    return np.asarray(np.maximum(NEGLIGIBLE * standard_deviations(changes), rounding))


@dataclass(frozen=True, eq=False)
class ResidualData:
    """Residuals ``x' - M(x, u)`` of N transitions in units in which they are about 1."""

    pairs: Array  # standardised state-input pairs, (N, n + m)
    outputs: Array  # standardised residuals, (N, n); 0 if the residual of a state is negligible
    sources: Rows  # the execution of each transition; -1 for data that the model was made from, (N,)
    # shift, scale: constants that standardise a state-input pair, (n + m,)
    shift: Array
    scale: Array
    sizes: Array  # root mean square of the residual of each state, (n,)
    steps: Array  # standard deviation of the change of each state in one step, (n,)
    learned: Mask  # which states have a residual that is not negligible, (n,)
    units: Array  # the unit of each standardised residual; 0 if it is negligible, (n,)
    inputs: int  # the number m of inputs of the system
    transitions: Transitions
    # recorded: all standardised pairs, also of joints that friction holds, with the inputs before friction, (R, n + m)
    # executed: which of them are of executions, (R,)
    recorded: Array
    executed: Mask
    executions: Transitions  # those of executions, also of joints that friction holds
    geometry: StateGeometry = PLAIN  # of the states of M
    # what was learned before: rows by their number, and climbs by their kernel and rows
    _rows: dict[int, Rows] = field(default_factory=dict, init=False, repr=False)
    _climbs: dict[tuple[ResidualKernel, bytes], Climbs] = field(default_factory=dict, init=False, repr=False)

    def learning_rows(self, count: int) -> Rows:
        """Return ``count`` well-spread transitions, from which hyperparameters are learned."""
        if count not in self._rows:
            self._rows[count] = learning_rows(self.pairs, self.inputs, count)
        return self._rows[count]

    def climbed(self, kernel: ResidualKernel, rows: Rows) -> Climbs:
        """Return where climbs of the log posterior of hyperparameters end, given some transitions."""
        key = kernel, rows.tobytes()
        if key not in self._climbs:
            self._climbs[key] = climbed(kernel, self.pairs[rows], self.outputs[rows][:, self.learned])
        return self._climbs[key]

    def standardised(self, x: Array, u: Array) -> Array:
        """Return standardised pairs ``(..., n + m)`` of states and acting inputs."""
        return standardised_pairs(self.geometry.features(x), u, self.shift, self.scale)


def residual_data(
    model: Model,
    transitions: Transitions,
    sources: Rows,
    *,
    unlearned: bool = False,
    geometry: StateGeometry | None = None,
) -> ResidualData | None:
    """Return the residuals of a model; None if fewer than two transitions are usable, or if M explains all of them.

    With ``unlearned``, no state counts as one with a residual that is not negligible. The geometry is that of the model
    by default.
    """
    geometry = geometry_of(model) if geometry is None else geometry
    recorded = np.concatenate([geometry.features(transitions.x), transitions.u], axis=1)
    every, teaches = transitions, np.ones(len(transitions), dtype=np.bool_)
    if isinstance(model, SettlingModel):
        transitions, teaches = model.teaching(transitions)
        model = model.given
    with np.errstate(all="ignore"):
        residuals = geometry.missed(transitions.x_next, predicted_steps(model, transitions), transitions.x)
        steps = geometry.difference(transitions.x_next, transitions.x)
    pairs = np.concatenate([geometry.features(transitions.x), transitions.u], axis=1)
    # Larger numbers have diverged, and their squares would not be finite.
    usable = (np.abs(np.concatenate([pairs, residuals, steps], axis=1)) < 1e100).all(axis=1)
    teach = usable & teaches
    if teach.sum() < 2:
        return None
    pairs, residuals = pairs[teach], residuals[teach]
    typical = standard_deviations(steps[teach])
    sizes = np.sqrt((residuals**2).mean(axis=0))
    learned = sizes > floors(transitions.x_next[teach], steps[teach])
    if unlearned:
        learned[:] = False
    elif not learned.any():
        return None
    shift, scale = pairs.mean(axis=0), standard_deviations(pairs)
    return ResidualData(
        (pairs - shift) / scale,
        residuals / np.where(learned, sizes, np.inf),
        sources[teach],
        shift,
        scale,
        sizes,
        typical,
        learned,
        units=np.where(learned, sizes, 0.0),
        inputs=transitions.u.shape[1],
        transitions=transitions[teach],
        recorded=(recorded[usable] - shift) / scale,
        executed=sources[usable] >= 0,
        executions=every[np.flatnonzero(usable & (sources >= 0))],
        geometry=geometry,
    )


def smoother_than(data: ResidualData, count: int) -> tuple[Model, ResidualData] | None:
    """Return a linear model and its residuals if these are far more probable than M's, by ``count`` transitions."""
    # With at least 10 transitions for each coefficient, the fit itself explains little.
    if len(data.pairs) < 10 * (data.pairs.shape[1] + 1) or data.geometry != PLAIN:  # no linear model turns
        return None
    known = data.transitions
    predicted = known.x_next - data.outputs * data.units
    deviations = predicted - _fitted(known, predicted).step(known.x, known.u)
    if (np.sqrt((deviations**2).mean(axis=0)) <= 1e-3 * data.sizes).all():
        return None  # the model of these residuals is linear itself, as far as it matters for them
    rows = data.learning_rows(count)
    needed = _log_density(data, rows) + len(rows) * len(data.sizes)  # a gain of 1 for each recorded number
    # If S itself is linear, its linear model leaves no residual. The change of its state has the same prior.
    for linear in (_fitted(known, known.x_next), Identity()):
        other = residual_data(linear, known, data.sources)
        if other is not None and len(other.pairs) == len(data.pairs):
            return (linear, other) if _log_density(other, rows) > needed else None
    return None


class InvarianceWarning(UserWarning):
    """The executions contradict that the dynamics do not depend on some states."""


def with_what_varies(
    data: ResidualData, model: Model, transitions: Transitions, sources: Rows, count: int, better: float
) -> ResidualData:
    """Return residuals as functions of all states if ``count`` transitions contradict that some are invariant.

    They do if the log evidence per recorded value is better by so much.
    """
    if not data.geometry.invariant:
        return data
    every = residual_data(model, transitions, sources, geometry=StateGeometry(data.geometry.quaternions))
    if every is None or len(every.pairs) != len(data.pairs):
        return data
    rows = every.learning_rows(count)
    gain = _log_density(every, rows) - _log_density(data, rows)
    if not gain > better * len(rows) * max(1, int(data.learned.sum())):
        return data
    warnings.warn(
        "what the model misses depends on states that it calls invariant: the ground may not be flat, or a wall is "
        "near. All states count now; remove `invariant`.",
        InvarianceWarning,
        stacklevel=2,
    )
    return every


class Identity:
    """The model ``x_next = x``; its residual is the step of the system."""

    def step(self, x: Array, u: Array) -> Array:
        """Return the state itself."""
        return x


def _log_density(data: ResidualData, rows: Rows) -> float:
    """Return the log density of transitions in the units of the system, up to a constant that all models share."""
    sizes = np.maximum(data.sizes, NEGLIGIBLE * data.steps)
    kernel = ResidualKernel(*FAMILIES[0], data.inputs)
    learned, _ = data.climbed(kernel, rows)[0]
    return learned - len(rows) * float(np.log(sizes).sum())


def _fitted(known: Transitions, following: Array) -> Linear:
    """Return the linear model with the least squared errors, and with the smallest weights if they are not unique."""
    pairs, n = np.concatenate([known.x, known.u], axis=1), known.x.shape[1]
    shift, scale = pairs.mean(axis=0), standard_deviations(pairs)
    regressors = np.concatenate([(pairs - shift) / scale, np.ones((len(pairs), 1))], axis=1)
    weights = np.linalg.lstsq(regressors, following - known.x, rcond=1e-10)[0]
    slopes = (weights[:-1] / scale[:, None]).T
    return Linear(np.eye(n) + slopes[:, :n], slopes[:, n:], weights[-1] - slopes @ shift)
