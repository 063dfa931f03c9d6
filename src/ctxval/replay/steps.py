"""Predictions of a model along recordings, and the errors that follow, in one place for all parts of a replay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval.core.model import Model
from ctxval.data.recordings import Recordings
from ctxval.errors import CtxvalError, ModelError

_MOST = 40_000  # largest number of predictions of one kind; of more, every second, third, ... one is made


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of k steps from recorded states, under the recorded inputs.

    Attributes:
        steps: the number k of steps.
        errors: predicted minus recorded states, shape ``(N, n)``; not finite if the model diverged.
        changes: recorded changes of the states over the steps, shape ``(N, n)``.
        states, inputs: recorded states and inputs at the start, shapes ``(N, n)`` and ``(N, m)``.
        groups: the part of the recordings in which each prediction lies, shape ``(N,)``.
    """

    steps: int
    errors: Array
    changes: Array
    states: Array
    inputs: Array
    groups: Rows


@dataclass(frozen=True, eq=False)
class Windows:
    """The places in recordings from which so many steps before and after are recorded.

    Attributes:
        runs, places: the recording, and the step in it, shape ``(N,)``.
        groups: the part of the recordings in which each lies, shape ``(N,)``.
    """

    runs: Rows
    places: Rows
    groups: Rows

    def __len__(self) -> int:
        return len(self.runs)


_PARTS = 5  # number of parts of a single recording, which then take the place of recordings


class RecordedSteps:
    """The steps of some recordings.

    If there is only one recording, it is divided into five parts of equal length, which take the place of recordings.

    Args:
        recordings: the recordings.
        used: the numbers of the recordings that are used.
    """

    def __init__(self, recordings: Recordings, used: Sequence[int]) -> None:
        self.recordings = recordings
        self._used = [recordings.runs[number].trajectory for number in used]
        self._states = np.concatenate([one.states for one in self._used])
        self._inputs = np.concatenate([one.inputs for one in self._used])
        self._horizons = np.array([one.horizon for one in self._used])
        self._first_input = np.cumsum([0, *self._horizons[:-1]])
        self._first_state = self._first_input + np.arange(len(self._used))

    @property
    def groups(self) -> int:
        """The number of recordings, or of parts of the only one."""
        return len(self._used) if len(self._used) > 1 else _PARTS

    def windows(self, before: int, after: int, most: int = _MOST) -> Windows:
        """Return places with so many recorded steps before and after them."""
        runs, places, groups = [], [], []
        for number, horizon in enumerate(self._horizons.tolist()):
            at = np.arange(before, horizon - after + 1)
            runs.append(np.full(len(at), number))
            places.append(at)
            groups.append(np.full(len(at), number) if len(self._used) > 1 else (_PARTS * at) // (horizon + 1))
        joined = [np.concatenate(part).astype(np.intp) for part in (runs, places, groups)]
        every = max(1, -(-len(joined[0]) // most))
        return Windows(*(part[::every] for part in joined))

    def states(self, where: Windows, shift: int = 0) -> Array:
        """Return the recorded states so many steps after places, shape ``(N, n)``."""
        return np.asarray(self._states[self._first_state[where.runs] + where.places + shift])

    def inputs(self, where: Windows, shift: int = 0) -> Array:
        """Return the recorded inputs so many steps after places, shape ``(N, m)``."""
        return np.asarray(self._inputs[self._first_input[where.runs] + where.places + shift])


def predicted(model: Model, recorded: RecordedSteps, steps: int) -> Predictions:
    """Return predictions of a number of steps from recorded states; none if no recording is so long."""
    where = recorded.windows(0, steps, min(_MOST, max(200, 400_000 // steps)))
    if not len(where):
        n, m = len(recorded.recordings.states), len(recorded.recordings.inputs)
        none = np.empty((0, n))
        return Predictions(steps, none, none, none, np.empty((0, m)), where.groups)
    x = start = recorded.states(where)
    for k in range(steps):
        x = stepped(model, x, recorded.inputs(where, k))
    reached = recorded.states(where, steps)
    return Predictions(steps, x - reached, reached - start, start, recorded.inputs(where), where.groups)


def stepped(model: Model, x: Array, u: Array) -> Array:
    """Return the next states of a model, ``(N, n)``."""
    try:
        with np.errstate(all="ignore"):
            found = np.asarray(model.step(x, u), dtype=np.float64)
    except CtxvalError as error:
        raise _unusable(x, u, str(error)) from error
    except Exception as error:  # the user's model
        raise _unusable(x, u, f"{type(error).__name__}: {str(error)[:200]}") from error
    if found.shape != x.shape:
        raise _unusable(x, u, f"it returned the shape {found.shape}")
    return found


def _unusable(x: Array, u: Array, why: str) -> ModelError:
    return ModelError(
        f"the model cannot predict a step of the recordings, which have {x.shape[1]} states and {u.shape[1]} inputs: "
        f"{why.removesuffix('.')}."
    )


def root_mean_square(values: Array) -> Array:
    """Return the root mean square over the first axis, without rows whose squares are not finite; NaN if none is."""
    with np.errstate(over="ignore"):
        squares = values**2
    finite = np.isfinite(squares).all(axis=tuple(range(1, values.ndim)))
    if not finite.any():
        return np.full(values.shape[1:], np.nan)
    return np.asarray(np.sqrt(squares[finite].mean(axis=0)))
