"""How well causes explain recorded executions: residuals after one step and after several, fits, and the evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from ctxval._util.arrays import Array, Rows
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory
from ctxval.studies.causes.candidates import Candidate
from ctxval.studies.causes.cause import Repaired

STEPS = (1, 6)  # of the predictions
_LARGEST = 1e3  # of a residual, as a multiple of the typical one of M


@dataclass(frozen=True, eq=False)
class Windows(ShortRepr):
    """Predictions over some steps: where they begin, and residuals ``(n,)`` that are too small to be evidence.

    ``states`` and ``inputs`` are rows of the first state and, in all padded runs, of the first input, shape ``(N,)``.
    """

    steps: int
    states: Rows
    inputs: Rows
    floors: Array


class Records:
    """Recorded executions, and what M misses in them.

    Attributes:
        states: of all k runs, one after the other, ``(N + k, n)``.
        inputs: of all runs, with zeros after the end of shorter ones, ``(k, H, m)``.
        windows, sizes: predictions of one step and of several, and the sizes ``(n,)`` of the residuals of M in these.
    """

    def __init__(
        self,
        model: Model,
        runs: Sequence[Trajectory],
        floors: Sequence[Array] | None = None,
        most: tuple[int, int] = (600, 120),
        steps: tuple[int, int] = STEPS,
    ) -> None:
        self.model, self.horizons = model, [len(run.inputs) for run in runs]
        self.states = np.concatenate([run.states for run in runs])
        longest = max(self.horizons)
        self.inputs = np.zeros((len(runs), longest, runs[0].inputs.shape[1]))
        for padded, run in zip(self.inputs, runs, strict=True):
            padded[: len(run.inputs)] = run.inputs
        self.windows, self.sizes = list[Windows](), list[Array]()
        for number, length in enumerate(steps):
            window = self._window(min(length, min(self.horizons)), most[number])
            left = self.left_by(Repaired(model, ()), window)
            changes = _size(self.states[window.states + window.steps] - self.states[window.states])
            # Smaller residuals are no evidence.
            least = np.hypot(0.01 * _size(left), 1e-3 * changes) if floors is None else floors[number]
            self.windows.append(replace(window, floors=np.maximum(least, 1e-15)))
            self.sizes.append(np.maximum(_size(left), self.windows[-1].floors))

    def _window(self, steps: int, most: int) -> Windows:
        states, inputs, first = [], [], 0
        for number, horizon in enumerate(self.horizons):
            begins = np.arange(0, horizon - steps + 1, max(1, steps // 2))
            states.append(first + begins)
            inputs.append(number * self.inputs.shape[1] + begins)
            first += horizon + 1
        of_states, of_inputs = np.concatenate(states), np.concatenate(inputs)
        rows = np.linspace(0, len(of_states) - 1, min(len(of_states), most)).round().astype(np.intp)
        return Windows(steps, of_states[rows], of_inputs[rows], np.zeros(self.states.shape[1]))

    @property
    def pairs(self) -> tuple[Array, Array, Array]:
        """The states, inputs and residuals of M in the predictions of one step, shapes ``(N, ...)``."""
        window = self.windows[0]
        residuals = -self.left_by(Repaired(self.model, ()), window)
        inputs = self.inputs.reshape(-1, self.inputs.shape[-1])
        return self.states[window.states], inputs[window.inputs], residuals

    def left_by(self, repaired: Repaired, window: Windows) -> Array:
        """Return predicted minus recorded states ``(N, n)``."""
        acting = repaired.acting(self.inputs).reshape(-1, self.inputs.shape[-1])
        x = repaired.true(self.states[window.states])
        for k in range(window.steps):
            x = repaired.reached(x, acting[window.inputs + k])
        return np.asarray(repaired.recorded(x) - self.states[window.states + window.steps])

    def structure(self, repaired: Repaired) -> tuple[float, float]:
        """Return the part of the squared residuals of one step that is no noise, and all of them, in those of M.

        The part is at most so large, up to one standard error. It is their autocovariance over two steps to four. Noise
        of a step or of a measurement has none of it: a measurement enters the residuals of two successive steps.
        """
        left = self.left_by(repaired, self._window(1, len(self.states)))
        left = np.nan_to_num(left / self.sizes[0], nan=_LARGEST).clip(-_LARGEST, _LARGEST)
        of_runs, squares = [], []
        for run in np.split(left, np.cumsum(self.horizons)[:-1]):
            lags = [k for k in (2, 3, 4) if k < len(run)]
            of_runs.append(np.sum([(run[k:] * run[:-k]).sum(axis=0) / (len(lags) * len(run)) for k in lags], axis=0))
            squares.append((run**2).mean(axis=0))
        matter = self.sizes[0] > 2 * self.windows[0].floors
        part, whole = (float(np.mean(each, axis=0)[matter].sum()) for each in (of_runs, squares))
        return max(part, 0.0) + whole / float(np.sqrt(3 * sum(self.horizons))), whole

    def measured(self, repaired: Repaired) -> tuple[float, float]:
        """Return minus twice the log-likelihood, and the share of the squared residuals of M that is left."""
        misfit, left = 0.0, 0.0
        for window, sizes in zip(self.windows, self.sizes, strict=True):
            most = _LARGEST * sizes
            errors = np.nan_to_num(self.left_by(repaired, window), nan=np.inf).clip(-most, most)
            squares = (errors**2).mean(axis=0)
            misfit += len(errors) * float(np.log((squares + window.floors**2) / sizes**2).sum())
            matter = sizes > 2 * window.floors
            left += float((squares / sizes**2)[matter].mean() if matter.any() else 0.0) / len(self.windows)
        return misfit, left


@dataclass(frozen=True, eq=False)
class Explanation(ShortRepr):
    """Causes with fitted sizes, and how well they explain the records.

    Attributes:
        candidates: those that were fitted, with the causes of ``repaired``.
        criterion: the Bayesian information criterion; the smaller, the better.
        left: the share of the squared residuals of M that is left.
    """

    candidates: tuple[Candidate, ...]
    repaired: Repaired
    criterion: float
    left: float

    @property
    def sizes(self) -> list[float]:
        """The sizes of all causes."""
        return [size for cause in self.repaired.causes for size in cause.sizes]


def explained(records: Records, candidates: tuple[Candidate, ...], begun: Sequence[float] | Array) -> Explanation:
    """Return causes whose sizes are fitted to records by nonlinear least squares.

    The residuals of each state are first divided by those of M, and then twice by what is left of them.

    Args:
        begun: the sizes of all causes with which the fit begins.
    """
    fit = _Fit(records, candidates)
    theta = np.array(begun)
    if len(theta):
        theta = fit.most_likely_of_states(fit.best(theta, records.sizes, 8))
        for _ in range(2):
            model = fit.repaired(theta)
            sizes = [
                np.clip(np.hypot(_size(records.left_by(model, window)), window.floors), window.floors, size)
                for window, size in zip(records.windows, records.sizes, strict=True)
            ]
            theta = fit.best(theta, sizes, 6)
    model = fit.repaired(theta)
    misfit, left = records.measured(model)
    fitted = tuple(replace(each, cause=cause) for each, cause in zip(candidates, model.causes, strict=True))
    return Explanation(fitted, model, misfit + fit.penalty, left)


def screened(records: Records, candidates: tuple[Candidate, ...]) -> tuple[float, Array]:
    """Return how badly causes explain records at most, and sizes to begin a fit with.

    The last cause is tried at each of its first guesses, and one Gauss-Newton step is made from there. The criterion is
    that of residuals which are linear in the sizes.
    """
    fit = _Fit(records, candidates)
    known = [size for each in candidates[:-1] for size in each.cause.sizes]
    results = []
    for start in candidates[-1].starts:
        theta = np.array([*known, *start])
        here = fit.errors(theta, records.sizes)
        linear, moved = here, theta
        if len(theta):
            J = fit.slope(theta, records.sizes, here)
            moved = np.clip(theta + np.linalg.lstsq(J, -here, rcond=1e-8)[0], fit.low, fit.high)
            linear = here + J @ (moved - theta)
        misfit, first = 0.0, 0
        for window, size in zip(records.windows, records.sizes, strict=True):
            count, n = len(window.states), len(size)
            squares = (linear[first : first + count * n].reshape(count, n) ** 2).sum(axis=0)
            misfit += count * float(np.log(squares + (window.floors / size) ** 2).sum())
            first += count * n
        results.append((misfit + fit.penalty, moved))
    return min(results, key=lambda result: result[0])


class _Fit:
    """The residuals of records as a function of the sizes of causes."""

    def __init__(self, records: Records, candidates: tuple[Candidate, ...]) -> None:
        self.records, self.candidates = records, candidates
        self.low, self.high, self.scales = (
            np.array([value for each in candidates for value in getattr(each, name)])
            for name in ("low", "high", "scales")
        )
        # Which cause it is counts like a size.
        count = len(self.scales) + len(candidates)
        self.penalty = count * float(np.log(len(records.windows[0].states)))

    def repaired(self, theta: Array) -> Repaired:
        causes, rest = [], theta
        for each in self.candidates:
            count = len(each.scales)
            causes.append(each.cause.with_sizes(rest[:count].tolist()))
            rest = rest[count:]
        return Repaired(self.records.model, tuple(causes))

    def errors(self, theta: Array, sizes: Sequence[Array]) -> Array:
        """Return residuals in given sizes, whose squares are means over the predictions of each window."""
        model, parts = self.repaired(theta), []
        for window, size in zip(self.records.windows, sizes, strict=True):
            left = np.nan_to_num(self.records.left_by(model, window) / size, nan=_LARGEST).clip(-_LARGEST, _LARGEST)
            parts.append(left.ravel() / np.sqrt(len(left)))
        return np.concatenate(parts)

    def slope(self, theta: Array, sizes: Sequence[Array], here: Array) -> Array:
        columns = []
        for i, step in enumerate(1e-3 * self.scales):
            moved = theta.copy()
            moved[i] += step if moved[i] + step <= self.high[i] else -step
            columns.append((self.errors(moved, sizes) - here) / (moved[i] - theta[i]))
        return np.stack(columns, axis=1)

    def most_likely_of_states(self, theta: Array) -> Array:
        """Return the most likely of these sizes and of those that explain one state alone, by a Gauss-Newton step.

        Where M integrates a position otherwise than the system does, a cause explains the rate alone.
        """
        here = self.errors(theta, self.records.sizes)
        J = self.slope(theta, self.records.sizes, here)
        n = len(self.records.sizes[0])
        tried = [theta]
        for i in range(n):  # rows of errors are predictions after predictions, each with all states
            step = np.linalg.lstsq(J[i::n], -here[i::n], rcond=1e-8)[0]
            tried.append(np.clip(theta + step, self.low, self.high))
        return min(tried, key=lambda each: self.records.measured(self.repaired(each))[0])

    def best(self, start: Array, sizes: Sequence[Array], evaluations: int) -> Array:
        inside = np.clip(start, self.low + 1e-9 * self.scales, self.high - 1e-9 * self.scales)
        known: dict[bytes, Array] = {}

        def errors(theta: Array) -> Array:
            known.clear()
            here = known[theta.tobytes()] = self.errors(theta, sizes)
            return here

        def slope(theta: Array) -> Array:
            here = known.get(theta.tobytes())
            return self.slope(theta, sizes, self.errors(theta, sizes) if here is None else here)

        result = least_squares(
            errors, inside, slope, bounds=(self.low, self.high), x_scale=self.scales, max_nfev=evaluations,
            xtol=1e-4, ftol=1e-5,
        )  # fmt: skip
        return np.asarray(result.x)


def _size(errors: Array) -> Array:
    finite = errors[np.isfinite(errors).all(axis=1)]
    return np.sqrt((finite**2).mean(axis=0)) if len(finite) else np.ones(errors.shape[1])
