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
from ctxval.learning.effects.effect import EffectCandidate
from ctxval.learning.effects.model import ModelWithEffects
from ctxval.learning.effects.uncertain import UncertainEffects


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
    effects: int = 2  # of inputs, such as a delay, at most
    explained: float = 0.05  # error of segments that is left, as a share of M's, below which no effects are looked for
    starts: int = 3  # draws of the prior from which single steps are fitted if the parameters explain too little
    screened: int = 2  # Gauss-Newton steps with each of the effects that are tried
    price: float = 10.0  # by which an effect must raise the log posterior, beside the price of its size


@dataclass(frozen=True, eq=False)
class Segments:
    """N pieces of L steps of executions, with all commands of E executions, because effects of inputs remember them."""

    states: Array  # at the start, (N, n)
    memory: Array  # of the model there, (N, k)
    commands: Array  # 0 after the end of an execution, (E, H, m)
    execution: Rows  # (N,)
    first: Rows  # the step that each begins with, (N,)
    reached: Array  # recorded states after each step, (N, L, n)
    scale: Array  # of the errors of each state, (n,)
    missed: Array  # mean squared errors of M, (N,)
    geometry: StateGeometry = PLAIN

    @classmethod
    def of(
        cls, model: Model, executed: Sequence[Trajectory], rng: np.random.Generator, settings: ParameterSettings
    ) -> Segments | None:
        """Return segments of executions; None if no step of a segment is finite."""
        L, horizon = (limit([settings.steps, *(run.horizon for run in executed)]) for limit in (min, max))
        parts, commands = [], []
        for k, trajectory in enumerate(executed):
            steps = with_memory(model, trajectory)
            memory = np.empty((len(steps), 0)) if steps.memory is None else steps.memory
            commands.append(np.pad(steps.u, ((0, horizon - len(steps)), (0, 0))))
            for first in range(0, trajectory.horizon - L + 1, L):
                parts.append((steps.x[first], memory[first], k, first, steps.x_next[first : first + L]))
        if len(parts) > settings.segments:
            parts = [parts[k] for k in np.sort(rng.permutation(len(parts))[: settings.segments])]
        states, memory, execution, begins, reached = (np.array(each) for each in zip(*parts, strict=True))
        units = np.ones(states.shape[1]), np.ones(len(states)), geometry_of(model)
        segments = cls(states, memory, np.stack(commands), execution, begins, reached, *units)
        errors = segments.errors(model)[0]
        finite = np.isfinite(errors).all(axis=(1, 2))
        if not finite.any():
            return None
        sizes = np.sqrt((errors[finite] ** 2).mean(axis=(0, 1)))
        changes = np.sqrt((segments.geometry.difference(reached[:, 0], states) ** 2).mean(axis=0))
        # Chatter of numbers in a state that M predicts far better than others is no error that parameters explain.
        relative = np.divide(sizes, changes, out=np.zeros_like(sizes), where=changes > 0)
        scale = np.maximum(sizes, settings.chatter * relative.max(initial=0.0) * changes)
        scale = np.maximum(scale, 1e-12 + 1e-9 * np.abs(reached).max(axis=(0, 1)))
        missed = np.nan_to_num(((errors / scale) ** 2).mean(axis=(1, 2)), nan=1e6)
        return replace(segments, scale=scale, missed=missed)

    def errors(self, model: Model, draws: int = 1) -> Array:
        """Return the errors ``(S, N, L, n)`` in units of the scale of a model, or of models of so many draws."""

        def of_draws(part: Array) -> Array:
            return np.broadcast_to(part, (draws, *part.shape))

        x, memory, commands, errors = *map(of_draws, (self.states, self.memory, self.commands)), []
        with np.errstate(all="ignore"):
            if isinstance(model, ModelWithEffects):
                commands, model = model.acting(commands), model.mechanics
            for step in range(self.reached.shape[1]):
                acting = commands[:, self.execution, self.first + step]
                x, memory = advanced(model, np.array(x), acting, np.array(memory))
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


@dataclass(frozen=True, eq=False)
class ParameterMode(ShortRepr):
    """The most probable standardised parameters, given segments of executions."""

    model: UncertainModel
    segments: Segments
    settings: ParameterSettings
    z: Array  # (K,)
    precision: Array  # (K, K)
    variance: Array | float  # of the errors of usual segments
    here: Array  # mean squared errors of segments, (N,)

    @classmethod
    def of(
        cls,
        model: UncertainModel,
        segments: Segments,
        settings: ParameterSettings,
        begun: Array | None = None,
        steps: int | None = None,
    ) -> ParameterMode:
        """Return the mode by Gauss-Newton steps, from standardised parameters that are ``begun`` with."""
        K = len(model.uncertain)
        mode = cls(model, segments, settings, np.zeros(K) if begun is None else begun, np.eye(K), 1.0, np.empty(0))
        z, here = mode.z, mode.squares(mode.z[None])[0]
        precision = np.eye(K)
        for _ in range(settings.newton if steps is None else steps):
            h = settings.difference * np.eye(K)
            errors = segments.errors(model.drawn(np.concatenate([z + h, z - h, z[None]])), 2 * K + 1)
            errors = np.nan_to_num(errors, nan=1e3, posinf=1e3, neginf=-1e3).reshape(2 * K + 1, len(here), -1)
            slopes = (errors[:K] - errors[K : 2 * K]) / (2 * settings.difference)
            variance = mode.usual(here)
            robust = (settings.tails + 1) / (settings.tails + here / variance) / (variance * errors.shape[2])
            weighted = slopes * robust[:, None]
            precision = np.einsum("ise,jse->ij", weighted, slopes) + np.eye(K)
            gradient = np.einsum("ise,se->i", weighted, errors[-1]) + z
            step = np.clip(-np.linalg.solve(precision, gradient), -settings.longest, settings.longest)
            tried = z + np.array([1.0, 0.5, 0.2, 0.05])[:, None] * step
            of_tried = mode.squares(tried)
            costs, before = mode.surprise(of_tried, tried, variance), float(mode.surprise(here, z, variance))
            if not costs.min() < before - 1e-3:
                break
            best = int(costs.argmin())
            z, here = tried[best], of_tried[best]
            if np.abs(step).max() < 1e-3:
                break
        return replace(mode, z=z, precision=precision, variance=mode.usual(here), here=here)

    def squares(self, z: Array) -> Array:
        """Return the mean squared errors ``(S, N)`` of segments; 1e6 where a run of the model fails."""
        errors = self.segments.errors(self.model.drawn(z), len(z))
        return np.asarray(np.nan_to_num((errors**2).mean(axis=(2, 3)), nan=1e6, posinf=1e6).clip(max=1e6))

    def surprise(self, of_segments: Array, z: Array, variance: Array | float) -> Array:
        """Return minus the log posterior ``(S,)`` of parameters ``(S, K)``, for a variance of errors."""
        nu = self.settings.tails
        misfit = 0.5 * (nu + 1) * np.log1p(of_segments / (nu * variance)).sum(axis=-1)
        return np.asarray(misfit + 0.5 * (z**2).sum(axis=-1))

    def usual(self, of_segments: Array) -> float:
        """Return the variance of errors that a Student likelihood has with its usual segments."""
        return max(float(np.median(of_segments)) / 0.8, self.settings.floor**2)

    def height_at(self, z: Array, of_segments: Array) -> float:
        """Return the log posterior of parameters ``(K,)`` with the variance that segments have there."""
        variance = self.usual(of_segments)
        return -float(self.surprise(of_segments, z, variance)) - 0.5 * len(of_segments) * float(np.log(variance))

    @property
    def height(self) -> float:
        """The log posterior at the mode."""
        return self.height_at(self.z, self.here)

    @property
    def left(self) -> float:
        """The mean square of the errors of segments in shares of M's, outliers limited."""
        of_model = np.minimum(self.segments.missed, 10.0).mean()
        return float(np.minimum(self.here, 10.0).mean() / max(of_model, 1e-300))

    def posterior(self, rng: np.random.Generator) -> ParameterPosterior:
        """Return samples around the mode by population Monte Carlo."""
        settings, K = self.settings, len(self.z)
        mean, covariance = self.z, np.asarray(np.linalg.inv(self.precision), dtype=np.float64)
        samples, weights = self.z[None], np.ones(1)
        for _ in range(settings.rounds):
            nu = settings.proposal_tails
            root = np.linalg.cholesky(settings.wider * covariance + 1e-12 * np.eye(K))
            normal = rng.standard_normal((settings.samples, K))
            moves = normal / np.sqrt(rng.chisquare(nu, (settings.samples, 1)) / nu)
            samples = mean + moves @ root.T
            samples[0], moves[0] = mean, 0.0
            of_proposal = -0.5 * (nu + K) * np.log1p((moves**2).sum(axis=1) / nu)
            logs = -self.surprise(self.squares(samples), samples, self.variance) - of_proposal
            weights = np.exp(logs - logs.max())
            weights /= weights.sum()
            mean = weights @ samples
            spread = samples - mean
            covariance = (spread * weights[:, None]).T @ spread + 0.1 * covariance
        at_mean = replace(self, here=self.squares(mean[None])[0])
        return ParameterPosterior(self.model, mean, covariance, samples, weights, at_mean.left, settings)


def most_probable_parameters(
    model: UncertainModel, executed: Sequence[Trajectory], rng: np.random.Generator, settings: ParameterSettings
) -> ParameterMode | None:
    """Return the mode of segments of the usual length or of single steps, which explains more; None without segments.

    Contacts begin and end with the parameters, so a fit of several steps, or one from the prior's mean alone, may end
    in one of many local modes.
    """
    segments = Segments.of(model, executed, rng, settings)
    if segments is None:
        return None
    mode = ParameterMode.of(model, segments, settings)
    short = Segments.of(model, executed, rng, replace(settings, steps=1))
    if mode.left <= settings.explained**2 or short is None:
        return mode
    of_steps = replace(mode, segments=short)
    drawn = rng.standard_normal((settings.samples, len(mode.z)))
    heights = [of_steps.height_at(z, here) for z, here in zip(drawn, of_steps.squares(drawn), strict=True)]
    begun = [mode.z, *drawn[np.argsort(heights)[::-1][: settings.starts]]]
    best = max((ParameterMode.of(model, short, settings, z) for z in begun), key=lambda each: each.height)
    return best if best.left < mode.left else mode


def most_probable_effects(
    mode: ParameterMode, candidates: Sequence[EffectCandidate], known: Sequence[EffectCandidate] | None = None
) -> ParameterMode:
    """Return the mode of a model with the effects of inputs that make executions clearly more probable.

    The effects are looked for greedily, or are the ``known`` ones, whose sizes are fitted again.
    """
    settings, model, inputs = mode.settings, mode.model, mode.segments.commands.shape[2]

    def with_effects(
        effects: tuple[EffectCandidate, ...], begun: ParameterMode, steps: int | None = None
    ) -> ParameterMode:
        extended = UncertainEffects(model, effects, inputs)
        z = np.append(begun.z, np.zeros(len(extended.uncertain) - len(begun.z)))
        return ParameterMode.of(extended, mode.segments, settings, z, steps)

    if known is not None:
        return with_effects(tuple(known), mode) if known else mode
    best, found = mode, tuple[EffectCandidate, ...]()
    while len(found) < settings.effects and best.left > settings.explained**2:
        tried = [
            (*found, each.sized(start))
            for each in candidates
            if each.effect.kind not in [other.effect.kind for other in found]
            for start in each.starts
        ]
        if not tried:
            break
        few = max((with_effects(each, best, settings.screened) for each in tried), key=lambda each: each.height)
        longer = ParameterMode.of(few.model, mode.segments, settings, few.z)
        if longer.height < best.height + settings.price + 0.5 * np.log(len(mode.here)):
            break
        best, found = longer, (few.model.effects if isinstance(few.model, UncertainEffects) else found)
    return best


def most_probable(
    model: UncertainModel,
    executed: Sequence[Trajectory],
    candidates: Sequence[EffectCandidate],
    known: Sequence[EffectCandidate] | None,
    rng: np.random.Generator,
    settings: ParameterSettings,
) -> ParameterMode | None:
    """Return the mode of parameters and effects; None without segments.

    If it explains too little, what explains one execution alone is fitted to all: a mode of few contacts is found more
    easily, and it ends at the mode of many.
    """

    def of(runs: Sequence[Trajectory]) -> ParameterMode | None:
        found = most_probable_parameters(model, runs, rng, settings)
        return None if found is None else most_probable_effects(found, candidates, known)

    mode = of(executed)
    for run in executed[: settings.starts] if mode is not None and len(executed) > 1 else ():
        if mode is None or mode.left <= settings.explained**2:
            break
        alone = of([run])
        if alone is not None and alone.left <= settings.explained**2:
            fitted = ParameterMode.of(alone.model, mode.segments, settings, alone.z)
            mode = fitted if fitted.height > mode.height else mode
    return mode


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
