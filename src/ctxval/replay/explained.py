"""How much of the model's residual is a function of state and input, and can therefore be learned from recordings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows, single_threaded
from ctxval._util.representation import record
from ctxval.core.model import Model
from ctxval.core.trajectory import Transitions
from ctxval.learning import PosteriorSettings, learn_posterior
from ctxval.replay.steps import RecordedSteps, stepped

_LEARNED = 1500  # largest number of transitions from which the residual is learned


@dataclass(frozen=True)
class ResidualShare:
    """How much of the one-step residual of a state can be explained, measured on held-out recordings.

    Attributes:
        state, unit: the state and its unit.
        rms: root mean square of the residual.
        linear: share of its mean square that an affine function of state and input explains; at least 0.
        explained: share that a Gaussian process of state and input explains, or the affine function if that is more;
            at least 0.
        history: share of the rest that the previous state, input and residual explain; at least 0. If it is large, the
            system has a state that is not recorded, or a delay.
        correlation: correlation of the rest with itself one step earlier.
        rest: root mean square of what state and input do not explain.
    """

    state: str
    unit: str
    rms: float
    linear: float
    explained: float
    history: float
    correlation: float
    rest: float
    __repr__ = record


def residual_shares(model: Model, recorded: RecordedSteps, seed: int) -> tuple[ResidualShare, ...]:
    """Return how much of the residual of each state can be explained; none if there are too few recorded steps."""
    data = _Steps(model, recorded)
    if len(data.residuals) < 20 or len(np.unique(data.folds)) < 2:
        return ()
    rest, linear, history = (np.zeros_like(data.residuals) for _ in range(3))
    for fold in np.unique(data.folds):
        held = data.folds == fold
        linear[held] = _affine(data.pairs, data.residuals, held)
        rest[held] = data.residuals[held] - _learned(model, data, held, seed)
    affine = data.residuals - linear
    better = (affine**2).mean(axis=0) < (rest**2).mean(axis=0)
    rest[:, better] = affine[:, better]
    for fold in np.unique(data.folds):
        held = data.folds == fold
        past = np.concatenate([data.pairs, data.earlier, data.earlier_residuals], axis=1)
        history[held] = _affine(past, rest, held)
    found = []
    for i, (name, unit) in enumerate(recorded.recordings.states.items()):
        size = float((data.residuals[:, i] ** 2).mean())
        left = float((rest[:, i] ** 2).mean())
        found.append(
            ResidualShare(
                *(name, unit, float(np.sqrt(size)), _share(data.residuals[:, i] - linear[:, i], size)),
                *(_share(rest[:, i], size), _share(rest[:, i] - history[:, i], left), data.correlation(rest[:, i])),
                float(np.sqrt(left)),
            )
        )
    return tuple(found)


def _share(errors: Array, size: float) -> float:
    """Return which share of a mean square is explained if these errors are left."""
    return max(0.0, 1.0 - float((errors**2).mean()) / size) if size > 0 else 0.0


class _Steps:
    """Recorded steps with the step before each, in parts that are held out in turn."""

    def __init__(self, model: Model, recorded: RecordedSteps) -> None:
        where = recorded.windows(1, 1, 12_000)
        x, u = recorded.states(where), recorded.inputs(where)
        x_before, u_before = recorded.states(where, -1), recorded.inputs(where, -1)
        self.transitions = Transitions(x, u, recorded.states(where, 1))
        self.residuals = self.transitions.x_next - stepped(model, x, u)
        self.earlier_residuals = x - stepped(model, x_before, u_before)
        self.pairs, self.earlier = np.concatenate([x, u], axis=1), np.concatenate([x_before, u_before], axis=1)
        both = np.concatenate([self.residuals, self.earlier_residuals], axis=1)
        finite: Mask = np.asarray(np.isfinite(both).all(axis=1))
        if not finite.all():
            self._keep(finite)
        groups = where.groups[finite]
        known = np.unique(groups)
        self.folds: Rows = np.searchsorted(known, groups) * min(4, len(known)) // max(len(known), 1)
        runs, places = where.runs[finite], where.places[finite]
        self.follows: Mask = (np.diff(runs) == 0) & (np.diff(places) == 1)

    def _keep(self, rows: Mask) -> None:
        old = self.transitions
        self.transitions = Transitions(old.x[rows], old.u[rows], old.x_next[rows])
        self.residuals, self.earlier_residuals = self.residuals[rows], self.earlier_residuals[rows]
        self.pairs, self.earlier = self.pairs[rows], self.earlier[rows]

    def correlation(self, values: Array) -> float:
        """Return the correlation of values with those one step earlier; 0 if no steps follow each other."""
        first, second = values[:-1][self.follows], values[1:][self.follows]
        if len(first) < 3 or first.std() == 0 or second.std() == 0:
            return 0.0
        return float(np.corrcoef(first, second)[0, 1])


def _affine(features: Array, targets: Array, held: Mask) -> Array:
    """Return the held-out predictions of an affine function of features, by regularised least squares."""
    shift, scale = features[~held].mean(axis=0), np.maximum(features[~held].std(axis=0), 1e-12)
    Z = np.column_stack([np.ones(len(features)), (features - shift) / scale])
    G = Z[~held].T @ Z[~held]
    G += 1e-6 * np.trace(G) / len(G) * np.eye(len(G))
    return np.asarray(Z[held] @ np.linalg.solve(G, Z[~held].T @ targets[~held]))


def _learned(model: Model, data: _Steps, held: Mask, seed: int) -> Array:
    """Return the residual that a Gaussian process predicts for held-out steps."""
    rows = np.flatnonzero(~held)
    if len(rows) > _LEARNED:
        rows = np.sort(np.random.default_rng(seed).permutation(rows)[:_LEARNED])
    some = Transitions(data.transitions.x[rows], data.transitions.u[rows], data.transitions.x_next[rows])
    with single_threaded():
        settings = PosteriorSettings(hyperparameters=1, centres=250)
        learned = learn_posterior(model, some, data.folds[rows], settings=settings)
        if learned is None:
            return np.zeros_like(data.residuals[held])
        x, u = data.transitions.x[held], data.transitions.u[held]
        # What is learned may be a linear model of the system, without M.
        return np.asarray(learned.mean.model_of(0).step(x, u) - model.step(x, u))
