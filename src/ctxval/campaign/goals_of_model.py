"""A warning if the model itself does not complete the tasks of a campaign, from the plans that it makes anyway."""

from __future__ import annotations

import warnings

from ctxval.core.labels import labels_of
from ctxval.core.plan import Plan
from ctxval.core.soundness import MISSED, goal_misses
from ctxval.core.validation import Validation


class GoalWarning(UserWarning):
    """The model itself misses the goals of its tasks, so that validating S against it says little."""


class GoalsOfModel:
    """Warns once if M misses a goal in the plans of a campaign, if the synthesizer tells which states have one."""

    def __init__(self, validation: Validation) -> None:
        self._validation = validation
        self._plans: list[Plan] = []
        self._warned = False

    def watch(self, plan: Plan) -> None:
        """Take note of a plan; warn if M misses its goal in this task or an earlier one, the first time."""
        if self._warned or not plan.task.has_goal:
            return
        self._plans = [*self._plans[:19], plan]  # which show the range of the states
        on_model = [each.model_trajectory for each in self._plans]
        if len(on_model) < 3:
            return
        misses = goal_misses(self._validation, on_model, [each.task.goal for each in self._plans])
        if misses is None or not misses.missed.any():
            return
        row, state, size = misses.worst
        names = labels_of(self._validation.names(on_model[0].states.shape[-1], on_model[0].inputs.shape[-1])[0])
        where = self._validation.space.describe_point(self._plans[row].parameters.points)
        self._warned = True
        warnings.warn(
            f"the model itself does not complete its tasks: in {misses.missed.sum()} of {len(self._plans)} it ends "
            f"more than {100 * MISSED:g} % of the range of a state from its goal, by {size:.3g} in {names[state]} for "
            f"the task {where}. A validation against such a model says little: see `ctxval check --aspect1`.",
            GoalWarning,
            stacklevel=2,
        )
