"""The trials of a campaign as a table of pandas."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ctxval.core.space import TaskSpace
from ctxval.core.task_suite import TASK, TaskSuite
from ctxval.core.trial import Trial
from ctxval.errors import InputError

if TYPE_CHECKING:
    from pandas import DataFrame

_BEFORE, _AFTER = ("number", "origin", "state"), ("distance", "seconds", "attempts", "failure")


def to_dataframe(trials: Sequence[Trial], space: TaskSpace) -> DataFrame:
    """Return one row for each trial, as :meth:`ctxval.Campaign.to_dataframe` describes it."""
    try:
        from pandas import DataFrame
    except ImportError as error:
        raise InputError("a table of trials needs pandas, which is not installed: pip install pandas.") from error
    columns: dict[str, list[Any]] = {name: [getattr(trial, name) for trial in trials] for name in _BEFORE}
    points = [space.point(trial.parameters) for trial in trials]
    if isinstance(space, TaskSuite):
        names = [space.task_names_at(point) for point in points]
        values = {TASK: names} | {name: [space.values_of(name, point) for point in points] for name in space.names}
    else:
        values = {name: [point[axis] for point in points] for axis, name in enumerate(space.names)}
    columns |= {f"parameters.{name}" if name in (*_BEFORE, *_AFTER) else name: of for name, of in values.items()}
    columns |= {name: [getattr(trial, name) for trial in trials] for name in _AFTER}
    frame = DataFrame(columns)
    texts = [name for name, of in columns.items() if any(isinstance(value, str) for value in of)]
    asked = ("distance", "seconds", *list(columns)[len(_BEFORE) : -len(_AFTER)])
    numbers = {name: "float64" for name in asked if name not in texts}
    return frame.astype({"number": "int64", "attempts": "int64", **numbers})
