"""Controllers of tasks that are looked at again and again, designed once."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.progress import advance
from ctxval.core.validation import Validation
from ctxval.learning.closed_loops import LoopPlanner, PlannedTasks

_LARGEST = 64_000_000
"""Largest size of the plans that are kept, in bytes, approximately."""


class PlanMemory:
    """The plans of tasks on M, of which the latest ones are kept.

    Tasks that are planned together are kept together, because a controller of a batch need not have parts. They are
    found again if the same points are asked for in the same order.

    Args:
        validation: the map p -> d(p); S is never executed.
    """

    def __init__(self, validation: Validation) -> None:
        self.planner = LoopPlanner(validation)
        self._kept: OrderedDict[bytes, tuple[list[PlannedTasks], int]] = OrderedDict()
        self._size = 0

    def plan(self, points: Array) -> list[PlannedTasks]:
        """Return the plans of points ``(q, d)``; tasks for which no controller can be designed are left out."""
        if self.planner.batched:
            return self._remembered(points)
        alone = (self._remembered(point[None]) for point in points)
        return [replace(one, rows=np.array([row])) for row, found in enumerate(alone) for one in found]

    def has(self, point: Array) -> bool:
        """Return whether the plan of one task ``(d,)`` is kept."""
        return point.tobytes() in self._kept

    def _remembered(self, points: Array) -> list[PlannedTasks]:
        key = points.tobytes()
        if key in self._kept:
            self._kept.move_to_end(key)
            advance(len(points))  # the planner reports only the tasks that it plans
            return self._kept[key][0]
        planned = self.planner.plan(points, together=max(1, len(points)))
        size = sum(map(_size, planned)) + len(key)
        self._kept[key] = planned, size
        self._size += size
        while self._size > _LARGEST:
            self._size -= self._kept.popitem(last=False)[1][1]
        return planned


def _size(planned: PlannedTasks) -> int:
    """Return the approximate size of a plan in bytes, with gains as large as those of a linear feedback."""
    states, inputs = planned.promised.states, planned.promised.inputs
    return 2 * (states.nbytes + inputs.nbytes) + int(states.shape[-1]) * inputs.nbytes
