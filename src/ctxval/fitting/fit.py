"""``fit``: models that are learned from recordings, each with its errors on recordings that were held out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval._util.representation import call, counted, record
from ctxval.core.model import Model, require_time_step
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.data.recordings import Recording, Recordings
from ctxval.errors import InputError, ModelError, UnknownNameError
from ctxval.fitting.least_squares import FittedParameter, as_bounds, fit_parameters
from ctxval.models import FeedforwardReLU, GaussianProcessModel, Linear
from ctxval.models.parametric import ParametricStep
from ctxval.replay.accuracy import RecordedSteps, StepError, step_errors
from ctxval.replay.report import plain_numbers

Kind = Literal["linear", "network", "gaussian-process", "parameters", "given"]
KINDS: tuple[Kind, ...] = get_args(Kind)[:4]
STEPS = (1, 20)
"""Numbers of steps after which the held-out errors are computed, unless others are given."""
HOLD_OUT = 0.25
"""Share of the recordings that is held out, unless another one is given."""

_UNITS = (32, 32)  # numbers of units in the hidden layers of the network
_POINTS = 400  # number of transitions that the Gaussian process is conditioned on
_MOST = 20_000  # largest number of transitions that a network is trained on; of more, every second, third, ... one is


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A model that was learned from recordings.

    Attributes:
        kind: its kind; ``given`` for a model that existed before.
        model: the model, with the transitions that it was learned from.
        errors: its errors on the held-out recordings.
        parameters: the parameters of the user's function; none for other kinds.
        notes: sentences on the fit, such as how well the recordings determine a linear model.
    """

    kind: Kind
    model: Model
    errors: tuple[StepError, ...]
    parameters: tuple[FittedParameter, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def relative(self) -> float:
        """The largest one-step error of a state on held-out recordings, as a share of its recorded change."""
        return max((one.relative for one in self.errors if one.steps == 1), default=float("inf"))

    @property
    def useless(self) -> str | None:
        """Why the model is no better than no model, in one sentence; None if it is.

        After one step, or after the largest number of steps, its error in a state is at least the recorded change.
        """
        last = max((one.steps for one in self.errors), default=0)
        worst = max((one for one in self.errors if one.steps in (1, last)), key=lambda one: one.relative, default=None)
        if worst is None or worst.relative < 1:
            return None
        return (
            f"the {self.kind} model is no better than to predict no change: its held-out error of {worst.state} after "
            f"{counted(worst.steps, 'step')} is {100 * worst.relative:.3g} % of the recorded change"
        )

    def __repr__(self) -> str:
        return call(self, self.kind, self.model, relative=self.relative)


@dataclass(frozen=True)
class FailedFit:
    """A kind of model that could not be learned from recordings.

    Attributes:
        kind: the kind.
        reason: why.
    """

    kind: Kind
    reason: str
    __repr__ = record


@dataclass(frozen=True, eq=False)
class FitReport:
    """Models that were learned from the same recordings, with their errors on the same held-out recordings.

    Attributes:
        fitted: the models, the most accurate first: that with the smallest error after the largest number of steps.
        failed: the kinds that could not be learned.
        learned_from, held_out: the recordings that models were learned from, and those that were held out.
    """

    fitted: tuple[FittedModel, ...]
    failed: tuple[FailedFit, ...]
    learned_from: Recordings
    held_out: Recordings

    def to_json(self) -> dict[str, Any]:
        """Return all results but the models as plain values; numbers that are not finite are None."""
        found = [
            {
                "kind": one.kind,
                "errors": [{**asdict(error), "relative": error.relative} for error in one.errors],
                "parameters": [asdict(parameter) for parameter in one.parameters],
                "notes": list(one.notes),
                "useless": one.useless,
            }
            for one in self.fitted
        ]
        sizes = {"recordings": len(self.learned_from.runs), "steps": self.learned_from.steps}
        held = {"recordings": len(self.held_out.runs), "steps": self.held_out.steps}
        failed = [asdict(one) for one in self.failed]
        report = {"fitted": found, "failed": failed, "learned_from": sizes, "held_out": held}
        return {**plain_numbers(report), "dt": self.held_out.dt, "notes": list(self.held_out.notes)}

    def __repr__(self) -> str:
        return call(self, [one.kind for one in self.fitted], failed=[one.kind for one in self.failed])


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
        recordings: the recordings.
        kinds: the kinds of models.
        step: the user's function ``(x, u, theta) -> x_next``, for the kind ``parameters``.
        bounds: the bounds of its parameters by name.
        vectorized: whether this function takes whole batches.
        given: a model that exists already, such as one that ``mujoco.sysid`` identified; its errors stand beside those
            of the others. It may have been learned from the recordings that are held out here.
        hold_out: the share of the recordings that is held out; of a single recording, its last part.
        steps: numbers of steps after which errors are computed.
        seed: seed of all random numbers.

    Raises:
        UnknownNameError: if there is no such kind.
        InputError: if no kind is given, if too little is recorded, if ``step`` or ``bounds`` is missing, or if the
            given model has another time step.
        ModelError: if the given model cannot predict the recordings.
    """
    _require_kinds(kinds, step, bounds)
    learned_from, held_out = split(recordings, hold_out, seed)
    data, _ = learned_from.transitions()

    def parameters() -> tuple[Model, tuple[FittedParameter, ...], tuple[str, ...]]:
        model, found = fit_parameters(step, bounds, data, vectorized=vectorized, seed=seed)  # type: ignore[arg-type]
        return model, found, ()

    makers: dict[Kind, Callable[[], tuple[Model, tuple[FittedParameter, ...], tuple[str, ...]]]] = {
        "linear": lambda: _linear(data, learned_from),
        "network": lambda: (FeedforwardReLU.fit(_some(data), _UNITS, seed=seed, restarts=2), (), ()),
        "gaussian-process": lambda: (GaussianProcessModel.fit(data, _POINTS, seed=seed), (), ()),
        "parameters": parameters,
    }
    fitted: list[FittedModel] = []
    failed: list[FailedFit] = []
    recorded = RecordedSteps(held_out, range(len(held_out.runs)))

    def errors_of(model: Model) -> tuple[StepError, ...]:
        return step_errors(model, recorded, sorted(set(steps)))

    with single_threaded():
        # Before anything is learned, because what is named must be usable.
        if given is not None:
            require_time_step(given, recordings.dt, "the recording")
        known = [] if given is None else [FittedModel("given", given, errors_of(given))]
        for kind in dict.fromkeys(kinds):
            try:
                model, found, notes = makers[kind]()
                fitted.append(FittedModel(kind, model, errors_of(model), found, notes))
            except (InputError, ModelError) as error:
                failed.append(FailedFit(kind, str(error)))
    return FitReport(tuple(sorted([*fitted, *known], key=_rank)), tuple(failed), learned_from, held_out)


def _require_kinds(
    kinds: Sequence[Kind], step: ParametricStep | None, bounds: Mapping[str, tuple[float, float]] | None
) -> None:
    for kind in kinds:
        if kind not in KINDS:
            raise UnknownNameError.among("kind of model", str(kind), KINDS)
    if not kinds:
        raise InputError(f"at least one kind of model is needed: {', '.join(KINDS)}.")
    if "parameters" in kinds:
        if step is None or not bounds:
            raise InputError("the kind 'parameters' needs a function (x, u, theta) -> x_next and the bounds of theta.")
        as_bounds(bounds)


def _rank(one: FittedModel) -> float:
    last = max((error.steps for error in one.errors), default=0)
    found = max((error.relative for error in one.errors if error.steps == last), default=np.inf)
    return found if np.isfinite(found) else np.inf


def split(recordings: Recordings, share: float, seed: int) -> tuple[Recordings, Recordings]:
    """Return the recordings to learn from, and those that are held out.

    Whole recordings are held out, drawn at random. Of a single recording, the last part is held out.
    """
    if not isinstance(share, int | float) or not 0 < share < 1:
        raise InputError(f"the share that is held out must be between 0 and 1, got {share!r}.")
    runs = recordings.runs
    if len(runs) == 1:
        horizon = runs[0].trajectory.horizon
        cut = round((1 - share) * horizon)
        if not 1 <= cut < horizon:
            raise InputError(f"the only recording has {counted(horizon, 'step')}: too few to hold a part out.")
        parts = [_part(runs[0], 0, cut), _part(runs[0], cut, horizon)]
        return replace(recordings, runs=(parts[0],)), replace(recordings, runs=(parts[1],))
    count = min(max(1, round(share * len(runs))), len(runs) - 1)
    chosen = set(np.random.default_rng(seed).permutation(len(runs))[:count].tolist())
    kept = tuple(run for number, run in enumerate(runs) if number not in chosen)
    return replace(recordings, runs=kept), replace(recordings, runs=tuple(runs[number] for number in sorted(chosen)))


def _part(run: Recording, first: int, last: int) -> Recording:
    one = run.trajectory
    times: Array = one.times[first : last + 1] - one.times[first]
    part = Trajectory(times, one.states[first : last + 1], one.inputs[first:last])
    return Recording(run.source, run.start + float(one.times[first]), part)


def _some(data: Transitions) -> Transitions:
    every = max(1, -(-len(data) // _MOST))
    return Transitions(data.x[::every], data.u[::every], data.x_next[::every])


def _linear(data: Transitions, recordings: Recordings) -> tuple[Model, tuple[FittedParameter, ...], tuple[str, ...]]:
    model = Linear.fit(data)
    return model, (), tuple(identifiability(data, [*recordings.states, *recordings.inputs]))


def identifiability(data: Transitions, names: Sequence[str]) -> list[str]:
    """Return sentences on how well transitions determine a linear model: the variance inflation of each regressor."""
    Z = np.concatenate([data.x, data.u], axis=1)
    deviations = Z.std(axis=0)
    still = [name for name, size in zip(names, deviations, strict=True) if size <= 0]
    if still:
        return [f"{', '.join(still)} never changes, so its coefficients are not determined"]
    correlation = np.corrcoef(Z, rowvar=False).reshape(len(names), -1)
    inflation = np.sqrt(np.diag(np.linalg.pinv(correlation)))
    weak = [name for name, ratio in zip(names, inflation, strict=True) if ratio > 30.0]
    worst = float(inflation.max())
    if weak:
        return [
            f"{' and '.join(weak)} nearly depend on each other in these recordings: the standard errors of their "
            f"coefficients are up to {worst:.2g} times those of independent excitation"
        ]
    return [
        f"all states and inputs vary independently enough: standard errors of coefficients are at most {worst:.2g} "
        "times those of independent excitation"
    ]
