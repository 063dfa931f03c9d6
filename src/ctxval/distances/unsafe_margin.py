"""The margin by which a model satisfies a specification that the system violates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import PositiveFloat
from ctxval._util.registry import part
from ctxval._util.representation import ShortRepr
from ctxval.core.distance import NamedStates
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError, UnknownNameError
from ctxval.specs import REGISTRY, Specification


@part()
@dataclass(frozen=True, eq=False)
class UnsafeMargin(ShortRepr):
    r"""The margin by which M satisfies a specification that S violates, a continuous function of the task.

    Let rho_M and rho_S be the robustness of both trajectories. The specification-based distance d_b of Ghosh et al.
    (2019, arXiv 1902.10320) is the largest rho_M over the tasks with ``rho_M > 0 >= rho_S``: every task with a larger
    rho_M is safe on S. That is a maximum of a function that jumps. This distance is

    - without a margin, ``max(0, rho_M - penalty max(0, rho_S))``. Its largest value is at least d_b, and equal to d_b
      if the largest rho_M among the tasks with ``rho_S <= s`` is at most ``d_b + penalty s`` for all s > 0. It is never
      larger than the largest deviation of the states that the specification looks at.
    - with a margin c, ``max(0, min(rho_M, c - rho_S))``. It exceeds c if and only if ``rho_M > c`` and ``rho_S < 0``:
      with the threshold c, a campaign asks whether every task with ``rho_M > c`` is safe.

    Raises:
        InputError: if there is no specification, or if the penalty is below 1.
    """

    to_task: ClassVar[bool] = True  #: whether it measures trajectories against the task

    kinked: ClassVar[bool] = True
    """Whether it is a continuous function of the trajectories with kinks, which are no jumps."""

    spec: Any  #: the specification, or a table of its arguments with its ``type``, by default ``ReachAvoid``
    margin: PositiveFloat | None = None  #: the margin of M that shall suffice; None to find it
    penalty: PositiveFloat = 2.0  #: how much each unit of rho_S counts without a margin, at least 1

    def __post_init__(self) -> None:
        if isinstance(self.spec, dict):
            table = {"type": "ReachAvoid", **self.spec}
            name = table.pop("type")
            if name not in REGISTRY.built_in:  # a table runs no code of other packages
                raise UnknownNameError.among("specification", str(name), REGISTRY.built_in)
            object.__setattr__(self, "spec", REGISTRY.make(name, **table))
        if not isinstance(self.spec, Specification):
            raise InputError(f"spec must be a specification, such as ReachAvoid, or its table, got {self.spec!r}.")
        if self.penalty < 1:
            raise InputError(f"penalty must be at least 1, got {self.penalty:g}.")

    def with_states(self, names: Sequence[str]) -> Self:
        """Return the same with the indices of states in place of their names, if there are names."""
        return replace(self, spec=self.spec.with_states(names)) if isinstance(self.spec, NamedStates) else self

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        of_model, of_system = (self.spec.robustness(loop, task) for loop in (model_trajectory, system_trajectory))
        if self.margin is not None:
            return np.asarray(np.maximum(np.minimum(of_model, self.margin - of_system), 0.0))
        return np.asarray(np.maximum(of_model - self.penalty * np.maximum(of_system, 0.0), 0.0))
