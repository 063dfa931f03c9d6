"""The methods by which a model is learned again from executions."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from ctxval._util.arrays import Array, Mask, single_threaded
from ctxval._util.checked import checked, require
from ctxval._util.representation import ShortRepr
from ctxval._util.texts import reason_of
from ctxval.campaign.campaign import Campaign
from ctxval.core.model import Model, Step, as_model
from ctxval.core.state_geometry import PLAIN, geometry_of
from ctxval.core.trajectory import Transitions
from ctxval.errors import CtxvalError, InputError, ModelError, UnknownNameError
from ctxval.learning import PosteriorSettings, learn_posterior
from ctxval.learning.effects import ModelWithEffects
from ctxval.learning.effects.fit import Segments, explained
from ctxval.learning.histories import History, Record, Structure
from ctxval.learning.innovations import fit_lagged
from ctxval.learning.residual_data import floors
from ctxval.models import Corrected, Correction, FeedforwardReLU, GaussianProcessModel, Linear, Parametric
from ctxval.models.parametric import ParametricStep
from ctxval.studies.causes import CauseReport, find_causes
from ctxval.studies.fitting import FittedParameter, fit_parameters
from ctxval.studies.fitting.fit import as_bounds, learned_model
from ctxval.studies.refinement.held_out import HeldOut, Records, held_out
from ctxval.studies.replay.accuracy import stepped

_CENTRES = 300  # largest number of transitions that a correction is conditioned on

RefitKind = Literal["linear", "network", "gaussian-process"]
_KINDS: dict[str, type[Model]] = {
    "linear": Linear, "network": FeedforwardReLU, "gaussian-process": GaussianProcessModel
}  # fmt: skip
NAMES = ("residual", "causes", *_KINDS, "parameters", "fit")  #: the names of the methods on the command line


@dataclass(frozen=True, eq=False)
class Learned(ShortRepr):
    """A model that was learned from records, with its errors on records that were held out."""

    model: Model
    errors: HeldOut
    notes: tuple[str, ...] = ()
    parameters: tuple[FittedParameter, ...] = ()  #: those of the user's function; none for other methods


class Method(ABC):
    """A method that learns a model from records. It is a function of the model and the records."""

    name: str
    makes: type[Model] | None = None  #: the type of the models that it learns; None if it may be any

    @abstractmethod
    def learn(self, model: Model, records: Records) -> Learned:
        """Return the model that is learned from records; ``model`` is the first one, which is corrected or replaced.

        An InputError says that the records do not suffice; a ModelError, that the learned model is not usable.
        """


@dataclass(frozen=True)
class ResidualCorrection(ShortRepr, Method):
    """The first model with a correction: the mean of Gaussian processes of its residual.

    A state is corrected only if this lowers the error on executions that are held out. Outside the range of the
    records the correction fades, so that the model is as before. It is conditioned on at most 300 transitions.
    If this leaves much of the error, as with noise, it is compared with a process of low rank that is conditioned on
    all transitions.
    """

    name: str = field(default="residual", init=False)
    makes = Corrected

    def learn(self, model: Model, records: Records) -> Learned:
        def left_by(correction: Callable[[Model, Records], Correction | None]) -> HeldOut:
            def corrected(some: Records) -> Model:
                learned = correction(model, some)
                return model if learned is None else Corrected(model, learned)

            return held_out(corrected, model, records)

        correction, errors = exact_correction, left_by(exact_correction)
        if errors.left > 0.1:  # much of the error
            averaged = left_by(averaged_correction)
            if averaged.left < errors.left:
                correction, errors = averaged_correction, averaged
        better, whole = errors.better, correction(model, records)
        if whole is None or not better.any():
            raise InputError(
                "no state can be corrected: on executions that were held out, the residual of the model is not "
                "predicted from state and input. A state may be missing, such as a temperature or a delay, or the "
                "executions have too little in common."
            )
        worth: Mask = np.asarray(errors.rms_before > 1e-7 * errors.changes.std(axis=0))
        rows = ", ".join(str(i) for i in np.flatnonzero(worth & ~better).tolist())
        note = f"not corrected, because the error on held-out executions would not fall: state {rows}"
        learned = Corrected(model, whole.of_states(better), data=records.transitions)
        return Learned(learned, errors.kept(better), (note,) if rows else ())


@dataclass(frozen=True, eq=False)
class CauseRepair(ShortRepr, Method):
    """The first model with the causes that executions of its campaign name, with sizes fitted to all executions."""

    campaign: Campaign
    thinking: float | None = None  #: seconds, as in ``find_causes``
    name: str = field(default="causes", init=False)
    makes = ModelWithEffects

    @functools.cached_property
    def report(self) -> CauseReport:
        """The causes, which a model can have."""
        report = find_causes(self.campaign, thinking=self.thinking)
        if report.repaired is None:
            raise InputError(f"no cause is known that a model could have. {report.sentence}")
        if not report.repaired.complete:
            why = "a step of a model depends on state and input alone, so it cannot have this cause"
            raise InputError(f"{why}. {report.sentence}")
        return report

    def learn(self, model: Model, records: Records) -> Learned:
        self.campaign.validation.require_states("the method 'causes'")
        best = self.report.explained[0].explanation

        def repaired(some: Records) -> ModelWithEffects:
            if not some.executed:
                raise InputError("the method 'causes' needs executions with trajectories.")
            with single_threaded():
                segments = Segments(model, some.executed, known=best.repaired.effects)
                return explained(segments, best.candidates, best.sizes).repaired

        learned = repaired(records)
        note = " and ".join(effect.sentence(self.report.plant) for effect in learned.effects)
        return Learned(learned, held_out(repaired, model, records), (note,))


class _Replacement(Method):
    @abstractmethod
    def _fit(self, model: Model, data: Transitions) -> tuple[Model, tuple[FittedParameter, ...]]: ...

    def learn(self, model: Model, records: Records) -> Learned:
        """Return the new model, which gives finite states of the right shape at recorded pairs."""
        data = records.transitions
        learned, parameters = self._fit(model, data)
        rows = np.linspace(0, len(data) - 1, min(50, len(data))).astype(int)
        if not np.isfinite(stepped(learned, data.x[rows], data.u[rows])).all():
            raise ModelError("the learned model returns NaN or infinity on recorded states and inputs.")
        errors = held_out(lambda some: self._fit(model, some.transitions)[0], model, records)
        return Learned(learned, errors, parameters=parameters)


@dataclass(frozen=True)
class Refit(ShortRepr, _Replacement):
    """A new model of a kind of :func:`ctxval.studies.fitting.fit`, in place of the first model."""

    kind: RefitKind
    seed: int = 0
    name: str = field(init=False, repr=False)

    def __post_init__(self) -> None:
        require("kind", RefitKind, self.kind)
        object.__setattr__(self, "name", self.kind)
        object.__setattr__(self, "makes", _KINDS[self.kind])

    def _fit(self, model: Model, data: Transitions) -> tuple[Model, tuple[FittedParameter, ...]]:
        with single_threaded():
            return learned_model(self.kind, data, _CENTRES, self.seed), ()


@dataclass(frozen=True, eq=False)
class ParameterFit(ShortRepr, _Replacement):
    """New values of the parameters of a user's function ``(x, u, theta) -> x_next``, by least squares."""

    bounds: Mapping[str, tuple[float, float]]  #: the bounds of each parameter by name, in the order of theta
    step: ParametricStep | None = None  #: the function; None for that of the first model, a ``Parametric``
    vectorized: bool = False  #: whether ``step`` takes whole batches
    name: str = field(default="parameters", init=False)
    makes = Parametric

    def __post_init__(self) -> None:
        as_bounds(self.bounds)

    def _fit(self, model: Model, data: Transitions) -> tuple[Model, tuple[FittedParameter, ...]]:
        if self.step is not None:
            return fit_parameters(self.step, self.bounds, data, vectorized=self.vectorized)
        if isinstance(model, Parametric):
            return fit_parameters(model.function, self.bounds, data, vectorized=model.vectorized)
        raise InputError(
            "the method 'parameters' needs the function step (--step), because the model is not a Parametric."
        )


@checked
@dataclass(frozen=True, eq=False)
class UserFit(ShortRepr, _Replacement):
    """The user's own function ``fit(data) -> model``, which must always return the same for the same data."""

    fit: Callable[[Transitions], Model | Step]
    name: str = field(default="fit", init=False)

    def _fit(self, model: Model, data: Transitions) -> tuple[Model, tuple[FittedParameter, ...]]:
        try:
            return as_model(self.fit(data)), ()
        except (Exception, SystemExit) as error:
            why = str(error) if isinstance(error, CtxvalError) else f"{reason_of(error)}."
            raise InputError(f"the fit failed: {why}") from error


def method_of(method: str | Method | Callable[[Transitions], Any], *, seed: int = 0) -> Method:
    """Return a method by its name, a method unchanged, and a function ``fit(data) -> model`` as a method."""
    if isinstance(method, Method):
        return method
    if not isinstance(method, str):
        return UserFit(method)
    if method == "residual":
        return ResidualCorrection()
    if method in _KINDS:
        return Refit(method, seed)  # type: ignore[arg-type]
    needs = {
        "parameters": "bounds: give refinement.ParameterFit({'mass': (0.5, 2.0)})",
        "causes": "the campaign: give refinement.CauseRepair(campaign)",
        "fit": "a function: give the function fit(data) -> model itself",
    }
    if method in needs:
        raise InputError(f"the method {method!r} needs {needs[method]}.")
    raise UnknownNameError.among("method of refinement", method, NAMES)


# Corrections: the mean of the residual dynamics, exact or averaged


def exact_correction(model: Model, records: Records) -> Correction | None:
    """Return the mean of Gaussian processes of the residual at representative transitions; None if M explains all."""
    # Matern 5/2 that does not grow with the inputs.
    settings = PosteriorSettings(hyperparameters=1, centres=_CENTRES, families=((2.5, 0.0),), of_steps=False)
    posterior = learn_posterior(model, records.transitions, records.sources, settings=settings)
    if posterior is None:
        return None
    # At least 24 centres are kept, if they predict the others with a relative error of 0.005: design on the model is
    # then faster.
    data, mean = posterior.data, posterior.with_few_centres(24, 0.005)
    (centres,), values = mean.centres, np.exp(mean.thetas[0])
    scales, constant, slope = values[:-2], values[-2], values[-1]
    weights = np.zeros((len(centres), len(data.units)))
    weights[:, data.learned] = mean.weights[0]
    weights *= data.units
    linear = np.concatenate([slope * centres.T @ weights, constant * weights.sum(axis=0, keepdims=True)])
    limit = posterior.limit * data.units
    return _correction(data.shift, data.scale, data.pairs, centres, scales, weights, linear, limit)


def averaged_correction(model: Model, records: Records) -> Correction | None:
    """Return the mean of a Gaussian process of low rank, averaging noise of plain vectors; None if there is none."""
    if geometry_of(model) != PLAIN:
        return None
    runs = [Record(run.states, run.inputs, run.states[0]) for run in records.executed]
    if records.own is not None:
        of_model = records.own[:: max(1, len(records.own) // 50_000)]  # of more, only a part is averaged
        steps = zip(of_model.x, of_model.u, of_model.x_next, strict=True)
        runs += [Record(np.stack([x, after]), u[None], x) for x, u, after in steps]
    data = records.transitions
    k, fit = data.x.shape[1] + data.u.shape[1], None
    # Numbers may not be finite.
    with suppress(np.linalg.LinAlgError, ValueError), single_threaded(), np.errstate(all="ignore"):
        sizes = np.sqrt(((data.x_next - model.step(data.x, data.u)) ** 2).mean(axis=0))
        live = sizes > floors(data.x_next, data.x_next - data.x)
        if live.any():
            history = History(model, Structure(), np.eye(len(live)))
            fit = fit_lagged(history, runs, np.zeros((0, k)), None, live, products=False)
    if fit is None:
        return None
    scaled, features, function = fit.scaled, fit.features, fit.features.function(fit.weights)
    linear = features.linear * np.roll(function.linear[: k + 1], -1, axis=0)  # the constant is the last row
    limit = 5.0 * np.abs(scaled.E).max(axis=0)
    scales = np.exp(features.theta[1:])
    return _correction(scaled.shift, scaled.scale, scaled.Z, features.centres, scales, function.matern, linear, limit)


def _correction(
    shift: Array, scale: Array, pairs: Array, centres: Array, scales: Array, weights: Array, linear: Array, limit: Array
) -> Correction:
    low, high = pairs.min(axis=0), pairs.max(axis=0)
    # A coordinate that the residual does not depend on fades the correction within one more range of the records.
    fade = np.minimum(scales, np.maximum(high - low, 1.0))
    return Correction(shift, scale, centres, scales, weights, linear, low, high, fade, limit)
