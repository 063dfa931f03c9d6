"""``survey``: a first statement on logs that nobody has described: what they hold, and how well models predict them.

Which fields are states and inputs is guessed from their names, and every guess is said. The models are learned from
some of the recordings and judged by the others.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ctxval._util.arrays import single_threaded
from ctxval._util.columns import TIMES, named_unit, time_column
from ctxval._util.describe import plain_json
from ctxval._util.representation import ShortRepr, counted
from ctxval._util.texts import enumerated
from ctxval.core.model import Model
from ctxval.data import Clock, Field, Log, LogMapping, Recordings, Table, component_names, read_logs, recordings_of
from ctxval.errors import InputError
from ctxval.studies.fitting import FitReport, fit
from ctxval.studies.fitting.fit import FittedModel
from ctxval.studies.replay import ReplayReport, replay
from ctxval.studies.replay.accuracy import step_errors
from ctxval.studies.replay.report import unseen

Role = Literal["state", "input", ""]

CLOSE = 0.1  # largest error, as a share of the recorded change, of a prediction that is called close

_NEVER, _HARDLY = "it never changes", "it hardly changes"

# Words in the names of fields by which their roles are guessed.
_INPUTS = (
    "u cmd command commands commanded input inputs action actions ref reference target goal setpoint desired tau "
    "torque force voltage volt volts duty pwm throttle steer steering brake effort control ctrl valve thrust enable"
)
_OTHERS = (
    "time t stamp timestamp sec nsec secs nanosec index frame episode seq id count counter status temp temperature "
    "battery done reward success run trial"
)
_RATES = "rate rates speed vel velocity velocities omega dq qd gyro twist"
_STATES = (
    f"{_RATES} pos position positions angle theta phi psi q x y z yaw pitch roll heading level height altitude state "
    "states displacement deflection encoder"
)


@dataclass(frozen=True)
class FieldSummary(ShortRepr):
    """One field of a log."""

    path: str  #: its name and its unit; the unit is empty if the log states none
    unit: str
    records: int  #: number of records, and median seconds between two of them
    period: float
    low: float  #: its smallest and its largest value
    high: float
    role: Role  #: whether it is taken as a state, as an input, or not at all
    remark: str  #: what is unusual, such as that it never changes


@dataclass(frozen=True, eq=False)
class Survey(ShortRepr):
    """What logs hold, and how well models that are learned from them predict others of them."""

    sources: tuple[str, ...]  #: the files and episodes
    fields: tuple[FieldSummary, ...]  #: the fields of the first log
    mapping: LogMapping  #: which fields are taken as states and inputs, and what was guessed, one sentence each
    guesses: tuple[str, ...]
    recordings: Recordings
    fit: FitReport  #: a linear model and one with what this leaves, each with its errors
    replay: ReplayReport  #: what the recordings show of the better one
    reach: tuple[int, int]  #: number of steps for which its errors are close, and those that were compared

    @property
    def best(self) -> FittedModel:
        """The more accurate model."""
        return self.fit.fitted[0]

    @property
    def statement(self) -> str:
        """How far the better model predicts, and which tasks it suits, in one sentence."""
        close, compared = self.reach
        dt, share = self.recordings.dt, f"{100 * CLOSE:g} % of the recorded change"
        model, far = f"the {self.best.kind} model", f"{counted(close, 'step')} ({close * dt:.3g} s)"
        if not close:
            return f"{model} errs by more than {share} after one step of {dt:g} s already: it suits no task yet"
        suits = f"up to {far}, and by more after that: it suits tasks that end, or that feedback corrects, in less time"
        if close == compared:
            suits = f"at least {far}, as long as was compared: it suits tasks in the recorded range"
        return f"{model} errs by less than {share} for {suits}"

    def to_json(self) -> dict[str, Any]:
        """Return all results as plain values."""
        values = {
            "sources": self.sources,
            "fields": self.fields,
            "states": self.recordings.states,
            "inputs": self.recordings.inputs,
            "guesses": self.guesses,
            "fit": self.fit,
            "replay": self.replay,
            "close": self.reach[0],
            "compared": self.reach[1],
            "statement": self.statement,
        }
        return plain_json(values)


def survey(
    paths: Sequence[str | Path], mapping: LogMapping | None = None, *, dt: float | None = None, seed: int = 0
) -> Survey:
    """Return a first statement on the logs in files and folders.

    Args:
        paths: as in :func:`ctxval.data.read_recordings`; the logs have the same fields.
        mapping: which fields are states and inputs; guessed if it is None.
        dt: length of a step in seconds, if the logs have no times or another one is wanted.
        seed: seed of the choice of recordings that are held out.

    Raises:
        InputError: if nothing can be read, or no model can be learned.
    """
    logs, names = read_logs(paths), component_names(paths) if mapping is None else {}
    first, guesses = logs[0], list[str]()
    clock = _clock(first, dt, guesses) if mapping is None else mapping.clock
    times = (*TIMES, clock.field or "")
    fields = [path for path in first.fields() if named_unit(path)[0].casefold() not in times and path != clock.field]
    summaries = [_summary(logs[:20], path, clock) for path in fields]
    chosen = replace(_guessed(first, summaries, clock, guesses), time=clock.field) if mapping is None else mapping
    chosen = chosen if dt is None else replace(chosen, dt=dt)
    recordings = recordings_of(logs, chosen, names)
    if mapping is None and (turned := _turning(chosen, recordings)):
        guesses.append(f"{enumerated(turned, 6)} jumps by 2 pi, so it is an angle that is continued over turns")
        chosen = replace(chosen, states={**chosen.states, **turned})
        recordings = recordings_of(logs, chosen, names)
    if not any(np.ptp(run.trajectory.states, axis=0).any() for run in recordings.runs):
        raise InputError(
            f"no state ever changes in the logs ({enumerated(recordings.states, 6)}), so nothing is learned."
        )
    roles: dict[str, Role] = {field.path: "state" for field in chosen.states.values()}
    roles |= {field.path: "input" for field in chosen.inputs.values()}
    horizons = sorted(run.trajectory.horizon for run in recordings.runs)
    whole = horizons[len(horizons) // 2] if len(horizons) > 1 else max(1, horizons[0] // 5)
    fitted = fit(recordings, ["linear", "gaussian-process"], steps=sorted({1, min(10, whole), whole}), seed=seed)
    if not fitted.fitted:
        raise InputError(f"no model can be learned: {'; '.join(failure.reason for failure in fitted.failed)}")
    model = fitted.fitted[0].model
    steps = {1, min(10, whole), *np.unique(np.geomspace(1, whole, 8).astype(int)).tolist(), whole}
    return Survey(
        tuple(dict.fromkeys(log.source for log in logs)),
        tuple(replace(summary, role=roles.get(summary.path, "")) for summary in summaries),
        chosen,
        tuple(guesses),
        recordings,
        fitted,
        replay(model, recordings, steps=sorted(steps), seed=seed),
        _reach(model, recordings, whole),
    )


def _summary(logs: Sequence[Log], path: str, clock: Clock) -> FieldSummary:
    try:
        signals = [log.signals([path], clock)[path] for log in logs]
    except InputError as error:
        return FieldSummary(path, "", 0, 0.0, np.nan, np.nan, "", str(error))
    unit, records = signals[0].unit, sum(len(signal.values) for signal in signals)
    known = [signal.values[np.isfinite(signal.values).all(axis=1)] for signal in signals]
    values = np.concatenate(known)
    if not len(values):
        return FieldSummary(path, unit, 0, 0.0, np.nan, np.nan, "", "it has no value")
    steps = np.concatenate([np.diff(signal.times) for signal in signals])
    period = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    low, high = float(values.min()), float(values.max())
    changing = np.concatenate([(np.diff(each, axis=0) != 0).any(axis=1) for each in known])
    changes = float(changing.mean()) if len(changing) else 0.0
    at_ends = max(float((values == end).all(axis=1).mean()) for end in (low, high))
    remark = ""
    if low == high:
        remark = _NEVER
    elif np.ptp(values, axis=0).max() <= 0.02 * max(abs(low), abs(high)):
        remark = _HARDLY
    elif changes == 0:
        remark = "it has one value in each file"
    elif len(np.unique(values)) == 2:
        remark = "a switch"
    elif changes < 0.5:
        remark = f"it changes in {100 * changes:.0f} % of the records"
    elif at_ends > 0.05:
        remark = f"it is at one end in {100 * at_ends:.0f} % of the records"
    if records > len(values):
        remark = ", ".join(filter(None, [remark, f"missing in {counted(records - len(values), 'record')}"]))
    return FieldSummary(path, unit, len(values), period, low, high, "", remark)


def _words(path: str) -> list[str]:
    """Return the words in the name of a field, without its unit."""
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", named_unit(path)[0])
    return re.findall("[a-z]+|[0-9]+", name.casefold())


def _is(path: str, words: str) -> bool:
    """Return whether the name of a field has one of some words."""
    return not set(_words(path)).isdisjoint(words.split())


def _guessed(log: Log, fields: Sequence[FieldSummary], clock: Clock, guesses: list[str]) -> LogMapping:
    """Return the mapping by usual names, or by words in the names of fields; say how it was found."""
    with suppress(InputError):
        usual = LogMapping.usual(log)
        guesses.append(f"states and inputs have their usual names: {enumerated(usual.fields, 12)}")
        return usual
    moving = [each for each in fields if each.records and not each.remark.startswith((_NEVER, _HARDLY))]
    still = [each.path for each in fields if each not in moving]
    inputs = [each.path for each in moving if _is(each.path, _INPUTS)]
    others = [each.path for each in moving if each.path not in inputs and _is(each.path, _OTHERS)]
    left = [each.path for each in moving if each.path not in (*inputs, *others)]
    rates = _RATES.split()
    moved = [[word for word in _words(path) if word not in rates] for path in left if _is(path, _RATES)]
    states = [path for path in left if _is(path, _STATES) or _words(path) in moved] or left  # shoulder, shoulder_rate
    if not states:
        raise InputError(
            f"{log.source} has no field that looks like a state; name the states and inputs with --state and --input. "
            f"Its fields are {enumerated((each.path for each in fields), 24)}."
        )
    # Short names: the last part of each path, or the whole path if that is not unique.
    plain = {path: named_unit(path)[0] for path in states + inputs}
    last = {path: re.split(r"[/.]", name)[-1].strip() or name for path, name in plain.items()}
    names = {path: name if [*last.values()].count(name) == 1 else plain[path] for path, name in last.items()}
    taken = f"states: {enumerated(states, 12)}; inputs: {enumerated(inputs, 12) or 'none'}"
    guesses.append(f"the names of the fields tell what they are taken as; {taken}")
    if unused := [*others, *still, *(path for path in left if path not in states)]:
        guesses.append(f"not used: {enumerated(unused, 12)}")
    of_states = {names[path]: Field(path) for path in states}
    single = [path for path in states if "[" in path or log.signals([path], clock)[path].values.shape[1] == 1]
    if not any(_is(path, _RATES) for path in states) and single:
        of_states |= {f"{names[path]} rate": Field(derivative_of=names[path]) for path in single}
        guesses.append("no rate is recorded, so the derivatives of the states are states too")
    return LogMapping(of_states, {names[path]: Field(path) for path in inputs}, dt=log.period)


def _clock(log: Log, dt: float | None, guesses: list[str]) -> Clock:
    """Return where the times of a log come from: a column of times, also within a structure, or the time step."""
    if not isinstance(log, Table) or time_column(log.source, log.fields()) is not None:
        return Clock(period=dt)
    inside = [path for path in log.fields() if re.split(r"[/.]", named_unit(path)[0])[-1].casefold() in TIMES]
    if not inside or dt is not None:
        return Clock(period=dt or log.period)
    guesses.append(f"the times are those of {inside[0]}")
    return Clock(inside[0])


def _turning(mapping: LogMapping, recordings: Recordings) -> dict[str, Field]:
    """Return the states that are angles kept within a turn, as fields that are continued over turns."""
    turned = {}
    for name, field in mapping.states.items():
        if field.derivative_of or name not in recordings.states:
            continue
        column = list(recordings.states).index(name)
        values = [run.trajectory.states[:, column] for run in recordings.runs]
        jumps = np.abs(np.concatenate([np.diff(each) for each in values]))
        small, large = jumps <= 1.0, jumps >= 1.5 * np.pi
        if large.any() and (small | large).all() and np.ptp(np.concatenate(values)) <= 1.05 * 2 * np.pi:
            turned[name] = replace(field, angle=True)
    return turned


def _reach(model: Model, recordings: Recordings, whole: int) -> tuple[int, int]:
    """Return for how many steps errors on recordings that were not learned from are close, and the most compared."""
    held = unseen(model, recordings) or range(len(recordings.runs))
    grid = sorted({min(whole, round(1.5**k)) for k in range(40) if 1.5**k <= 2 * whole} | {whole})
    with single_threaded():
        errors = step_errors(model, replace(recordings, runs=tuple(recordings.runs[number] for number in held)), grid)
    close, most = 0, 0
    for most in sorted({error.steps for error in errors}):
        if any(not error.relative < CLOSE or error.diverged for error in errors if error.steps == most):
            break
        close = most
    return close, most
