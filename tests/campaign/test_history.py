from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, searches
from ctxval.campaign.history import history_of
from ctxval.core.trial import Trial
from ctxval.core.trial_note import TrialNote
from rig_thorough import more


def trial(number: int, goal: float, distance: float | None = None) -> Trial:
    state = "open" if distance is None else "completed"
    return Trial(number, "manual", state, np.array([goal]), {"goal": goal}, distance=distance)


def test_a_point_that_waits_for_its_value_is_in_the_history_once() -> None:
    trials = [trial(0, 0.1), trial(1, 0.2, 2.0), trial(2, 0.1), trial(3, 0.1, 1.0), trial(4, 0.1)]
    trials[0] = replace(trials[0], note=TrialNote({"first": True}))
    assert [(t.number, t.distance) for t in history_of(trials)] == [(3, 1.0), (1, 2.0), (4, None)]
    assert history_of(trials)[0].note.search == {"first": True}


@pytest.mark.slow
@pytest.mark.parametrize("data", [False, *more(True)])
def test_auto_goes_on_although_distances_were_told_without_trajectories(tmp_path: Path, data: bool) -> None:
    validation = make_validation()
    if not data:
        validation.model.data = None  # type: ignore[attr-defined]

    def campaign() -> Campaign:
        return Campaign(validation, search=searches.Auto(), seed=3, store=tmp_path / "a.sqlite")

    live = campaign()
    for goal in (-2.0, 0.5, 2.5):
        opened = live.ask({"goal": goal})
        live.tell(opened, distance=validation.outcome([goal]).distance)
    live.run(6, explore=True)
    resumed = campaign()
    np.testing.assert_array_equal(resumed.ask().trial.unit_point, live.reopen(6).trial.unit_point)
    assert len(np.unique([t.unit_point[0] for t in resumed.trials])) == 7


def test_a_prediction_leaves_out_what_was_executed_at_a_point() -> None:
    validation = make_validation()
    campaign = Campaign(validation, search=searches.Random(), seed=3)
    late = campaign.ask({"goal": 2.0})
    told = campaign.ask({"goal": -1.0})
    campaign.tell(told, distance=validation.outcome([-1.0]).distance)
    campaign.run(4)
    again = campaign.ask({"goal": 2.0})
    campaign.tell(again, validation.execute(again.plan))
    assert late.trial.state == "open"
    known = [t for t in history_of(campaign.trials) if t.distance is not None]
    assert [t.number for t in known] == [5, 1, 2, 3, 4]
    found = campaign.recorder.dynamics.prediction(campaign.trials)
    assert found is not None
    points = np.array([t.unit_point for t in known])
    expected = found.left_out(points)
    np.testing.assert_allclose(expected, [t.distance for t in known], rtol=0.5)
    np.testing.assert_array_equal(found.left_out(points[[0, 3]]), expected[[0, 3]])
    # Nothing was learned from the distance that was told alone.
    assert expected[1] == found.expected(known[1].unit_point[None])[0][0]
