"""``fit``: models that are learned from recordings, each with its errors on recordings that were held out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, get_args

import numpy as np
import scipy

from ctxval._util.arrays import Array, single_threaded
from ctxval._util.checked import Must, require
from ctxval._util.describe import plain_json
from ctxval._util.representation import ShortRepr, counted
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.data.recordings import Recordings
from ctxval.errors import InputError, ModelError, UnknownNameError
from ctxval.models import FeedforwardReLU, GaussianProcessModel, Linear, Parametric
from ctxval.models.parametric import ParametricStep
from ctxval.studies.replay.accuracy import StepError, step_errors, stepped, useless
from ctxval.studies.replay.units import in_units_of

Kind = Literal["linear", "network", "gaussian-process", "parameters", "given"]
KINDS: tuple[Kind, ...] = get_args(Kind)[:4]
STEPS = (1, 20)  #: numbers of steps after which the held-out errors are computed, unless others are given
HOLD_OUT = 0.25  #: share of the recordings that is held out, unless another one is given


@dataclass(frozen=True)
class FittedParameter(ShortRepr):
    """One parameter of a model."""

    name: str
    value: float  #: the estimate and the confidence interval, which is infinite if the recordings determine none
    low: float
    high: float
    note: str = ""  #: what is unusual: the value is at a bound, or depends on others; empty otherwise


@dataclass(frozen=True, eq=False)
class FittedModel(ShortRepr):
    """A model that was learned from recordings."""

    kind: Kind  #: ``given`` for a model that existed before
    model: Model
    errors: tuple[StepError, ...]  #: those on the held-out recordings
    parameters: tuple[FittedParameter, ...] = ()  #: those of the user's function; none for other kinds
    notes: tuple[str, ...] = ()  #: sentences on the fit, such as how well the recordings determine a linear model

    @property
    def relative(self) -> float:
        """The largest one-step error of a state on held-out recordings, as a share of its recorded change."""
        return max((error.relative for error in self.errors if error.steps == 1), default=float("inf"))

    @property
    def steps(self) -> int:
        """The largest number of steps after which there are errors; 0 if there are none."""
        return max((error.steps for error in self.errors), default=0)

    @property
    def useless(self) -> str | None:
        """Why the model is no better than no model after one step, or after the largest number; None if it is."""
        if (worst := useless(self.errors)) is None:
            return None
        return (
            f"the {self.kind} model is no better than to predict no change: its held-out error of {worst.state} after "
            f"{counted(worst.steps, 'step')} is {100 * worst.relative:.3g} % of the recorded change"
        )


@dataclass(frozen=True)
class FailedFit(ShortRepr):
    """A kind of model that could not be learned from recordings."""

    kind: Kind
    reason: str


@dataclass(frozen=True, eq=False)
class FitReport(ShortRepr):
    """Models that were learned from the same recordings, with their errors on the same held-out recordings."""

    fitted: tuple[FittedModel, ...]  #: that with the smallest error after the largest number of steps is the first
    failed: tuple[FailedFit, ...]
    learned_from: Recordings
    held_out: Recordings

    def to_json(self) -> dict[str, Any]:
        """Return all results but the models as plain values; numbers that are not finite are None."""
        names = ("kind", "errors", "parameters", "notes", "useless")
        fitted = [{name: getattr(model, name) for name in names} for model in self.fitted]
        parts = {"learned_from": self.learned_from, "held_out": self.held_out}
        sizes = {name: {"recordings": len(part.runs), "steps": part.steps} for name, part in parts.items()}
        about = {"dt": self.held_out.dt, "notes": self.held_out.notes}
        return plain_json({"fitted": fitted, "failed": self.failed, **sizes, **about})


def fit(
    recordings: Recordings,
    kinds: Sequence[Kind] = KINDS[:3],
    *,
    step: ParametricStep | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    vectorized: bool = False,
    given: Model | None = None,
    hold_out: float = HOLD_OUT,
    steps: Sequence[int] = STEPS,
    seed: int = 0,
) -> FitReport:
    """Learn models from recordings; a part of the recordings is held out and never learned from.

    Args:
        step: the user's function ``(x, u, theta) -> x_next``, for the kind ``parameters``.
        bounds: the bounds of its parameters by name.
        vectorized: whether this function takes whole batches.
        given: a model that exists already, such as one that ``mujoco.sysid`` identified; its errors stand beside those
            of the others. It may have been learned from the recordings that are held out here.
        hold_out: the share of the recordings that is held out; of a single recording, its last part.
        steps: numbers of steps after which errors are computed.

    Raises:
        InputError: if no kind is given, or ``parameters`` without a step and bounds.
    """
    if unknown := [str(kind) for kind in kinds if kind not in KINDS]:
        raise UnknownNameError.among("kind of model", unknown[0], KINDS)
    if not kinds:
        raise InputError(f"at least one kind of model is needed: {', '.join(KINDS)}.")
    if "parameters" in kinds:
        if step is None or not bounds:
            raise InputError("the kind 'parameters' needs a function (x, u, theta) -> x_next and the bounds of theta.")
        as_bounds(bounds)
    recordings = recordings if given is None else in_units_of(given, recordings)
    learned_from, held_out = split(recordings, hold_out, seed)
    data, _ = learned_from.transitions()
    fitted, failed = list[FittedModel](), list[FailedFit]()

    def add(kind: Kind, model: Model, parameters: tuple[FittedParameter, ...] = ()) -> None:
        notes = (identifiability(data, [*recordings.states, *recordings.inputs]),) if kind == "linear" else ()
        fitted.append(FittedModel(kind, model, step_errors(model, held_out, sorted(set(steps))), parameters, notes))

    with single_threaded():
        # Before anything is learned, because what is named must be usable.
        if given is not None:
            add("given", given)
        for kind in dict.fromkeys(kinds):
            try:
                if kind == "parameters":
                    assert step is not None
                    add(kind, *fit_parameters(step, bounds or {}, data, vectorized=vectorized, seed=seed))
                else:  # of too many transitions, a network learns from every second, third, ...
                    every = max(1, -(-len(data) // 20_000)) if kind == "network" else 1
                    add(kind, learned_model(kind, data if every == 1 else data[::every], 400, seed))
            except (InputError, ModelError) as error:
                failed.append(FailedFit(kind, str(error)))

    def rank(model: FittedModel) -> tuple[float, bool]:
        relative = max((error.relative for error in model.errors if error.steps == model.steps), default=np.inf)
        return relative if np.isfinite(relative) else np.inf, model.kind == "given"

    return FitReport(tuple(sorted(fitted, key=rank)), tuple(failed), learned_from, held_out)


def learned_model(kind: str, data: Transitions, centres: int, seed: int) -> Model:
    """Return the linear model, the network or the Gaussian process that is learned from transitions."""
    if kind == "linear":
        return Linear.fit(data)
    if kind == "network":
        return FeedforwardReLU.fit(data, (32, 32), seed=seed, restarts=2)
    return GaussianProcessModel.fit(data, centres, seed=seed)


def split(recordings: Recordings, share: float, seed: int) -> tuple[Recordings, Recordings]:
    """Return the recordings to learn from, and those that are held out, drawn at random; of one, the last part is."""
    inside = Must("between 0 and 1", lambda share: 0 < share < 1)
    require("the share that is held out", Annotated[float, inside], share)
    runs = recordings.runs
    if len(runs) == 1:
        run, horizon = runs[0], runs[0].trajectory.horizon
        cut = round((1 - share) * horizon)
        if not 1 <= cut < horizon:
            raise InputError(f"the only recording has {counted(horizon, 'step')}: too few to hold a part out.")
        first, start = replace(run, trajectory=part_of(run.trajectory, 0, cut)), float(run.trajectory.times[cut])
        last = replace(run, start=run.start + start, trajectory=part_of(run.trajectory, cut, horizon))
        return replace(recordings, runs=(first,)), replace(recordings, runs=(last,))
    count = min(max(1, round(share * len(runs))), len(runs) - 1)
    chosen = np.sort(np.random.default_rng(seed).permutation(len(runs))[:count]).tolist()
    kept = tuple(run for number, run in enumerate(runs) if number not in chosen)
    return replace(recordings, runs=kept), replace(recordings, runs=tuple(runs[number] for number in chosen))


def part_of(run: Trajectory, first: int, last: int) -> Trajectory:
    """Return the steps of a trajectory from one to another one; its times begin at 0."""
    times: Array = run.times[first : last + 1] - run.times[first]
    return Trajectory(times, run.states[first : last + 1], run.inputs[first:last])


def identifiability(data: Transitions, names: Sequence[str]) -> str:
    """Return how well transitions determine a linear model: the variance inflation of each regressor."""
    Z = np.concatenate([data.x, data.u], axis=1)
    still = [name for name, size in zip(names, Z.std(axis=0), strict=True) if size <= 0]
    if still:
        return f"{', '.join(still)} never changes, so its coefficients are not determined"
    inflation = np.sqrt(np.diag(np.linalg.pinv(np.corrcoef(Z, rowvar=False).reshape(len(names), -1))))
    weak = [name for name, ratio in zip(names, inflation, strict=True) if ratio > 30.0]
    worst = float(inflation.max())
    if weak:
        return (
            f"{' and '.join(weak)} nearly depend on each other in these recordings: the standard errors of their "
            f"coefficients are up to {worst:.2g} times those of independent excitation"
        )
    return (
        f"all states and inputs vary independently enough: standard errors of coefficients are at most {worst:.2g} "
        "times those of independent excitation"
    )


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
        vectorized: whether ``step`` takes whole batches.

    Raises:
        InputError: if there are too few records.
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
        return scipy.optimize.least_squares(
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
    ordered = Must("two numbers, the lower one first", lambda pair: -np.inf < pair[0] < pair[1] < np.inf)
    for name, pair in bounds.items():
        require(f"the bounds of {name}", Annotated[tuple[float, float], ordered], pair)
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
    reach = np.where(undetermined, np.inf, deviations * scipy.special.stdtrit(degrees, 0.5 + confidence / 2))
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
