r"""The regular part of the dynamics: a smooth residual, and the states where the system does something else.

A stiff contact changes few steps, and by much. Learned as noise, or as a rough function, it spoils the predictions of
all tasks. So the recorded transitions are split. The regular ones follow one smooth function of state and input. The
others are irregular: a least-squares fit of quadratic functions whose weights fall with the error (Holland and Welsch
1977) finds them first, and then a Gaussian process of the regular ones, in a few rounds.

A run is regular until it comes to states like those of irregular transitions. Which states these are is unknown, so
every simple discriminant counts: a quadratic function of one or two states that separates the irregular transitions
from the regular ones, and one of all states and inputs. It has the largest margin (a support vector machine with
squared errors). A run is trusted if it comes no nearer to the irregular side of any of these functions than a regular
record.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows, single_threaded
from ctxval.core.model import Model, predicted_steps
from ctxval.core.trajectory import Transitions
from ctxval.learning.closed_loops import Loops
from ctxval.learning.dynamics_posterior import (
    DynamicsPosterior,
    LearnedCovariances,
    PosteriorSettings,
    condition,
    learn_covariances,
)
from ctxval.learning.residual_data import residual_data


@dataclass(frozen=True)
class RegularSettings:
    """Which transitions are irregular, and how clearly their states must differ from those of the others."""

    irregular: float = 5.0  # standardised error of the regular part from which a transition is irregular
    exact: float = 0.01  # error that is regular in any case, as a share of a state's regular residual
    rounds: int = 4  # largest number of times that the regular part is learned
    most: float = 0.3  # largest share of the executed transitions that may be irregular
    overlap: float = 0.01  # share of the regular states that a discriminant may have on the irregular side


@dataclass(frozen=True, eq=False)
class RegularTransitions:
    """The recorded transitions, split."""

    covariances: LearnedCovariances  #: the posterior of the hyperparameters of the regular part
    #: transitions, sources: all of them, and the execution of each; -1 for data that the model was made from
    transitions: Transitions
    sources: Rows
    regular: Mask  #: which are regular, ``(N,)``
    settings: RegularSettings

    @property
    def irregular(self) -> int:
        """The number of irregular transitions of executions."""
        return int((~self.regular & (self.sources >= 0)).sum())

    def posterior(self, without: Collection[int] = ()) -> tuple[DynamicsPosterior, Boundary] | None:
        """Return the posterior of the regular part without some executions, and where it ends; None without any."""
        kept = ~np.isin(self.sources, list(without))
        rows = np.flatnonzero(self.regular & kept)
        posterior = condition(self.covariances, self.transitions[rows], self.sources[rows])
        if posterior is None or not np.isfinite(posterior.most_probable.weights).all():
            return None
        others = self.transitions[np.flatnonzero(~self.regular & kept & (self.sources >= 0))]
        return posterior, Boundary.between(posterior, others, self.settings.overlap)


def split_transitions(
    model: Model, transitions: Transitions, sources: Rows, seed: tuple[int, ...], of_posterior: PosteriorSettings,
    settings: RegularSettings = RegularSettings(),
) -> RegularTransitions | None:  # fmt: skip
    """Return the regular and the irregular transitions; None if there are no irregular ones, or too many."""
    data = residual_data(model, transitions, sources)
    if data is None or len(data.pairs) < len(transitions):
        return None
    regular = _errors_of_quadratic(data.pairs, data.outputs[:, data.learned]) <= settings.irregular + 1
    before, covariances = list[bytes](), None
    for _ in range(settings.rounds):
        before.append(regular.tobytes())
        rows = np.flatnonzero(regular)
        covariances = learn_covariances(model, transitions[rows], sources[rows], seed, of_posterior)
        if covariances is None:
            return None
        posterior = condition(covariances, transitions[rows], sources[rows])
        if posterior is None:
            return None
        regular = _is_regular(posterior, transitions, regular, settings)
        if regular.tobytes() in before:
            break
    split = covariances and RegularTransitions(covariances, transitions, sources, regular, settings)
    return split if split and 0 < split.irregular <= settings.most * (sources >= 0).sum() else None


def _errors_of_quadratic(Z: Array, Y: Array) -> Array:
    """Return the largest standardised error ``(N,)`` of quadratic functions that large errors hardly influence."""
    F, weights = _quadratic(Z), np.ones(len(Z))
    ridge = 1e-8 * np.eye(F.shape[1])
    for _ in range(30):
        weighted = F * weights[:, None]
        errors = np.abs(Y - F @ np.linalg.solve(weighted.T @ F + ridge, weighted.T @ Y))
        standardised = (errors / np.maximum(1.48 * np.median(errors, axis=0), 1e-12)).max(axis=1)
        weights = (1 + (standardised / 2) ** 2) ** -2.0
    return np.asarray(standardised)


def _is_regular(
    posterior: DynamicsPosterior, transitions: Transitions, regular: Mask, settings: RegularSettings
) -> Mask:
    """Return which transitions the posterior has, as far as it knows them."""
    data, most = posterior.data, posterior.most_probable
    learned = data.learned
    with single_threaded(), np.errstate(all="ignore"):
        pairs = data.standardised(transitions.x, transitions.u)
        predicted = predicted_steps(posterior.covariances.model, transitions)
        residuals = data.geometry.missed(transitions.x_next, predicted, transitions.x)[:, learned]
        errors = np.abs(residuals / data.sizes[learned] - most.mean(pairs[None])[0])
        sizes = np.sqrt(most.squares / len(most.centres))
        doubts = np.sqrt(np.maximum(most.whitened(pairs)[1], 0.0))[:, None] * sizes
    usual = 1.48 * np.median(errors[regular], axis=0)
    return np.asarray((errors <= settings.irregular * np.sqrt(doubts**2 + usual**2 + settings.exact**2)).all(axis=1))


# Where the regular part ends


@dataclass(frozen=True, eq=False)
class Discriminant:
    """A quadratic function of some coordinates that is larger at irregular transitions than at regular ones."""

    columns: tuple[int, ...]  # indices of standardised coordinates; states come before inputs
    weights: Array
    limit: float  # the largest value that is regular
    width: float  # the range of its values at regular records

    def excess(self, pairs: Array) -> Array:
        """Return by how much pairs ``(..., k)`` exceed the limit ``(...)``, as a share of the regular range."""
        values = _quadratic(pairs[..., self.columns].reshape(-1, len(self.columns))) @ self.weights
        return np.asarray((values.reshape(pairs.shape[:-1]) - self.limit) / self.width)


@dataclass(frozen=True, eq=False)
class Boundary:
    """Where the regular part of the dynamics ends, in standardised state-input pairs of its posterior."""

    discriminants: tuple[Discriminant, ...]

    @classmethod
    def between(cls, posterior: DynamicsPosterior, irregular: Transitions, overlap: float) -> Boundary:
        """Return the boundary between the executed transitions of a posterior and irregular ones.

        A discriminant of states may have a share ``overlap`` of the regular ones on the irregular side.
        """
        if not len(irregular):
            return cls(())
        data, n = posterior.data, len(posterior.data.sizes)
        known = data.transitions[np.flatnonzero(data.sources >= 0)]
        with single_threaded(), np.errstate(all="ignore"):
            expected = posterior.mean.step(irregular.x, irregular.u)
        pairs, others = (data.standardised(each.x, each.u) for each in (known, irregular))
        regular = np.concatenate([pairs[:, :n], data.standardised(known.x_next, known.u)[:, :n]])
        # A step that hits something may begin before it, and leaves it as if nothing were there.
        ends = np.stack([others[:, :n], data.standardised(expected, irregular.u)[:, :n]])
        ends = np.where(np.isfinite(ends).all(axis=2, keepdims=True), ends, ends[:1])
        discriminants = []
        for columns in [*combinations(range(n), 1), *combinations(range(n), 2)]:
            discriminant, beyond = _separated(regular[:, columns], ends[..., columns], columns)
            if beyond <= overlap:
                discriminants.append(discriminant)
        every = tuple(range(pairs.shape[1]))
        return cls((*discriminants, _separated(pairs, others[None], every)[0]))

    def crossed(self, posterior: DynamicsPosterior, loops: Loops) -> Array:
        """Return by how much loops of the first draw cross it ``(q,)``; at most 0 if not, 1 if one diverges."""
        states, inputs = loops.states[0], loops.inputs[0]
        with np.errstate(all="ignore"):
            inputs = np.concatenate([inputs, inputs[:, -1:]], axis=1)
            pairs = np.nan_to_num(posterior.data.standardised(states, inputs), nan=1e3, posinf=1e3, neginf=-1e3)
            excesses = [each.excess(np.clip(pairs, -1e3, 1e3)).max(axis=1) for each in self.discriminants]
        return np.asarray(np.clip(np.max(excesses, axis=0), -1.0, 1.0) if excesses else np.full(len(states), -1.0))


def _separated(regular: Array, ends: Array, columns: Sequence[int]) -> tuple[Discriminant, float]:
    """Return a function that separates points ``(N, k)`` from ends ``(e, M, k)``, and the share of points beyond."""
    F, of_ends = _quadratic(regular), _quadratic(ends.reshape(-1, ends.shape[-1])).reshape(*ends.shape[:2], -1)
    chosen, M = np.full(ends.shape[1], len(ends) - 1), ends.shape[1]
    weights = np.zeros(F.shape[1])
    for _ in range(len(ends) + 1):
        weights = _largest_margin(F, of_ends[chosen, np.arange(M)])
        again = (of_ends @ weights).argmax(axis=0)
        if (again == chosen).all():
            break
        chosen = again
    values, first = F @ weights, float((of_ends @ weights).max(axis=0).min())
    limit, width = min(float(values.max()), first), max(float(np.ptp(values)), 1e-9)
    return Discriminant(tuple(columns), weights, limit, width), float((values > first).mean())


def _largest_margin(low: Array, high: Array) -> Array:
    """Return weights ``(f,)`` by Newton's method on squared errors, both kinds equal (Keerthi and DeCoste 2005)."""
    F, y = np.concatenate([low, high]), np.concatenate([-np.ones(len(low)), np.ones(len(high))])
    share = np.where(y < 0, 0.5 / len(low), 0.5 / len(high))
    ridge, active = np.diag([1e-9, *[1e-3] * (F.shape[1] - 1)]), np.ones(len(y), dtype=np.bool_)
    for _ in range(50):
        weighted = F[active] * share[active, None]
        weights = np.linalg.solve(weighted.T @ F[active] + ridge, weighted.T @ y[active])
        wrong = y * (F @ weights) < 1
        if (wrong == active).all():
            break
        active = wrong
    return np.asarray(weights)


def _quadratic(Z: Array) -> Array:
    """Return 1, the coordinates ``(N, k)`` and their products."""
    i, j = np.triu_indices(Z.shape[1])
    return np.concatenate([np.ones((len(Z), 1)), Z, Z[:, i] * Z[:, j]], axis=1)
