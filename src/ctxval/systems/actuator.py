"""Actuators that act late: the definition of a delay and of a lag for simulations, learned dynamics and effects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array


@dataclass(frozen=True)
class Actuator:
    """How the inputs act that a controller commands; before the first one, they are 0.

    A step of a system takes one input, so what acts in a step is the mean over it. Both sizes may be those of draws
    ``(S, 1)``; the inputs are then ``(S, q, m)``.
    """

    delay: float | Array = 0.0  #: steps by which inputs act late; between whole steps, two inputs act in parts
    #: time constant in steps of the first-order lag with which delayed inputs are followed; 0 if there is none
    lag: float | Array = 0.0

    @property
    def _late(self) -> int:
        """The number of earlier commands that may act in a step."""
        return int(np.ceil(np.max(self.delay)))

    def remembered(self, inputs: int) -> int:
        """Return the number of values that it remembers of so many inputs."""
        return (self._late + bool(np.any(self.lag))) * inputs

    def follow(self, u: Array, memory: Array | None = None, parts: int = 1) -> tuple[Array, Array]:
        """Return the inputs that act ``(..., m)`` for those that are commanded, and the new memory ``(..., k)``.

        With parts, they are the means over these parts of the step, ``(..., parts, m)``. The memory has the latest
        commands, the latest first, and what the lag has reached when the step ends; None, or zeros, at the first step.
        """
        late, m = self._late, u.shape[-1]
        memory = np.zeros((*u.shape[:-1], self.remembered(m))) if memory is None else memory
        commands = np.concatenate([u, memory[..., : late * m]], axis=-1)
        acting = self._due([commands[..., k * m : (k + 1) * m] for k in range(late + 1)], parts)
        kept, reached = commands[..., : late * m], memory[..., late * m :]
        for k in range(parts) if reached.shape[-1] else ():
            acting[..., k, :], reached = self._followed(reached, acting[..., k, :], parts)
        acting = acting[..., 0, :] if parts == 1 else acting
        return acting, np.concatenate([kept, reached], axis=-1)

    def acting(self, inputs: Array, parts: int = 1) -> Array:
        """Return the inputs that act in each step, for commanded ones ``(..., H, m)``; see :meth:`follow`."""
        late, commands = self._late, np.moveaxis(inputs, -2, 0)
        padded = np.concatenate([np.zeros((late, *commands.shape[1:])), commands])
        due = self._due([padded[late - k : len(padded) - k] for k in range(late + 1)], parts)
        if np.any(self.lag):
            due = self._all_followed(due, parts)
        return np.moveaxis(due[..., 0, :] if parts == 1 else due, 0, inputs.ndim - 2)

    def _due(self, commands: list[Array], parts: int) -> Array:
        """Return the means ``(..., parts, m)`` over parts of a step of commands, the latest first, that are delayed."""
        ends = np.arange(parts + 1) / parts
        due = np.zeros((*commands[0].shape[:-1], parts, commands[0].shape[-1]))
        for k, command in enumerate(commands):
            begins = np.asarray(self.delay)[..., None] - k  # the command acts from here on, for a step
            share = parts * np.maximum(np.minimum(ends[1:], begins + 1) - np.maximum(ends[:-1], begins), 0.0)
            due += share[..., None] * command[..., None, :]
        return due

    def _followed(self, reached: Array, due: Array, parts: int) -> tuple[Array, Array]:
        """Return the mean over a part of a step of what approaches the inputs that are due, and what it reaches."""
        lag, missing = parts * np.asarray(self.lag)[..., None], reached - due
        gone = np.exp(-1 / np.maximum(lag, 1e-300))
        return due + missing * (lag * (1 - gone)), due + missing * gone

    def _all_followed(self, due: Array, parts: int) -> Array:
        """Return the means over all parts of all steps ``(H, ..., parts, m)`` of what approaches the inputs due."""
        steps = np.moveaxis(due, -2, 1).reshape(-1, *due.shape[1:-2], due.shape[-1])
        # What a lag reaches is a sum of inputs with weights g, g^2, g^3, ...: after k doublings, that of 2^k inputs.
        gone = np.broadcast_to(np.exp(-1 / np.maximum(parts * np.asarray(self.lag)[..., None], 1e-300)), steps[0].shape)
        reached, span, weight = (1 - gone) * steps, 1, gone
        while span < len(steps) and weight.max() > 1e-18:
            reached[span:] = reached[span:] + weight * reached[:-span]
            span, weight = 2 * span, weight**2
        before = np.concatenate([np.zeros_like(reached[:1]), reached[:-1]])
        means, _ = self._followed(before, steps, parts)
        return np.moveaxis(means.reshape(len(due), parts, *steps.shape[1:]), 1, -2)
