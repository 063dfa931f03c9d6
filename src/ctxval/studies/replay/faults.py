"""Faults of recordings that look like errors of a model: angles that jump by a turn, frozen sensors, spikes, odd files.

Each fault is found in the recordings alone. Its share is that of the model's squared one-step error that lies in the
steps concerned, so it explains the error only if the share is large. A file that differs from all others is named in
any case, because a model that was learned from it errs everywhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval._util.representation import ShortRepr, counted
from ctxval.core.labels import labels_of
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory
from ctxval.data.recordings import Recording, Recordings
from ctxval.studies.replay.accuracy import squared, stepped

EXPLAINS = 0.5  # least share of the error with which a fault is named as its cause


FaultKind = Literal["turn", "frozen", "spike", "file"]


@dataclass(frozen=True)
class Fault(ShortRepr):
    """A fault of recordings, and its part in the one-step error of a model."""

    kind: FaultKind
    state: str  #: the state concerned; empty for a file
    source: str  #: the first file concerned, and the number of steps
    steps: int
    share: float  #: their share of the model's squared one-step error, of states in units of their typical changes
    sentence: str  #: what it is, and what would help

    @property
    def explains(self) -> bool:
        """Whether it is named as a cause of the error."""
        return self.share >= EXPLAINS or self.kind == "file"


def faults(model: Model, recordings: Recordings, used: Sequence[int]) -> tuple[Fault, ...]:
    """Return the faults of some recordings, that with the largest share of the model's error first."""
    runs = [recordings.runs[number] for number in used]
    whole = [run.trajectory for run in runs]
    changes = np.concatenate([np.diff(run.states, axis=0) for run in whole])
    sizes = np.maximum(np.sqrt((changes**2).mean(axis=0)), 1e-300)
    errors = [squared(stepped(model, run.states[:-1], run.inputs) - run.states[1:], sizes) for run in whole]
    total = max(float(sum(error.sum() for error in errors)), 1e-300)
    results = []
    for number, (name, unit) in enumerate(recordings.states.items()):
        columns = [run.states[:, number] for run in whole]
        others = [np.delete(run.states, number, axis=1) for run in whole]
        kinds: dict[FaultKind, list[Mask]] = {
            "turn": _turns(columns), "frozen": _frozen(columns, others), "spike": _spikes(columns)
        }  # fmt: skip
        for kind, marked in kinds.items():
            count = int(sum(mask.sum() for mask in marked))
            if not count:
                continue
            share = sum(float(error[mask].sum()) for error, mask in zip(errors, marked, strict=True)) / total
            first = next(k for k, mask in enumerate(marked) if mask.any())
            at = runs[first].start + recordings.dt * int(np.argmax(marked[first]))
            where, (state,) = f"{runs[first].source}, {at:.4g} s", labels_of({name: unit})
            what = {
                "turn": f"{state} jumps by a whole turn in {counted(count, 'step')} (first at {where}): state angle = "
                "true for its field in the mapping",
                "frozen": f"{state} keeps exactly one value for {count * recordings.dt:.3g} s while other states move "
                f"(first at {where}): a frozen sensor; leave this part out",
                "spike": f"{state} has values far from those before and after them, around {counted(count, 'step')} "
                f"(first at {where}): leave them out, or mark them as missing",
            }[kind]
            sentence = f"{what}; {100 * share:.0f} % of the squared one-step error lies there"
            results.append(Fault(kind, name, runs[first].source, count, share, sentence))
    by_run = dict(zip(used, (float(error.sum()) / total for error in errors), strict=True))
    results += _files(recordings.runs, by_run)
    return tuple(sorted(results, key=lambda fault: -fault.share))


def _turns(columns: Sequence[Array]) -> list[Mask]:
    """Return the steps of each recording in which a state jumps by a turn and otherwise hardly changes."""
    steps = [np.diff(column) for column in columns]
    every, span = np.abs(np.concatenate(steps)), float(np.ptp(np.concatenate(columns)))
    for turn in (2 * np.pi, 360.0):
        jumps = [np.abs(np.abs(step) - turn) < 0.25 * turn for step in steps]
        others = every[np.abs(every - turn) >= 0.25 * turn]
        if any(jump.any() for jump in jumps) and span <= 1.05 * turn and others.max(initial=0.0) < 0.4 * turn:
            return jumps
    return [np.zeros(len(step), dtype=bool) for step in steps]


def _frozen(columns: Sequence[Array], others: Sequence[Array]) -> list[Mask]:
    """Return the steps of each recording that touch a long run of equal values, while other states move."""
    marked = [np.zeros(len(column) - 1, dtype=bool) for column in columns]
    if not others[0].shape[1]:
        return marked
    segments = [list(pairwise([0, *(np.flatnonzero(np.diff(column)) + 1).tolist(), len(column)])) for column in columns]
    lengths = np.array([last - first for each in segments for first, last in each])
    usual = float(np.quantile(lengths, 0.9))
    spread = np.maximum(np.concatenate(others).std(axis=0), 1e-300)
    for mask, each, beside in zip(marked, segments, others, strict=True):
        for first, last in each:
            if last - first >= max(10, 8 * usual) and (beside[first:last].std(axis=0) > 0.1 * spread).any():
                mask[max(first - 1, 0) : last] = True
    return marked


def _spikes(columns: Sequence[Array]) -> list[Mask]:
    """Return the steps before and after single values far from their neighbours, which are near each other."""
    away = [np.abs(column[1:-1] - 0.5 * (column[:-2] + column[2:])) for column in columns]
    every = np.concatenate(away)
    low, high = np.quantile(np.concatenate(columns), [0.01, 0.99])
    # A corner of a signal that moves fast is no spike.
    limit = max(10 * float(np.quantile(every, 0.9)), 0.05 * float(high - low)) if len(every) else 0.0
    marked = []
    for column, far in zip(columns, away, strict=True):
        mask = np.zeros(len(column) - 1, dtype=bool)
        if limit > 0:
            alone = np.flatnonzero((far > limit) & (np.abs(column[2:] - column[:-2]) < 0.3 * far))
            mask[alone] = mask[alone + 1] = True
        marked.append(mask)
    return marked


def _files(runs: Sequence[Recording], shares: Mapping[int, float]) -> Iterator[Fault]:
    """Yield the file that differs from all others: an affine model of these errs far more in it than in them.

    The shares are those of runs in the model's error.
    """
    of = {source: [k for k, run in enumerate(runs) if run.source == source] for source in (run.source for run in runs)}
    if len(of) < 3:
        return
    ratios = {}
    for source, inside in of.items():
        rest = [run.trajectory for k, run in enumerate(runs) if k not in inside]
        ratios[source] = _affine_ratio(rest, [runs[k].trajectory for k in inside])
    source, (ratio, relative) = max(ratios.items(), key=lambda item: item[1][0])
    if ratio < 3 or relative < 0.1:
        return
    share = sum(shares.get(k, 0.0) for k in of[source])
    steps = sum(runs[k].trajectory.horizon for k in of[source])
    sentence = (
        f"{source} differs from the other files: an affine model that is fitted to them errs {ratio:.0f} times as much "
        f"in it, by {100 * relative:.0f} % of its change; leave it out, or look at its columns and units"
    )
    yield Fault("file", "", source, steps, share, sentence)


def _affine_ratio(rest: Sequence[Trajectory], others: Sequence[Trajectory]) -> tuple[float, float]:
    """Return how much more an affine model of some runs errs in others, and this error as a share of their change.

    It is the smaller one of the ratio of medians and that of root mean squares: a part of a file with another fault
    does not make it another file, nor does a file in which more moves.
    """
    Z, changes = _regression(rest)
    weights = np.linalg.lstsq(Z, changes, rcond=1e-10)[0]
    inside = np.abs(Z @ weights - changes)
    Z, changes = _regression(others)
    outside, size = np.abs(Z @ weights - changes), np.sqrt((changes**2).mean(axis=0))
    ratios, shares = [], []
    for of in (lambda errors: np.median(errors, axis=0), lambda errors: np.sqrt((errors**2).mean(axis=0))):
        ratios.append(of(outside) / np.maximum(of(inside), 1e-300))
        shares.append(of(outside) / np.maximum(size, 1e-300))
    worst = int(np.min(ratios, axis=0).argmax())
    return float(np.min(ratios, axis=0)[worst]), float(np.min(shares, axis=0)[worst])


def _regression(runs: Sequence[Trajectory]) -> tuple[Array, Array]:
    pairs = np.concatenate([np.concatenate([run.states[:-1], run.inputs], axis=1) for run in runs])
    changes = np.concatenate([np.diff(run.states, axis=0) for run in runs])
    return np.column_stack([np.ones(len(pairs)), pairs]), changes
