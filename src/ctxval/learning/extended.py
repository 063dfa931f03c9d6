"""The validation of which dynamics are learned: states of M for outputs, parameters as states, inputs that act late."""

from __future__ import annotations

import functools
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from ctxval._util.arrays import Array
from ctxval.core.trajectory import Trajectory
from ctxval.core.validation import Validation
from ctxval.learning.actuators import Actuator, commands_of, with_actuator, with_commands
from ctxval.learning.histories import Record
from ctxval.learning.physical import added_states, with_parameters, with_parameters_as_states, without_parameters
from ctxval.learning.recorded import closed_loops_on_model
from ctxval.learning.state_estimates import StateEstimates, with_states_of_model
from ctxval.learning.vector import Executed


class ExtendedValidation:
    """A user's validation, and the one whose trajectories what S does in a step is a function of.

    Attributes:
        given: the user's validation.
        actuator: how the inputs act; None if they act at once.
        inputs: their number m; it need not be known without an actuator.
        validation: the other one. Its closed loops have the inputs that act and those that are commanded, if they
            differ.
    """

    def __init__(
        self,
        given: Validation,
        actuator: Actuator | None = None,
        inputs: int = 0,
        estimates: StateEstimates | None = None,
    ) -> None:
        self.given, self.actuator, self.inputs, self._known = given, actuator, inputs, estimates
        self._acting = WeakKeyDictionary[Trajectory, Trajectory]()
        self.validation = with_actuator(with_parameters_as_states(with_states_of_model(given)), actuator, inputs)

    @property
    def needs_tasks(self) -> bool:
        """Whether only executions of tasks can be learned from: other recordings tell no parameters and no start."""
        return bool(self.given.physical) or self.given.outputs is not None or self.actuator is not None

    @functools.cached_property
    def loops(self) -> Trajectory | None:
        """Closed loops on M; None if no task can be planned."""
        return closed_loops_on_model(self.validation)

    @functools.cached_property
    def pairs(self) -> Array:
        """Some states and acting inputs of the closed loops on M, shape ``(V, n + m)``."""
        assert self.loops is not None
        pairs = np.concatenate([self.loops.states[..., :-1, :], self.acting(self.loops)], axis=-1)
        pairs = pairs.reshape(-1, pairs.shape[-1])
        pairs = pairs[np.isfinite(pairs).all(axis=1)]
        return np.asarray(pairs[:: max(1, len(pairs) // 600)])

    def executions(self, executed: Executed, some: int) -> Executed | None:
        """Return executions as closed loops of the other validation; None if states of M cannot be estimated.

        Estimates are learned from the first ``some`` of them.
        """
        acting = [(point, self._actuated(trajectory)) for point, trajectory in executed]
        if self.given.outputs is not None:
            states = None if self._estimates is None else self._estimates.of(acting, some)
            if states is None:
                return None
            acting = [(point, trajectory) for (point, _), trajectory in zip(acting, states, strict=True)]
        together = []
        for (point, trajectory), (_, whole) in zip(acting, executed, strict=True):
            extended = with_parameters(self.given, point, trajectory)
            together.append((point, with_commands(extended, whole.inputs) if self.actuator else extended))
        return together

    def _actuated(self, trajectory: Trajectory) -> Trajectory:
        """Return an execution with the inputs that act alone, the same object each time."""
        if self.actuator is None:
            return trajectory
        if trajectory not in self._acting:
            self._acting[trajectory] = replace(trajectory, inputs=self.actuator.acting(trajectory.inputs))
        return self._acting[trajectory]

    def of(self, given: Validation) -> ExtendedValidation:
        """Return the same with other physical parameters; the states of M along executions are the same."""
        return ExtendedValidation(given, self.actuator, self.inputs, self._estimates)

    @functools.cached_property
    def _estimates(self) -> StateEstimates | None:
        if self.given.outputs is None or self.loops is None or self._known is not None:
            return self._known
        states = self.loops.states[..., : self.loops.states.shape[-1] - added_states(self.given)]
        return StateEstimates(self.given, self.given.outputs, states)

    def recorded(self, trajectory: Trajectory) -> Trajectory:
        """Return a closed loop as the system records it."""
        plain = without_parameters(self.given, trajectory)
        plain = plain if self.actuator is None else commands_of(plain, self.inputs)
        return plain if self.given.outputs is None else self.given.outputs.of(plain)

    def acting(self, trajectory: Trajectory) -> Array:
        """Return the inputs of a closed loop that act."""
        return trajectory.inputs if self.actuator is None else trajectory.inputs[..., : self.inputs]

    def with_acting(self, trajectory: Trajectory) -> Trajectory:
        """Return a closed loop with the inputs that act alone."""
        return replace(trajectory, inputs=self.acting(trajectory))

    def records(self, executed: Executed) -> list[Record]:
        """Return executions of the other validation with the inputs that act, and the initial states of their tasks."""
        space, records = self.validation.space, []
        for point, trajectory in executed:
            task = self.validation.task(space.parameters(space.from_unit(point)))
            start = np.asarray(task.initial_state, dtype=np.float64)
            records.append(Record(trajectory.states, self.acting(trajectory), start))
        return records
