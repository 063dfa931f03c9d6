"""How well effects explain recorded executions: residuals after one step and after several, and fits."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ctxval._util.arrays import Array, Mask, Rows
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model
from ctxval.core.state_geometry import geometry_of
from ctxval.core.trajectory import Trajectory
from ctxval.learning.effects.effect import Effect, EffectCandidate, all_sized
from ctxval.learning.effects.flow import Linearisation
from ctxval.learning.effects.model import ModelWithEffects
from ctxval.models import MuJoCo


@dataclass(frozen=True)
class SegmentSettings:
    """Of which predictions evidence is, and how far an outlier counts."""

    steps: tuple[int, int] = (1, 6)  # of the predictions
    most: tuple[int, int] = (600, 120)  # predictions of these numbers of steps
    largest: float = 1e3  # residual that counts, as a multiple of the typical one of M
    draws: int = 4  # of noise
    longer: int = 4  # times as many steps, with which shares are measured if there is noise
    unknown: float = 1e3  # standard deviation of a share that nothing tells

    def part(self, share: float) -> SegmentSettings:
        """Return the settings of a share of the predictions."""
        single, several = (max(12, round(share * each)) for each in self.most)
        return replace(self, most=(single, several))


@dataclass(frozen=True, eq=False)
class Predictions(ShortRepr):
    """Predictions over some steps."""

    steps: int
    states: Rows  #: rows of the first state and, in all padded runs, of the first input, ``(N,)``
    inputs: Rows
    runs: Rows  #: the numbers of the executions ``(N,)``
    floors: Array  #: residuals ``(n,)`` that are too small to be evidence


class Segments:
    """Recorded executions, and what M misses in them: residuals of sizes ``(n,)`` after one step and after several.

    The states ``(N + k, n)`` are of all k runs, one after the other, and inputs ``(k, H, m)`` are padded with zeros.
    Effects that are known say how states are compared.
    """

    def __init__(
        self,
        model: Model,
        runs: Sequence[Trajectory],
        floors: Sequence[Array] | None = None,
        settings: SegmentSettings = SegmentSettings(),
        known: tuple[Effect, ...] = (),
        numbers: Sequence[int] | None = None,
    ) -> None:
        self.numbers: Rows = np.array(range(len(runs)) if numbers is None else numbers)  # of the executions
        self.settings, self._geometry = settings, geometry_of(model)
        self.model, self.known, self.horizons = model, known, [len(run.inputs) for run in runs]
        self.states = np.concatenate([run.states for run in runs])
        self.inputs = np.zeros((len(runs), max(self.horizons), runs[0].inputs.shape[1]))
        for padded, run in zip(self.inputs, runs, strict=True):
            padded[: len(run.inputs)] = run.inputs
        self.windows, self.sizes = list[Predictions](), list[Array]()
        self._missed = dict[int, tuple[Array, Mask]]()  # by M after a number of steps, and which of it is evidence
        for number, length in enumerate(settings.steps):
            window = self._window(min(length, min(self.horizons)), settings.most[number])
            left = self.left_by(ModelWithEffects(model, ()), window)
            changes = _size(self._gap(self.states[window.states + window.steps], self.states[window.states]))
            # Smaller residuals are no segments.
            least = np.hypot(0.01 * _size(left), 1e-3 * changes) if floors is None else floors[number]
            self.windows.append(replace(window, floors=np.maximum(least, 1e-15)))
            self.sizes.append(np.maximum(_size(left), self.windows[-1].floors))

    def _window(self, steps: int, most: int) -> Predictions:
        states, inputs, runs, first = [], [], [], 0
        for number, horizon in enumerate(self.horizons):
            begins = np.arange(0, horizon - steps + 1, max(1, steps // 2))
            states.append(first + begins)
            inputs.append(number * self.inputs.shape[1] + begins)
            runs.append(np.full(len(begins), self.numbers[number]))
            first += horizon + 1
        of_states, of_inputs, of_runs = map(np.concatenate, (states, inputs, runs))
        rows = np.linspace(0, len(of_states) - 1, min(len(of_states), most)).round().astype(np.intp)
        return Predictions(steps, of_states[rows], of_inputs[rows], of_runs[rows], np.zeros(self.states.shape[1]))

    @property
    def pairs(self) -> tuple[Array, Array, Array]:
        """The states, inputs and residuals of M in the predictions of one step, shapes ``(N, ...)``."""
        window = self.windows[0]
        residuals = -self.left_by(ModelWithEffects(self.model, ()), window)
        inputs = self.inputs.reshape(-1, self.inputs.shape[-1])
        return self.states[window.states], inputs[window.inputs], residuals

    @functools.cached_property
    def linearised(self) -> Linearisation:
        """M at all recorded states."""
        rows = [np.arange(horizon + 1) + k * self.inputs.shape[1] for k, horizon in enumerate(self.horizons)]
        inputs = self.inputs.reshape(-1, self.inputs.shape[-1])
        with np.errstate(all="ignore"):
            return Linearisation.of(self.model, self.states, inputs[np.minimum(np.concatenate(rows), len(inputs) - 1)])

    def left_by(self, repaired: ModelWithEffects, window: Predictions, moved: Array | float = 0.0) -> Array:
        """Return predicted minus recorded states ``(N, n)``, of draws ``(S, N, n)``.

        Predictions begin at recorded states that are moved.
        """
        draws = (repaired.draws,) if repaired.draws else ()
        acting = repaired.in_run(self.numbers).acting(np.broadcast_to(self.inputs, (*draws, *self.inputs.shape)))
        repaired = repaired.in_run(window.runs)
        acting = acting.reshape(*draws, -1, *acting.shape[len(draws) + 2 :])
        begun = self._geometry.add(self.states[window.states], np.zeros(self.states.shape[1]) + moved)
        x = repaired.true(np.broadcast_to(begun, (*draws, *begun.shape)))
        moved_back = any(type(effect).true is not Effect.true for effect in repaired.effects)
        for k in range(window.steps):
            at = None if moved_back else self.linearised[window.states + k]
            x = repaired.reached(x, acting.take(window.inputs + k, axis=len(draws)), at)
        return self._gap(repaired.recorded(x), self.states[window.states + window.steps])

    def _gap(self, states: Array, others: Array) -> Array:
        difference = self._geometry.difference(states, others)
        return functools.reduce(lambda difference, effect: effect.gap(difference), self.known, difference)

    def noise(self, repaired: ModelWithEffects) -> Array:
        """Return the standard deviations ``(n,)`` of white noise of measurements, as residuals of one step show it."""
        left = self.left_by(repaired, self._window(1, len(self.states)))
        left = self.limited(left / self.sizes[0])
        # The noise of a measurement enters two successive residuals, with opposite signs.
        runs = np.split(left, np.cumsum(self.horizons)[:-1])
        products = np.concatenate([run[1:] * run[:-1] for run in runs])
        first = self.windows[0]
        window = replace(first, states=first.states[::4], inputs=first.inputs[::4], runs=first.runs[::4])
        here, slopes = self.left_by(repaired, window), np.ones(left.shape[1])
        for i, size in enumerate(0.1 * self.sizes[0]):
            there = self.left_by(repaired, window, size * np.eye(len(slopes))[i])
            slopes[i] = np.median(np.nan_to_num((there - here)[:, i], nan=size)) / size
        variances = -products.mean(axis=0) / np.clip(slopes, 0.1, None)
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)) * self.sizes[0])

    def explained(self, repaired: ModelWithEffects, noise: Array) -> tuple[float, float]:
        """Return which share of M's squared residuals after several steps is explained, and its deviation by noise.

        What an effect does grows with the number of steps, and so does an error of its size. More steps than in fits
        are therefore taken only if noise, with standard deviations ``(n,)``, then hides less of the effect.
        """
        steps, shortest = self.windows[1].steps, min(self.horizons)
        lengths = [steps, *({min(self.settings.longer * steps, shortest)} - {steps} if noise.any() else ())]
        return min((self._explained(repaired, noise, length) for length in lengths), key=lambda result: result[1])

    def limited(self, ratios: Array) -> Array:
        """Return residuals as multiples of typical ones, within the largest that counts."""
        most = self.settings.largest
        return np.nan_to_num(ratios, nan=most).clip(-most, most)

    def _explained(self, repaired: ModelWithEffects, noise: Array, steps: int) -> tuple[float, float]:
        settings = self.settings
        window, rng = self._window(steps, len(self.states)), np.random.default_rng(0)
        if steps not in self._missed:
            changes = _size(self._gap(self.states[window.states + steps], self.states[window.states]))
            missed = _size(self.left_by(ModelWithEffects(self.model, ()), window))
            self._missed[steps] = missed, missed > 2e-3 * np.maximum(changes, 1e-12)
        sizes, matter = self._missed[steps]
        if not matter.any():
            return 0.0, settings.unknown
        most = settings.largest * np.maximum(sizes, 1e-15)
        errors = np.nan_to_num(self.left_by(repaired, window), nan=np.inf).clip(-most, most)
        by_noise = noise**2
        for _ in range(settings.draws if noise.any() else 0):
            moved = self.left_by(repaired, window, noise * rng.standard_normal(errors.shape)).clip(-most, most)
            by_noise = by_noise + np.nan_to_num((moved - errors) ** 2).mean(axis=0) / settings.draws
        squares = np.stack([(errors**2).mean(axis=0), sizes**2, by_noise])[:, matter] / sizes[matter] ** 2
        left, before, spread = squares[0] - squares[2], squares[1] - squares[2], squares[2]
        whole = float(before.sum())
        if whole <= 0:
            return 0.0, settings.unknown
        # Every second prediction is independent of the others.
        uncertainty = float(np.sqrt((spread**2).sum() * 4 / len(errors))) / whole
        return 1.0 - max(float(left.sum()), 0.0) / whole, min(uncertainty, settings.unknown)

    def measured(self, repaired: ModelWithEffects) -> tuple[float, float]:
        """Return minus twice the log-likelihood, and the share of the squared residuals of M that is left."""
        misfit, left = 0.0, 0.0
        for window, sizes in zip(self.windows, self.sizes, strict=True):
            most = self.settings.largest * sizes
            errors = np.nan_to_num(self.left_by(repaired, window), nan=np.inf).clip(-most, most)
            squares = (errors**2).mean(axis=0)
            misfit += len(errors) * float(np.log((squares + window.floors**2) / sizes**2).sum())
            matter = sizes > 2 * window.floors
            left += float((squares / sizes**2)[matter].mean() if matter.any() else 0.0) / len(self.windows)
        return misfit, left


@dataclass(frozen=True, eq=False)
class Explanation(ShortRepr):
    """Effects with fitted sizes, and how well they explain the records."""

    candidates: tuple[EffectCandidate, ...]  #: those that were fitted, with the effects of ``repaired``
    repaired: ModelWithEffects
    criterion: float  #: the Bayesian information criterion; the smaller, the better
    left: float  #: the share of the squared residuals of M that is left

    @property
    def sizes(self) -> list[float]:
        """The sizes of all effects."""
        return [float(size) for effect in self.repaired.effects for size in effect.sizes]


def explained(
    segments: Segments, candidates: tuple[EffectCandidate, ...], begun: Sequence[float] | Array, *, near: bool = False
) -> Explanation:
    """Return effects whose sizes are fitted to records by nonlinear least squares, from sizes that are ``begun`` with.

    The residuals of each state are first divided by those of M, and then twice by what is left of them; only once if
    the fit begins ``near`` its end, with sizes that were fitted to nearly the same records.
    """
    fit = _Fit(segments, candidates)
    theta = np.array(begun)
    if len(theta):
        theta = theta if near else fit.most_likely_of_states(fit.best(theta, segments.sizes, 8))
        for _ in range(1 if near else 2):
            model = fit.repaired(theta)
            sizes = [
                np.clip(np.hypot(_size(segments.left_by(model, window)), window.floors), window.floors, size)
                for window, size in zip(segments.windows, segments.sizes, strict=True)
            ]
            before, theta = theta, fit.best(theta, sizes, 6)
            if (np.abs(theta - before) < 0.01 * fit.scales).all():
                break
    model = fit.repaired(theta)
    misfit, left = segments.measured(model)
    fitted = tuple(replace(each, effect=effect) for each, effect in zip(candidates, model.effects, strict=True))
    return Explanation(fitted, model, misfit + fit.penalty, left)


def screened(segments: Segments, candidates: tuple[EffectCandidate, ...]) -> tuple[float, Array]:
    """Return how badly effects explain records at most, and sizes to begin a fit with.

    One Gauss-Newton step is made from each first guess of the last effect; residuals are taken as linear in the sizes.
    """
    fit = _Fit(segments, candidates)
    known = [size for each in candidates[:-1] for size in each.effect.sizes]
    results = []
    for start in candidates[-1].starts:
        theta = np.array([*known, *start])
        here, J = fit.slope(theta, segments.sizes)
        linear, moved = here, theta
        if len(theta):
            moved = np.clip(theta + np.linalg.lstsq(J, -here, rcond=1e-8)[0], fit.low, fit.high)
            linear = here + J @ (moved - theta)
        results.append((fit.misfit(linear) + fit.penalty, moved))
    return min(results, key=lambda result: result[0])


class _Fit:
    """The residuals of records as a function of the sizes of effects."""

    def __init__(self, segments: Segments, candidates: tuple[EffectCandidate, ...]) -> None:
        self.segments, self.candidates = segments, candidates
        parameters = [parameter for each in candidates for parameter in each.parameters]
        self.low, self.high, self.scales = (
            np.array([getattr(parameter, name) for parameter in parameters]) for name in ("low", "high", "scale")
        )
        # Which effect it is counts like a size.
        self.penalty = (len(self.scales) + len(candidates)) * float(np.log(len(segments.windows[0].states)))

    def repaired(self, theta: Array) -> ModelWithEffects:
        """Return M with effects of sizes ``(p,)``, or with those of draws ``(S, p)``."""
        sized = all_sized(self.candidates, theta.tolist() if theta.ndim == 1 else theta.T[:, :, None])
        effects = tuple(each.effect for each in sized)
        return ModelWithEffects(self.segments.model, effects, self.segments.inputs.shape[-1])

    def errors(self, theta: Array, sizes: Sequence[Array]) -> Array:
        """Return residuals ``(R,)`` in given sizes, or ``(S, R)``; their squares are means over each window."""
        model, parts = self.repaired(theta), []
        for window, size in zip(self.segments.windows, sizes, strict=True):
            left = self.segments.limited(self.segments.left_by(model, window) / size)
            parts.append(left.reshape(*theta.shape[:-1], -1) / np.sqrt(len(window.states)))
        return np.concatenate(parts, axis=-1)

    def slope(self, theta: Array, sizes: Sequence[Array]) -> tuple[Array, Array]:
        """Return residuals ``(R,)`` and their derivatives ``(R, p)``."""
        steps = 1e-3 * np.where(theta + 1e-3 * self.scales <= self.high, self.scales, -self.scales)
        moved = theta + np.concatenate([np.zeros((1, len(theta))), np.diag(steps)])
        if isinstance(self.segments.model, MuJoCo) or not len(theta):  # its draws run one after the other in any case
            errors = np.stack([self.errors(each, sizes) for each in moved])
        else:
            errors = self.errors(moved, sizes)
        return errors[0], (errors[1:] - errors[0]).T / steps

    def most_likely_of_states(self, theta: Array) -> Array:
        """Return the most likely of these sizes and of those that explain one state alone, by a Gauss-Newton step."""
        # Where M integrates a position otherwise than the system does, an effect explains the rate alone.
        (here, J), n, tried = self.slope(theta, self.segments.sizes), len(self.segments.sizes[0]), [theta]
        for i in range(n):  # rows of errors are predictions after predictions, each with all states
            step = np.linalg.lstsq(J[i::n], -here[i::n], rcond=1e-8)[0]
            tried.append(np.clip(theta + step, self.low, self.high))
        likely = min(tried, key=lambda each: self.misfit(here + J @ (each - theta)))
        if likely is theta:
            return theta
        return min((theta, likely), key=lambda each: self.segments.measured(self.repaired(each))[0])

    def misfit(self, errors: Array) -> float:
        """Return minus twice the log-likelihood of residuals in the sizes of those of M."""
        misfit, first = 0.0, 0
        for window, size in zip(self.segments.windows, self.segments.sizes, strict=True):
            count, n = len(window.states), len(size)
            squares = (errors[first : first + count * n].reshape(count, n) ** 2).sum(axis=0)
            misfit += count * float(np.log(squares + (window.floors / size) ** 2).sum())
            first += count * n
        return misfit

    def best(self, start: Array, sizes: Sequence[Array], evaluations: int) -> Array:
        inside = np.clip(start, self.low + 1e-9 * self.scales, self.high - 1e-9 * self.scales)
        bounds, options = (self.low, self.high), {"max_nfev": evaluations, "xtol": 1e-4, "ftol": 1e-5}
        fitted = scipy.optimize.least_squares(
            lambda theta: self.errors(theta, sizes), inside, lambda theta: self.slope(theta, sizes)[1],
            bounds=bounds, x_scale=self.scales, **options,
        )  # fmt: skip
        return np.asarray(fitted.x)


def _size(errors: Array) -> Array:
    finite = errors[np.isfinite(errors).all(axis=1)]
    return np.sqrt((finite**2).mean(axis=0)) if len(finite) else np.ones(errors.shape[1])
