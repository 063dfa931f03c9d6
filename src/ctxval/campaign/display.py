"""Views of a campaign: as text, and as a table of pandas."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ctxval._util.representation import Shown, counted, lines, named, number, shown
from ctxval.campaign.trials import TrialRecorder
from ctxval.core.space import TaskSpace
from ctxval.core.task_suite import TASK, TaskSuite
from ctxval.core.trial import Trial, Trials
from ctxval.errors import InputError

if TYPE_CHECKING:
    from pandas import DataFrame

_BEFORE, _AFTER = ("number", "origin", "state"), ("distance", "seconds", "attempts", "failure")


def as_text(head: str, recorder: TrialRecorder) -> str:
    """Return a campaign in five lines: the task space, the search, the number of trials, the worst task, the store."""
    worst, at = recorder.trials.worst, "no distance is known"
    if worst is not None and worst.distance is not None:
        where = named(worst.parameters, recorder.validation.space.units)
        at = f"trial {worst.number} with distance {number(worst.distance)} at {where}"
    return lines(
        head,
        f"search: {shown(recorder.search)}",
        f"trials: {_counts(recorder.trials)}",
        f"worst: {at}",
        f"store: {shown(recorder.store)}",
    )


def _counts(trials: Trials) -> Shown:
    states = Counter(trial.state for trial in trials)
    counts = [counted(trials.executions, "execution"), *(f"{count} {state}" for state, count in states.items())]
    return Shown(f"{len(trials)} ({', '.join(counts)})")


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
