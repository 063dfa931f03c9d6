"""Inputs that act late: a delay and a lag of the actuators, found in executions, as a part of the controller.

What S does in a step then depends on earlier inputs. Recorded inputs tell which input acts in each step, so the
residual is a function of the state and of that input, and everything that is learned, covered and tested of state and
input holds. A closed loop has the acting inputs and those that were commanded, in this order; M, the user's controllers
and the distance see what was commanded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize

from ctxval._util.arrays import Array, Mask
from ctxval.core.controller import Controller, ControllerWithMemory, Synthesizer
from ctxval.core.distance import Distance
from ctxval.core.model import Model
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.learning.histories import History, Record, Structure
from ctxval.learning.hyperparameters import FAMILIES, HyperparameterPosterior, learning_rows, log_posterior
from ctxval.learning.innovations import fit_usual
from ctxval.learning.residual_data import NEGLIGIBLE
from ctxval.models.scaling import standard_deviations

_LONGEST = 6.0  # steps, of a delay and of a time constant
_DELAYS, _LAGS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0), (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
_TRIED = [*((each, 0.0) for each in _DELAYS), *((0.0, each) for each in _LAGS), (1.0, 1.0), (1.0, 2.0), (2.0, 2.0)]
_BETTER, _GOOD, _PROMISING, _EXACT = 0.1, 0.05, 0.5, 1e-3  # shares of squared errors; see `found_actuator`
_LEFT_OUT = 4  # records
_LEARNED_FROM = 150  # transitions


@dataclass(frozen=True)
class Actuator:
    """How the inputs act that a controller commands; before the first one, they are 0.

    Attributes:
        delay: steps by which inputs act late; between whole steps, two inputs act in parts.
        lag: time constant in steps with which the delayed inputs are followed; 0 if they are followed at once.
    """

    delay: float = 0.0
    lag: float = 0.0

    def follow(self, acting: Array, commanded: Sequence[Array]) -> Array:
        """Return the acting input ``(..., m)`` from the one before and all that were commanded, the latest first."""
        whole, share = int(self.delay), self.delay % 1.0
        due = np.zeros_like(acting)
        for weight, back in ((1.0 - share, whole), (share, whole + 1)):
            if weight and back < len(commanded):
                due = due + weight * commanded[back]
        return acting + (due - acting) * (1 - np.exp(-1 / self.lag)) if self.lag else due

    @property
    def remembered(self) -> int:
        """The number of commanded inputs that the next one depends on."""
        return int(self.delay) + 2

    def acting(self, inputs: Array) -> Array:
        """Return the inputs that act in each step, for commanded ones ``(..., H, m)``."""
        result, acting = np.empty_like(inputs), np.zeros_like(inputs[..., 0, :])
        for t in range(inputs.shape[-2]):
            latest = [inputs[..., t - back, :] for back in range(min(t + 1, self.remembered))]
            acting = self.follow(acting, latest)
            result[..., t, :] = acting
        return result


RecordsOf = Callable[[Actuator], Sequence[Record]]
"""Returns executions with the inputs that act, and with states that are estimated with these if they must be."""


def found_actuator(
    model: Model,
    records_of: RecordsOf,
    pairs: Array,
    before: Actuator | None = None,
    evaluations: int = 80,
) -> Actuator | None:
    """Return the delay and the lag with which each record is best predicted from the others; None if they do not help.

    They help if the squared error of left-out records, in the geometric mean, is at most a tenth of that without them,
    and at most 5 % of the residual of M.

    Args:
        pairs: states and inputs of closed loops on M, shape ``(V, n + m)``.
        before: one that was found in fewer executions.
        evaluations: how often records may be asked for while the actuator is refined, twice.

    Raises:
        LinAlgError: if states cannot be estimated.
    """
    plain = records_of(Actuator())
    history = History(model, Structure(0), np.eye(plain[0].states.shape[1]))
    sizes = (history.along(plain)[1] ** 2).mean(axis=0)
    steps = standard_deviations(np.concatenate([np.diff(record.states, axis=0) for record in plain]))
    live = np.sqrt(sizes) > NEGLIGIBLE * steps
    if not live.any():
        return None

    def error(actuator: Actuator) -> float:
        acting, squares = records_of(actuator), []
        for k in range(len(acting) - min(_LEFT_OUT, len(acting) - 1), len(acting)):
            fit = fit_usual(history, [*acting[:k], *acting[k + 1 :]], pairs, live)
            squares.append((history.along([acting[k]], fit.residual)[2][:, live] ** 2).mean(axis=0) / sizes[live])
        # A record that lies outside of the others is badly predicted with every actuator.
        return float(np.exp(np.log(np.maximum(squares, 1e-300)).mean(axis=0)).max())

    without = error(Actuator())
    if not without > _EXACT:
        return None
    best = min([*(Actuator(*each) for each in _TRIED), *([before] if before else [])], key=error)
    if not error(best) < _PROMISING * min(without, 1.0):
        return None
    for _ in range(2):  # the noise that a wrong actuator seems to add is less the second time
        best = _refined(best, history, records_of, live, evaluations)
    return best if error(best) < min(_BETTER * without, _GOOD) else None


def _refined(start: Actuator, history: History, records_of: RecordsOf, live: Mask, evaluations: int) -> Actuator:
    """Return the most likely actuator near one of which the hyperparameters of the residual are learned."""
    records = records_of(start)
    Z, E, _ = history.along(records)
    shift, scale, sizes = Z.mean(axis=0), standard_deviations(Z), np.sqrt((E[:, live] ** 2).mean(axis=0))
    inputs = records[0].inputs.shape[-1]
    rows = learning_rows((Z - shift) / scale, inputs, _LEARNED_FROM)
    Z, E = (Z[rows] - shift) / scale, E[rows][:, live] / sizes
    mode = HyperparameterPosterior.given(Z, E, inputs, FAMILIES[:1]).mode
    place = np.append(mode.theta, np.log(mode.noise))

    def unlikely(each: Array) -> float:
        Z, E, _ = history.along(records_of(Actuator(*np.clip(each, 0.0, _LONGEST).tolist())))
        Z, E = (Z[rows] - shift) / scale, E[rows][:, live] / sizes
        return -log_posterior(mode.kernel, place, Z, E)[0]

    at = np.array([start.delay, start.lag])
    simplex = at + np.array([[0.0, 0.0], [0.25, 0.0], [0.0, 0.25]])
    options = {"initial_simplex": simplex, "maxfev": evaluations, "xatol": 1e-5, "fatol": 1e-3}
    return Actuator(*np.clip(minimize(unlikely, at, method="Nelder-Mead", options=options).x, 0.0, _LONGEST).tolist())


# A closed loop whose inputs are those that act, followed by those that were commanded


def with_actuator(validation: Validation, actuator: Actuator | None, inputs: int) -> Validation:
    """Return a validation whose controllers have an actuator and return both inputs ``(..., 2 m)``; itself if None.

    Its system is that of the given one, and cannot be executed.
    """
    if actuator is None:
        return validation
    return validation.with_parts(
        model=_OfCommands(validation.model, inputs),
        synthesizer=_ActuatedSynthesizer(validation.synthesizer, validation.model, actuator),
        distance=_DistanceOfCommands(validation.distance, inputs),
    )


def with_commands(trajectory: Trajectory, commanded: Array) -> Trajectory:
    """Return a trajectory whose inputs act, with those that were commanded in its steps beside them."""
    steps = trajectory.inputs.shape[-2]
    return replace(trajectory, inputs=np.concatenate([trajectory.inputs, commanded[..., :steps, :]], axis=-1))


@dataclass(frozen=True)
class _OfCommands:
    """M under the last m inputs, which are commanded, or under what acts if nothing else is given."""

    model: Model
    inputs: int

    def step(self, x: Array, u: Array) -> Array:
        return np.asarray(self.model.step(x, u[..., -self.inputs :]))


@dataclass(frozen=True)
class _ActuatedSynthesizer:
    """Designs the user's controllers on the user's model."""

    synthesizer: Synthesizer
    model: Model
    actuator: Actuator

    @property
    def batched(self) -> bool:
        return bool(getattr(self.synthesizer, "batched", False))

    def design(self, task: Task, model: Model) -> Controller:
        return _ActuatedController(self.synthesizer.design(task, self.model), self.actuator)


@dataclass(frozen=True)
class _ActuatedController:
    """A controller whose memory has the latest commands, the latest first, and the input that acts."""

    controller: Controller
    actuator: Actuator

    def start(self, task: Task) -> Any:
        own = self.controller.start(task) if isinstance(self.controller, ControllerWithMemory) else None
        return own, (), None

    def step(self, t: int, x: Array, memory: Any) -> tuple[Array, Any]:
        own, commanded, acting = memory
        if isinstance(self.controller, ControllerWithMemory):
            u, own = self.controller.step(t, x, own)
        else:
            u = self.controller(t, x)
        u = np.array(u, dtype=np.float64)
        commanded = (u, *commanded)[: self.actuator.remembered]
        acting = self.actuator.follow(np.zeros_like(u) if acting is None else acting, commanded)
        return np.concatenate([acting, u], axis=-1), (own, commanded, acting)


@dataclass(frozen=True)
class _DistanceOfCommands:
    """The user's distance of trajectories with the inputs that were commanded."""

    distance: Distance
    inputs: int

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        return self.distance(
            commands_of(model_trajectory, self.inputs), commands_of(system_trajectory, self.inputs), task
        )


def commands_of(trajectory: Trajectory, inputs: int) -> Trajectory:
    """Return a closed loop with the m inputs that were commanded alone."""
    return replace(trajectory, inputs=trajectory.inputs[..., -inputs:])
