"""Whether a store belongs to an experiment: by its description, and by results that are computed again."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np

from ctxval._util.describe import describe, differences
from ctxval._util.progress import advance, stage
from ctxval._util.texts import text_of
from ctxval.campaign.storage.store import Store
from ctxval.core.plan import least_distance
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import REDEFINED, TOLD_ALONE, Change, Trial, Trials
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError, DistanceError, InputError, StoreError, StoreMismatchError
from ctxval.searches import DEFAULT, REGISTRY, Search, by_name

_QUESTION = ("name", "seed", "search", "validation.space")
"""Parts of the description that must not differ, whatever reason the user gives."""


def search_of(store: Store) -> Search:
    """Return the search of a store, made from its description; the default search for a new store."""
    described = store.description().get("search")
    if described is None:
        return by_name(DEFAULT)
    search = _ready_made(described)
    # A user's search may have the same name, and options that are not numbers cannot be restored.
    if search is None or described_plainly(search) != described:
        kind = described.get("type", "unknown") if isinstance(described, dict) else described
        raise StoreMismatchError(
            f"{store.name} was made with the search {kind!r}, which cannot be made from its description in the store: "
            "open the store with that search (search= in Python)."
        )
    return search


def _ready_made(described: Any) -> Search | None:
    """Return a search of this package, with the described options that differ from the default; None if it is none."""
    if not isinstance(described, dict):
        return None
    name = described.get("type")
    try:
        kind = next(kind for kind in map(REGISTRY.find, REGISTRY.built_in) if kind.__name__ == name)
        default = described_plainly(kind())
        options = {name: value for name, value in described.items() if value != default.get(name)}
        for name, value in options.items():
            items = value if isinstance(value, list) else [value]
            if not (isinstance(default.get(name), str) or all(isinstance(item, int | float | None) for item in items)):
                return None
        search: Search = kind(**{name: tuple(v) if isinstance(v, list) else v for name, v in options.items()})
        return search
    except (StopIteration, TypeError, InputError):
        return None


def described_plainly(value: Any) -> Any:
    """Return the description of an object in the form that a store returns."""
    return json.loads(json.dumps(describe(value)))


def with_distance(description: dict[str, Any], distance: Any) -> dict[str, Any]:
    """Return a description with that of another distance."""
    return {**description, "validation": {**description["validation"], "distance": distance}}


def identify(
    store: Store, validation: Validation, description: dict[str, Any], accept: str | None, remeasuring: bool
) -> None:
    """Describe the experiment in a new store, or check that an existing store belongs to it.

    Besides the descriptions, some stored closed loops on the model and some distances are compared with recomputed
    ones. Only this detects, for example, that the private weights of a model have changed.
    """
    if accept is not None and not accept.strip():
        raise InputError('accepting a change needs a reason, such as "gripper replaced".')
    store.describe_first(description)
    with store.snapshot():
        stored, trials = store.description(), store.trials()
    if not isinstance(stored.get("validation"), dict) or "distance" not in stored["validation"]:
        raise StoreError(f"{store.name} is damaged: it does not describe its validation; use another store.")
    differing = list(differences(stored, description))
    # The trials to recompute: the first, the worst and the last that has ended.
    ended = [trial for trial in trials if trial.executed or trial.state == "open"]
    chosen = {t.number: t for t in (*ended[:1], *ended[-1:], Trials(ended).worst) if t is not None}
    samples = [chosen[number] for number in sorted(chosen)]

    def refuse(difference: str, advice: str) -> NoReturn:
        raise StoreMismatchError(f"{store.name} was made by another experiment: {difference}; {advice}.")

    for path, sentence in differing:
        if path.startswith(_QUESTION):
            named = f"give the campaign the name {stored.get('name')!r}, or " if path == "name" else ""
            refuse(sentence, f"{named}use another store")
    loop = _changed_loop(store, validation, samples)
    if loop is not None:
        advice = "the model, the task or the controller design has changed since the executions: use another store"
        refuse(differing[0][1] if differing else loop, advice)
    of_distance = [sentence for path, sentence in differing if path.startswith("validation.distance")]
    others = [sentence for _, sentence in differing if sentence not in of_distance]
    if others and accept is None:
        refuse(
            others[0],
            "the closed loops on the model have not changed. If the difference does not matter, or if it is a repair "
            'of the system, give the reason: --accept-change "REASON" (accept_change= in Python); otherwise use '
            "another store",
        )
    if not remeasuring:
        advice = (
            "`ctxval remeasure STORE --experiment FILE.toml` (remeasure=True in Python) recomputes the distances "
            "without an execution; in place of FILE.toml, a case or module:attr can name the experiment"
        )
        measured = _changed_distance(store, validation, samples)
        if measured is not None:
            refuse(of_distance[0] if of_distance else measured, advice)
        if of_distance and accept is None:
            refuse(of_distance[0], f'{advice}; if the distance still computes the same, give --accept-change "REASON"')
        others = [sentence for _, sentence in differing]
    if others or accept is not None:
        change = Change("accepted", str(accept), {"differences": others, "trials": len(trials)})
        if remeasuring:  # the stored values are still those of the earlier distance
            description = with_distance(description, stored["validation"]["distance"])
        store.describe_anew(description, change)


def _changed_loop(store: Store, validation: Validation, samples: Sequence[Trial]) -> str | None:
    """Return a sentence about a stored closed loop on the model that has changed; None if none has."""
    for trial in samples:
        before, point = store.trajectory(trial.number, "model"), validation.space.point
        if before is None:
            continue
        what = f"the closed loop on the model for the task of trial {trial.number}"
        try:
            now = validation.plan(point(trial.parameters)).model_trajectory
            gap = _gap(before, now)
            # Results that differ from one call to the next, such as those of a random planner, cannot be compared.
            if gap <= 1e-4 or _gap(now, validation.plan(point(trial.parameters)).model_trajectory) > 1e-4:
                continue
        except CtxvalError as error:
            return f"{what} cannot be computed any more ({error})"
        if np.isfinite(gap):
            return f"{what} differs from the stored one by {100 * min(gap, 1e6):.2g} % of its range"
        had, has = (
            f"{loop.horizon} steps of {loop.states.shape[-1]} states and {loop.inputs.shape[-1]} inputs"
            for loop in (before, now)
        )
        return f"{what} had {had} and has now {has}"
    return None


def _gap(before: Trajectory, after: Trajectory) -> float:
    """Return the largest difference of a state or input, as a fraction of its range; infinity for another shape."""
    gaps = [0.0]
    for old, new in ((before.states, after.states), (before.inputs, after.inputs)):
        if old.shape != new.shape:
            return np.inf
        if old.size:
            size = np.maximum(np.ptp(old, axis=0), np.abs(old).max(axis=0))
            scale = np.maximum(size, max(1e-3 * float(size.max()), 1e-9))
            gaps.append(float((np.abs(old - new) / scale).max()))
    return max(gaps)


def _changed_distance(store: Store, validation: Validation, samples: Sequence[Trial]) -> str | None:
    """Return a sentence about a stored distance that has changed; None if none has."""
    for trial in samples:
        model, system = store.trajectory(trial.number, "model"), store.trajectory(trial.number, "system")
        if trial.distance is None or model is None or system is None:
            continue
        try:
            point = validation.space.point(trial.parameters)
            now, again = (validation.remeasure(point, model, system) for _ in range(2))
        except (DistanceError, InputError) as error:
            return f"the distance of trial {trial.number} cannot be computed any more ({error})"
        if now == again and not _equal(trial.distance, now):
            return f"the distance of trial {trial.number} was {trial.distance:.6g} and is now {now:.6g}"
    return None


def _equal(before: Any, after: Any) -> bool:
    return bool(np.isclose(after, before, rtol=1e-6, atol=1e-12))


def remeasure(store: Store, validation: Validation, description: dict[str, Any]) -> list[Trial]:
    """Recompute the distance of every stored execution; return the trials whose distance changed."""
    with store.sole_writer():
        while True:
            with store.snapshot():
                seen, before, stored = store.signature(), store.trials(), store.description()
            redefined = any(path.startswith("validation.distance") for path, _ in differences(stored, description))
            with stage("measuring again", len(before), "trials"):
                after = [_measured_again(store, validation, trial) for trial in before]
            known = [(old.distance, new.distance) for old, new in zip(before, after, strict=True)]
            redefined |= any(not _equal(*pair) for pair in known if None not in pair)
            if redefined:
                # A distance without trajectories was told in another definition.
                alone = [t.distance is not None and store.trajectory(t.number, "system") is None for t in after]
                unknown: dict[str, Any] = {"state": "unmeasured", "distance": None, "failure": TOLD_ALONE}
                after = [replace(t, **unknown) if by_hand else t for t, by_hand in zip(after, alone, strict=True)]
            changed = [(old, new) for old, new in zip(before, after, strict=True) if _measured(old) != _measured(new)]
            trials, outcomes = [new for _, new in changed], {str(old.number): _measured(old) for old, _ in changed}
            change = Change("remeasured", REDEFINED if redefined else "asked for", {"before": outcomes})
            # Another process may have recorded a result meanwhile; the distances are then computed again.
            if not (changed or redefined) or store.remeasure(trials, description, change, seen):
                return [trial for trial in trials if trial.state != "failed"]


def _measured(trial: Trial) -> dict[str, Any]:
    """Return the fields of a trial that a new measurement can change."""
    of_failed = {"at_least": trial.least} if trial.state == "failed" and trial.ended_alone is None else {}
    return {"state": trial.state, "distance": trial.distance, "failure": trial.failure, **of_failed}


def _measured_again(store: Store, validation: Validation, trial: Trial) -> Trial:
    advance()
    model, system = store.trajectory(trial.number, "model"), store.trajectory(trial.number, "system")
    if trial.state == "open" or model is None or system is None or trial.ended_alone is not None:
        return trial
    point = validation.space.point(trial.parameters)
    if trial.state == "failed":
        return replace(trial, note=replace(trial.note, at_least=least_distance(validation, point, model, system)))
    try:
        distance = validation.remeasure(point, model, system)
    except DistanceError as error:
        if trial.distance is not None:
            sentence = f"the distance of trial {trial.number} cannot be computed again, and nothing is changed: {error}"
            raise DistanceError(sentence) from error
        return replace(trial, state="unmeasured", failure=text_of(error))
    return replace(trial, state="completed", distance=distance, failure=None)
