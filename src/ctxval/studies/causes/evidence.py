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

_SEVERAL = 8  # steps of the longer predictions
_MOST = (1200, 240)  # predictions of one step, and of several
_EXACT, _NEGLIGIBLE = 0.01, 1e-3  # what is smaller is no evidence: shares of the residuals of M, and of the changes
_LARGEST = 1e3  # of a residual, as a multiple of the typical one of M


@dataclass(frozen=True, eq=False)
class Windows(ShortRepr):
    """Predictions over some steps: where they begin, and residuals that are too small to be evidence.

    Attributes:
        steps: after so many steps, predictions are compared with what is recorded.
        states, inputs: rows of the first state and of the first input, shape ``(N,)``.
        floors: shape ``(n,)``.
    """

    steps: int
    states: Rows
    inputs: Rows
    floors: Array


class Records:
    """Recorded executions, and what M misses in them.

    Attributes:
        states, inputs: of all runs, one after the other, ``(N + k, n)`` and ``(N, m)``.
        windows: predictions of one step, and of several.
        sizes: of the residuals of M in these, shape ``(n,)`` each.
    """

    def __init__(
        self,
        model: Model,
        runs: Sequence[Trajectory],
        floors: Sequence[Array] | None = None,
        most: tuple[int, int] = _MOST,
    ) -> None:
        self.model, self.horizons = model, [len(run.inputs) for run in runs]
        self.states = np.concatenate([run.states for run in runs])
        self.inputs = np.concatenate([run.inputs for run in runs])
        self.windows: list[Windows] = []
        nothing, n = Repaired(model, ()), self.states.shape[1]
        for number, steps in enumerate((1, _SEVERAL)):
            window = self._window(min(steps, min(self.horizons)), most[number], np.zeros(n))
            left = self.left_by(nothing, window)
            changes = _size(self.states[window.states + window.steps] - self.states[window.states])
            least = np.hypot(_EXACT * _size(left), _NEGLIGIBLE * changes) if floors is None else floors[number]
            self.windows.append(replace(window, floors=np.maximum(least, 1e-15)))
        self.sizes = [np.maximum(_size(self.left_by(nothing, window)), window.floors) for window in self.windows]

    def _window(self, steps: int, most: int, floors: Array) -> Windows:
        states, inputs, first = [], [], 0
        for number, horizon in enumerate(self.horizons):
            begins = np.arange(0, horizon - steps + 1, max(1, steps // 2))
            states.append(first + number + begins)
            inputs.append(first + begins)
            first += horizon
        of_states, of_inputs = np.concatenate(states), np.concatenate(inputs)
        rows = np.linspace(0, len(of_states) - 1, min(len(of_states), most)).round().astype(np.intp)
        return Windows(steps, of_states[rows], of_inputs[rows], floors)

    @property
    def pairs(self) -> tuple[Array, Array, Array]:
        """The states, inputs and residuals of M in the predictions of one step, shapes ``(N, ...)``."""
        window = self.windows[0]
        residuals = -self.left_by(Repaired(self.model, ()), window)
        return self.states[window.states], self.inputs[window.inputs], residuals

    def left_by(self, repaired: Repaired, window: Windows) -> Array:
        """Return predicted minus recorded states ``(N, n)``."""
        ends = np.cumsum(self.horizons)[:-1]
        acting = np.concatenate([repaired.acting(inputs) for inputs in np.split(self.inputs, ends)])
        x = repaired.true(self.states[window.states])
        for k in range(window.steps):
            x = repaired.reached(x, acting[window.inputs + k])
        return np.asarray(repaired.recorded(x) - self.states[window.states + window.steps])

    def measured(self, repaired: Repaired) -> tuple[float, float]:
        """Return minus twice the log-likelihood, and the share of the squared residuals of M that is left."""
        misfit, left = 0.0, 0.0
        for window, sizes in zip(self.windows, self.sizes, strict=True):
            errors = np.clip(
                np.nan_to_num(self.left_by(repaired, window), nan=np.inf), -_LARGEST * sizes, _LARGEST * sizes
            )
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
    def count(self) -> int:
        """The number of sizes."""
        return sum(len(each.scales) for each in self.candidates)


def explained(records: Records, candidates: tuple[Candidate, ...], begun: Repaired | None = None) -> Explanation:
    """Return causes whose sizes are fitted to records by nonlinear least squares, from one or from several starts.

    The residuals of each state are first divided by those of M, and then by what is left of them.

    Args:
        begun: the same causes with sizes of a former fit.
    """
    low, high, scales = (
        np.array([value for each in candidates for value in getattr(each, name)]) for name in ("low", "high", "scales")
    )

    def repaired(theta: Array) -> Repaired:
        causes, rest = [], theta
        for each in candidates:
            count = len(each.scales)
            causes.append(each.cause.with_sizes(rest[:count].tolist()))
            rest = rest[count:]
        return Repaired(records.model, tuple(causes))

    def errors(theta: Array, sizes: Sequence[Array]) -> Array:
        model, parts = repaired(theta), []
        for window, size in zip(records.windows, sizes, strict=True):
            left = np.nan_to_num(records.left_by(model, window) / size, nan=_LARGEST).clip(-_LARGEST, _LARGEST)
            parts.append(left.ravel() / np.sqrt(len(left)))
        return np.concatenate(parts)

    def best(start: Array, sizes: Sequence[Array], steps: int) -> Array:
        def slope(theta: Array) -> Array:
            here, columns = errors(theta, sizes), []
            for i, step in enumerate(1e-3 * scales):
                moved = theta.copy()
                moved[i] += step if moved[i] + step <= high[i] else -step
                columns.append((errors(moved, sizes) - here) / (moved[i] - theta[i]))
            return np.stack(columns, axis=1)

        inside = np.clip(start, low + 1e-9 * scales, high - 1e-9 * scales)
        found = least_squares(
            lambda theta: errors(theta, sizes), inside, slope, bounds=(low, high), x_scale=scales, max_nfev=steps,
            xtol=1e-5, ftol=1e-6,
        )  # fmt: skip
        return np.asarray(found.x)

    theta = np.array([])
    if len(scales):
        if begun is not None:
            starts = [np.array([size for cause in begun.causes for size in cause.sizes])]
        else:
            known = [np.array(each.cause.sizes) for each in candidates[:-1]]
            starts = [np.concatenate([*known, start]) for start in candidates[-1].starts]
        costs = [float((errors(start, records.sizes) ** 2).sum()) for start in starts]
        theta = starts[int(np.argmin(costs))]
        theta = best(theta, records.sizes, 12)
        model = repaired(theta)
        sizes = [
            np.clip(np.hypot(_size(records.left_by(model, window)), window.floors), window.floors, size)
            for window, size in zip(records.windows, records.sizes, strict=True)
        ]
        theta = best(theta, sizes, 8)
    model = repaired(theta)
    misfit, left = records.measured(model)
    fitted = tuple(
        Candidate(cause, each.low, each.high, each.scales, each.starts)
        for each, cause in zip(candidates, model.causes, strict=True)
    )
    count = len(theta) + len(candidates)  # which cause it is counts like a size
    return Explanation(fitted, model, misfit + count * float(np.log(len(records.windows[0].states))), left)


def _size(errors: Array) -> Array:
    finite = errors[np.isfinite(errors).all(axis=1)]
    return np.sqrt((finite**2).mean(axis=0)) if len(finite) else np.ones(errors.shape[1])
