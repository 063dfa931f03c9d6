"""Functions and people as the true system: drivers, steps of dynamics, and simulations of imperfect robots."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite, as_floats
from ctxval._util.checked import NonNegativeFloat, Seconds
from ctxval._util.refusals import reworded
from ctxval._util.registry import part
from ctxval.core.controller import Controller, Feedback, started
from ctxval.core.labels import require_names
from ctxval.core.model import Model, Step, as_model, run_of
from ctxval.core.rollout import rollout
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import ExecutionError, InputError
from ctxval.systems.actuator import Actuator

Derivative = Callable[[Array, Array], Array]


def rk4(derivative: Derivative, dt: float) -> Callable[[Array, Array], Array]:
    """Return the step ``(x, u) -> x_next`` of the classical Runge-Kutta method of order 4, of dt seconds.

    The derivative is a function ``(x, u) -> dx/dt``, shapes ``(..., n), (..., m) -> (..., n)``; inputs are held.
    """

    def step(x: Array, u: Array) -> Array:
        k1 = derivative(x, u)
        k2 = derivative(x + 0.5 * dt * k1, u)
        k3 = derivative(x + 0.5 * dt * k2, u)
        k4 = derivative(x + dt * k3, u)
        return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    return step


@part(functions={"execute": "(controller, task) -> trajectory"})
class Function:
    """A plain function ``(controller, task) -> trajectory`` as the true system: a robot's own driver, a simulator.

    The function calls ``controller(t, x)`` for the inputs, once for each step in order if the controller has memory.
    It returns a trajectory, or the states ``(H + 1, n)`` and the inputs ``(H, m)``; a vectorized one takes a batch
    of tasks. If it raises an exception, the execution has failed for that reason. For a function of one step,
    ``(x, u) -> x_next``, use a :class:`Simulated` system.
    """

    def __init__(self, execute: Callable[[Feedback, Task], Any], *, vectorized: bool = False) -> None:
        self.function, self.batched = execute, vectorized

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        returned = self.function(started(controller, task), task)
        if isinstance(returned, Trajectory):
            return returned
        wanted = f"a Trajectory, or states (H + 1, n) and inputs (H, m) with H = {task.horizon}"
        with reworded(f"the system's function must return {wanted}", TypeError, ValueError, to=ExecutionError):
            states, inputs = (as_floats(name, part) for name, part in zip(("states", "inputs"), returned, strict=True))
            return Trajectory(task.times, states, inputs)


@part()
class Manual:
    """A system whose tasks people execute: get a task with ``campaign.ask()``, report it with ``campaign.tell()``.

    States and inputs are names of the components with their units, for files.

    Raises:
        InputError: if there are no states.
    """

    manual = True  #: mark of a system that a program cannot execute

    def __init__(self, *, states: Mapping[str, str], inputs: Mapping[str, str], dt: Seconds) -> None:
        self.states, self.inputs = dict(states), dict(inputs)
        if not self.states:
            raise InputError(f"states and inputs must be names with units, got {self.states} and {self.inputs}.")
        require_names(self.states, self.inputs)
        self.dt = float(dt)

    def execute(self, controller: Controller, task: Task) -> NoReturn:
        advice = "get a task with campaign.ask() and report its result with campaign.tell() instead of campaign.run()"
        raise ExecutionError(f"a manual system is executed by people; {advice}.")


@part(functions={"step": "(x, u) -> x_next"}, parts={"step": "model"})
class Imperfect:
    """A step function or a model, such as a simulator, as the true system, whose records and actuators are imperfect.

    The controller acts on the records, as on a robot. Executions of one task differ if there is noise.

    Attributes:
        start: standard deviations of the initial state from that of the task, a number or shape ``(n,)``.
        process: standard deviations of the noise of each state in each step.
        measurement: standard deviations of the noise of each recorded state.
        resolution: steps to which records are rounded, as an encoder does; 0 for a state that is not rounded.
        delay: steps by which inputs act late; it need not be an integer.
        lag: time constant in steps with which the actuators approach the input; 0 if they follow at once. The mean over
            a step acts in it.
        before: the inputs before the first one acts, a number or shape ``(m,)``, such as the pose of servos.
        strength: factor of the inputs that act, a number or shape ``(m,)``, as of weak motors; of an MJCF, whose
            actuators may be servos, factor of their forces.
        payload: masses in kg that are added to bodies of an MJCF, by their names; None if there are none.
        friction: factor of the sliding friction of all geoms of an MJCF.
        push: what a push adds to states, by their indices, such as ``{7: 0.5}``; None if there is none.
        push_time: seconds after which it does, rounded to a step.
        seed: with a seed, noise is a function of it, of the task and of how often this object has executed.

    Raises:
        InputError: if a size is negative or not finite.
    """

    batched = True

    def __init__(
        self,
        step: Step | Model,
        *,
        start: ArrayLike = 0.0,
        process: ArrayLike = 0.0,
        measurement: ArrayLike = 0.0,
        resolution: ArrayLike = 0.0,
        delay: NonNegativeFloat = 0.0,
        lag: NonNegativeFloat = 0.0,
        before: ArrayLike = 0.0,
        strength: ArrayLike = 1.0,
        payload: Mapping[str, float] | None = None,
        friction: NonNegativeFloat = 1.0,
        push: Mapping[Any, float] | None = None,
        push_time: NonNegativeFloat = 0.0,
        vectorized: bool = False,
        seed: int | None = None,
    ) -> None:
        self.model = as_model(step, vectorized=vectorized)
        self.start, self.process = as_floats("start", start), as_floats("process", process)
        self.measurement = as_floats("measurement", measurement)
        self.resolution = as_floats("resolution", resolution)
        for name in ("start", "process", "measurement", "resolution"):
            if not (np.isfinite(getattr(self, name)) & (getattr(self, name) >= 0)).all():
                raise InputError(f"{name} must be finite and not negative, got {getattr(self, name).tolist()}.")
        self.before, self.strength = as_finite("before", before), as_finite("strength", strength)
        self.payload, self.friction = dict(payload or {}), friction
        self._factor = self.strength  # of the inputs
        if self.payload or friction != 1 or (self.strength != 1).any():
            self._alter()
        with reworded("push must be numbers by the indices of states", ValueError, TypeError):
            self.push = {int(index): float(change) for index, change in (push or {}).items()}
        self.delay, self.lag, self.seed, self.push_time = delay, lag, seed, push_time
        self._executed = 0

    def _alter(self) -> None:
        """Change the masses, the friction and the actuators of an MJCF; refuse the first two of other models."""
        changed = getattr(self.model, "changed", None)  # of models.MuJoCo
        if changed is None:
            if self.payload or self.friction != 1:
                raise InputError("payload and friction need a model of an MJCF, such as models.MuJoCo.")
            return

        def change(model: Any) -> None:
            for name, mass in self.payload.items():
                with reworded("payload", KeyError):
                    model.body(name).mass += mass
            model.geom_friction[:, 0] *= self.friction
            model.pair_friction[:, :2] *= self.friction
            for parameters in (model.actuator_gainprm, model.actuator_biasprm):
                parameters[:, :3] *= np.broadcast_to(self.strength, (model.nu,))[:, None]

        self.model, self._factor = changed(change), np.ones(())

    def describe(self) -> dict[str, Any]:
        """Return what identifies this system in a store."""
        known = {name: value for name, value in vars(self).items() if not name.startswith("_")}
        usual = {"before": not self.before.any(), "strength": (self.strength == 1.0).all(), "push": not self.push}
        usual |= {"payload": not self.payload, "friction": self.friction == 1.0}
        usual["push_time"] = usual["push"]
        return {name: value for name, value in known.items() if not usual.get(name)}

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        """Run the closed loop from the initial state of the task over its horizon; batches have noise of their own."""
        pushed = round(self.push_time / task.dt) if self.push else -1
        start, rng = np.array(task.initial_state, dtype=np.float64), np.random.default_rng()
        if self.seed is not None:
            self._executed += 1
            of_task = zlib.crc32(np.ascontiguousarray(task.initial_state).tobytes() + task.reference.tobytes())
            rng = np.random.default_rng([self.seed, of_task, self._executed])
        if self.start.any():
            start = start + self.start * rng.standard_normal(start.shape)
        actuator, truth, memory, steps = Actuator(self.delay, self.lag), start, None, 0
        of_model = run_of(self.model, start)

        def record(x: Array) -> Array:
            read = x + self.measurement * rng.standard_normal(x.shape) if self.measurement.any() else x
            unit = np.where(self.resolution > 0, self.resolution, 1.0)
            return np.asarray(np.where(self.resolution > 0, np.round(read / unit) * unit, read))

        def step(_: Array, u: Array) -> Array:
            nonlocal truth, memory, steps
            if steps == pushed:
                truth = np.array(truth)
                truth[..., list(self.push)] += list(self.push.values())
            steps += 1
            u, memory = actuator.follow(u - self.before, memory)
            truth = of_model(truth, self._factor * (u + self.before))
            if self.process.any():
                truth = truth + self.process * rng.standard_normal(truth.shape)
            return record(truth)

        return rollout(step, controller, task.starting_at(record(start)))
