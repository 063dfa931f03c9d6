"""Specifications: sets to avoid and to reach, and how robustly a trajectory satisfies them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.registry import part
from ctxval.core.distance import NamedStates, selected
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError
from ctxval.specs.sets import Set, as_set, as_sets


@runtime_checkable
class Specification(Protocol):
    """What a closed loop shall do in its task, such as to reach a set and to avoid another one.

    A specification that looks at some states only has their indices or names as ``components``.
    """

    def robustness(self, trajectory: Trajectory, task: Task) -> Array:
        """Return rho, shape ``(...)`` over the batch: positive if the trajectory satisfies it, negative if it does not.

        A trajectory whose states move by at most e at each time, in the Euclidean norm of the components, has a rho
        that differs by at most e.
        """


@part()
@dataclass(frozen=True, eq=False)
class ReachAvoid(NamedStates):
    """Sets that a trajectory never enters, and a set that it reaches.

    The robustness is the smaller one of the least signed distance to the sets that are avoided, over all recorded
    times, and the depth in the reach set at its deepest within the times. What happens between two recorded times is
    not seen.

    Raises:
        InputError: if there is no set, or if components or times are not valid.
    """

    avoid: Any = ()  #: the sets that are never entered; one set, a list, or their tables
    reach: Any = None  #: the set that is reached, or its table; None if there is none
    #: the first and the last second at which it may be reached; by default, it is reached at the end
    times: Sequence[float] | None = None
    #: the states that are positions, by index or by the name in the experiment; all states by default
    components: Sequence[int | str] | None = None

    def __post_init__(self) -> None:
        none = self.avoid is None or (isinstance(self.avoid, list | tuple) and not len(self.avoid))
        if none and self.reach is None:
            raise InputError("a specification needs at least one set to avoid or to reach, and has none.")
        object.__setattr__(self, "avoid", () if none else as_sets("avoid", self.avoid))
        if self.reach is not None:
            object.__setattr__(self, "reach", as_set("reach", self.reach))
        if self.times is not None:
            if self.reach is None:
                raise InputError("times say when a set is reached, and there is no set to reach.")
            if len(self.times) != 2 or not 0 <= self.times[0] <= self.times[1] < np.inf:
                raise InputError(f"times must be a first and a last second, such as [1.0, 2.0], got {self.times!r}.")
        if self.components is not None and not len(self.components):
            raise InputError("components must name at least one state; leave it out to look at all states.")

    def robustness(self, trajectory: Trajectory, task: Task) -> Array:
        """Return rho ``(...)``; see :class:`Specification`."""
        positions = selected(trajectory.states, self.components)
        least = [avoided.signed_distance(positions, task).min(axis=-1) for avoided in self.avoid]
        if self.reach is not None:
            depths = -self.reach.signed_distance(positions, task)
            least.append(depths[..., self._steps(task)].max(axis=-1))
        return np.asarray(functools.reduce(np.minimum, least))

    def _steps(self, task: Task) -> Rows:
        """Return the steps at which the set may be reached."""
        if self.times is None:
            return np.array([task.horizon])
        first, last = np.array(self.times) / task.dt
        if last > task.horizon + 1e-6:
            end = task.horizon * task.dt
            raise InputError(f"times must not be after the end of the task at {end:g} s, got {self.times[1]:g} s.")
        # A position at a recorded time outside of the window reaches nothing; 1e-6 of a step is rounding.
        steps = np.arange(np.ceil(first - 1e-6), np.floor(last + 1e-6) + 1, dtype=np.intp)
        if not len(steps):
            got = f"{self.times[0]:g} to {self.times[1]:g} s"
            raise InputError(f"times must contain a recorded time, a multiple of dt = {task.dt:g} s, got {got}.")
        return steps

    @property
    def sets(self) -> tuple[Set, ...]:
        """All sets."""
        return (*self.avoid, *filter(None, [self.reach]))

    def tightened(self, by: float) -> ReachAvoid:
        """Return the specification with sets to avoid that grow, and a set to reach that shrinks, by a distance.

        A trajectory that satisfies it still satisfies this one if its positions change by less than the distance. An
        InputError is raised if nothing is left of the set to reach.
        """
        reach = None if self.reach is None else self.reach.grown(-by)
        return dataclasses.replace(self, avoid=tuple(each.grown(by) for each in self.avoid), reach=reach)
