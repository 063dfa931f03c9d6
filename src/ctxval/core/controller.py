"""Controllers with and without memory, the synthesizers that design them, and limits of inputs."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Mask, as_floats
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr, shown
from ctxval.core.model import Model
from ctxval.core.task import Task
from ctxval.errors import InputError, ShapeError

Feedback = Callable[[int, Array], Array]
"""A function ``u = pi(t, x)`` from the index t of the step and the state ``(..., n)`` to the input ``(..., m)``."""


@runtime_checkable
class ControllerWithMemory(Protocol):
    """A controller whose input depends on earlier steps too, such as a PID controller, an estimator or a filter.

    The memory c is an array or any tree of arrays, with the batch axes of the task in front. Each run has a memory of
    its own, which the closed loop holds. The controller itself never changes, so one controller runs on M, on S, on
    many draws at once and in several processes.
    """

    def start(self, task: Task) -> Any:
        """Return the memory before the first step, for one task or for a batch ``(...)``."""

    def step(self, t: int, x: Array, memory: Any) -> tuple[Array, Any]:
        """Return the pair of the inputs ``(..., m)`` in the states ``(..., n)`` at step t and the new memory."""


Controller = Feedback | ControllerWithMemory
"""A function ``u = pi(t, x)``, or an object with ``start`` and ``step``; :func:`started` runs both in the same way."""


class ControllerRun(ShortRepr):
    """One run of a controller with memory, as a function ``u = pi(t, x)`` that is called once for each step.

    Attributes:
        controller: the controller, of which this is one run.

    Raises:
        InputError: if steps are not called in order, or ``step`` returns no pair.
    """

    def __init__(self, controller: ControllerWithMemory, task: Task) -> None:
        self.controller = controller
        # A copy, because a step may change the arrays of its memory, and they may be those of the controller.
        self._memory = copy.deepcopy(controller.start(task))
        self._next = 0

    def __call__(self, t: int, x: Array) -> Array:
        """Return the inputs ``(..., m)`` in the states ``(..., n)`` at the next step t.

        Raises:
            InputError: if steps are not called in order, or ``step`` returns no pair.
        """
        if t != self._next:
            raise InputError(
                f"a run of a controller with memory must be called once for each step in order, got step {t} in the "
                f"place of step {self._next}; controllers.started(controller, task) starts another run."
            )
        returned = self.controller.step(t, x, self._memory)
        if not (isinstance(returned, tuple) and len(returned) == 2):
            raise InputError(f"step of a controller must return the pair (u, memory), got {shown(returned)}.")
        u, self._memory = returned
        self._next += 1
        return as_floats("inputs of a controller", u).copy()  # it may be a part of the memory


def is_controller(value: object) -> bool:
    """Return whether an object is a function or has the methods of a controller with memory."""
    return callable(value) or isinstance(value, ControllerWithMemory)


def started(controller: Controller, task: Task) -> Feedback:
    """Return a controller as the function ``u = pi(t, x)`` of one run of a task, or of a batch of tasks.

    A controller without memory is that function. One with memory gets a :class:`ControllerRun`, which begins with the
    memory of the task; call it once for each step, in order.

    Raises:
        InputError: if the controller cannot be called.
    """
    if isinstance(controller, ControllerWithMemory):
        return ControllerRun(controller, task)
    if not callable(controller):
        wanted = "a function (t, x) -> u, or have the methods start(task) and step(t, x, memory)"
        raise InputError(f"a controller must be {wanted}, got {shown(controller)}.")
    return controller


def memory_of(controller: Controller, task: Task) -> Any:
    """Return the memory of a controller before the first step of a task; None if it has none."""
    return controller.start(task) if isinstance(controller, ControllerWithMemory) else None


def stepped(controller: Controller, t: int, x: Array, memory: Any) -> tuple[Any, Any]:
    """Return the inputs of a controller with memory or without at step t, and its new memory."""
    if isinstance(controller, ControllerWithMemory):
        return controller.step(t, x, memory)
    return controller(t, x), memory


def seeing(controller: Controller, seen: Callable[[Array], Array], of_task: Callable[[Task], Task]) -> Controller:
    """Return a controller of states for one that sees a function of them, and starts from a function of the task."""
    if isinstance(controller, ControllerWithMemory):
        return _SeeingController(controller, seen, of_task)
    return lambda t, x: controller(t, seen(x))


@dataclass(frozen=True)
class _SeeingController:
    controller: ControllerWithMemory
    seen: Callable[[Array], Array]
    of_task: Callable[[Task], Task]

    def start(self, task: Task) -> Any:
        return self.controller.start(self.of_task(task))

    def step(self, t: int, x: Array, memory: Any) -> tuple[Array, Any]:
        return self.controller.step(t, self.seen(x), memory)


def each_alone(controllers: Sequence[Controller], tasks: Sequence[Task]) -> Feedback:
    """Return controllers of tasks as one of their batch, whose inputs are to the last digit those of each alone."""
    runs = [started(controller, task) for controller, task in zip(controllers, tasks, strict=True)]
    return lambda t, x: np.stack([as_floats("inputs", run(t, state)) for run, state in zip(runs, x, strict=True)])


@runtime_checkable
class Synthesizer(Protocol):
    """A method that designs a controller for a task on a model.

    With ``batched = True`` it designs for a batch of tasks in one call. If its controllers then have ``__getitem__``,
    which returns the controller of one task, tasks are also designed together if the system executes them one at a
    time.

    A controller may tell whether its design ``converged``, by a boolean or booleans of the batch shape ``(...)``.
    Reports and ``ctxval check --aspect1`` name the tasks whose design did not.
    """

    def design(self, task: Task, model: Model) -> Controller:
        """Return the controller pi(x; g_p, M).

        Raises:
            DesignError: if no controller can be designed for the task.
        """


def converged_of(controller: object, batch_shape: tuple[int, ...] = ()) -> Mask | None:
    """Return whether the design of a controller converged, of the shape of its batch; None if it does not tell."""
    given = getattr(controller, "converged", None)
    if given is None:
        return None
    converged = np.asarray(given)
    if converged.dtype != np.bool_ or converged.shape not in ((), batch_shape):
        raise ShapeError(f"converged of a controller must be booleans of shape {batch_shape}, got {given!r}.")
    return np.broadcast_to(converged, batch_shape)


@dataclass(frozen=True, eq=False, init=False)
class Limits(ShortRepr):
    """Limits of the inputs, ``low <= u <= high``.

    Raises:
        InputError: if a lower limit is not below the upper one.
        ShapeError: if they are not equally many.
    """

    #: low, high: the lower and upper limits: a number for all inputs, or one for each input, shape ``(m,)``; infinite
    #: if there is no limit
    low: Array
    high: Array

    def __init__(self, low: ArrayLike, high: ArrayLike) -> None:
        for name, bound in (("low", low), ("high", high)):
            object.__setattr__(self, name, as_floats(f"{name} of the limits", bound))
        if max(self.low.ndim, self.high.ndim) > 1 or len({self.low.size, self.high.size} - {1}) > 1:
            got = f"shapes {self.low.shape} and {self.high.shape}"
            raise ShapeError(f"low and high of the limits must be numbers, or one for each input, got {got}.")
        if not (self.low < self.high).all():
            got = f"{self.low.tolist()} and {self.high.tolist()}"
            raise InputError(f"limits must be low < high for every input, got {got}.")

    @classmethod
    def of(cls, limits: LimitsLike, inputs: int | None = None) -> Limits:
        """Return limits of rows ``[low, high]``, one for each input; a number h stands for ``[-h, h]`` of every input.

        It is expanded if the number of ``inputs`` is given.

        Raises:
            InputError: if the limits have another form, or if a lower one is not below the upper one.
            ShapeError: if there are not as many rows as inputs.
        """
        box = limits if isinstance(limits, Limits) else cls(*_ends(limits))
        if inputs is None:
            return box
        if any(bound.shape not in ((), (inputs,)) for bound in (box.low, box.high)):
            got = f"{box.low.shape} and {box.high.shape}"
            raise ShapeError(f"limits must be numbers or have shape ({inputs},), got {got}.")
        return cls(*(np.array(np.broadcast_to(bound, (inputs,))) for bound in (box.low, box.high)))

    def describe(self) -> dict[str, Any]:
        """Return what identifies these limits in a store."""
        return {"low": self.low.tolist(), "high": self.high.tolist()}

    def clip(self, u: Array) -> Array:
        """Return inputs ``(..., m)`` clipped to the limits; NaN stays NaN."""
        return np.asarray(np.clip(u, self.low, self.high))


def _ends(limits: Any) -> tuple[ArrayLike, ArrayLike]:
    spellings = "write rows [[low, high], ...], one for each input, or one number h for [-h, h] of every input"
    if isinstance(limits, Mapping):
        with suppress(KeyError, ValueError, InputError):  # other tables
            ends = np.broadcast_arrays(*(np.atleast_1d(as_floats(name, limits[name])) for name in ("low", "high")))
            spellings = f"write limits = {np.stack(ends, axis=1).tolist()}" if ends[0].ndim == 1 else spellings
        raise InputError(f"limits must not be a table, got {dict(limits)}: {spellings}.")
    try:
        array = as_floats("limits", limits)
    except InputError as error:
        raise InputError(f"{str(error).removesuffix('.')}; {spellings}.") from error
    if array.ndim == 1 and array.size:
        # It could be the lower and the upper limit, or the upper limits of several inputs.
        raise InputError(f"limits must not be a flat list, got {array.tolist()}: {spellings}.")
    if array.ndim and array.shape[1:] != (2,):
        raise ShapeError(f"limits must not have shape {array.shape}; {spellings}.")
    return (array[:, 0], array[:, 1]) if array.ndim else (-array, array)


LimitsLike = float | Limits | ArrayLike
"""Rows ``(m, 2)``, or one number; see :meth:`Limits.of`. Limits that were made of these are taken, too."""


def fed_back(K: Array, deviations: Array) -> Array:
    """Return ``K dx``, shape ``(..., m)``, for gains ``(m, n)``, or ``(..., m, n)``, and deviations ``(..., n)``."""
    # One product of two matrices is far faster than many small ones.
    return np.asarray(deviations @ K.T if K.ndim == 2 else np.einsum("...ij,...j->...i", K, deviations))


@dataclass(frozen=True, eq=False)
class AffineFeedback(ShortRepr):
    """Time-varying affine feedback ``u = v_t + K_t (x - x_t)``, clipped to its limits if it has any.

    Raises:
        InputError: if it is called for a step without an input.
    """

    gains: Array  #: the gains K, shape ``(..., H, m, n)``, or ``(H, m, n)`` if all tasks of the batch share them
    inputs: Array  #: the inputs v, shape ``(..., H, m)``
    states: Array  #: the states x, shape ``(..., H, n)`` or with more times than H
    limits: Limits | None = None  #: the limits of the inputs, shared by all tasks of the batch; None if there are none
    #: whether the design converged, booleans of shape ``(...)``; None if the design is not iterative
    converged: Mask | None = None

    def __call__(self, t: int, x: Array) -> Array:
        """Return the input at step t, shape ``(..., m)``.

        Raises:
            InputError: if there is no input for the step.
        """
        steps = self.inputs.shape[-2]
        if not 0 <= t < steps:
            raise InputError(f"the controller has inputs for the steps 0 to {steps - 1}, got step {t}.")
        u = self.inputs[..., t, :] + fed_back(self.gains[..., t, :, :], x - self.states[..., t, :])
        return u if self.limits is None else self.limits.clip(u)

    def __getitem__(self, index: int) -> AffineFeedback:
        """Return the controller of one task of the batch."""
        gains = self.gains[index] if self.gains.ndim > 3 else self.gains
        converged = None if self.converged is None else np.asarray(self.converged[index])
        return AffineFeedback(gains, self.inputs[index], self.states[index], self.limits, converged)


@part(functions={"policy": "(t, x, task) -> u"})
class Policy(ShortRepr):
    """A synthesizer that uses the same policy ``policy(t, x, task) -> u`` for every task.

    Args:
        policy: function of the step's index, the states ``(..., n)`` and the task; returns the inputs ``(..., m)``.
        vectorized: False if the policy takes only one state ``(n,)`` at a time.
        limits: limits of the inputs, rows ``[low, high]`` for each, or one number h for ``[-h, h]`` of all.
    """

    def __init__(
        self, policy: Callable[[int, Array, Task], Array], *, vectorized: bool = True, limits: LimitsLike | None = None
    ) -> None:
        self.policy = policy
        self.batched = vectorized
        self.limits = None if limits is None else Limits.of(limits)

    def design(self, task: Task, model: Model) -> BoundPolicy:
        """Return the policy bound to the task; the model is not used."""
        return BoundPolicy(self.policy, task, self.limits)

    def describe(self) -> dict[str, Any]:
        """Return what identifies this synthesizer in a store."""
        return {"policy": self.policy, **({} if self.limits is None else {"limits": self.limits})}


@dataclass(frozen=True, eq=False)
class BoundPolicy(ShortRepr):
    """The controller of a policy for one task or a batch; unlike a lambda it can be pickled for another process."""

    policy: Callable[[int, Array, Task], Array]
    task: Task
    limits: Limits | None

    def __call__(self, t: int, x: Array) -> Array:
        """Return the inputs ``(..., m)`` at step t, within the limits."""
        u = as_floats("inputs of a policy", self.policy(t, x, self.task))
        return u if self.limits is None else Limits.of(self.limits, u.shape[-1]).clip(u)

    def __getitem__(self, index: int) -> BoundPolicy:
        """Return the controller of one task of the batch."""
        return BoundPolicy(self.policy, self.task[index], self.limits)
