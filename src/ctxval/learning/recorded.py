"""Recorded transitions of a system: those of its executions, and the model's own data near the tasks."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence

import numpy as np
import scipy

from ctxval._util.arrays import Rows
from ctxval._util.latest import Latest
from ctxval.core.model import Model, has_memory, with_memory
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.core.validation import Validation
from ctxval.learning.histories import Record
from ctxval.models.increments import standard_deviations


def data_near(model: Model, loops: Trajectory) -> Transitions | None:
    """Return the transitions that a model was made from, of many those nearest to closed loops on M; None if none."""
    data = getattr(model, "data", None)
    return data[_nearest(data, loops, 600)] if isinstance(data, Transitions) and len(data) else None


class Memories:
    """The transitions of recordings with the memory of models that follow them; simulators take long to follow."""

    def __init__(self) -> None:
        self._known = Latest[tuple[int, bytes, bool], tuple[Model, Transitions]](256)

    def of(self, model: Model, recorded: Trajectory, *, started: bool = True) -> Transitions:
        """Return what :func:`ctxval.core.model.with_memory` returns; the latest ones are kept."""
        if not has_memory(model):
            return recorded.transitions()
        key = id(model), digest([recorded]), started
        if key not in self._known:  # with the model, whose identity stays its own
            self._known[key] = model, with_memory(model, recorded, started=started)
        return self._known[key][1]


def recorded_transitions(
    model: Model, data: Transitions | None, executed: Sequence[Trajectory], loops: Trajectory,
    logged: Sequence[Trajectory] = (), most: int = 3000, memories: Memories | None = None,
) -> tuple[Transitions, Rows] | None:  # fmt: skip
    """Return the known transitions of the system and the execution of each; -1 for data that the model was made from.

    Returns None if there are none. Of more than ``most`` transitions, a random part is returned, and of recordings that
    belong to no task, those near closed loops on M; the numbers of these recordings follow those of the executions.
    """
    memories = memories or Memories()
    parts = [memories.of(model, trajectory) for trajectory in executed]
    sources = [np.full(len(part), k) for k, part in enumerate(parts)]
    if logged:
        others = [memories.of(model, trajectory, started=False) for trajectory in logged]
        of = np.repeat(len(executed) + np.arange(len(others)), [len(part) for part in others])
        together = Transitions.joined(others)
        rows = _nearest(together, loops, 1500, many=True)
        parts.append(together[rows])
        sources.append(of[rows])
    if data is not None:
        parts.append(data)
        sources.append(np.full(len(data), -1))
    if not parts:
        return None
    together, of = Transitions.joined(parts), np.concatenate(sources)
    if len(of) > most:
        kept = np.sort(np.random.default_rng(len(of)).permutation(len(of))[:most])
        together, of = together[kept], of[kept]
    return together, of


def closed_loops_on_model(validation: Validation) -> Trajectory | None:
    """Return closed loops on M for random tasks: a batch, or one task; None if no task can be planned."""
    space = validation.space
    points = space.from_unit(np.random.default_rng(0).random((64, space.dimension)))
    batches = [points] if getattr(validation.synthesizer, "batched", False) else []
    for rows in [*batches, *points[:3]]:
        try:
            task = validation.task_at(space.parameters(rows))
            loops = validation.closed_loop(validation.synthesizer.design(task, validation.model), task)
        except Exception:  # the user's own parts, on tasks that may never be executed
            continue
        if loops.batch_shape == rows.shape[:-1]:
            return loops
    return None


def _nearest(data: Transitions, loops: Trajectory, count: int, *, many: bool = False) -> Rows:
    """Return at most so many rows of transitions: those that are nearest to the closed loops of the tasks."""
    needed = loops.transitions()
    there = np.concatenate([needed.x, needed.u], axis=1)
    there = there[np.isfinite(there).all(axis=1)][:: max(1, len(there) // 3000)]
    if len(data) <= count or not len(there):
        return np.arange(len(data))
    here = np.concatenate([data.x, data.u], axis=1)
    scale = standard_deviations(here)
    # Transitions from which on a tree finds the nearest ones, in less memory than all distances need.
    if many or len(here) > 30_000:
        gaps = scipy.spatial.cKDTree(there / scale).query(here / scale)[0]
    else:
        gaps = scipy.spatial.distance.cdist(here / scale, there / scale).min(axis=1)
    return np.sort(np.argsort(gaps, kind="stable")[:count])


def digest(runs: Iterable[Trajectory | Record]) -> bytes:
    """Return what identifies the states and inputs of some runs."""
    return hashlib.sha256(b"".join(part.tobytes() for run in runs for part in (run.states, run.inputs))).digest()


def schedule(fewest: int, count: int) -> list[int]:
    """Return the numbers from ``fewest`` to ``count`` at which :func:`scheduled` changes."""
    return [each for each in range(fewest, count + 1) if scheduled(each) == each]


def scheduled(count: int) -> int:
    """Return the largest of 0 to 4, 6, 8, 12, 16, 24 and so on, two in each doubling, that is not above ``count``."""
    step = 1
    while count >= 4 * step:
        step *= 2
    return count - count % step
