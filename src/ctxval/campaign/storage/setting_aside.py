"""One unreadable trial of a store is set aside: the other trials stay usable, and the history keeps what it held."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, get_args

import numpy as np

from ctxval._util.arrays import Array, as_finite
from ctxval.campaign.storage.rows import COLUMNS, checksum_of, read_json, read_trajectory, read_trial, row_of
from ctxval.campaign.storage.store import Store
from ctxval.certificates import Provenance
from ctxval.core.space import TaskSpace
from ctxval.core.trajectory import COMPLETE
from ctxval.core.trial import Change, Origin, State, Trial
from ctxval.errors import InputError

SET_ASIDE = "set aside"  #: kind of a change in the history


def set_aside(store: Store, number: int) -> str:
    """Make a store usable in spite of one trial that cannot be read; return a sentence on what stands in its place.

    A damaged trajectory is taken out of its trial. A damaged trial becomes unmeasured if the trajectory of the system
    can be read, so that its distance is measured again without an execution, and otherwise a failed execution of its
    task. The middle of the task space stands for a task that cannot be read. The history keeps all that was stored.

    Raises:
        InputError: if there is no such trial, if it can be read, or if the task space cannot.
    """
    with store.sole_writer():
        with store.snapshot():
            row = store._execute(f"SELECT {COLUMNS}, checksum FROM trials WHERE number = ?", (number,)).fetchone()
            query = "SELECT side, npz, checksum FROM trajectories WHERE trial = ?"
            trajectories = store._execute(query, (number,)).fetchall()
        if row is None:
            raise InputError(f"there is no trial {number} in {store.name}.")
        read = {side: read_trajectory(number, side, npz, checksum) for side, npz, checksum in trajectories}
        damaged = [side for side, trajectory in read.items() if trajectory is None]
        try:
            trial = read_trial(row[:-1], row[-1])
        except InputError as error:
            executed, predicted = read.get("system"), read.get("model")
            measurable = executed is not None and executed.ended == COMPLETE and predicted is not None
            trial, sentence = _stand_in(store, dict(zip(COLUMNS.split(", "), row, strict=False)), measurable)
            sentence = f"{sentence}, because {error}"
        else:
            if not damaged:
                raise InputError(f"trial {number} of {store.name} can be read, so it is not set aside.")
            sentence = (
                f"trial {number} keeps its result, without the trajectory of the {' and the '.join(map(str, damaged))}"
            )
        cells = {name: repr(value) for name, value in zip([*COLUMNS.split(", "), "checksum"], row, strict=True)}
        npz = {str(side): _text(content) for side, content, _ in trajectories if side in damaged}
        with store._transaction():
            store._insert_change(Change(SET_ASIDE, sentence, {"row": cells, "npz": npz}))
            values = row_of(trial)
            assignments = f"{COLUMNS.replace(',', ' = ?,')} = ?, checksum = ?"
            store._execute(f"UPDATE trials SET {assignments} WHERE number = ?", (*values, checksum_of(values), number))
            for side in damaged:
                store._execute("DELETE FROM trajectories WHERE trial = ? AND side = ?", (number, side))
    return sentence


def _text(content: Any) -> str:
    return base64.b64encode(content).decode() if isinstance(content, bytes) else repr(content)


def _stand_in(store: Store, values: Mapping[str, Any], measurable: bool) -> tuple[Trial, str]:
    """Return the trial in the place of a damaged one, with those of its values that matter and can be read."""
    number, space = values["number"], Provenance.of(store.description()).space
    if space is None:
        raise InputError(f"trial {number} cannot be set aside: the task space in {store.name} cannot be read either.")
    point, readable = _task_of(values, space)
    measurable &= readable
    opened = values["state"] == "open" and not measurable
    origin: Origin = values["origin"] if values["origin"] in get_args(Origin) else "manual"
    task = "its task" if readable else "a task in the middle of the task space, as its own cannot be read"
    state: State
    state, what = ("unmeasured", "is measured again") if measurable else ("failed", f"is a failed execution of {task}")
    sentence = f"trial {number} {what}"
    attempts = values["attempts"] if isinstance(values["attempts"], int) and 0 <= values["attempts"] < 2**53 else 0
    parameters = space.describe_point(space.from_unit(point))
    trial = Trial(number, origin, state, point, parameters, attempts, not opened, failure=f"{SET_ASIDE}: {sentence}.")
    return trial, sentence


def _task_of(values: Mapping[str, Any], space: TaskSpace) -> tuple[Array, bool]:
    """Return the point of the unit cube of a damaged row and whether it can be read; if not, the middle of the cube."""
    with suppress(InputError):
        parameters = read_json(values["parameters"])
        if isinstance(parameters, dict):
            return space.to_unit(space.point(parameters)), True
    with suppress(InputError):
        point = as_finite("unit_point", read_json(values["unit_point"]))
        if point.shape == (space.dimension,) and ((point >= 0) & (point <= 1)).all():
            return point, True
    return space.rounded(np.full(space.dimension, 0.5)), False
