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
from ctxval._util.columns import TIMES, column_of, named_unit, time_column
from ctxval._util.describe import plain_json
from ctxval._util.representation import ShortRepr, counted
from ctxval._util.texts import enumerated
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory
from ctxval.data import Clock, Field, Log, LogMapping, Recordings, Table, component_names, read_logs, recordings_of
from ctxval.data.rates import Column, rate_pairs
from ctxval.errors import InputError
from ctxval.studies.fitting import FitReport, fit
from ctxval.studies.fitting.fit import FittedModel
from ctxval.studies.replay import ReplayReport, replay
from ctxval.studies.replay.accuracy import step_errors
from ctxval.studies.replay.report import unseen
from ctxval.studies.roles import Evidence, roles

Role = Literal["state", "input", ""]

CLOSE = 0.1  # largest error, as a share of the recorded change, of a prediction that is called close

_NEVER, _HARDLY, _COUNTS = "it never changes", "it hardly changes", "it counts the records or the time"


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

    @property
    def moves(self) -> bool:
        """Whether its records change, and do not only count."""
        return bool(self.records) and not self.remark.startswith((_NEVER, _HARDLY, _COUNTS))


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
    #: the numbers of steps from which and up to which its errors are close, 0 if none is, and the most compared
    reach: tuple[int, int, int]

    @property
    def best(self) -> FittedModel:
        """The more accurate model."""
        return self.fit.fitted[0]

    @property
    def statement(self) -> str:
        """How far the better model predicts, and which tasks it suits, in one sentence."""
        first, close, compared = self.reach
        dt, share = self.recordings.dt, f"{100 * CLOSE:g} % of the recorded change"
        model, far = f"the {self.best.kind} model", f"{counted(close, 'step')} ({close * dt:.3g} s)"
        if not close:
            return f"{model} errs by more than {share} after each number of steps of {dt:g} s: it suits no task yet"
        suits = f"up to {far}, and by more after that: it suits tasks that end, or that feedback corrects, in less time"
        if close == compared:
            suits = f"at least {far}, as long as was compared: it suits tasks in the recorded range"
        if first > 1:
            suits += f"; over less than {first} steps, noise hides the motion"
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
            "close_from": self.reach[0],
            "close": self.reach[1],
            "compared": self.reach[2],
            "statement": self.statement,
        }
        return plain_json(values)


def survey(
    paths: Sequence[str | Path],
    mapping: LogMapping | None = None,
    *,
    time: str | None = None,
    dt: float | None = None,
    seed: int = 0,
) -> Survey:
    """Return a first statement on the logs in files and folders.

    Args:
        paths: as in :func:`ctxval.data.read_recordings`; the logs have the same fields.
        mapping: which fields are states and inputs; guessed if it is None.
        time: the column of the times, perhaps with a unit that it does not state, as ``t [ms]``; found if it is None.
        dt: length of a step in seconds, if the logs have no times or another one is wanted.
        seed: seed of the choice of recordings that are held out.

    Raises:
        InputError: if nothing can be read, or no model can be learned.
    """
    logs, names = read_logs(paths), component_names(paths) if mapping is None else {}
    first, guesses = logs[0], list[str]()
    clock = mapping.clock if mapping is not None else Clock(time) if time else _clock(first, dt, guesses)
    used = _time_of(first, clock)
    evidence = [_evidence(logs[:20], path, clock) for path in first.fields() if path != used]
    reasons = {each.remark if isinstance(each, FieldSummary) else "" for each in evidence}
    if len(reasons) == 1 and "" not in reasons:  # there are no times, for example: that error is the answer
        for log in logs[:20]:
            log.signals([evidence[0].path], clock)
    summaries = [_summary(each) if isinstance(each, Evidence) else each for each in evidence]
    if mapping is None:
        moving = [each for each in evidence if isinstance(each, Evidence) and _summary(each).moves]
        chosen = replace(_guessed(first, summaries, moving, guesses), time=clock.field)
    else:
        chosen = mapping
    chosen = chosen if dt is None else replace(chosen, dt=dt)
    recordings = recordings_of(logs, chosen, names)
    if mapping is None and (corrected := _corrected(chosen, recordings, guesses)) is not chosen:
        chosen, recordings = corrected, recordings_of(logs, corrected, names)
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


def _time_of(log: Log, clock: Clock) -> str | None:
    """Return the column of the times of a table; None if there is none."""
    if not isinstance(log, Table):
        return clock.field
    about = log.source, log.fields()
    column = time_column(*about) if clock.field is None else column_of(*about, clock.field)
    return None if column is None else column[0]


def _evidence(logs: Sequence[Log], path: str, clock: Clock) -> Evidence | FieldSummary:
    try:
        signals = [log.signals([path], clock)[path] for log in logs]
    except InputError as error:
        return FieldSummary(path, "", 0, 0.0, np.nan, np.nan, "", _bare(error, logs[0]))
    return Evidence(path, signals[0].unit, signals)


def _bare(error: InputError, log: Log) -> str:
    """Return the reason why a field of a log cannot be read, without the file and the full stop."""
    return str(error).removeprefix(log.source).lstrip(",: ").removesuffix(".")


def _summary(field: Evidence) -> FieldSummary:
    path, unit, signals = field.path, field.unit, field.signals
    records = sum(len(signal.values) for signal in signals)
    known = [signal.values[np.isfinite(signal.values).all(axis=1)] for signal in signals]
    values = np.concatenate(known)
    if not len(values):
        return FieldSummary(path, unit, 0, 0.0, np.nan, np.nan, "", "it has no value")
    steps = np.concatenate([np.diff(signal.times) for signal in signals])
    period = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    low, high = float(values.min()), float(values.max())
    changes = 1 - field.repeated
    at_ends = max(float((values == end).all(axis=1).mean()) for end in (low, high))
    remark = ""
    if low == high:
        remark = _NEVER
    elif np.ptp(values, axis=0).max() <= 0.02 * max(abs(low), abs(high)):
        remark = _HARDLY
    elif field.counts:
        remark = _COUNTS
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


def _guessed(log: Log, fields: Sequence[FieldSummary], moving: Sequence[Evidence], guesses: list[str]) -> LogMapping:
    """Return the mapping by usual names, or by the records, units and names of fields; say how it was found."""
    with suppress(InputError):
        usual = LogMapping.usual(log)
        guesses.append(f"states and inputs have their usual names: {enumerated(usual.fields, 12)}")
        return usual
    states, inputs = roles(moving)
    if not states:
        raise InputError(
            f"{log.source} has no field that looks like a state; name the states and inputs with --state and --input. "
            f"Its fields are {_with_reasons(fields, 24)}."
        )
    # Short names: the last part of each path, or the whole path if that is not unique.
    plain = {path: named_unit(path)[0] for path in states + inputs}
    last = {path: re.split(r"[/.]", name)[-1].strip() or name for path, name in plain.items()}
    names = {path: name if [*last.values()].count(name) == 1 else plain[path] for path, name in last.items()}
    taken = f"states: {enumerated(states, 12)}; inputs: {enumerated(inputs, 12) or 'none'}"
    guesses.append(f"the records, units and names of the fields tell what they are taken as; {taken}")
    if unused := [each for each in fields if each.path not in (*states, *inputs)]:
        guesses.append(f"not used: {_with_reasons(unused, 12)}")
    of_states, known = {names[path]: Field(path) for path in states}, {each.path: each for each in moving}
    orders = {path: Column(path, known[path].unit).order for path in states}
    bare = [path for path in states if known[path].values.shape[1] == 1 and not known[path].process]
    if bare and not {1, 2} & {*orders.values()}:
        of_states |= {f"{names[path]} rate": Field(derivative_of=names[path]) for path in bare}
    for path in states:
        if 0 < (share := known[path].repeated) > 0.5:
            guesses.append(
                f"{path} repeats its value in {100 * share:.0f} % of the records: it is rounded or held there"
            )
    return LogMapping(of_states, {names[path]: Field(path) for path in inputs}, dt=log.period)


def _with_reasons(fields: Sequence[FieldSummary], most: int) -> str:
    """Return the names of fields, each with the remark that tells why it is not used."""
    unknown = "its name, unit and records show neither a state nor an input"
    return enumerated((f"{each.path} ({each.remark or unknown})" for each in fields), most)


def _clock(log: Log, dt: float | None, guesses: list[str]) -> Clock:
    """Return where the times of a log come from: a column of times, also within a structure, or the time step."""
    if not isinstance(log, Table) or time_column(log.source, log.fields()) is not None:
        return Clock(period=dt)
    inside = [path for path in log.fields() if re.split(r"[/.]", named_unit(path)[0])[-1].casefold() in TIMES]
    if not inside or dt is not None:
        return Clock(period=dt or log.period)
    guesses.append(f"the times are those of {inside[0]}")
    return Clock(inside[0])


def _corrected(mapping: LogMapping, recordings: Recordings, guesses: list[str]) -> LogMapping:
    """Return a guessed mapping as the records show it: angles over turns, and no derivatives if a rate is recorded."""
    states = {**mapping.states, **(turned := _turning(mapping, recordings))}
    if turned:
        guesses.append(f"{enumerated(turned, 6)} jumps by 2 pi, so it is an angle that is continued over turns")
    recorded = [name for name, field in mapping.states.items() if not field.derivative_of]
    if len(recorded) < len(mapping.states):
        places = [k for k, name in enumerate(recordings.states) if name in recorded]
        columns = [Column(list(recordings.states)[k]) for k in places]
        pasts = [run.trajectory for run in recordings.runs]
        runs = [Trajectory(past.times, past.states[:, places], past.inputs) for past in pasts]
        columns += [Column(name, of_input=True) for name in recordings.inputs]
        if pairs := rate_pairs(runs, columns, recordings.dt):
            states = {name: field for name, field in states.items() if not field.derivative_of}
            guesses.append(f"{pairs[0].rate.name} changes as the rate of {pairs[0].state.name} does")
        else:
            guesses.append("no rate is recorded, so the derivatives of the states are states too")
    return mapping if states == mapping.states else replace(mapping, states=states)


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


def _reach(model: Model, recordings: Recordings, whole: int) -> tuple[int, int, int]:
    """Return from and up to which number of steps the model is close on recordings that it was not learned from.

    The third number is the most steps that were compared. Over a few steps of a slow or often sampled system, the noise
    of the records is larger than the motion, and tells nothing of the model over more steps.
    """
    held = unseen(model, recordings) or range(len(recordings.runs))
    grid = sorted({min(whole, round(1.5**k)) for k in range(40) if 1.5**k <= 2 * whole} | {whole})
    with single_threaded():
        errors = step_errors(model, replace(recordings, runs=tuple(recordings.runs[number] for number in held)), grid)
    scale, runs, before = dict[str, float](), [[0]], 0
    for steps in sorted({error.steps for error in errors}):
        after = [error for error in errors if error.steps == steps]
        # A motion may come back to where it began, so an error is a share of the largest change up to then.
        scale |= {error.state: max(error.change, scale.get(error.state, 0.0)) for error in after}
        if all(error.rms < CLOSE * scale[error.state] and not error.diverged for error in after):
            runs[-1].append(steps)
        elif len(runs[-1]) > 1:
            runs.append([0])
        before = steps
    longest = max(runs, key=len)[1:] or [0]
    return longest[0], longest[-1], before
