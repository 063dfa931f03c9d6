"""Whether the closed loops of M are smooth: M against M with start and motion changed by 0.1 %, before any execution.

If they are, ten times the change moves them ten times as far. At contacts, a small change may lead to other motion.
Then the largest distance over the tasks is no stable number, while the one that a share of them stays below is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval.core.model import Model, Step, advanced, memory_in
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.learning.draws import DrawsWithoutNoise
from ctxval.learning.stage_costs import Costs, Sizes, Thinking


@dataclass(frozen=True)
class SensitivitySettings:
    """How closed loops are changed, in how many tasks, and from when on they are not smooth."""

    change: float = 0.001  # of how far each state moves in a step, and of its range at the start
    factor: float = 10.0  # of the larger change
    directions: int = 2  # combinations of signs of the changes of states
    tasks: int = 256  # random tasks
    tasks_alone: int = 16  # the same, if each closed loop is designed and run on its own
    smooth: float = 0.3  # the largest distance by the change, as a share of the 0.99 quantile by 10 times as much
    matters: float = 0.05  # the largest distance by the change that does not matter, as a share of the threshold
    spike: float = 5.0  # multiple of the median from which on a distance is a spike


SENSITIVITY = SensitivitySettings()
"""The settings in use."""


@dataclass(frozen=True)
class Sensitivity:
    """The distances between M and M changed by 0.1 % over some tasks, which are large for so small a change."""

    largest: float  #: infinity if a changed loop falls or diverges
    median: float
    larger_change: float  #: the 0.99 quantile by 10 times as much
    spikes: float  #: share of the tasks with a distance of more than 5 times the median
    tasks: int  #: their number

    @classmethod
    def from_json(cls, values: Any) -> Self | None:
        """Return what :meth:`to_json` returned; None if these are not its values."""
        if not isinstance(values, Mapping) or set(values) != set(cls.__dataclass_fields__):
            return None
        numbers: dict[str, Any] = {name: np.inf if value is None else value for name, value in values.items()}
        return cls(**numbers) if all(isinstance(each, int | float) for each in numbers.values()) else None

    def to_json(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON; infinity is None."""
        return {name: value if np.isfinite(value) else None for name, value in asdict(self).items()}

    def in_words(self, units: str = "") -> str:
        """Return what it says and what helps, as a sentence."""
        largest, median, larger = (
            f"{value:.2g} {units}".rstrip() if np.isfinite(value) else "infinity"
            for value in (self.largest, self.median, self.larger_change)
        )
        return (
            f"M against M with 0.1 % of change in start and motion gives distances up to {largest} (median {median}, "
            f"and more than 5 times that in {100 * self.spikes:.2g} % of {self.tasks} tasks; {larger} with ten times "
            "the change): closed loops are not smooth, as with contacts, so the largest distance over all tasks is no "
            "stable number. Ask what 99 % of the tasks stay below: --share 0.99 (share=0.99 in Python)."
        )


@dataclass(frozen=True, eq=False)
class _Changed(DrawsWithoutNoise):
    """M with each state's start and motion changed, in several ways that are run together as draws are."""

    model: Model
    changes: Array  # shares (S, n)
    ranges: Array  # of the states, (n,)

    def __len__(self) -> int:
        return len(self.changes)

    def _some(self, rows: Rows) -> Self:
        return replace(self, changes=self.changes[rows])

    def begun(self, rows: Rows, tasks: int, start: Array) -> tuple[Array, Step]:
        """Return changed states, and the step of those systems."""
        return super().begun(rows, tasks, start + self.changes[rows // tasks] * self.ranges)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states; see :class:`DrawsWithoutNoise`."""
        return self.advance(x, u, self.start(x))[0]

    def start(self, x: Array) -> Array:
        """Return the memory of M at the start of closed loops in states ``(..., n)``."""
        return memory_in(self.model, x)

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        """Return the next states and the memory of M, as :class:`ctxval.core.model.ModelWithMemory`."""
        following, memory = advanced(self.model, x, u, memory)
        each, before = self._of_draws(following), self._of_draws(x)
        return (before + (1 + self.changes[:, None]) * (each - before)).reshape(x.shape), memory


def found_sensitivity(
    planner: LoopPlanner,
    thinking: Thinking,
    threshold: float | None = None,
    settings: SensitivitySettings = SENSITIVITY,
) -> Sensitivity | None:
    """Return how far small changes move closed loops; None if these are smooth, or if the budget does not suffice."""
    validation, count = planner.validation, settings.tasks if planner.batched else settings.tasks_alone
    space, ways = validation.space, 2 * settings.directions
    costs = Costs(thinking, Sizes.of(thinking.speed, space.dimension, 0, 0))
    if space.members is not None or costs.plan(count) + costs.run(ways, count) > thinking.seconds:
        return None
    rng = np.random.default_rng(0)
    with single_threaded(), np.errstate(all="ignore"):
        plans = planner.plan(space.unit_draws(count, rng))
        states = [plan.nominal.states.reshape(-1, plan.nominal.states.shape[-1]) for plan in plans]
        if not states:
            return None
        ranges = np.nan_to_num(np.nanmax(np.concatenate(states), axis=0) - np.nanmin(np.concatenate(states), axis=0))
        signs = rng.choice([-1.0, 1.0], (settings.directions, len(ranges)))
        changes = settings.change * np.concatenate([signs, settings.factor * signs])
        distances = planner.distances(_Changed(validation.model, changes, ranges), plans, count)
        small, large = distances.reshape(2, settings.directions, count).max(axis=1)
    known = ~np.isnan(small) & np.isfinite(large)
    if not known.any():
        return None
    largest, larger = float(small[known].max()), float(np.quantile(large[known], 0.99))
    if largest <= settings.smooth * larger or largest <= settings.matters * (threshold or 0.0):
        return None
    median = float(np.median(small[known]))
    spikes = float((small[known] > settings.spike * median).mean())
    return Sensitivity(largest, median, larger, spikes, int(known.sum()))
