"""Draws of the dynamics: models ``M + r_s``, which are run together."""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from typing import Any, Self

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, Rows
from ctxval._util.representation import ShortRepr
from ctxval.core.model import Model, Step, advanced, memory_in, run_of
from ctxval.learning.kernel_expansion import KernelExpansion
from ctxval.learning.residual_data import ResidualData
from ctxval.learning.settling import SettlingModel


class Draws(ShortRepr, ABC):
    """S systems, with R sequences of noise each, whose closed loops are run together."""

    @property
    def replicates(self) -> int:
        """The number R of sequences of noise; 1 without noise."""
        return 1

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def __getitem__(self, rows: ArrayLike) -> Self:
        """Return some draws; their rows are in ascending order."""

    @abstractmethod
    def begun(self, rows: Rows, tasks: int, start: Array) -> tuple[Array, Step]:
        """Return the first states of closed loops that start at states ``(..., n)``, and the step of all of them.

        The S R systems, draw after draw, have a loop on each of so many ``tasks``; these are ascending rows ``(...)``.
        """

    @property
    def searched(self) -> Self:
        """The same with fewer sequences of noise, with which a search finds the same tasks."""
        return self

    def without_noise(self) -> Self:
        """Return the same without noise."""
        return self

    def settled(self, rng: np.random.Generator) -> Self | None:
        """Return the same with more sequences of noise, for tasks that a search has found; None without noise."""

    def reduced(self, distances: Array) -> Array:
        """Return the distances ``(S, q)`` of draws from those of all systems ``(S R, q)``."""
        return distances


class DrawsWithoutNoise(Draws):
    """Systems whose next states follow from states and inputs."""

    def __getitem__(self, rows: ArrayLike) -> Self:
        """Return some draws; their rows are in ascending order."""
        rows = np.atleast_1d(np.asarray(rows, dtype=np.intp))
        if not (rows < len(self)).all():
            raise IndexError(f"there are {len(self)} draws.")
        return self if len(rows) == len(self) else self._some(rows)

    @abstractmethod
    def _some(self, rows: Rows) -> Self:
        """Return fewer draws than all."""

    def _of_draws(self, part: Array) -> Array:
        """Return states, inputs or memories ``(..., k)`` with the draws as the first axis, ``(S, q, k)``."""
        return part.reshape(len(self), math.prod(part.shape[:-1]) // len(self), part.shape[-1])

    @abstractmethod
    def step(self, x: Array, u: Array) -> Array:
        """Return the next states, ``(..., n), (..., m) -> (..., n)``, equally many of each draw, draw after draw."""

    def begun(self, rows: Rows, tasks: int, start: Array) -> tuple[Array, Step]:
        """Return the states, and the step of those draws; see :meth:`Draws.begun`."""
        first, last = int(rows.min()) // tasks, int(rows.max()) // tasks + 1
        needed, here = self[np.arange(first, last)], rows.ravel() - first * tasks
        if start.ndim == 1 or len(here) == len(needed) * tasks:
            return start, run_of(needed, start)

        def whole(part: Array) -> Array:  # a flat batch has some rows of all tasks of these draws
            filled = np.repeat(part[:1], len(needed) * tasks, axis=0)  # others run, too, and are not looked at
            filled[here] = part
            return filled

        run = run_of(needed, whole(start))
        return start, lambda x, u: np.asarray(run(whole(x), whole(u))[here])


@dataclass(frozen=True, eq=False)
class DynamicsDraws(DrawsWithoutNoise):
    """S models ``M + r_s``, run together: a draw is the first axis of states and inputs; a single draw is a model."""

    model: Model
    data: ResidualData
    expansions: tuple[KernelExpansion, ...]  # functions r_s, in groups that are evaluated together
    left_out: float = 0.0  # largest share of the posterior variance that draws leave out between pivots
    # the largest standardised residual of each learned state, in magnitude; None if there is no limit
    limit: Array | None = None

    def __len__(self) -> int:
        return self._firsts[-1]

    @functools.cached_property
    def _firsts(self) -> list[int]:
        """The first draw of each group, and the number of all."""
        return [0, *accumulate(len(expansion.weights) for expansion in self.expansions)]

    @functools.cached_property
    def _moved(self) -> tuple[Rows, Array]:
        """The learned states, and the units of their residuals."""
        at = np.flatnonzero(self.data.learned)
        return at, self.data.units[at]

    def _some(self, rows: Rows) -> Self:
        chosen = [rows[(rows >= first) & (rows < last)] - first for first, last in pairwise(self._firsts)]
        kept = tuple(each[some] for each, some in zip(self.expansions, chosen, strict=True) if len(some))
        model = self.model[rows] if isinstance(self.model, SettlingModel) else self.model
        return replace(self, expansions=kept, model=model)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states; see :class:`DrawsWithoutNoise`."""
        return self._following(x, u, None)[0]

    def start(self, x: Array) -> Array:
        """Return the memory of M at the start of closed loops in states ``(..., n)``."""
        return memory_in(self.model, x)

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        """Return the next states and the memory of M, as :class:`ctxval.core.model.ModelWithMemory`."""
        following, memory = self._following(x, u, memory)
        return following, memory

    def _following(self, x: Array, u: Array, memory: Any) -> tuple[Array, Any]:
        shape = x.shape
        x, acting = map(self._of_draws, (x, u))
        with np.errstate(all="ignore"):
            if isinstance(self.model, SettlingModel):
                following = self.model.following(x, acting, lambda inputs: self.residuals(x, inputs))
            elif memory is None:
                following = self.data.geometry.corrected(self.model.step(x, acting), self.residuals(x, acting), x)
            else:
                following, given = advanced(self.model, x, acting, self._of_draws(memory))
                following = self.data.geometry.corrected(following, self.residuals(x, acting), x)
                memory = given.reshape(memory.shape)
            return following.reshape(shape), memory

    def residuals(self, x: Array, u: Array) -> Array:
        """Return the residuals ``(S, q, n)`` at states ``(S, q, n)`` and acting inputs ``(S, q, m)``."""
        residuals, (at, units) = np.zeros(x.shape), self._moved
        if len(at):
            z = bounded(self.data.standardised(x, u))
            groups = zip(self.expansions, pairwise(self._firsts), strict=True)
            parts = [expansion(z[first:last]) for expansion, (first, last) in groups]
            learned = np.concatenate(parts) if parts[1:] else parts[0]
            if self.limit is not None:
                np.maximum(learned, -self.limit, out=learned)
                np.minimum(learned, self.limit, out=learned)
            learned *= units
            residuals[:, :, at] = learned
        return residuals


@dataclass(frozen=True, eq=False)
class DisturbedDynamics(DrawsWithoutNoise):
    """One model, to whose next states something is added, in several ways that are run together as draws are."""

    mean: DynamicsDraws  # the model, as the only draw
    ways: Rows  # numbers of the ways, (S,)
    # what is added for ways (S,) at states (S, q, n), in a shape that broadcasts to theirs
    added: Callable[[Rows, Array], Array]

    def __len__(self) -> int:
        return len(self.ways)

    def _some(self, rows: Rows) -> Self:
        return replace(self, ways=self.ways[rows])

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states; see :class:`DrawsWithoutNoise`."""
        return self._moved(x, self.mean.step(x, u))

    def start(self, x: Array) -> Array:
        """Return the memory of M at the start of closed loops in states ``(..., n)``."""
        return self.mean.start(x)

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        """Return the next states and the memory of M, as :class:`ctxval.core.model.ModelWithMemory`."""
        x_next, memory = self.mean.advance(x, u, memory)
        return self._moved(x, x_next), memory

    def _moved(self, x: Array, x_next: Array) -> Array:
        together = self._of_draws(x)
        added = self.added(self.ways, together)
        return self.mean.data.geometry.corrected(x_next.reshape(together.shape), added, together).reshape(x.shape)


def bounded(z: Array) -> Array:
    """Return standardised pairs within limits, in the same array: a loop that diverges stays finite; NaN becomes 0."""
    np.maximum(z, -1e6, out=z)
    np.minimum(z, 1e6, out=z)
    if math.isnan(np.vdot(z, z)):
        z[np.isnan(z)] = 0.0
    return z
