"""Formulas of signal temporal logic, by the package ``rtamt``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.refusals import require_extra, reworded
from ctxval._util.registry import part
from ctxval.core.distance import NamedStates, selected
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError, ShapeError


@part()
@dataclass(frozen=True, eq=False)
class STL(NamedStates):
    """A formula of signal temporal logic over the states at the recorded times, such as ``always (x < 1.0)``.

    ``rtamt`` computes its robustness, one trajectory after the other. Times in a formula are seconds and multiples of
    the time step. An entry ``obstacle`` of the task's environment is known to the formula as ``obstacle_0``,
    ``obstacle_1`` and so on. The robustness changes by at most as much as the states if each predicate compares one
    state with a constant; with other predicates, scale them.

    Raises:
        InputError: if there are no variables.
        ShapeError: if there is not a variable for each component.
    """

    formula: str  #: the formula
    variables: Sequence[str]  #: a name in the formula for each state that it looks at
    #: these states, by index or by the name in the experiment; the first ones by default
    components: Sequence[int | str] | None = None

    def __post_init__(self) -> None:
        require_extra("rtamt", "stl", "specifications in signal temporal logic need")
        if not len(self.variables):
            raise InputError("a formula needs the name of at least one state in variables, got none.")
        if self.components is None:
            object.__setattr__(self, "components", tuple(range(len(self.variables))))
        elif len(self.components) != len(self.variables):
            got = f"{len(self.variables)} variables and {len(self.components)} components"
            raise ShapeError(f"a formula needs a variable for each component, got {got}.")

    def robustness(self, trajectory: Trajectory, task: Task) -> Array:
        """Return rho ``(...)``; see :class:`ctxval.specs.Specification`."""
        positions = selected(trajectory.states, self.components)
        shape, names = positions.shape[:-1], list(self.variables)
        signals = [positions[..., i] for i in range(len(self.variables))]
        for entry, values in task.environment.items():
            for i in range(values.shape[-1]):
                names.append(f"{entry}_{i}")
                signals.append(np.broadcast_to(values[..., i, None], shape))
        rows = np.stack(signals, axis=-2).reshape(-1, len(names), shape[-1])
        return np.array([self._of_one(names, row, task) for row in rows]).reshape(shape[:-1])

    def _of_one(self, names: Sequence[str], signals: Array, task: Task) -> float:
        rtamt = require_extra("rtamt", "stl", "specifications in signal temporal logic need")
        monitor = rtamt.StlDiscreteTimeSpecification()
        monitor.unit = "s"
        monitor.set_sampling_period(task.dt, "s", 0.1)
        for name in names:
            monitor.declare_var(name, "float")
        monitor.spec = self.formula
        with reworded(f"the formula {self.formula!r} cannot be evaluated"):  # whatever rtamt raises
            monitor.parse()
            data = dict(zip(names, signals.tolist(), strict=True))
            rho = float(monitor.evaluate({"time": task.times[: signals.shape[1]].tolist(), **data})[0][1])
        if not np.isfinite(rho):
            raise InputError(f"the formula {self.formula!r} needs times after the end of the task.")
        return rho
