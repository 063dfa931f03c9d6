"""What follows from a replay, in sentences."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from ctxval.replay.accuracy import Region, StepError
from ctxval.replay.explained import ResidualShare
from ctxval.replay.timing import Suggestion
from ctxval.replay.untested import PredictedTasks

_SHARE = 0.3  # share of a residual from which an explanation is named
_SMALL = 1e-3  # a one-step error below this share of the change is called small, and its causes are not named


def insights(
    names: Mapping[str, str],
    held_out: int,
    errors: Sequence[StepError],
    found: Sequence[Region],
    residuals: Sequence[ResidualShare],
    changes: Sequence[Suggestion],
    tasks: PredictedTasks | None,
) -> tuple[str, ...]:
    """Return what follows from the results of a replay, the most important first."""
    return (
        *(one.sentence for one in changes),
        *_of_errors(errors, held_out),
        *_of_residuals(errors, residuals),
        *_of_regions(errors, found),
        *_of_tasks(names, tasks),
    )


def _of_errors(errors: Sequence[StepError], held_out: int) -> Iterator[str]:
    single = [one for one in errors if one.steps == 1]
    if not single:
        yield "no recording has a single step, so nothing can be compared"
        return
    worst = max(single, key=lambda one: one.relative)
    if worst.relative >= 1:
        yield (
            f"the model predicts {worst.state} no better than no change at all: its one-step error is "
            f"{100 * worst.relative:.0f} % of the recorded change"
        )
    last = max(errors, key=lambda one: one.steps)
    late = [one for one in errors if one.steps == last.steps and one.relative >= 1]
    if late and worst.relative < 1:
        states = ", ".join(one.state for one in late)
        yield f"after {last.steps} steps the model predicts {states} no better than no change at all"
    diverged = max(errors, key=lambda one: one.diverged)
    if diverged.diverged > 0:
        yield f"{100 * diverged.diverged:.2g} % of the predictions of {diverged.steps} steps diverge"
    if held_out == 1:
        yield "there is only one recording, so the spread is that over five parts of it"


def _of_residuals(errors: Sequence[StepError], residuals: Sequence[ResidualShare]) -> Iterator[str]:
    relative = {one.state: one.relative for one in errors if one.steps == 1}
    for one in residuals:
        if relative.get(one.state, 0.0) < _SMALL:
            continue
        left = f"{one.rest:.3g} {one.unit}".rstrip()
        if one.explained >= _SHARE:
            how = "an affine function" if one.linear > 0.9 * one.explained else "a function"
            yield (
                f"{100 * one.explained:.0f} % of the residual of {one.state} is {how} of state and input: a better "
                f"model can be learned from these recordings, with {left} of one-step error left"
            )
        elif one.history < _SHARE:
            yield (
                f"state and input explain {100 * one.explained:.0f} % of the residual of {one.state}: the rest of "
                f"{left} is noise, or has a cause that is not recorded"
            )
        if one.history >= _SHARE and one.rest > 0.05 * one.rms:
            yield (
                f"the step before explains {100 * one.history:.0f} % of what state and input leave of the residual of "
                f"{one.state}: the system has a state that is not recorded, a delay, or filtered measurements"
            )


def _of_regions(errors: Sequence[StepError], found: Sequence[Region]) -> Iterator[str]:
    if max((one.relative for one in errors if one.steps == 1), default=0.0) < _SMALL:
        return
    large = sorted((one for one in found if one.ratio >= 1.5), key=lambda one: -one.ratio)
    for one in large[:3]:
        unit = f" {one.unit}" if one.unit else ""
        yield (
            f"the one-step error is {one.ratio:.2g} times as large as on average where {one.variable} is between "
            f"{one.low:.3g} and {one.high:.3g}{unit}"
        )


def _of_tasks(names: Mapping[str, str], tasks: PredictedTasks | None) -> Iterator[str]:
    if tasks is None or not tasks.worst:
        return
    worst = tasks.worst[0]
    at = ", ".join(f"{name} = {_short(value)}" for name, value in worst.parameters.items())
    yield (
        f"of all tasks, {at} has the largest predicted distance, {worst.median:.3g} (between {worst.low:.3g} and "
        f"{worst.high:.3g}); no execution has tested it"
    )
    if tasks.beyond > 0.05:
        yield (
            f"the closed loops of the tasks lead beyond all records of {list(names)[tasks.beyond_of]}, by "
            f"{100 * tasks.beyond:.0f} % of the range that they visit: predictions are extrapolated there"
        )


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
