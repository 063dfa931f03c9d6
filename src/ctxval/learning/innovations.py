"""Residual dynamics with noise: ``y' = M(x^, u) + r(z) + eps`` with regressors z of a history, and innovations eps.

r is linear in features (:mod:`ctxval.learning.features`), with shared length-scales and, for each state, an amplitude
and a noise of its own. If records are the state, the evidence is known in closed form from one eigendecomposition
(MacKay 1992), and all transitions are used. With measurement noise, r is inside the filter: Gauss-Newton steps on the
innovations, with their sensitivities to the weights, and MacKay's updates of amplitudes and noise (Ljung 1999, Sec. 7).
Innovations are drawn from those that were recorded, all states of a step together.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy

from ctxval._util.arrays import Array, Mask, Rows
from ctxval.learning.features import Features, spread_rows
from ctxval.learning.histories import History, Memory, Record, jacobian, of_one_horizon, rows_of_executions
from ctxval.learning.local_noise import LocalNoise, local_noise
from ctxval.learning.run_effects import RunEffects, run_effects

DrawnWeights = tuple[Features, Array, Array]  # weights (k, F, n) and standard deviations of noise (k, n) of k draws


@dataclass(frozen=True)
class FeatureSettings:
    """The features of the residual, and what their hyperparameters are a priori."""

    centres: int = 64  # well-spread regressors at which features are
    candidates: int = 600  # regressors from which centres are chosen
    length: float = 3.0  # median of the length-scales in standard deviations of the data; their logarithms deviate by 1
    # first and last power of 10, and number, of amplitudes of the residual in root mean squares
    amplitudes: tuple[float, float, int] = (-4.0, 2.0, 19)
    # the same, of standard deviations of the noise in root mean squares of the residual
    noises: tuple[float, float, int] = (-3.3, 0.3, 18)


@dataclass(frozen=True, eq=False)
class Scaled:
    """Regressors and errors of M, with the constants that standardise them."""

    Z: Array  # standardised regressors, (N, D)
    E: Array  # errors of M, (N, n)
    visited: Array  # standardised regressors of closed loops on M, from which centres are chosen too, (V, D)
    # shift, scale: shapes (D,)
    shift: Array
    scale: Array
    inputs: int  # the number m of inputs
    products: bool = True  # whether inputs times states are among the features
    settings: FeatureSettings = FeatureSettings()

    @classmethod
    def of(cls, Z: Array, E: Array, pairs: Array, inputs: int, products: bool = True) -> Scaled:
        """Return regressors of records; those of closed loops on M, ``(V, n + m)``, have no errors of M as lags."""
        shift, scale = Z.mean(axis=0), np.maximum(Z.std(axis=0), 1e-9 + 1e-6 * np.abs(Z).max(axis=0))
        visited = np.pad(pairs, ((0, 0), (0, Z.shape[1] - pairs.shape[1])))
        return cls((Z - shift) / scale, E, (visited - shift) / scale, shift, scale, inputs, products)

    @functools.cached_property
    def sizes(self) -> Array:
        """Root mean squares of the errors of M, shape ``(n,)``."""
        return np.asarray(np.sqrt((self.E**2).mean(axis=0)))

    @property
    def states(self) -> int:
        """The number n of states."""
        return int(self.E.shape[1])

    @functools.cached_property
    def centres(self) -> Array:
        """Well-spread regressors, shape ``(M, D)``."""
        together = np.concatenate([self.Z, np.clip(self.visited, -5.0, 5.0)])
        some = np.random.default_rng(len(together)).permutation(len(together))[: self.settings.candidates]
        return np.asarray(together[some][spread_rows(together[some], self.settings.centres)])

    def features(self, theta: Array, centres: Array | None = None) -> Features:
        """Return the features for hyperparameters: logarithms of the scales of (x, u), of all lags, and of linear."""
        pairs = self.states + self.inputs
        scales = np.exp(np.concatenate([theta[:pairs], np.full(self.Z.shape[1] - pairs, theta[pairs])]))
        chosen = self.centres if centres is None else centres
        return Features.of(chosen, scales, float(np.exp(theta[-1])), self.states, self.inputs, self.products)


@dataclass(frozen=True, eq=False)
class InnovationsFit(ABC):
    """The posterior of the residual dynamics of one structure."""

    history: History
    scaled: Scaled
    theta: Array  # hyperparameters of the features; see Scaled.features
    live: Mask  # the states whose error of M is not negligible, (n,)
    # features, weights, noise: the most probable features, weights (F, n) and standard deviations (n,)
    features: Features
    weights: Array
    noise: Array
    evidence: float  # logarithm of the evidence, to compare structures
    innovations: Array  # recorded innovations with a root mean square of 1, (N, n)
    local: LocalNoise | None  # how the noise changes with state and input; None if it does not
    executions: Sequence[Rows]  # the rows of each execution in the order of time, in the order of the executions

    @functools.cached_property
    def runs(self) -> RunEffects:
        """What the innovations of each execution have in common."""
        pairs = self.scaled.Z[:, : self.scaled.states + self.scaled.inputs]
        return run_effects(pairs, self.innovations, self.live, self.executions, self.hats)

    def influences(self, tasks: Sequence[Sequence[int]]) -> Array | None:
        """Return how far the residual along the executions of each task depends on them, in deviations of the noise.

        It is the change of the residual if they are left out (Cook 1977), shape ``(T,)``; None in a filter.
        """
        return None

    @property
    def hats(self) -> list[tuple[Array, Array]] | None:
        """The hat matrix of each learned state in two factors; see :func:`run_effects`. None in a filter."""
        return None

    @property
    def share(self) -> float:
        """The variance of the innovations as a share of the mean square of the error of M, where it is largest."""
        return float(((self.noise[self.live] / self.scaled.sizes[self.live]) ** 2).max(initial=0.0))

    def residual(self, z: Array) -> Array:
        """Return the most probable residual ``(..., n)`` of regressors ``(..., D)``."""
        flat = (z.reshape(-1, z.shape[-1]) - self.scaled.shift) / self.scaled.scale
        return np.asarray((self.features(flat) @ self.weights).reshape(*z.shape[:-1], -1))

    @abstractmethod
    def draw(self, groups: int, each: int, rng: np.random.Generator) -> list[DrawnWeights]:
        """Return draws in groups of the same hyperparameters."""


# Records are the state


@dataclass(frozen=True, eq=False)
class LaggedFit(InnovationsFit):
    """The posterior if records are the state, known in closed form; regressors may have lags."""

    rows: Array  # weights of the transitions, (N, 1)

    @functools.cached_property
    def hats(self) -> list[tuple[Array, Array]]:
        """The hat matrix of each learned state in two factors; see :func:`run_effects`."""
        phi = self.features(self.scaled.Z)
        spectrum = _Spectrum.of(phi, self.scaled, self.live, self.rows)
        Phi = phi * self.rows
        return [(Phi, spectrum.vectors / (spectrum.values + ridge) @ spectrum.vectors.T) for ridge in spectrum.ridges]

    def influences(self, tasks: Sequence[Sequence[int]]) -> Array:
        """Return how far the residual along the executions of each task depends on them; see the base class."""
        squares = np.zeros((len(tasks), int(self.live.sum())))
        for place, (i, (Phi, inverse)) in enumerate(zip(np.flatnonzero(self.live), self.hats, strict=True)):
            for row, executions in enumerate(tasks):
                steps = np.concatenate([self.executions[k] for k in executions])
                own, e = Phi[steps], self.innovations[steps, i]
                without = np.eye(len(inverse)) - own.T @ own @ inverse
                squares[row, place] = ((own @ inverse @ np.linalg.solve(without, own.T @ e)) ** 2).mean()
        return np.asarray(np.sqrt(squares.max(axis=1, initial=0.0)))

    def draw(self, groups: int, each: int, rng: np.random.Generator) -> list[DrawnWeights]:
        """Return draws in groups of the same hyperparameters."""
        theta, n = self.theta, self.scaled.states
        others = theta + 0.35 * rng.standard_normal((2 * groups, len(theta)))
        heights = np.array([_height(self.scaled, other, self.live, self.rows) for other in others])
        heights -= _height(self.scaled, theta, self.live, self.rows)
        chances = np.exp(np.clip(heights, -30.0, 0.0))
        chosen = rng.choice(len(others), groups - 1, p=chances / chances.sum())
        drawn = []
        for place in [theta, *(others[row] if heights[row] > -6 else theta for row in np.sort(chosen))]:
            features = self.scaled.features(place)
            spectrum = _Spectrum.of(features(self.scaled.Z), self.scaled, self.live, self.rows)
            weights, noise = np.zeros((each, len(spectrum.values), n)), np.zeros((each, n))
            for k in range(each):
                weights[k][:, self.live], noise[k, self.live] = spectrum.draw(rng)
            drawn.append((features, weights, noise))
        return drawn


@dataclass(frozen=True, eq=False)
class _Spectrum:
    """The posterior of weights, amplitudes and noises for one set of features, in the units ``sizes`` of the states.

    Its values and vectors are those of the features' second moments, on which errors are projected.
    """

    values: Array
    vectors: Array
    projected: Array
    squares: Array
    count: int
    sizes: Array
    settings: FeatureSettings

    @classmethod
    def of(cls, phi: Array, scaled: Scaled, live: Mask, rows: Array) -> _Spectrum:
        """Return it for features ``(N, F)`` of the regressors, with weights of the transitions ``(N, 1)``."""
        sizes = scaled.sizes[live]
        Phi, Y = phi * rows, scaled.E[:, live] / sizes * rows
        values, vectors = np.linalg.eigh(Phi.T @ Phi)
        values = np.maximum(values, 1e-12)
        return cls(values, vectors, vectors.T @ (Phi.T @ Y), (Y**2).sum(axis=0), len(Y), sizes, scaled.settings)

    def log_evidence(self, i: int, amplitudes: Array, noises: Array) -> Array:
        """Return the log density of one state's errors for all amplitudes and noises, shape ``(A, S)``."""
        a2, s2 = amplitudes[:, None, None] ** 2, noises[None, :, None] ** 2
        total = a2 * self.values + s2
        volume = np.log(total).sum(axis=-1) + (self.count - len(self.values)) * np.log(s2[..., 0])
        explained = (a2 * self.projected[:, i] ** 2 / (s2 * total)).sum(axis=-1)
        return np.asarray(-0.5 * volume - 0.5 * np.maximum(self.squares[i] / s2[..., 0] - explained, 0.0))

    def log_posterior(self, theta: Array) -> float:
        """Return the log posterior of hyperparameters, with amplitudes and noises integrated out on a grid."""
        heights = [self.log_evidence(i, *self._grid).ravel() for i in range(len(self.squares))]
        length = np.log(self.settings.length)
        prior = -0.5 * (((theta[:-1] - length) ** 2).sum() + ((theta[-1] - length) / 3) ** 2)
        return float(sum(scipy.special.logsumexp(each) - np.log(each.size) for each in heights) + prior)

    @functools.cached_property
    def _grid(self) -> tuple[Array, Array]:
        """Amplitudes and noises."""
        return np.logspace(*self.settings.amplitudes), np.logspace(*self.settings.noises)

    @functools.cached_property
    def _grids(self) -> list[tuple[Array, Array, Array]]:
        """The log densities of amplitudes and noises on a grid around the mode, for each state."""
        width, grids = min(0.3, 3 / np.sqrt(self.count)), []
        for i in range(len(self.sizes)):
            coarse = self.log_evidence(i, *self._grid)
            j, k = np.unravel_index(int(coarse.argmax()), coarse.shape)
            amplitudes = self._grid[0][j] * np.logspace(-0.7, 0.7, 11)
            noises = self._grid[1][k] * np.exp(np.linspace(-0.24 - width, 0.24 + width, 25))
            grids.append((self.log_evidence(i, amplitudes, noises), amplitudes, noises))
        return grids

    @property
    def ridges(self) -> list[float]:
        """The variance of the noise over that of the weights at the mode, for each state."""
        modes = [(np.unravel_index(int(heights.argmax()), heights.shape), a, s) for heights, a, s in self._grids]
        return [float(noises[k] / amplitudes[j]) ** 2 for (j, k), amplitudes, noises in modes]

    def draw(self, rng: np.random.Generator | None) -> tuple[Array, Array]:
        """Return weights ``(F, live)`` and noises ``(live,)`` in the units of states; the mode if there is no rng."""
        weights, noises = [], []
        for i, (heights, amplitudes, sds) in enumerate(self._grids):
            if rng is None:
                j, k = divmod(int(heights.argmax()), len(sds))
            else:
                chances = np.exp(heights - heights.max()).ravel()
                j, k = divmod(int(rng.choice(chances.size, p=chances / chances.sum())), len(sds))
            precision = self.values / sds[k] ** 2 + 1 / amplitudes[j] ** 2
            coefficients = self.projected[:, i] / sds[k] ** 2 / precision
            if rng is not None:
                coefficients = coefficients + rng.standard_normal(len(coefficients)) / np.sqrt(precision)
            weights.append(self.vectors @ coefficients)
            noises.append(sds[k])
        return np.stack(weights, axis=1) * self.sizes, np.array(noises) * self.sizes


def _height(scaled: Scaled, theta: Array, live: Mask, rows: Array) -> float:
    """Return the log posterior of hyperparameters; minus infinity if their covariance is not positive definite."""
    try:
        return _Spectrum.of(scaled.features(theta)(scaled.Z), scaled, live, rows).log_posterior(theta)
    except np.linalg.LinAlgError:
        return -np.inf


def fit_lagged(
    history: History,
    records: Sequence[Record],
    pairs: Array,
    theta: Array | None,
    live: Mask,
    *,
    products: bool = True,
    usual: bool = False,
) -> LaggedFit:
    """Return the posterior if records are the state; the ``usual`` one is cheap: it learns no hyperparameters."""
    Z, E, _ = history.along(records)
    scaled, rows = Scaled.of(Z, E, pairs, records[0].inputs.shape[1], products), np.ones((len(Z), 1))
    most_likely = np.full(scaled.states + scaled.inputs + 2, np.log(scaled.settings.length))  # a priori
    runs = rows_of_executions(records)
    if usual:
        return _conditioned(history, scaled, most_likely, live, rows, None, runs)
    if theta is None:
        theta, best = most_likely, _height(scaled, most_likely, live, rows)
        # Moves of one coordinate at a time; that of lags does nothing if there are none.
        moved = [i for i in range(len(theta)) if history.structure.lags or i != len(theta) - 2]
        for step, i in product((0.9, 0.5), moved):
            for sign in (1, -1):
                other = theta.copy()
                other[i] += sign * step * (2 if i == len(theta) - 1 else 1)
                height = _height(scaled, other, live, rows)
                if height > best:
                    theta, best = other, height
                    break
    fit, within = _conditioned(history, scaled, theta, live, rows, None, runs), scaled.Z[:, : pairs.shape[1]]
    for _ in range(3):  # records with little noise weigh more, so the mean fits them better, and noise differs more
        local = local_noise(within, _unit(fit.innovations / fit.rows, live)[:, live])
        if local is None:
            return fit
        fit = _conditioned(history, scaled, theta, live, 1 / local(within)[:, None], local, runs)
    # Where there is no noise at all, innovations are smaller than weights say. Drawn among these, those beyond an edge
    # would be too small.
    left = local_noise(within, fit.innovations[:, live])
    if left is None:
        return fit
    unit = _unit(fit.innovations / left(within)[:, None], live)
    return replace(fit, local=replace(left, before=fit.local), innovations=unit)


def _conditioned(
    history: History,
    scaled: Scaled,
    theta: Array,
    live: Mask,
    rows: Array,
    local: LocalNoise | None,
    runs: Sequence[Rows],
) -> LaggedFit:
    features = scaled.features(theta)
    phi = features(scaled.Z)
    spectrum = _Spectrum.of(phi, scaled, live, rows)
    weights, noise = np.zeros((phi.shape[1], scaled.states)), np.zeros(scaled.states)
    weights[:, live], noise[live] = spectrum.draw(None)
    innovations = _unit((scaled.E - phi @ weights) * rows, live)
    units = len(scaled.Z) * np.log(scaled.sizes[live]).sum() - live.sum() * np.log(rows).sum()
    evidence = spectrum.log_posterior(theta) - units
    return LaggedFit(history, scaled, theta, live, features, weights, noise, evidence, innovations, local, runs, rows)


def _unit(innovations: Array, live: Mask) -> Array:
    """Return innovations with a root mean square of 1 for each state, and 0 where the error of M is negligible."""
    sizes = np.sqrt((innovations**2).mean(axis=0))
    return np.where(live & (sizes > 0), innovations / np.maximum(sizes, 1e-300), 0.0)


# With measurement noise


@dataclass(frozen=True, eq=False)
class FilterFit(InnovationsFit):
    """The posterior of weights inside a filter, approximated around its mode (Laplace)."""

    root: Array  # of the covariance of the weights, (F n, F n)

    def draw(self, groups: int, each: int, rng: np.random.Generator) -> list[DrawnWeights]:
        """Return draws in one group: their hyperparameters are the same."""
        count, (F, n) = groups * each, self.weights.shape
        moved = (rng.standard_normal((count, F * n)) @ self.root.T).reshape(count, F, n) * self.live
        factors = np.exp(0.8 / np.sqrt(len(self.innovations)) * rng.standard_normal((count, n)))
        return [(self.features, self.weights + moved, self.noise * factors)]


def fit_filter(
    history: History, records: Sequence[Record], pairs: Array, plain: InnovationsFit, steps: int = 5
) -> FilterFit:
    """Return the posterior with measurement noise, from that without; LinAlgError if the filter diverges."""
    live, n = plain.live, plain.scaled.states
    Z, E, _ = history.along(records)
    # The units are those of the records, not those of a filter that knows no residual yet.
    recorded = Scaled.of(Z, E, pairs, records[0].inputs.shape[1])
    width = n + recorded.inputs
    shift, scale = recorded.shift.copy(), recorded.scale.copy()
    shift[:width], scale[:width] = plain.scaled.shift[:width], plain.scaled.scale[:width]
    raw = recorded.Z * recorded.scale + recorded.shift
    scaled = replace(recorded, Z=(raw - shift) / scale, E=plain.scaled.E, shift=shift, scale=scale)
    scaled = replace(scaled, visited=(recorded.visited * recorded.scale + recorded.shift - shift) / scale)
    theta = plain.theta.copy()
    theta[width] = np.log(6.0)
    centres = scaled.centres[spread_rows(scaled.centres, 32)]
    features, sizes = scaled.features(theta, centres), np.maximum(plain.scaled.sizes, 1e-12)
    F, N = features(scaled.Z[:1]).shape[1], len(scaled.Z)
    weights: Array = np.zeros((F, n))
    noise, amplitudes = np.maximum(0.8 * plain.noise, 1e-3 * sizes), 0.5 * sizes
    for _ in range(steps):
        innovations, G = _sensitivities(history, records, features, scaled, weights)
        Gw = (G / noise[:, None]).reshape(-1, F * n)
        prior = np.tile(1 / amplitudes**2, F)
        A = Gw.T @ Gw + np.diag(prior)
        target = (innovations / noise).ravel() + Gw @ weights.ravel()
        weights = np.asarray(np.linalg.solve(A, Gw.T @ target)).reshape(F, n)
        left = (target - Gw @ weights.ravel()).reshape(-1, n) * noise
        covariance = np.linalg.inv(A)
        determined = np.maximum(F - (np.diag(covariance) * prior).reshape(F, n).sum(axis=0), 0.5)
        # What noise does not explain of the errors has some amplitude, so that few records leave it uncertain.
        least = 0.5 * np.sqrt(np.maximum(sizes**2 - 2 * noise**2, 0.01 * sizes**2))
        amplitudes = np.clip(np.sqrt((weights**2).sum(axis=0) / determined), least, 30 * sizes)
        noise = np.sqrt((left**2).sum(axis=0) / np.maximum(N - determined, N / 3))
        noise = np.maximum(noise, 3e-3 * sizes)
    weights, noise = weights * live, noise * live
    fit = FilterFit(
        history, scaled, theta, live, features, weights, noise, 0.0, np.zeros((N, n)), None,
        rows_of_executions(records),
        np.asarray(np.linalg.cholesky(0.5 * (covariance + covariance.T) + 1e-18 * np.eye(len(A)))),
    )  # fmt: skip
    innovations = history.along(records, fit.residual)[2]
    kept = np.tile(live, F)
    likelihood = -0.5 * ((innovations / np.where(live, noise, np.inf)) ** 2).sum() - N * np.log(noise[live]).sum()
    of_prior = -0.5 * ((weights[:, live] / amplitudes[live]) ** 2).sum() - F * np.log(amplitudes[live]).sum()
    volume = -0.5 * np.linalg.slogdet(A[np.ix_(kept, kept)])[1] - 5.0 * live.sum()
    unit = _unit(innovations, live)
    local = local_noise(scaled.Z[:, :width], unit[:, live])
    if local is not None:
        unit = _unit(unit / local(scaled.Z[:, :width])[:, None], live)
    return replace(fit, evidence=float(likelihood + of_prior + volume), innovations=unit, local=local)


def _sensitivities(
    history: History, records: Sequence[Record], features: Features, scaled: Scaled, weights: Array
) -> tuple[Array, Array]:
    """Return innovations ``(N, n)`` and the derivatives of the predicted records by the weights, ``(N, n, F n)``."""
    F, n = weights.shape
    keep, steps = np.eye(n) - history.gain, 1e-4 * scaled.scale[:n]
    rows, innovations = [], []

    def residual(z: Array) -> Array:
        return np.asarray(features((z - scaled.shift) / scaled.scale) @ weights)

    for alike in of_one_horizon(records):
        psi = np.zeros((len(alike), n, F * n))

        def visit(memory: Memory, u: Array, z: Array) -> None:
            nonlocal psi

            def step(x: Array) -> Array:
                rest = np.broadcast_to(z[:, n:], (*x.shape[:-1], z.shape[1] - n))
                moved = np.concatenate([x, rest], axis=-1).reshape(-1, z.shape[1])
                inputs = np.broadcast_to(u, (*x.shape[:-1], u.shape[1])).reshape(len(moved), u.shape[1])
                after = history.model.step(moved[:, :n], inputs) + residual(moved)
                return np.asarray(after.reshape(x.shape))

            G = jacobian(step, memory.estimate, steps) @ psi
            by_state = G.reshape(len(z), n, F, n)
            phi = features((z - scaled.shift) / scaled.scale)
            for i in range(n):
                by_state[:, i, :, i] += phi
            rows.append(G)
            psi = keep @ G

        innovations.append(history.along(alike, residual, visit)[2])
    return np.concatenate(innovations), np.concatenate(rows)
