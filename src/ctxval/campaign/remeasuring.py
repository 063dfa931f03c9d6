"""Recompute the distances of stored executions, without an execution."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ctxval._util.describe import differences
from ctxval._util.progress import advance, stage
from ctxval._util.texts import text_of
from ctxval.campaign.identity import with_distance
from ctxval.campaign.trials import TrialRecorder
from ctxval.core.distance import Distance
from ctxval.core.trial import TOLD_ALONE, Change, Trial
from ctxval.core.validation import Validation
from ctxval.errors import DistanceError
from ctxval.storage.store import Store


def remeasure(recorder: TrialRecorder, distance: Distance | None = None) -> list[Trial]:
    """Recompute the distance of every stored execution; return the trials that changed.

    Args:
        recorder: the recorder of the trials.
        distance: the new distance; by default, that of the validation.

    Raises:
        DistanceError: if the distance of a measured trial cannot be computed any more; nothing is changed.
        StoreAccessError: if another process is running the store.
    """
    validation, description = recorder.validation, recorder.description
    if distance is not None:
        validation, description = validation.with_distance(distance), with_distance(description, distance)
    with recorder.store.sole_writer():
        # Another process may record a result meanwhile; the distances are then computed again.
        while (changed := _remeasured(recorder.store, validation, description)) is None:
            pass
    recorder.redefine(validation, description)
    return changed


def _remeasured(store: Store, validation: Validation, description: dict[str, Any]) -> list[Trial] | None:
    """Store the recomputed distances; return the trials that changed, or None if the store has changed meanwhile."""
    seen = store.signature()
    before = store.trials()
    differing = differences(store.description(), description)
    redefined = any(path.startswith("validation.distance") for path, _ in differing)
    with stage("measuring again", len(before), "trials"):
        after = [_measured_again(store, validation, trial, redefined) for trial in before]
    changed = [(old, new) for old, new in zip(before, after, strict=True) if _outcome(old) != _outcome(new)]
    trials = [new for _, new in changed]
    if not changed and not redefined:
        return trials
    outcomes = {str(old.number): _outcome(old) for old, _ in changed}
    change = Change("remeasured", "the distance has changed" if redefined else "asked for", {"before": outcomes})
    return trials if store.remeasure(trials, description, change, seen) else None


def _outcome(trial: Trial) -> dict[str, Any]:
    """Return the fields of a trial that a new measurement can change."""
    return {"state": trial.state, "distance": trial.distance, "failure": trial.failure}


def _measured_again(store: Store, validation: Validation, trial: Trial, redefined: bool) -> Trial:
    """Return a trial with its recomputed distance.

    Args:
        store: contains the trajectories.
        validation: contains the distance function.
        trial: the stored trial.
        redefined: whether the distance function differs from the one of the stored values.

    Raises:
        DistanceError: if the trial had a distance that cannot be computed any more.
    """
    advance()
    if trial.state == "open" or not trial.executed:
        return trial
    model, system = store.trajectory(trial.number, "model"), store.trajectory(trial.number, "system")
    if model is None or system is None:
        outdated = trial.distance is not None and redefined
        return replace(trial, state="unmeasured", distance=None, failure=TOLD_ALONE) if outdated else trial
    try:
        distance = validation.remeasure(validation.space.from_unit(trial.unit_point), model, system)
    except DistanceError as error:
        if trial.distance is not None:
            sentence = f"the distance of trial {trial.number} cannot be computed again, and nothing is changed: {error}"
            raise DistanceError(sentence) from error
        return replace(trial, state="unmeasured", failure=text_of(error))
    return replace(trial, state="completed", distance=distance, failure=None)
