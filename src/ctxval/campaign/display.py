"""Views of a campaign: as text, as an HTML table, and as a table of pandas."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ctxval._util.representation import Shown, call, counted, lines, named, number, shown, table
from ctxval.core.space import TaskSpace
from ctxval.core.task_suite import TASK, TaskSuite
from ctxval.core.trial import Trial
from ctxval.errors import InputError

if TYPE_CHECKING:
    from pandas import DataFrame

    from ctxval.campaign.campaign import Campaign

_BEFORE, _AFTER = ("number", "origin", "state"), ("distance", "seconds", "attempts", "failure")


def as_text(campaign: Campaign) -> str:
    """Return a campaign in five lines: the task space, the search, the number of trials, the worst task, the store."""
    worst, at = campaign.worst, "no distance is known"
    if worst is not None and worst.distance is not None:
        where = named(worst.parameters, campaign.validation.space.units)
        at = f"trial {worst.number} with distance {number(worst.distance)} at {where}"
    return lines(
        call(campaign, campaign.validation.space, name=campaign.name or None, seed=campaign.seed),
        f"search: {shown(campaign.search)}",
        f"trials: {_trials(campaign)}",
        f"worst: {at}",
        f"store: {shown(campaign.store)}",
    )


def as_html(campaign: Campaign) -> str:
    """Return a campaign as an HTML table, with one row for each parameter of the worst task."""
    worst, units = campaign.worst, campaign.validation.space.units
    parameters = {} if worst is None else worst.parameters
    return table(
        f"Campaign {campaign.name}",
        [
            ("search", shown(campaign.search)),
            ("seed", campaign.seed),
            ("trials", _trials(campaign)),
            ("worst trial", "no distance is known" if worst is None else worst.number),
            ("distance", None if worst is None else worst.distance),
            *((name, f"{shown(value)} {units.get(name, '')}") for name, value in parameters.items()),
            ("store", shown(campaign.store)),
        ],
    )


def _trials(campaign: Campaign) -> Shown:
    states = Counter(trial.state for trial in campaign.trials)
    counts = [counted(campaign.executions, "execution"), *(f"{count} {state}" for state, count in states.items())]
    return Shown(f"{len(campaign.trials)} ({', '.join(counts)})")


def to_dataframe(trials: Sequence[Trial], space: TaskSpace) -> DataFrame:
    """Return one row for each trial: number, origin, state, the task parameters, distance, seconds, attempts, failure.

    A vector parameter has one column for each component, ``name[0], name[1], ...``. If a parameter has the name of
    another column, such as ``distance``, its column is ``parameters.distance``. Unknown values are missing values.
    """
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
