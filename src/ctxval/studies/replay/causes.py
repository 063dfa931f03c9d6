"""Causes of the error of a model: what state and input explain of it, mistakes of timing, and faults of recordings.

A fault (an angle that jumps by a turn, a frozen sensor, a spike, an odd file) is found in the recordings alone. Its
share is that of the model's squared one-step error that lies in the steps concerned, so it explains the error only if
the share is large. A file that differs from all others is named in any case, because a model that was learned from it
errs everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from ctxval._util.arrays import Array, Mask, Rows, single_threaded
from ctxval._util.representation import ShortRepr, counted
from ctxval._util.turns import turns
from ctxval.core.labels import labels_of
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.data.recordings import Recording, Recordings
from ctxval.learning import PosteriorSettings, learn_posterior
from ctxval.studies.replay.accuracy import Windows, squared, stepped

EXPLAINS = 0.5  # least share of the error with which a fault is named as its cause

FaultKind = Literal["turn", "frozen", "spike", "file"]


@dataclass(frozen=True)
class ResidualShare(ShortRepr):
    """How much of the one-step residual of a state can be explained, measured on held-out recordings."""

    state: str
    unit: str
    rms: float  #: root mean square of the residual
    linear: float  #: share of its mean square that an affine function of state and input explains; at least 0
    explained: float  #: share that a Gaussian process explains, or the affine function if that is more; at least 0
    #: share of the rest that the previous step explains, at least 0; if it is large, a state is missing, or a delay
    history: float
    rest: float  #: root mean square of what state and input do not explain


def residual_shares(model: Model, recordings: Recordings, seed: int) -> tuple[ResidualShare, ...]:
    """Return how much of the residual of each state can be explained; none if there are too few recorded steps."""
    where = Windows.of(recordings, 1, 1, 12_000)
    residuals, earlier = (where.states(k + 1) - stepped(model, where.states(k), where.inputs(k)) for k in (0, -1))
    finite: Mask = np.asarray((np.isfinite(residuals) & np.isfinite(earlier)).all(axis=1))
    where, residuals, earlier = where[finite], residuals[finite], earlier[finite]
    pairs, past = where.pairs(), np.concatenate([where.pairs(), where.pairs(-1), earlier], axis=1)
    groups = np.unique(where.groups)
    folds = np.searchsorted(groups, where.groups) * min(4, len(groups)) // max(len(groups), 1)
    if len(residuals) < 20 or len(np.unique(folds)) < 2:
        return ()

    def left_by(predict: Callable[[Mask], Array], targets: Array) -> Array:
        left = np.zeros_like(targets)
        for fold in np.unique(folds):
            held = folds == fold
            left[held] = targets[held] - predict(held)
        return left

    affine = left_by(lambda held: _affine(pairs, residuals, held), residuals)
    rest = left_by(lambda held: _learned(model, where, folds, held, seed), residuals)
    better = (affine**2).mean(axis=0) < (rest**2).mean(axis=0)
    rest[:, better] = affine[:, better]
    history = left_by(lambda held: _affine(past, rest, held), rest)

    def share(errors: Array, size: float) -> float:
        return max(0.0, 1.0 - float((errors**2).mean()) / size) if size > 0 else 0.0

    sizes, left = (residuals**2).mean(axis=0).tolist(), (rest**2).mean(axis=0).tolist()
    return tuple(
        ResidualShare(
            *(name, unit, math.sqrt(sizes[i]), share(affine[:, i], sizes[i]), share(rest[:, i], sizes[i])),
            *(share(history[:, i], left[i]), math.sqrt(left[i])),
        )
        for i, (name, unit) in enumerate(recordings.states.items())
    )


def _affine(features: Array, targets: Array, held: Mask) -> Array:
    """Return the held-out predictions of an affine function of features, by regularised least squares."""
    shift, scale = features[~held].mean(axis=0), np.maximum(features[~held].std(axis=0), 1e-12)
    Z = np.column_stack([np.ones(len(features)), (features - shift) / scale])
    G = Z[~held].T @ Z[~held]
    G += 1e-6 * np.trace(G) / len(G) * np.eye(len(G))
    return np.asarray(Z[held] @ np.linalg.solve(G, Z[~held].T @ targets[~held]))


def _learned(model: Model, where: Windows, folds: Rows, held: Mask, seed: int) -> Array:
    transitions = Transitions(where.states(), where.inputs(), where.states(1))
    rows = np.flatnonzero(~held)
    if len(rows) > 1500:
        rows = np.sort(np.random.default_rng(seed).permutation(rows)[:1500])
    x, u = transitions.x[held], transitions.u[held]
    with single_threaded():
        settings = PosteriorSettings(hyperparameters=1, centres=250)
        posterior = learn_posterior(model, transitions[rows], folds[rows], settings=settings)
        if posterior is None:
            return np.zeros_like(x)
        # What is learned may be a linear model of the system, without M.
        return np.asarray(posterior.mean.step(x, u) - model.step(x, u))


@dataclass(frozen=True)
class Suggestion(ShortRepr):
    """A change of timing with which the model predicts held-out recordings clearly better."""

    kind: Literal["delay", "time step"]
    value: float  #: the delay, or the time step of the model, in seconds
    ratio: float  #: the held-out one-step error with the change, divided by that without it
    sentence: str


def suggestions(model: Model, recordings: Recordings) -> tuple[Suggestion, ...]:
    """Return the change of timing with which the model predicts held-out recordings clearly better, if there is one."""
    # Of two, only the better one, because one mistake can look like another one.
    changes = filter(None, (_time_step(model, recordings), _delay(model, recordings)))
    return tuple(sorted(changes, key=lambda change: change.ratio)[:1])


def _delay(model: Model, recordings: Recordings) -> Suggestion | None:
    """Suggest a delay if the model, or an affine model of the recordings themselves, predicts better with it."""
    first, last = -3, 10  # delays in steps that are tried
    where = Windows.of(recordings, last + 1, 1 - first, 8000)
    if not recordings.inputs or not len(where):
        return None
    x, reached, groups = where.states(), where.states(1), where.groups
    sizes = np.sqrt(((reached - x) ** 2).mean(axis=0))

    def errors(of: Callable[[Array], Array], shift: float) -> Array:
        """Return the squared errors of states that depend on the mean input of each step, if inputs act so late."""
        whole = math.floor(shift)
        u, part = where.inputs(-whole), shift - whole
        u = u + part * (where.inputs(-whole - 1) - u) if part else u
        return squared(of(u), sizes)

    def chosen(of: Callable[[Array], Array]) -> tuple[dict[float, Array], tuple[float, float] | None]:
        """Return the errors for whole steps, and for tenths around the best of them, and what they choose."""
        known = {float(shift): errors(of, shift) for shift in range(first, last + 1)}
        best = min(known, key=lambda shift: known[shift].mean())
        tenths = sorted({round(best + k / 10, 1) for k in range(-9, 10)} - {best})
        known |= {shift: errors(of, shift) for shift in tenths if first <= shift <= last}
        return known, _chosen(known, groups, 0.0, 0.85, 0.5)

    by_model, change = chosen(lambda u: stepped(model, x, u) - reached)
    of_model = change is not None
    if change is None:
        fitted, change = chosen(lambda u: _affine_errors(x, u, reached, groups))
        # A model that predicts better than these affine models was not learned with inputs of another time.
        if change is None or by_model[0].mean() <= fitted[change[0]].mean():
            return None
    shift, ratio = change
    delay = shift * recordings.dt
    when = (
        f"if the inputs act {abs(delay):.3g} s ({abs(shift):g} steps) {'after' if shift > 0 else 'before'} the time at "
        "which they are taken here"
    )
    sentence = (
        f"the one-step error falls to {100 * ratio:.0f} % {when}: add {delay:.3g} to delay in the mapping of the "
        "recordings, or let the model have this delay"
        if of_model
        else f"an affine model that is fitted to the recordings has {100 * ratio:.0f} % of the error {when}; the model "
        "was perhaps learned with inputs of another time"
    )
    return Suggestion("delay", delay, ratio, sentence)


def _time_step(model: Model, recordings: Recordings) -> Suggestion | None:
    multiples = (2, 3, 4, 5, 10)
    where = Windows.of(recordings, 0, max(multiples), 8000)
    if not len(where):
        return None

    def errors(of_model: int, steps: int) -> Array:
        """Return squared errors if so many steps of the model and of the recordings take the same time."""
        x, held = where.states(), np.mean([where.inputs(k) for k in range(steps)], axis=0)
        for _ in range(of_model):
            x = stepped(model, x, held)
        return squared(x - where.states(steps), np.sqrt(((where.states(steps) - where.states()) ** 2).mean(axis=0)))

    known: dict[float, Array] = {1.0: errors(1, 1)}
    for k in multiples:
        known |= {1 / k: errors(k, 1), float(k): errors(1, k)}
    change = _chosen(known, where.groups, 1.0, 0.7, 0.0)
    if change is None:
        return None
    factor, ratio = change
    dt = factor * recordings.dt
    sentence = (
        f"the error relative to the motion falls to {100 * ratio:.0f} % if one step of the model takes {dt:g} s "
        f"instead of {recordings.dt:g} s: check the time step of the model, or give dt = {dt:g}"
    )
    return Suggestion("time step", dt, ratio, sentence)


def _affine_errors(x: Array, u: Array, reached: Array, groups: Rows) -> Array:
    """Return held-out errors of an affine model of the recordings; every second group is held out in turn."""
    Z = np.column_stack([np.ones(len(x)), x, u])
    Z = Z / np.maximum(np.abs(Z).max(axis=0), 1e-12)
    odd = np.searchsorted(np.unique(groups), groups) % 2 == 1
    errors = np.zeros_like(reached)
    for held in (odd, ~odd):
        if held.any() and (~held).sum() > Z.shape[1]:
            weights = np.linalg.lstsq(Z[~held], (reached - x)[~held], rcond=1e-10)[0]
            errors[held] = Z[held] @ weights + x[held] - reached[held]
    return errors


def _chosen(
    errors: Mapping[float, Array], groups: Rows, usual: float, clear: float, alike: float
) -> tuple[float, float] | None:
    """Return the value that two halves of the recordings choose alike, and the ratio of its errors to the usual ones.

    Each value has squared errors ``(N,)`` in groups. Returns None unless the ratio is at most ``clear``, errors fall in
    most recordings, and the values that the halves choose differ by at most ``alike``.
    """
    known = np.unique(groups)
    if len(known) < 2:
        return None
    values = list(errors)
    table = np.array([[errors[value][groups == group].mean() for group in known] for value in values])
    base = table[values.index(usual)]
    picked = [values[int(np.argmin(table[:, half::2].sum(axis=1)))] for half in (0, 1)]
    # Smaller errors are rounding.
    if abs(picked[0] - picked[1]) > alike or usual in picked or base.mean() < 1e-9**2:
        return None
    row = int(np.argmin(table.sum(axis=1)))
    ratio = float(np.sqrt(table[row].sum() / base.sum()))
    if ratio > clear or (table[row] < base).mean() < 0.8:  # in most recordings
        return None
    return values[row], ratio


@dataclass(frozen=True)
class Fault(ShortRepr):
    """A fault of recordings, and its part in the one-step error of a model."""

    kind: FaultKind  #: an angle that jumps by a turn, a frozen sensor, a spike, or a file that differs from all others
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
            "turn": turns(columns)[1], "frozen": _frozen(columns, others), "spike": _spikes(columns)
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
    """Yield the file that differs from all others: an affine model of these errs far more in it than in them."""
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
    """Return how much more an affine model of some runs errs in others, and this error as a share of their change."""
    Z, changes = _regression(rest)
    weights = np.linalg.lstsq(Z, changes, rcond=1e-10)[0]
    inside = np.abs(Z @ weights - changes)
    Z, changes = _regression(others)
    outside, size = np.abs(Z @ weights - changes), np.sqrt((changes**2).mean(axis=0))
    # The smaller one of two ratios: a part of a file with another fault does not make it another file, nor does a file
    # in which more moves.
    ratios, shares = [], []
    for of in (lambda errors: np.median(errors, axis=0), lambda errors: np.sqrt((errors**2).mean(axis=0))):
        ratios.append(of(outside) / np.maximum(of(inside), 1e-300))
        shares.append(of(outside) / np.maximum(size, 1e-300))
    worst = int(np.min(ratios, axis=0).argmax())
    return float(np.min(ratios, axis=0)[worst]), float(np.min(shares, axis=0)[worst])


def _regression(runs: Sequence[Trajectory]) -> tuple[Array, Array]:
    where = Windows.of(runs, 0, 1, sum(run.horizon for run in runs))
    return np.column_stack([np.ones(len(where)), where.pairs()]), where.states(1) - where.states()
