"""``replay``: what recordings show of a model, as one value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import single_threaded
from ctxval._util.columns import unit_advice
from ctxval._util.representation import ShortRepr, counted
from ctxval.core.model import Model, require_time_step
from ctxval.core.trajectory import Transitions
from ctxval.core.validation import Validation
from ctxval.data.recordings import Recordings
from ctxval.data.sampling import Break
from ctxval.errors import InputError
from ctxval.replay.accuracy import Region, StepError, regions, step_errors
from ctxval.replay.explained import ResidualShare, residual_shares
from ctxval.replay.insights import insights
from ctxval.replay.steps import RecordedSteps
from ctxval.replay.timing import Suggestion, suggestions
from ctxval.replay.untested import PredictedTasks, predicted_tasks

STEPS = (1, 5, 20, 100)
"""Numbers of steps after which errors are computed, unless others are given."""


@dataclass(frozen=True)
class RecordedData(ShortRepr):
    """The recordings that were compared with the model.

    Attributes:
        sources: the files and episodes.
        recordings, steps: the numbers of recordings and of steps.
        dt: length of a step, seconds.
        states, inputs: the names of the states and inputs with their units.
        breaks: where logs were split, and why.
        notes: sentences on how the logs were read.
        seen: number of recordings that are in the data from which the model was learned. They are left out of the
            errors, unless all recordings are.
    """

    sources: tuple[str, ...]
    recordings: int
    steps: int
    dt: float
    states: dict[str, str]
    inputs: dict[str, str]
    breaks: tuple[Break, ...]
    notes: tuple[str, ...]
    seen: int


@dataclass(frozen=True, eq=False)
class ReplayReport(ShortRepr):
    """What recordings show of a model.

    Attributes:
        data: the recordings.
        errors: the error of each state after each number of steps.
        regions: the one-step error in ranges of each state and input.
        residuals: how much of the one-step residual of each state can be explained.
        suggestions: changes of timing with which the model predicts held-out recordings clearly better.
        tasks: what the recordings predict of the tasks of an experiment; None without an experiment, or if the
            recordings teach nothing.
        insights: what follows, in sentences, the most important one first.
    """

    data: RecordedData
    errors: tuple[StepError, ...]
    regions: tuple[Region, ...]
    residuals: tuple[ResidualShare, ...]
    suggestions: tuple[Suggestion, ...]
    tasks: PredictedTasks | None
    insights: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Return all results as plain values; numbers that are not finite are None."""
        found: dict[str, Any] = plain_numbers(asdict(self))
        for row, error in zip(found["errors"], self.errors, strict=True):
            row["relative"] = plain_numbers(error.relative)
        return found


def replay(
    model: Model,
    recordings: Recordings,
    *,
    steps: Sequence[int] = STEPS,
    validation: Validation | None = None,
    executions: int = 10,
    seed: int = 0,
) -> ReplayReport:
    """Compare a model with recordings of its system. Nothing is executed.

    Args:
        model: the model M, with the time step of the recordings.
        recordings: the recordings.
        steps: numbers of steps after which errors are computed.
        validation: an experiment with this model, whose tasks are then judged too; its system is never executed.
        executions: number of executions of the experiment that are proposed.
        seed: seed of all random numbers.

    Raises:
        InputError: if a number of steps is not positive, or the model or the tasks have another time step than the
            recordings.
        ModelError: if the model cannot be run on the recorded states and inputs.
    """
    if not steps or not all(isinstance(k, int) and not isinstance(k, bool) and k >= 1 for k in steps):
        raise InputError(f"steps must be positive integers, got {list(steps)}.")
    if validation is not None:
        _require_same_step(validation, recordings)
    require_time_step(model, recordings.dt, "the recording")
    seen = _seen(model, recordings)
    used = [number for number in range(len(recordings.runs)) if number not in seen] or list(range(len(recordings.runs)))
    recorded = RecordedSteps(recordings, used)
    with single_threaded():
        errors = step_errors(model, recorded, sorted(set(steps)))
        found = regions(model, recorded)
        residuals = residual_shares(model, recorded, seed)
        changes = suggestions(model, recorded)
    tasks = None
    if validation is not None:
        logged = [run.trajectory for run in recordings.runs]
        tasks = predicted_tasks(validation, logged, executions=executions, seed=seed)
    data = _data(recordings, len(seen))
    said = (
        *_of_data(data),
        *insights(data.states | data.inputs, len(used), errors, found, residuals, changes, tasks),
        *([_NOTHING] if validation is not None and tasks is None else []),
    )
    return ReplayReport(data, errors, found, residuals, changes, tasks, said)


_NOTHING = (
    "nothing is predicted of the tasks: the model explains the recordings, or no controller can be designed for a task"
)


def _data(recordings: Recordings, seen: int) -> RecordedData:
    sources = tuple(dict.fromkeys(run.source for run in recordings.runs))
    return RecordedData(
        sources,
        len(recordings.runs),
        recordings.steps,
        recordings.dt,
        recordings.states,
        recordings.inputs,
        recordings.breaks,
        recordings.notes,
        seen,
    )


def _of_data(data: RecordedData) -> list[str]:
    found = []
    if data.breaks:
        places = {(one.source, one.time): one.seconds for one in data.breaks}  # several fields may lack one time
        found.append(
            f"the logs were split at {counted(len(places), 'place')}, and {sum(places.values()):.3g} s are left out; "
            f"the first is {data.breaks[0]}"
        )
    if data.seen == data.recordings:
        found.append("the model was learned from all of these recordings, so its errors on others are larger")
    elif data.seen:
        found.append(f"the model was learned from {data.seen} of these recordings; the errors are those of the others")
    return found


def _seen(model: Model, recordings: Recordings) -> set[int]:
    """Return the recordings most of whose steps are in the data from which the model was learned."""
    data = getattr(model, "data", None)
    n, m = len(recordings.states), len(recordings.inputs)
    if not isinstance(data, Transitions) or data.x.shape[1] != n or data.u.shape[1] != m:
        return set()
    known = set(_rows(data))
    found = set()
    for number, run in enumerate(recordings.runs):
        rows = _rows(run.trajectory.transitions())
        if sum(row in known for row in rows) > len(rows) / 2:
            found.add(number)
    return found


def _rows(transitions: Transitions) -> list[bytes]:
    """Return transitions as texts that agree if the numbers agree to single precision."""
    whole = np.concatenate([transitions.x, transitions.u, transitions.x_next], axis=1)
    return [row.tobytes() for row in (whole.astype(np.float32) + np.float32(0.0))]


def _require_same_step(validation: Validation, recordings: Recordings) -> None:
    space = validation.space
    task = validation.task(space.parameters(0.5 * (space.low + space.high)))
    if task.initial_state.shape[-1] != len(recordings.states):
        raise InputError(
            f"the tasks have {task.initial_state.shape[-1]} states and the recordings have {len(recordings.states)}: "
            f"{', '.join(recordings.states)}."
        )
    if not np.isclose(task.dt, recordings.dt, rtol=1e-3, atol=0):
        raise InputError(
            f"the tasks have steps of {task.dt:g} s and the recordings have steps of {recordings.dt:g} s: "
            f"{unit_advice(recordings.dt, task.dt) or f'give dt = {task.dt:g} in the mapping of the recordings'}."
        )


def plain_numbers(value: Any) -> Any:
    """Return plain values for JSON; numbers that are not finite are None."""
    if isinstance(value, dict):
        return {key: plain_numbers(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_numbers(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain_numbers(value.tolist())
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value
