"""Parameters of a user's own model by least squares, with bounds and confidence intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.special import stdtrit

from ctxval._util.arrays import Array, single_threaded
from ctxval._util.representation import ShortRepr
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError
from ctxval.models import Parametric
from ctxval.models.parametric import ParametricStep
from ctxval.studies.replay.accuracy import stepped


@dataclass(frozen=True)
class FittedParameter(ShortRepr):
    """One parameter of a model.

    Attributes:
        value: the estimate.
        low, high: the confidence interval; infinite if the recordings do not determine the parameter.
        note: what is unusual: the value is at a bound, or depends on others; empty otherwise.
    """

    name: str
    value: float
    low: float
    high: float
    note: str = ""


def fit_parameters(
    step: ParametricStep,
    bounds: Mapping[str, tuple[float, float]],
    data: Transitions,
    *,
    vectorized: bool = False,
    confidence: float = 0.95,
    seed: int = 0,
) -> tuple[Parametric, tuple[FittedParameter, ...]]:
    """Return a model with the parameters of least squared one-step errors, and their confidence intervals.

    The errors of each state are divided by their size at the estimate, so that states of different units count alike
    (two rounds). The intervals assume that the model is right and that the errors of the steps are independent. Noise
    of the measured states biases the estimate.

    Args:
        step: the user's function ``(x, u, theta) -> x_next``.
        bounds: the lower and upper bound of each parameter by name, in the order of theta.
        data: the recorded transitions.
        vectorized: whether ``step`` takes whole batches.
        confidence: the confidence of each interval.
        seed: seed of the starting points.
    """
    low, high = as_bounds(bounds)
    some = data[:: max(1, -(-len(data) // 4000))]
    if some.x.size <= len(low):
        raise InputError(f"{len(low)} parameters need more than {some.x.size} recorded numbers.")
    sizes = np.maximum((some.x_next - some.x).std(axis=0), 1e-12)

    def errors(theta: Array, recorded: Transitions) -> Array:
        model = Parametric(step, dict(zip(bounds, theta, strict=True)), vectorized=vectorized)
        # Parameters for which the model diverges are far from the estimate; the search needs finite numbers.
        left = stepped(model, recorded.x, recorded.u) - recorded.x_next
        return np.nan_to_num(left, nan=1e6, posinf=1e6, neginf=-1e6).clip(-1e6, 1e6)

    def best(start: Array, recorded: Transitions) -> Any:
        return least_squares(
            lambda theta: (errors(theta, recorded) / sizes).ravel(), start, bounds=(low, high), x_scale=high - low
        )

    with single_threaded():
        rng = np.random.default_rng(seed)
        starts = np.concatenate([[0.5 * (low + high)], rng.uniform(low, high, (7, len(low)))])
        few = some[:: max(1, len(some) // 400)]
        theta = min((best(start, few) for start in starts), key=lambda result: result.cost).x
        sizes = np.maximum(np.sqrt((errors(theta, some) ** 2).mean(axis=0)), 1e-9 * sizes)
        result = best(theta, some)
    intervals = _intervals(list(bounds), result.x, result.jac, result.fun, (low, high), confidence)
    return Parametric(step, dict(zip(bounds, result.x, strict=True)), vectorized=vectorized, data=data), intervals


def as_bounds(bounds: Mapping[str, tuple[float, float]]) -> tuple[Array, Array]:
    """Return the lower and the upper bounds of parameters, shapes ``(p,)``."""
    if not bounds:
        raise InputError("at least one parameter with its bounds is needed, such as mass = [0.5, 2.0].")
    for name, pair in bounds.items():
        valid = isinstance(pair, Sequence) and not isinstance(pair, str) and len(pair) == 2
        if not valid or not all(isinstance(b, int | float) and np.isfinite(b) for b in pair) or pair[0] >= pair[1]:
            raise InputError(f"the bounds of {name} must be two numbers, the lower one first, got {pair!r}.")
    ends = np.array([[float(b) for b in pair] for pair in bounds.values()])
    return ends[:, 0], ends[:, 1]


def _intervals(
    names: Sequence[str], theta: Array, J: Array, errors: Array, bounds: tuple[Array, Array], confidence: float
) -> tuple[FittedParameter, ...]:
    """Return the confidence intervals of least squares (Seber and Wild 1989, section 5.1)."""
    width = bounds[1] - bounds[0]
    _, singular, V = np.linalg.svd(J * width, full_matrices=False)
    degrees = max(len(errors) - len(theta), 1)
    variance = float((errors**2).sum()) / degrees
    # Beyond this condition number the data do not determine all parameters.
    weak = V[singular <= singular.max(initial=0.0) / 1e8] if singular.max(initial=0.0) > 0 else V
    undetermined = (np.abs(weak) > 0.1).any(axis=0) if len(weak) else np.zeros(len(theta), dtype=bool)
    with np.errstate(all="ignore"):
        deviations = width * np.sqrt(variance * ((V / singular[:, None]) ** 2).sum(axis=0))
    reach = np.where(undetermined, np.inf, deviations * stdtrit(degrees, 0.5 + confidence / 2))
    parameters = []
    for i, name in enumerate(names):
        ends = zip(("lower", "upper"), bounds, strict=True)
        near = [end for end, bound in ends if abs(theta[i] - bound[i]) <= 1e-4 * width[i]]
        others = [names[j] for j in np.flatnonzero(undetermined).tolist() if j != i]
        note = f"at its {near[0]} bound" if near else ""
        if undetermined[i]:
            note = f"not determined together with {', '.join(others)}" if others else "not determined"
        interval = float(theta[i] - reach[i]), float(theta[i] + reach[i])
        parameters.append(FittedParameter(name, float(theta[i]), *interval, note))
    return tuple(parameters)
