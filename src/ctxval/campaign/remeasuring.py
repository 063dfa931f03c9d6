"""The distances of stored executions computed anew, without an execution."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ctxval._util.describe import differences
from ctxval._util.texts import text_of
from ctxval.campaign.identity import with_distance
from ctxval.campaign.trials import TrialRecorder
from ctxval.core.distance import Distance
from ctxval.core.trial import TOLD_ALONE, Change, Trial
from ctxval.core.validation import Validation
from ctxval.errors import DistanceError
from ctxval.storage.store import Store


def remeasure(recorder: TrialRecorder, distance: Distance | None = None) -> list[Trial]:
    """Measure the distance of every stored execution anew; return the trials that changed.

    Args:
        recorder: of the trials.
        distance: the distance from now on; the one of the validation if it is not given.

    Raises:
        DistanceError: the distance of a trial that had one cannot be measured any more; nothing is changed.
        StoreAccessError: another process is running the store.
    """
    validation, description = recorder.validation, recorder.description
    if distance is not None:
        validation, description = validation.with_distance(distance), with_distance(description, distance)
    with recorder.store.sole_writer():
        # Somebody may tell of a trial while distances are computed; they are computed again then.
        while (changed := _remeasured(recorder.store, validation, description)) is None:
            pass
    recorder.redefine(validation, description)
    return changed


def _remeasured(store: Store, validation: Validation, description: dict[str, Any]) -> list[Trial] | None:
    """Store what is measured anew; return the trials that changed, None if the store has changed meanwhile."""
    seen = store.signature()
    before = store.trials()
    differing = differences(store.description(), description)
    redefined = any(path.startswith("validation.distance") for path, _ in differing)
    after = [_measured_again(store, validation, trial, redefined) for trial in before]
    changed = [(old, new) for old, new in zip(before, after, strict=True) if _outcome(old) != _outcome(new)]
    trials = [new for _, new in changed]
    if not changed and not redefined:
        return trials
    outcomes = {str(old.number): _outcome(old) for old, _ in changed}
    change = Change("remeasured", "the distance has changed" if redefined else "asked for", {"before": outcomes})
    return trials if store.remeasure(trials, description, change, seen) else None


def _outcome(trial: Trial) -> dict[str, Any]:
    """Return what measuring again may change of a trial."""
    return {"state": trial.state, "distance": trial.distance, "failure": trial.failure}


def _measured_again(store: Store, validation: Validation, trial: Trial, redefined: bool) -> Trial:
    """Return a trial as it ends once its distance is measured anew.

    Args:
        store: has its trajectories.
        validation: has the distance.
        trial: as it is stored.
        redefined: whether the distance is another one than the stored values are of.

    Raises:
        DistanceError: the trial had a distance, which cannot be measured any more.
    """
    if trial.state == "open" or not trial.executed:
        return trial
    model, system = store.trajectory(trial.number, "model"), store.trajectory(trial.number, "system")
    if model is None or system is None:
        told = trial.distance is not None and redefined
        return replace(trial, state="unmeasured", distance=None, failure=TOLD_ALONE) if told else trial
    try:
        distance = validation.remeasure(validation.space.from_unit(trial.unit_point), model, system)
    except DistanceError as error:
        if trial.distance is not None:
            sentence = f"trial {trial.number} cannot be measured anew, and nothing is changed: {error}"
            raise DistanceError(sentence) from error
        return replace(trial, state="unmeasured", failure=text_of(error))
    return replace(trial, state="completed", distance=distance, failure=None)
