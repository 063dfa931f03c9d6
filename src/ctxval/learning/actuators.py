"""Inputs that act late: a delay and a lag of the actuators, found in executions, as a part of the controller.

What S does in a step then depends on earlier inputs. Recorded inputs tell which input acts in each step, so the
residual is a function of the state and of that input.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from ctxval._util.arrays import Array
from ctxval.core.controller import Controller, memory_of, stepped
from ctxval.core.model import Model
from ctxval.core.task import Task
from ctxval.learning.histories import History, Record, Structure
from ctxval.learning.hyperparameters import FAMILIES, HyperparameterPosterior, Mode, learning_rows, log_posterior
from ctxval.learning.residual_data import floors
from ctxval.models.increments import standard_deviations
from ctxval.systems.actuator import Actuator


@dataclass(frozen=True)
class ActuatorSettings:
    """Which delays and lags are tried, and how clearly one must explain the residual."""

    better: float = 0.3  # by which the log evidence per recorded value must be larger than without an actuator
    close: float = 0.1  # by which it may be smaller before the actuator is refined
    longest: float = 6.0  # steps, of a delay and of a time constant
    learned_from: int = 150  # transitions
    climbed: int = 4  # candidates whose hyperparameters are searched for
    tried: tuple[tuple[float, float], ...] = (  # delays and lags in steps
        *((delay, 0.0) for delay in (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0)),
        *((0.0, lag) for lag in (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)),
        *((1.0, 1.0), (1.0, 2.0), (2.0, 2.0)),
    )


RecordsOf = Callable[[Actuator], Sequence[Record]]
"""Returns executions with the inputs that act, and with states that are estimated with these if they must be."""


def found_actuator(
    model: Model, records_of: RecordsOf, before: Actuator | None = None, evaluations: int = 80,
    settings: ActuatorSettings = ActuatorSettings(),
) -> Actuator | None:  # fmt: skip
    """Return the delay and the lag with which the residual of M is most probably a function; None if they do not help.

    They help if the log evidence per recorded value, with the hyperparameters at their mode, is clearly larger than
    without them. One that was found ``before``, in fewer executions, is refined. So many ``evaluations`` of the records
    are allowed while the actuator is refined, twice. A LinAlgError is raised if states cannot be estimated.
    """
    records = records_of(Actuator())
    history = History(model, Structure(0), np.eye(records[0].states.shape[1]))
    Z, E, _ = history.along(records)
    steps = np.concatenate([np.diff(each.states, axis=0) for each in records])
    sizes = np.sqrt((E**2).mean(axis=0))
    live = sizes > floors(np.concatenate([each.states[1:] for each in records]), steps)
    if not live.any():
        return None
    inputs = records[0].inputs.shape[-1]

    def standardised(Z: Array) -> Array:
        return np.asarray((Z - Z.mean(axis=0)) / standard_deviations(Z))

    rows = learning_rows(standardised(Z), inputs, settings.learned_from)

    def data(actuator: Actuator) -> tuple[Array, Array]:
        """Return states and acting inputs ``(N, n + m)``, and residuals over their sizes if inputs act at once."""
        Z, E, _ = history.along(records_of(actuator))
        return Z[rows], E[rows][:, live] / sizes[live]

    def mode_of(actuator: Actuator) -> Mode:
        Z, E = data(actuator)
        return HyperparameterPosterior.given(standardised(Z), E, inputs, FAMILIES[:1]).highest

    def refined(start: Actuator, mode: Mode) -> Actuator:
        """Return the most likely actuator near one, with the hyperparameters that are most probable for that one."""
        Z, _ = data(start)
        shift, scale = Z.mean(axis=0), standard_deviations(Z)

        def unlikely(each: Array) -> float:
            Z, E = data(Actuator(*np.clip(each, 0.0, settings.longest).tolist()))
            return -log_posterior(mode.kernel, mode.place, (Z - shift) / scale, E)[0]

        at = np.array([start.delay, start.lag])
        simplex = at + np.array([[0.0, 0.0], [0.25, 0.0], [0.0, 0.25]])
        options = {"initial_simplex": simplex, "maxfev": evaluations, "xatol": 1e-5, "fatol": 1e-3}
        best = np.clip(
            scipy.optimize.minimize(unlikely, at, method="Nelder-Mead", options=options).x, 0.0, settings.longest
        )
        # Whole steps and no lag are preferred as by the Bayesian information criterion.
        whole, each = np.array([np.round(best[0]), best[1]]), 0.5 * np.log(len(rows))
        near = [(best, 2), (whole, 1), (best * [1, 0], 1), (whole * [1, 0], 0)]
        chosen, _ = min(near, key=lambda pair: unlikely(pair[0]) + each * pair[1])
        return Actuator(*chosen.tolist())

    base = mode_of(Actuator())
    without, tried = base.height, [before] if before else [Actuator(*each) for each in settings.tried]
    if len(tried) > settings.climbed:  # those that explain most with the hyperparameters of inputs that act at once
        of_tried = [data(each) for each in tried]
        heights = [log_posterior(base.kernel, base.place, standardised(Z), E)[0] for Z, E in of_tried]
        tried = [tried[k] for k in sorted(range(len(tried)), key=lambda k: -heights[k])]
    mode, best = max(((mode_of(each), each) for each in tried[: settings.climbed]), key=lambda pair: pair[0].height)
    values = len(rows) * int(live.sum())
    if mode.height < without - settings.close * values:
        return None
    for _ in range(2):  # the noise that a wrong actuator seems to add is less the second time
        best = refined(best, mode)
        mode = mode_of(best)
    return best if mode.height > without + settings.better * values else None


@dataclass(frozen=True)
class ActuatedController:
    """A controller with an actuator, whose inputs ``(..., 2 m)`` are those that act and those that are commanded."""

    controller: Controller
    actuator: Actuator

    def start(self, task: Task) -> Any:
        """Return the memory before the first step."""
        return memory_of(self.controller, task), None

    def step(self, t: int, x: Array, memory: Any) -> tuple[Array, Any]:
        """Return both inputs and the memory after the step."""
        of_controller, of_actuator = memory
        u, of_controller = stepped(self.controller, t, x, of_controller)
        u = np.array(u, dtype=np.float64)
        acting, of_actuator = self.actuator.follow(u, of_actuator)
        return np.concatenate([acting, u], axis=-1), (of_controller, of_actuator)
