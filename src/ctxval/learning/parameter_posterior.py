r"""The posterior of a model's uncertain parameters, given executions.

Executions are cut into segments of a few steps that begin at recorded states, so that chaos and long horizons do not
matter. With the standardised errors :math:`e_s(z)` of segment s, the prior :math:`z \sim N(0, I)` and a Student
likelihood that bears contacts and outliers, minus the log posterior is

.. math:: \tfrac{\nu + 1}{2} \sum_s \log\left(1 + \frac{|e_s(z)|^2}{\nu \sigma^2}\right) + \tfrac12 |z|^2,

where the mean square of all errors of a segment counts as one observation, because they are far from independent. The
mode is found by Gauss-Newton steps, and draws come from population Monte Carlo (Cappe et al. 2004) around it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model, advanced, with_memory
from ctxval.core.state_geometry import PLAIN, StateGeometry, geometry_of
from ctxval.core.trajectory import Trajectory
from ctxval.core.uncertain import UncertainModel


@dataclass(frozen=True)
class ParameterSettings:
    """Numbers of segments and of samples, and what counts as an error."""

    steps: int = 3  # of a segment
    segments: int = 150  # of all executions, drawn at random if there are more
    chatter: float = 0.03  # share of the largest relative error of a state that every state has at least
    floor: float = 0.01  # error of segments that remains at least, as a share of M's error: integration, rounding
    tails: float = 4.0  # degrees of freedom of the likelihood
    newton: int = 8  # Gauss-Newton steps
    difference: float = 0.02  # of a standardised parameter in a central difference
    longest: float = 2.0  # largest change of a standardised parameter in a step
    samples: int = 64  # of a round of population Monte Carlo
    rounds: int = 2
    wider: float = 1.6  # factor of the covariance of the proposal
    proposal_tails: float = 6.0  # degrees of freedom of the proposal
    jitter: float = 0.2  # of draws around samples, in standard deviations


@dataclass(frozen=True, eq=False)
class Segments:
    """N pieces of L steps of executions, and the transitions of all steps."""

    states: Array  # at the start, (N, n)
    memory: Array  # of the model there, (N, k)
    inputs: Array  # (N, L, m)
    reached: Array  # recorded states after each step, (N, L, n)
    scale: Array  # of the errors of each state, (n,)
    geometry: StateGeometry = PLAIN

    @classmethod
    def of(
        cls, model: Model, executed: Sequence[Trajectory], rng: np.random.Generator, settings: ParameterSettings
    ) -> Segments | None:
        """Return segments of executions; None if no step of a segment is finite."""
        parts = []
        for trajectory in executed:
            steps, L = with_memory(model, trajectory), min(settings.steps, trajectory.horizon)
            memory = np.empty((len(steps), 0)) if steps.memory is None else steps.memory
            for first in range(0, trajectory.horizon - L + 1, L):
                some = slice(first, first + L)
                parts.append((steps.x[first], memory[first], steps.u[some], steps.x_next[some]))
        if len(parts) > settings.segments:
            parts = [parts[k] for k in np.sort(rng.permutation(len(parts))[: settings.segments])]
        if not parts or len({part[2].shape for part in parts}) > 1:
            return None
        states, memory, inputs, reached = map(np.stack, zip(*parts, strict=True))
        segments = cls(states, memory, inputs, reached, np.ones(states.shape[1]), geometry_of(model))
        errors = segments.errors(model)[0]
        finite = np.isfinite(errors).all(axis=(1, 2))
        if not finite.any():
            return None
        sizes = np.sqrt((errors[finite] ** 2).mean(axis=(0, 1)))
        changes = np.sqrt((segments.geometry.difference(reached[:, 0], states) ** 2).mean(axis=0))
        # Chatter of numbers in a state that M predicts far better than others is no error that parameters explain.
        relative = np.divide(sizes, changes, out=np.zeros_like(sizes), where=changes > 0)
        scale = np.maximum(sizes, settings.chatter * relative.max(initial=0.0) * changes)
        return replace(segments, scale=np.maximum(scale, 1e-12 + 1e-9 * np.abs(reached).max(axis=(0, 1))))

    def errors(self, model: Model, draws: int = 1) -> Array:
        """Return the errors ``(S, N, L, n)`` in units of the scale of a model, or of models of so many draws."""

        def of_draws(part: Array) -> Array:
            return np.repeat(part[None], draws, axis=0)

        x, memory, errors = of_draws(self.states), of_draws(self.memory), []
        with np.errstate(all="ignore"):
            for step in range(self.inputs.shape[1]):
                x, memory = advanced(model, x, of_draws(self.inputs[:, step]), memory)
                errors.append(self.geometry.difference(x, self.reached[:, step]) / self.scale)
        return np.stack(errors, axis=2)


@dataclass(frozen=True, eq=False)
class ParameterPosterior(ShortRepr):
    """Samples of standardised parameters with weights, their mean, and what it leaves unexplained."""

    model: UncertainModel
    mean: Array  # (K,)
    covariance: Array  # (K, K)
    samples: Array  # (N, K)
    weights: Array  # of the samples, (N,)
    left: float  # mean square of the errors of segments in shares of M's, outliers limited
    settings: ParameterSettings = field(default_factory=ParameterSettings)

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Return standardised parameters ``(count, K)``."""
        rows = rng.choice(len(self.samples), count, p=self.weights)
        root = np.linalg.cholesky(self.covariance + 1e-12 * np.eye(len(self.mean)))
        moves = rng.standard_normal((count, len(self.mean))) @ root.T
        return np.asarray(self.samples[rows] + self.settings.jitter * moves)


def parameter_posterior(
    model: UncertainModel,
    segments: Segments,
    rng: np.random.Generator,
    settings: ParameterSettings = ParameterSettings(),
) -> ParameterPosterior:
    """Return the posterior of standardised parameters given segments of executions."""
    K = len(model.uncertain)

    def squares(z: Array) -> Array:
        """Return the mean squared errors ``(S, N)`` of segments; 1e6 where a run of the model fails."""
        errors = segments.errors(model.drawn(z), len(z))
        return np.asarray(np.nan_to_num((errors**2).mean(axis=(2, 3)), nan=1e6, posinf=1e6).clip(max=1e6))

    def surprise(of_segments: Array, z: Array, variance: float) -> Array:
        """Return minus the log posterior ``(S,)`` of parameters ``(S, K)``."""
        nu = settings.tails
        misfit = 0.5 * (nu + 1) * np.log1p(of_segments / (nu * variance)).sum(axis=-1)
        return np.asarray(misfit + 0.5 * (z**2).sum(axis=-1))

    def usual(of_segments: Array) -> float:
        """Return the variance of errors that a Student likelihood has with its usual segments."""
        return max(float(np.median(of_segments)) / 0.8, settings.floor**2)

    z, precision = np.zeros(K), np.eye(K)
    of_model = here = squares(z[None])[0]
    for _ in range(settings.newton):
        h = settings.difference * np.eye(K)
        errors = segments.errors(model.drawn(np.concatenate([z + h, z - h, z[None]])), 2 * K + 1)
        errors = np.nan_to_num(errors, nan=1e3, posinf=1e3, neginf=-1e3).reshape(2 * K + 1, len(here), -1)
        slopes = (errors[:K] - errors[K : 2 * K]) / (2 * settings.difference)
        variance = usual(here)
        robust = (settings.tails + 1) / (settings.tails + here / variance) / (variance * errors.shape[2])
        weighted = slopes * robust[:, None]
        precision = np.einsum("ise,jse->ij", weighted, slopes) + np.eye(K)
        gradient = np.einsum("ise,se->i", weighted, errors[-1]) + z
        step = np.clip(-np.linalg.solve(precision, gradient), -settings.longest, settings.longest)
        tried = z + np.array([1.0, 0.5, 0.2, 0.05])[:, None] * step
        of_tried = squares(tried)
        costs, before = surprise(of_tried, tried, variance), float(surprise(here, z, variance))
        if not costs.min() < before - 1e-3:
            break
        best = int(costs.argmin())
        z, here = tried[best], of_tried[best]
        if np.abs(step).max() < 1e-3:
            break
    variance = usual(here)
    mean, covariance = z, np.linalg.inv(precision)
    samples, weights = z[None], np.ones(1)
    for _ in range(settings.rounds):
        nu = settings.proposal_tails
        root = np.linalg.cholesky(settings.wider * covariance + 1e-12 * np.eye(K))
        normal = rng.standard_normal((settings.samples, K))
        moves = normal / np.sqrt(rng.chisquare(nu, (settings.samples, 1)) / nu)
        samples = mean + moves @ root.T
        samples[0], moves[0] = mean, 0.0
        logs = -surprise(squares(samples), samples, variance) + 0.5 * (nu + K) * np.log1p((moves**2).sum(axis=1) / nu)
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        mean = weights @ samples
        spread = samples - mean
        covariance = (spread * weights[:, None]).T @ spread + 0.1 * covariance
    left = float(np.minimum(squares(mean[None])[0], 10.0).mean() / max(np.minimum(of_model, 10.0).mean(), 1e-300))
    return ParameterPosterior(model, mean, np.asarray(covariance, dtype=np.float64), samples, weights, left, settings)


def blocks_of(lengths: Sequence[int], count: int, horizon: int, block: int, rng: np.random.Generator) -> Rows:
    """Return rows ``(count, horizon)`` of records of given lengths that follow each other in blocks.

    Each block of consecutive rows begins at a random row of one record, and does not leave this record if it is long
    enough (moving-block bootstrap, Kuensch 1989).
    """
    firsts = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    starts = np.concatenate(
        [first + np.arange(max(n - block + 1, 1)) for first, n in zip(firsts, lengths, strict=True)]
    )
    blocks = -(-horizon // block)
    chosen = starts[rng.integers(len(starts), size=(count, blocks))]
    rows = (chosen[..., None] + np.arange(block)).reshape(count, -1)[:, :horizon]
    return np.asarray(np.minimum(rows, sum(lengths) - 1))
