r"""The posterior of a model's uncertain parameters, given executions.

Executions are cut into segments of a few steps that begin at recorded states, so that chaos and long horizons do not
matter. With the standardised errors :math:`e_s(z)` of segment s, the prior :math:`z \sim N(0, I)` and a Student
likelihood that bears contacts and outliers, minus the log posterior is

.. math:: \tfrac{\nu + 1}{2} \sum_s \log\left(1 + \frac{|e_s(z)|^2}{\nu \sigma^2}\right) + \tfrac12 |z|^2,

where the mean square of all errors of a segment counts as one observation, because they are far from independent. The
mode is found by Gauss-Newton steps, and draws come from adaptive multiple importance sampling (Cornuet et al. 2012)
around it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Self

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model, advanced, with_memory
from ctxval.core.state_geometry import PLAIN, StateGeometry, geometry_of
from ctxval.core.trajectory import Trajectory
from ctxval.core.uncertain import UncertainModel
from ctxval.learning.effects.effect import EffectCandidate, with_one_more
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
    samples: int = 64  # of a round of importance sampling
    rounds: int = 8  # at most
    effective: float = 30.0  # effective number of samples that suffices
    curved: float = 1.0  # by which the log posterior may be less at the mean, in whose place the mode is taken
    wider: float = 1.6  # factor of the covariance of the proposal
    proposal_tails: float = 6.0  # degrees of freedom of the proposal
    jitter: float = 0.2  # of draws around samples, in standard deviations
    effects: int = 2  # of inputs, such as a delay, at most
    explained: float = 0.05  # error of segments that is left, as a share of M's, below which no effects are looked for
    screened: int = 2  # Gauss-Newton steps with each of the effects that are tried
    best: int = 16  # samples around which the next round of the cross-entropy method draws
    wider_rounds: tuple[float, float] = (1.3, 0.05)  # factors of their covariance, and of the one of the round before
    first_rounds: int = 2  # with each effect
    further_rounds: int = 4  # with the best ones
    starts: int = 3  # of these
    last_rounds: int = 8  # with the best one
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
    def explains(self) -> bool:
        """Whether it leaves so little of M's errors that nothing else is looked for."""
        return self.left <= self.settings.explained**2

    @property
    def left(self) -> float:
        """The mean square of the errors of segments in shares of M's, outliers limited."""
        of_model = np.minimum(self.segments.missed, 10.0).mean()
        return float(np.minimum(self.here, 10.0).mean() / max(of_model, 1e-300))

    def posterior(self, rng: np.random.Generator) -> ParameterPosterior:
        """Return samples around the mode by adaptive multiple importance sampling."""
        settings, K, nu = self.settings, len(self.z), self.settings.proposal_tails
        values, vectors = np.linalg.eigh(self.precision)  # an inverse of eigenvalues so unequal is not symmetric
        mean, covariance = self.z, np.asarray(vectors / values @ vectors.T, dtype=np.float64)
        samples, heights, proposals = np.empty((0, K)), np.empty(0), list[tuple[Array, Array]]()
        for _ in range(settings.rounds):
            root = np.asarray(np.linalg.cholesky(settings.wider * covariance + 1e-12 * np.eye(K)), dtype=np.float64)
            proposals.append((mean, root))
            scale = np.sqrt(rng.chisquare(nu, (settings.samples, 1)) / nu)
            new = mean + rng.standard_normal((settings.samples, K)) / scale @ root.T
            samples = np.concatenate([samples, new])
            heights = np.concatenate([heights, -self.surprise(self.squares(new), new, self.variance)])
            # All samples together are from the mixture of all proposals.
            squares = [(np.linalg.solve(at, (samples - middle).T) ** 2).sum(axis=0) for middle, at in proposals]
            volumes = np.array([np.log(np.diag(at)).sum() for _, at in proposals])
            of_proposals = -0.5 * (nu + K) * np.log1p(np.array(squares) / nu) - volumes[:, None]
            logs = heights - np.logaddexp.reduce(of_proposals, axis=0)
            weights = np.exp(logs - logs.max())
            weights /= weights.sum()
            effective = 1 / float((weights**2).sum())
            mean = weights @ samples
            spread = samples - mean
            # Few samples know no covariance of many parameters.
            covariance = (effective * (spread * weights[:, None]).T @ spread + K * covariance) / (effective + K)
            if effective >= settings.effective:
                break
        middle = np.stack([self.z, mean])
        of_middle = np.stack([self.here, self.squares(mean[None])[0]])
        # The mean of a curved posterior lies beside it.
        at_mode, at_mean = self.surprise(of_middle, middle, self.variance)
        row = int(at_mean <= at_mode + settings.curved)
        left = replace(self, here=of_middle[row]).left
        return ParameterPosterior(self.model, middle[row], covariance, samples, weights, left, settings)


@dataclass(frozen=True, eq=False)
class Known(ShortRepr):
    """What fewer executions told: standardised parameters of a model, and effects with their sizes."""

    parameters: Array  # (K,)
    effects: tuple[EffectCandidate, ...] = ()


PRIOR_SEARCH = "parameters of M from all of their prior"
"""The name of this stage in a budget of thinking."""


class CrossEntropySearch:
    """Looks for the mode of a model from all of its prior by the cross-entropy method (Rubinstein 1999).

    Contacts begin and end with the parameters, so Gauss-Newton steps may end in one of many local modes.
    """

    def __init__(self, model: UncertainModel, segments: Segments, settings: ParameterSettings) -> None:
        self.origin = ParameterMode.of(model, segments, settings, steps=0)
        K = len(self.origin.z)
        self._mean, self._covariance = np.zeros(K), np.eye(K)
        self.z, self.height = self.origin.z, self.origin.height

    def advance(self, rounds: int, rng: np.random.Generator) -> Self:
        """Sample some rounds, each around the best samples of the one before."""
        settings, K = self.origin.settings, len(self.z)
        best = settings.best
        weights = np.log(best + 0.5) - np.log(np.arange(1, best + 1))
        weights /= weights.sum()
        for _ in range(rounds):
            root = np.linalg.cholesky(self._covariance + 1e-8 * np.eye(K))
            samples = self._mean + rng.standard_normal((settings.samples, K)) @ root.T
            samples[0] = self.z
            of_samples = zip(samples, self.origin.squares(samples), strict=True)
            heights = np.array([self.origin.height_at(z, squares) for z, squares in of_samples])
            top = np.argsort(-heights, kind="stable")[:best]
            self.z, self.height = samples[top[0]], float(heights[top[0]])
            self._mean = weights @ samples[top]
            spread = samples[top] - self._mean
            wider, before = settings.wider_rounds
            self._covariance = wider * (spread * weights[:, None]).T @ spread + before * self._covariance
        return self

    def refined(self) -> ParameterMode:
        """Return the mode by Gauss-Newton steps from the best sample."""
        origin = self.origin
        return ParameterMode.of(origin.model, origin.segments, origin.settings, self.z)


@dataclass(frozen=True)
class _Structures:
    """Models with a model's parameters and effects, such as a delay, of which executions make one most probable."""

    model: UncertainModel
    candidates: Sequence[EffectCandidate]
    settings: ParameterSettings

    def with_effects(self, effects: Sequence[EffectCandidate], segments: Segments) -> UncertainModel:
        if not effects:
            return self.model
        return UncertainEffects(self.model, tuple(effects), segments.commands.shape[2])

    def fitted(
        self, segments: Segments, begun: Array, effects: Sequence[EffectCandidate] = (), steps: int | None = None
    ) -> ParameterMode:
        """Return the mode with effects by Gauss-Newton steps from parameters, and usual sizes of further effects."""
        model = self.with_effects(effects, segments)
        begun = np.append(begun, np.zeros(len(model.uncertain) - len(begun)))
        return ParameterMode.of(model, segments, self.settings, begun, steps)

    def from_known(self, segments: Segments, known: Known | None) -> ParameterMode:
        """Return the mode by Gauss-Newton steps that begin at what is known, or if this explains too little, at M."""
        mode = None if known is None else self.fitted(segments, known.parameters, known.effects)
        if mode is not None and mode.explains:
            return mode
        alone = self.fitted(segments, np.zeros(len(self.model.uncertain)))
        if mode is None or known is None:
            return alone
        return min(mode, self.fitted(segments, alone.z, known.effects), key=attrgetter("left"))

    def greedily(self, mode: ParameterMode) -> ParameterMode:
        """Return the mode with the effects that make executions clearly more probable, one after the other."""
        settings = self.settings
        while len(_effects(mode.model)) < settings.effects and not mode.explains:
            longer = with_one_more(_effects(mode.model), self.candidates)
            tried = [self.fitted(mode.segments, mode.z, effects, settings.screened) for effects in longer]
            if not tried:
                break
            few = max(tried, key=attrgetter("height"))
            found = ParameterMode.of(few.model, mode.segments, settings, few.z)
            if found.height < mode.height + self.price_of(mode):
                break
            mode = found
        return mode

    @property
    def rounds(self) -> int:
        """How many rounds the search from all of the prior takes."""
        settings, kinds = self.settings, len({each.effect.kind for each in self.candidates})
        return (1 + kinds) * settings.first_rounds + settings.starts * settings.further_rounds + settings.last_rounds

    def from_prior(self, segments: Segments, rng: np.random.Generator) -> ParameterMode:
        """Return the mode with one effect, or none, whose parameters and size are looked for together."""
        settings, seen, searches = self.settings, list[object](), list[CrossEntropySearch]()
        for each in (None, *self.candidates):
            kind = None if each is None else each.effect.kind
            if kind not in seen:
                effects = () if each is None else (each.sized(each.starts[0]),)
                search = CrossEntropySearch(self.with_effects(effects, segments), segments, settings)
                searches.append(search.advance(settings.first_rounds, rng))
                seen.append(kind)
        plain = searches[0].refined()
        searches.sort(key=lambda each: -each.height)
        further = [each.advance(settings.further_rounds, rng) for each in searches[: settings.starts]]
        mode = max(further, key=attrgetter("height")).advance(settings.last_rounds, rng).refined()
        return mode if mode.height > plain.height + self.price_of(plain) else plain

    def price_of(self, mode: ParameterMode) -> float:
        return self.settings.price + 0.5 * float(np.log(len(mode.here)))


def _effects(model: UncertainModel) -> tuple[EffectCandidate, ...]:
    return model.effects if isinstance(model, UncertainEffects) else ()


def most_probable(
    model: UncertainModel,
    executed: Sequence[Trajectory],
    candidates: Sequence[EffectCandidate],
    known: Known | None,
    rng: np.random.Generator,
    settings: ParameterSettings,
    affords: Callable[[int], bool] = lambda steps: True,
) -> ParameterMode | None:
    """Return the mode of parameters and effects; None without segments.

    Effects are looked for among candidates, or are the ``known`` ones, whose sizes are fitted again. Gauss-Newton steps
    begin at what is known, then at the prior's mean. If they explain too little, the mode of single steps, of which
    more are without a change of contacts, is looked for from all of the prior: of the parameters, then with each
    effect, if so many steps of the model can be afforded.
    """
    segments, structures = Segments.of(model, executed, rng, settings), _Structures(model, candidates, settings)
    if segments is None:
        return None
    mode = structures.from_known(segments, known)
    short = None if mode.explains else Segments.of(model, executed, rng, replace(settings, steps=1))
    if short is None:
        return mode
    rounds = settings.first_rounds + settings.further_rounds, settings.last_rounds
    of_round = settings.samples * len(short.states)
    if affords(sum(rounds) * of_round):
        search = CrossEntropySearch(mode.model, short, settings)
        for each in rounds:
            found = search.advance(each, rng).refined()
            mode = found if found.left < mode.left else mode
            if mode.explains:
                break
    if known is not None or mode.explains:
        return mode
    mode = structures.greedily(mode)
    if mode.explains or not affords(structures.rounds * of_round):
        return mode
    found = structures.greedily(structures.from_prior(short, rng))
    return found if found.left < mode.left else mode


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
