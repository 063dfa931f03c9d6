"""Whether a store is of this experiment: its description, and some of what is stored computed anew."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.describe import describe, differences
from ctxval.core.distance import Distance
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Change, Trial
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError, DistanceError, InputError, StoreMismatchError
from ctxval.searches import DEFAULT, NAMES, Repeated, Search, by_name
from ctxval.storage.store import Store

VERSION = 2
"""Of descriptions; those of version 0.1.0 have none."""

_RECOMPUTED = 1e-4
"""By how much a recomputed closed loop on the model may differ from the stored one, as a share of each range."""

_REMEASURED = 1e-6
"""By how much a distance that is measured again may differ, relative to the larger."""

_QUESTION = ("name", "seed", "search", "validation.space")
"""What no reason can make another campaign's trials this one's."""

_DISTANCE = "validation.distance"


def description_of(validation: Validation, search: Search, seed: int, name: str) -> dict[str, Any]:
    """Return what identifies an experiment in a store, as JSON gives it back."""
    described = {"name": name, "seed": seed, "search": describe(search), "validation": validation.describe()}
    plain: dict[str, Any] = json.loads(json.dumps({**described, "version": VERSION}))
    return plain


def search_of(store: Store) -> Search:
    """Return the search that a store was made with, made again from its description; the default one for a new store.

    Raises:
        StoreMismatchError: it cannot be made from what the store says of it.
    """
    described = _with_present_names(store.description()).get("search")
    search = by_name(DEFAULT) if described is None else _search_described(described)
    if search is None:
        kind = described.get("type", "unknown") if isinstance(described, dict) else described
        raise StoreMismatchError(
            f"{store.name} was made with the search {kind!r}, which cannot be made again from what the store says of "
            "it; open it with that search (search= in Python)."
        )
    return search


def _search_described(described: Any) -> Search | None:
    """Return a ready-made search from its description; None if it is none or has options other than numbers."""
    if not isinstance(described, dict):
        return None
    if described.get("type") == Repeated.__name__:
        inner, times = _ready_made(described.get("search")), described.get("times")
        search: Search | None = None if inner is None or not isinstance(times, int) else Repeated(inner, times)
    else:
        search = _ready_made(described)
    # A user's own search of the same name, and options that are no numbers, do not come back as they were.
    return search if search is not None and _plain(search) == described else None


def _ready_made(described: Any) -> Search | None:
    """Return the search of a description, with those options that are not the default ones."""
    if not isinstance(described, dict):
        return None
    kind = next((kind for kind in NAMES.values() if kind.__name__ == described.get("type")), None)
    if kind is None:
        return None
    default = _plain(kind())
    options = {name: value for name, value in described.items() if value != default.get(name)}
    if not all(_is_numeric(value) for value in options.values()):
        return None
    try:
        search: Search = kind(**{name: tuple(v) if isinstance(v, list) else v for name, v in options.items()})
    except (TypeError, InputError):
        return None
    return search


def _is_numeric(value: Any) -> bool:
    return all(isinstance(item, int | float | None) for item in (value if isinstance(value, list) else [value]))


def _plain(value: Any) -> Any:
    """Return the description of an object as a store gives it back."""
    return json.loads(json.dumps(describe(value)))


def with_distance(description: dict[str, Any], distance: Distance) -> dict[str, Any]:
    """Return a description with another distance; the rest stays as it was described."""
    return {**description, "validation": {**description["validation"], "distance": _plain(distance)}}


def identify(
    store: Store, validation: Validation, description: dict[str, Any], accept: str | None, remeasuring: bool
) -> None:
    """Write which experiment the trials of a store are of, or check that it is this one.

    Besides the descriptions, some stored closed loops on the model and some distances are compared with what is
    computed now: a model whose weights are private, for example, shows there alone.

    Args:
        store: of the trials.
        validation: what is validated now.
        description: of the experiment now, of :func:`description_of`.
        accept: why a difference does not matter, or what was repaired; it is kept in the store.
        remeasuring: whether all distances are about to be measured anew.

    Raises:
        StoreMismatchError: the store was made by another experiment; the message names the first difference and what
            may be done.
        InputError: the reason is empty.
    """
    if accept is not None and not accept.strip():
        raise InputError('accepting a change needs a reason, such as "gripper replaced".')
    stored = _with_present_names(store.describe_first(description))
    present = description if "version" in stored else _as_before(description, stored)
    found = list(differences(stored, present))
    asked = [sentence for path, sentence in found if path.startswith(_QUESTION)]
    if asked:
        raise _mismatch(store, asked[0], "use another store")
    trials = store.trials()
    loop = _changed_loop(store, validation, trials)
    if loop is not None:
        raise _mismatch(store, next((sentence for _, sentence in found), loop), _LOOP_CHANGED)
    others = [sentence for path, sentence in found if not path.startswith(_DISTANCE)]
    if others and accept is None:
        raise _mismatch(store, others[0], _OTHER_CHANGED)
    if not remeasuring:
        _require_same_distance(store, validation, trials, [s for p, s in found if p.startswith(_DISTANCE)], accept)
        others = [sentence for _, sentence in found]
    kept = _with_distance(description, stored) if remeasuring else description
    if others or accept is not None:
        store.describe_anew(kept, Change("accepted", str(accept), {"differences": others, "trials": len(trials)}))
    elif "version" not in stored:
        store.describe_anew(kept, Change("described anew", "made by an older version", {}))


def _with_distance(description: dict[str, Any], stored: dict[str, Any]) -> dict[str, Any]:
    """Return a description with the distance that the stored values are of."""
    return {**description, "validation": {**description["validation"], "distance": stored["validation"]["distance"]}}


_LOOP_CHANGED = (
    "the model, the task or the controller design is another one than the executions were made with: use another store"
)
_OTHER_CHANGED = (
    "the closed loops on the model are as they were. If that does not matter, or if it is a repair of the system, "
    'give the reason: --accept-change "WHY" (accept_change= in Python); otherwise use another store'
)
_DISTANCE_CHANGED = (
    "`ctxval remeasure STORE --experiment FILE.toml`, or whatever names the experiment (remeasure=True in Python), "
    "computes it anew for what was executed, without an execution"
)


def _mismatch(store: Store, difference: str, advice: str) -> StoreMismatchError:
    return StoreMismatchError(f"{store.name} was made by another experiment: {difference}; {advice}.")


def _require_same_distance(
    store: Store, validation: Validation, trials: Sequence[Trial], described: list[str], accept: str | None
) -> None:
    measured = _changed_distance(store, validation, trials)
    if measured is not None:
        raise _mismatch(store, (described or [measured])[0], _DISTANCE_CHANGED)
    if described and accept is None:
        advice = f'{_DISTANCE_CHANGED}; if it computes the same, --accept-change "WHY" says so'
        raise _mismatch(store, described[0], advice)


# What is computed anew


def _samples(trials: Sequence[Trial]) -> list[Trial]:
    """Return the trials that are looked at: the first, the worst and the last that has ended."""
    ended = [trial for trial in trials if trial.executed or trial.state == "open"]
    worst = max((t for t in ended if t.distance is not None), key=lambda t: t.distance or 0.0, default=None)
    chosen = {t.number: t for t in (*ended[:1], *ended[-1:], *([] if worst is None else [worst]))}
    return [chosen[number] for number in sorted(chosen)]


def _changed_loop(store: Store, validation: Validation, trials: Sequence[Trial]) -> str | None:
    """Return which stored closed loop on the model is not what is computed now; None if all are."""
    for trial in _samples(trials):
        stored = store.trajectory(trial.number, "model")
        if stored is None:
            continue
        what = f"the closed loop on the model for the task of trial {trial.number}"
        try:
            now = _loop(validation, trial)
            gap = _gap(stored, now)
            # What differs from one call to the next, such as a planner that draws, cannot be compared.
            if gap > _RECOMPUTED and _gap(now, _loop(validation, trial)) <= _RECOMPUTED:
                return f"{what} differs from the stored one by {100 * min(gap, 1e6):.2g} % of its range"
        except CtxvalError as error:
            return f"{what} cannot be computed any more ({error})"
    return None


def _loop(validation: Validation, trial: Trial) -> Trajectory:
    return validation.plan(validation.space.from_unit(trial.unit_point)).model_trajectory


def _gap(one: Trajectory, other: Trajectory) -> float:
    """Return the largest difference of a state or input, as a share of its range."""
    if one.states.shape != other.states.shape or one.inputs.shape != other.inputs.shape:
        return np.inf
    return max(_relative(one.states, other.states), _relative(one.inputs, other.inputs))


def _relative(one: Array, other: Array) -> float:
    if not one.size:
        return 0.0
    size = np.maximum(np.ptp(one, axis=0), np.abs(one).max(axis=0))
    scale = np.maximum(size, max(1e-3 * float(size.max()), 1e-9))
    return float((np.abs(one - other) / scale).max())


def _changed_distance(store: Store, validation: Validation, trials: Sequence[Trial]) -> str | None:
    """Return which stored distance is not what is measured now; None if all are."""
    for trial in _samples(trials):
        model, system = store.trajectory(trial.number, "model"), store.trajectory(trial.number, "system")
        if trial.distance is None or model is None or system is None:
            continue
        point = validation.space.from_unit(trial.unit_point)
        try:
            now = validation.remeasure(point, model, system)
            again = validation.remeasure(point, model, system)
        except DistanceError as error:
            return f"the distance of trial {trial.number} cannot be measured any more ({error})"
        if now == again and not np.isclose(now, trial.distance, rtol=_REMEASURED, atol=1e-12):
            return f"the distance of trial {trial.number} was {trial.distance:.6g} and is now {now:.6g}"
    return None


# Descriptions of older versions

_RENAMED = {"Scalar": "BayesianOptimisation", "Climbs": "TrustRegion"}
"""Classes of searches by the names that older stores have, and their present names."""


def _with_present_names(stored: dict[str, Any]) -> dict[str, Any]:
    """Return a stored description in which classes of searches have their present names; the store keeps the old ones.

    A search may stand inside another, such as ``Repeated``, or in what the code of a user's search uses.
    """

    def renamed(value: Any, key: str = "") -> Any:
        if isinstance(value, dict):
            return {name: renamed(item, name) for name, item in value.items()}
        if isinstance(value, list):
            return [renamed(item) for item in value]
        if not isinstance(value, str):
            return value
        start = "ctxval." if value.startswith("ctxval.") else ""
        old = value.removeprefix(start)
        return start + _RENAMED[old] if old in _RENAMED and (start or key == "type") else value

    return {**stored, "search": renamed(stored["search"])} if "search" in stored else stored


def _as_before(present: dict[str, Any], stored: dict[str, Any]) -> dict[str, Any]:
    """Return a description so that one of version 0.1.0 can be compared with it; what code it named is not compared.

    That the code computes the same is seen in what is recomputed.
    """
    bounds = present["validation"]["space"].items()
    space = {name: bound[:2] if isinstance(bound, list) else bound for name, bound in bounds}
    before = {**present, "validation": {**present["validation"], "space": space}}
    merged = _without_code({key: value for key, value in before.items() if key != "version"}, stored)
    assert isinstance(merged, dict)
    return merged


_CODE = ("function", "constants", "digest", "uses", "code")


def _without_code(present: Any, stored: Any) -> Any:
    """Return the present description with what the stored one says of code."""
    if isinstance(present, dict) and isinstance(stored, dict):
        own = {key: _without_code(value, stored.get(key)) for key, value in present.items() if key not in _CODE}
        return {**{key: value for key, value in stored.items() if key in _CODE}, **own}
    if isinstance(present, list) and isinstance(stored, list) and len(present) == len(stored):
        return [_without_code(a, b) for a, b in zip(present, stored, strict=True)]
    named = isinstance(stored, str) and (isinstance(present, dict) and "function" in present)
    if named or (isinstance(stored, dict) and "function" in stored and isinstance(present, str)):
        return stored
    if isinstance(stored, str) and isinstance(present, str) and stored.rpartition(".")[2] == present.rpartition(".")[2]:
        return stored
    return present
