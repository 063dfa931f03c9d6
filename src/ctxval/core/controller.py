"""Controllers, and what designs them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_floats
from ctxval._util.registry import part
from ctxval._util.representation import call, record
from ctxval.core.model import Model
from ctxval.core.task import Task
from ctxval.errors import InputError, ShapeError

Controller = Callable[[int, Array], Array]
"""``u = pi(t, x)``: step index t, state ``(..., n)`` -> input ``(..., m)``."""


@runtime_checkable
class Synthesizer(Protocol):
    """Designs a controller for a task on a model.

    A synthesizer that can design for a batch of tasks in one call says so with an attribute ``batched = True``.
    """

    def design(self, task: Task, model: Model) -> Controller:
        """Return the controller pi(x; g_p, M).

        Raises:
            DesignError: there is none.
        """


_SPELLINGS = (
    "write one number h for -h to h of every input, { low = 0.0, high = 8.0 } (in Python also Limits(low=0.0, "
    "high=8.0)) with numbers or one for each input, or rows [[low, high], ...], one for each input"
)


@dataclass(frozen=True, eq=False, init=False)
class Limits:
    """The box that inputs stay in, ``low <= u <= high``.

    Attributes:
        low, high: a number for every input, or one for each, shape ``(m,)``; infinite if there is no limit.

    Raises:
        InputError: a limit is NaN, or a low one is not below its high one.
        ShapeError: they are neither numbers nor as many as each other.
    """

    low: Array
    high: Array

    def __init__(self, low: ArrayLike, high: ArrayLike) -> None:
        for name, bound in (("low", low), ("high", high)):
            object.__setattr__(self, name, as_floats(f"{name} of the limits", bound))
        try:
            fits = len(np.broadcast_shapes(self.low.shape, self.high.shape)) <= 1
        except ValueError:
            fits = False
        if not fits:
            raise ShapeError(
                "low and high of the limits must be numbers, or one for each input, "
                f"got shapes {self.low.shape} and {self.high.shape}."
            )
        if not (self.low < self.high).all():
            raise InputError(
                f"limits must be low < high for every input, got {self.low.tolist()} and {self.high.tolist()}."
            )

    @classmethod
    def of(cls, limits: LimitsLike, inputs: int | None = None) -> Limits:
        """Return limits from what a user gives.

        Args:
            limits: one number h for ``-h`` to ``h`` of every input; ``Limits(low=, high=)`` or a mapping of low and
                high, numbers or ``(m,)``; or rows ``[low, high]``, one for each input, shape ``(m, 2)``.
            inputs: m, the shape that the limits are brought to; None leaves numbers as they are.

        Raises:
            InputError: they could be read in two ways, are NaN, or a low one is not below its high one.
            ShapeError: there are not as many as inputs.
        """
        found = limits if isinstance(limits, Limits) else _read_limits(limits)
        if inputs is None:
            return found
        if any(bound.shape not in ((), (inputs,)) for bound in (found.low, found.high)):
            raise ShapeError(
                f"limits must be numbers or have shape ({inputs},), got {found.low.shape} and {found.high.shape}."
            )
        return cls(*(np.array(np.broadcast_to(bound, (inputs,))) for bound in (found.low, found.high)))

    def describe(self) -> dict[str, Any]:
        """Return what identifies these limits in a store."""
        return {"low": self.low.tolist(), "high": self.high.tolist()}

    def clip(self, u: Array) -> Array:
        """Return inputs ``(..., m)`` within the limits; NaN stays NaN."""
        return np.asarray(np.clip(u, self.low, self.high))

    def __repr__(self) -> str:
        return record(self)


LimitsLike = float | Limits | Mapping[str, ArrayLike] | ArrayLike
"""One number, ``Limits(low=, high=)``, a mapping of low and high, or rows ``(m, 2)``; see :meth:`Limits.of`."""


def _read_limits(limits: Any) -> Limits:
    if isinstance(limits, Mapping):
        if set(limits) != {"low", "high"}:
            raise InputError(
                "limits must have low and high, of which one may be infinite, "
                f"got {', '.join(map(str, limits)) or 'neither'}; {_SPELLINGS}."
            )
        return Limits(limits["low"], limits["high"])
    try:
        array = as_floats("limits", limits)
    except InputError as error:
        raise InputError(f"{str(error).removesuffix('.')}; {_SPELLINGS}.") from error
    if array.ndim == 0:
        return Limits(-array, array)
    if array.ndim == 1 and array.size:
        raise _flat(array.tolist())
    if array.ndim != 2 or array.shape[1] != 2:
        raise ShapeError(f"limits must not have shape {array.shape}; {_SPELLINGS}.")
    return Limits(array[:, 0], array[:, 1])


def _flat(listed: list[float]) -> InputError:
    """Return the error of a flat list, with the ways to write what may be meant."""
    ways = []
    if len(listed) == 2 and listed[0] < listed[1]:
        ways.append(f"{_table(*listed)} for {listed[0]:g} to {listed[1]:g} of every input")
    if all(high > 0 for high in listed):
        ways.append(f"{[[-high, high] for high in listed]} for one row [low, high] for each input")
    if len(ways) == 2:
        return InputError(f"limits {listed} can be read in two ways: write {ways[0]}, or {ways[1]}.")
    return InputError(f"limits must not be a flat list, got {listed}: {'write ' + ways[0] if ways else _SPELLINGS}.")


def _table(low: Any, high: Any) -> str:
    return f"{{ low = {low}, high = {high} }}"


def given_limits(limits: LimitsLike | None) -> float | Limits | None:
    """Return limits for a number of inputs that is not known yet, checked; one number stays one.

    Raises:
        InputError: they cannot be used.
    """
    if limits is None:
        return None
    found = Limits.of(limits)
    # A number is described in stores as a number, as it always was.
    given_a_number = not isinstance(limits, Limits | Mapping) and np.ndim(limits) == 0
    return float(found.high) if given_a_number else found


def describe_limits(limits: float | Limits | None) -> Any:
    """Return what identifies the limits of a policy in a store: as version 0.1.0 did if that was unambiguous."""
    if not isinstance(limits, Limits) or not (limits.low.ndim or limits.high.ndim):
        return limits
    return [limits.low.tolist(), limits.high.tolist()]


@dataclass(frozen=True, eq=False)
class AffineFeedback:
    """Time-varying affine feedback ``u = v_t + K_t (x - x_t)``, clipped to its limits where it has any.

    Attributes:
        gains: K, shape ``(..., H, m, n)``, or ``(H, m, n)`` where the whole batch has the same.
        inputs: v, shape ``(..., H, m)``.
        states: x, shape ``(..., H, n)`` or more.
        limits: the same for every task of a batch.
    """

    gains: Array
    inputs: Array
    states: Array
    limits: Limits | None = None

    def __call__(self, t: int, x: Array) -> Array:
        """Return the input at step t, shape ``(..., m)``."""
        deviation = x - self.states[..., t, :]
        u = self.inputs[..., t, :] + (self.gains[..., t, :, :] @ deviation[..., None])[..., 0]
        return u if self.limits is None else self.limits.clip(u)

    def __getitem__(self, index: int) -> AffineFeedback:
        """Return the controller of one task of the batch."""
        gains = self.gains[index] if self.gains.ndim > 3 else self.gains
        return AffineFeedback(gains, self.inputs[index], self.states[index], self.limits)

    def __repr__(self) -> str:
        return call(self, gains=self.gains, inputs=self.inputs, limits=self.limits)


@part(functions={"policy": "(t, x, task) -> u"})
class Policy:
    """The same policy for every task: ``policy(t, x, task) -> u``, as a synthesizer.

    Args:
        policy: called with the step index, states ``(..., n)`` and the task; returns inputs ``(..., m)``.
        vectorized: False where it only takes one state ``(n,)`` at a time.
        limits: inputs are clipped to them: one number h for -h to h, ``Limits(low=, high=)``, a mapping of low and
            high, or rows ``[low, high]``, one for each input.

    Raises:
        InputError: the limits could be read in two ways, or are not low < high.
    """

    def __init__(
        self,
        policy: Callable[[int, Array, Task], Array],
        *,
        vectorized: bool = True,
        limits: LimitsLike | None = None,
    ) -> None:
        self.policy = policy
        self.batched = vectorized
        self.limits = given_limits(limits)

    def design(self, task: Task, model: Model) -> Controller:
        """Return the policy bound to the task; the model is not asked."""
        return _BoundPolicy(self.policy, task, self.limits)

    def describe(self) -> dict[str, Any]:
        """Return what identifies this synthesizer in a store."""
        return {"policy": self.policy, **({} if self.limits is None else {"limits": describe_limits(self.limits)})}

    def __repr__(self) -> str:
        return call(self, self.policy, vectorized=self.batched, limits=self.limits)


@dataclass(frozen=True, eq=False)
class _BoundPolicy:
    """A policy for one task or a batch; unlike a lambda it can go to another process."""

    policy: Callable[[int, Array, Task], Array]
    task: Task
    limits: float | Limits | None

    def __call__(self, t: int, x: Array) -> Array:
        u = np.asarray(self.policy(t, x, self.task), dtype=np.float64)
        return u if self.limits is None else Limits.of(self.limits, u.shape[-1]).clip(u)

    def __repr__(self) -> str:
        return record(self)
