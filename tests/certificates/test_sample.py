from __future__ import annotations

import json

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ctxval import Trial
from ctxval.certificates import RecoveredFailure, Sample
from ctxval.certificates.sample import listed
from ctxval.core.trial import Origin, State
from ctxval.core.trial_note import NO_NOTE, TrialNote
from facts import assert_names


def trial(
    number: int,
    x: float,
    distance: float | None,
    state: State | None = None,
    origin: Origin = "acquisition",
    because: str | None = None,
    note: TrialNote = NO_NOTE,
) -> Trial:
    ended: State = state or ("failed" if distance is None else "completed")
    return Trial(number, origin, ended, np.array([x]), {"x": x}, 1, True, distance, note=note, because=because)


# What failed, and what was made good


def test_a_failure_made_good_is_kept_with_its_reason() -> None:
    again = [trial(0, 0.1, None), trial(1, 0.1, None), trial(2, 0.5, 0.3), trial(3, 0.1, 0.2, because="fuse replaced")]
    sample = Sample.of(again)
    assert sample.made_good == (RecoveredFailure(0, 3, "fuse replaced"), RecoveredFailure(1, 3, "fuse replaced"))
    assert_names(sample.remarks, 2, (0, 1), "trial", 3)
    assert json.loads(json.dumps(sample.failures))["made_good"][0] == {"trial": 0, "by": 3, "because": "fuse replaced"}


def test_of_several_successes_the_one_with_a_reason_counts() -> None:
    trials = [trial(0, 0.1, None), trial(1, 0.1, 0.2), trial(2, 0.1, 0.2, because="cable fixed")]
    assert Sample.of(trials).made_good == (RecoveredFailure(0, 2, "cable fixed"),)
    assert Sample.of(trials[:2]).made_good == (RecoveredFailure(0, 1, None),)
    Sample.of(trials[:2])


def test_what_failed_and_what_was_not_measured_is_listed() -> None:
    sample = Sample.of([trial(0, 0.1, None), trial(1, 0.2, 0.4), trial(2, 0.3, None, "unmeasured")])
    assert sample.failures == {"failed": [0], "unmeasured": [2], "made_good": []}
    assert_names(sample.remarks, "trial", 0, "failed", 2)
    assert Sample.of([trial(0, 0.1, 0.3)]).remarks == ()


def test_what_could_not_be_measured_is_not_made_good_by_executing_it_again() -> None:
    sample = Sample.of([trial(0, 0.1, None, "unmeasured"), trial(1, 0.1, 0.2)])
    assert sample.made_good == ()
    assert sample.failed == 1


def test_many_numbers_are_cut_short() -> None:
    assert listed([3]) == "trial 3"
    assert listed(range(7)) == "7 trials (0, 1, 2, 3, 4, ...)"


# The order of what people bring


@given(st.permutations(range(8)))
def test_the_order_of_imported_rows_does_not_matter(order: list[int]) -> None:
    rows = np.random.default_rng(3).random((8, 2))
    imported = [Trial(1 + k, "manual", "completed", rows[row], {}, 0, True, float(row)) for k, row in enumerate(order)]
    points = Sample.of([Trial(0, "acquisition", "completed", np.array([0.5, 0.5]), {}, 1, True, 9.0), *imported])
    assert points.distances[0] == 9.0
    assert points.points[1:].tolist() == sorted(rows.tolist())
    assert sorted(points.numbers[1:]) == list(range(1, 9))
    assert [imported[number - 1].distance for number in points.numbers[1:]] == points.distances[1:].tolist()


def test_the_order_of_a_search_is_kept() -> None:
    trials = [trial(k, x, x) for k, x in enumerate([0.9, 0.1, 0.5])]
    assert list(Sample.of(trials).numbers) == [0, 1, 2]


# How many draws there were to be


def test_a_draw_knows_how_many_there_were_to_be() -> None:
    trials = [
        trial(0, 0.1, 0.3, origin="iid", note=TrialNote(draws=59)),
        trial(1, 0.2, 0.3, origin="iid"),
        trial(2, 0.3, 0.3, note=TrialNote(draws=7)),
    ]
    assert list(Sample.of(trials).planned) == [59, None, None]
    assert list(Sample.of(trials).only("iid").planned) == [59, None]
