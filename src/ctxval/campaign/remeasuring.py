"""Recompute the distances of stored executions, without an execution."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ctxval._util.describe import differences
from ctxval._util.progress import advance, stage
from ctxval._util.texts import text_of
from ctxval.campaign.identity import REMEASURED, with_distance
from ctxval.campaign.storage.store import Store
from ctxval.campaign.trials import TrialRecorder
from ctxval.core.distance import Distance
from ctxval.core.trial import REDEFINED, TOLD_ALONE, Change, Trial
from ctxval.core.validation import Validation
from ctxval.errors import DistanceError


def remeasure(recorder: TrialRecorder, distance: Distance | None = None) -> list[Trial]:
    """Recompute the distance of every stored execution; return the trials that changed."""
    validation, description = recorder.validation, recorder.description
    if distance is not None:
        validation = validation.with_distance(distance)
        description = with_distance(description, validation.distance)
    with recorder.store.sole_writer():
        # Another process may record a result meanwhile; the distances are then computed again.
        while (changed := _remeasured(recorder.store, validation, description)) is None:
            pass
    recorder.redefine(validation, description)
    return changed


def _remeasured(store: Store, validation: Validation, description: dict[str, Any]) -> list[Trial] | None:
    """Store the recomputed distances; return the trials that changed, or None if the store has changed meanwhile."""
    with store.snapshot():
        seen, before, stored = store.signature(), store.trials(), store.description()
    redefined = any(path.startswith("validation.distance") for path, _ in differences(stored, description))
    with stage("measuring again", len(before), "trials"):
        after = [_measured_again(store, validation, trial) for trial in before]
    redefined |= any(_differs(old, new) for old, new in zip(before, after, strict=True))
    if redefined:
        after = [_without_told(store, trial) for trial in after]
    changed = [(old, new) for old, new in zip(before, after, strict=True) if _outcome(old) != _outcome(new)]
    trials = [new for _, new in changed]
    if not changed and not redefined:
        return trials
    outcomes = {str(old.number): _outcome(old) for old, _ in changed}
    change = Change("remeasured", REDEFINED if redefined else "asked for", {"before": outcomes})
    return trials if store.remeasure(trials, description, change, seen) else None


def _outcome(trial: Trial) -> dict[str, Any]:
    """Return the fields of a trial that a new measurement can change."""
    return {"state": trial.state, "distance": trial.distance, "failure": trial.failure}


def _differs(old: Trial, new: Trial) -> bool:
    """Return whether a trial shows that the distance function is another one."""
    if old.distance is None or new.distance is None:
        return False
    return not np.isclose(new.distance, old.distance, rtol=REMEASURED, atol=1e-12)


def _without_told(store: Store, trial: Trial) -> Trial:
    """Return a trial without a distance that was told without trajectories, in another definition."""
    if trial.distance is None or store.trajectory(trial.number, "system") is not None:
        return trial
    return replace(trial, state="unmeasured", distance=None, failure=TOLD_ALONE)


def _measured_again(store: Store, validation: Validation, trial: Trial) -> Trial:
    """Return a trial with its recomputed distance."""
    advance()
    if trial.state == "open" or not trial.executed:
        return trial
    model, system = store.trajectory(trial.number, "model"), store.trajectory(trial.number, "system")
    if model is None or system is None:
        return trial
    try:
        distance = validation.remeasure(validation.space.point(trial.parameters), model, system)
    except DistanceError as error:
        if trial.distance is not None:
            sentence = f"the distance of trial {trial.number} cannot be computed again, and nothing is changed: {error}"
            raise DistanceError(sentence) from error
        return replace(trial, state="unmeasured", failure=text_of(error))
    return replace(trial, state="completed", distance=distance, failure=None)
