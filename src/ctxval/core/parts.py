"""The check that the parts of a validation have the right types."""

from __future__ import annotations

from ctxval.core.controller import Synthesizer
from ctxval.core.labels import Labels
from ctxval.core.space import TaskSpace
from ctxval.core.system import System
from ctxval.errors import InputError


def require_parts(
    space: object,
    task: object,
    system: object,
    synthesizer: object,
    distance: object,
    start_tolerance: object,
    labels: object,
) -> None:
    """Check the types of the arguments of :class:`ctxval.Validation`; the model is checked where it is converted.

    Raises:
        InputError: if one of them has the wrong type; the message names it and what is missing.
    """
    require_part("space", space, isinstance(space, TaskSpace), "a TaskSpace")
    require_part("task", task, callable(task), "a function p -> Task")
    require_part("system", system, isinstance(system, System), "a System with execute(controller, task)")
    designs = isinstance(synthesizer, Synthesizer)
    require_part("synthesizer", synthesizer, designs, "a Synthesizer with design(task, model)")
    measures = "a function (model_trajectory, system_trajectory, task) -> d"
    require_part("distance", distance, callable(distance), measures)
    require_part("labels", labels, labels is None or isinstance(labels, Labels), "Labels(states, inputs, units)")
    require_part("start_tolerance", start_tolerance, _is_tolerance(start_tolerance), "a finite number >= 0")


def _is_tolerance(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < float("inf")


def require_part(name: str, value: object, valid: bool, wanted: str) -> None:
    """Raise an error with the name, what would be right and the value, unless the value is valid.

    Raises:
        InputError: if it is not.
    """
    if not valid:
        raise InputError(f"{name} must be {wanted}, got {value!r}.")
