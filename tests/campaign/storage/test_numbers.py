"""Every number that is stored reads back equal, or is refused before anything is stored."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from ctxval import Store, Trajectory, Trial
from ctxval.campaign.storage.rows import row_of
from ctxval.core.trial import Change
from ctxval.core.trial_note import TrialNote
from ctxval.errors import CtxvalError, InputError

STRANGE = (0, -0.0, 0.5, 1, np.nan, np.inf, -np.inf, 5e-324, -5e-324, 1.7e308, 2**53 - 1, 2**53, 2**63, 2**70, -1, True)
SCALARS = st.sampled_from(STRANGE) | st.floats() | st.integers() | st.booleans()
NUMBERS = SCALARS.flatmap(
    lambda value: st.sampled_from(
        [value, *(kind(value) for kind in (np.float64, np.float32, np.float16))]
        if abs(value) < 6e4
        else [value, float("inf") if isinstance(value, int) and value > 1e308 else np.float64(value)]
    )
) | st.integers(-128, 127).map(np.int8)
NOTES = st.none() | st.dictionaries(st.text(), st.recursive(NUMBERS | st.text(), st.lists, max_leaves=5), max_size=3)
POINTS = st.lists(NUMBERS, min_size=1, max_size=3)
TRIAL = Trial(0, "iid", "open", np.array([0.5]), {"goal": 0.5})
RUN = Trajectory(np.arange(3.0), np.zeros((3, 1)), np.zeros((2, 1)))


def stored(store: Store) -> list[tuple[Any, ...]]:
    return [row_of(trial) for trial in store.trials()]


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "number": NUMBERS,
            "attempts": NUMBERS,
            "unit_point": POINTS.map(np.array),
            "parameters": st.dictionaries(st.text(), NUMBERS | POINTS | st.text(), max_size=2),
            "note": NOTES.map(TrialNote),
            "because": st.text() | st.just("\udcff\0"),
        },
    )
)
def test_a_trial_that_is_opened_reads_back_or_is_refused(values: dict[str, Any]) -> None:
    store, trial = Store(), replace(TRIAL, **values)
    try:
        store.add([(trial, None, None)])
    except InputError:
        assert store.trials() == []
    else:
        assert stored(store) == [row_of(trial)]
        assert store.trials()[0].parameters == trial.parameters
        np.testing.assert_array_equal(store.trials()[0].unit_point, trial.unit_point)


@given(NUMBERS, NUMBERS | st.none(), NOTES, st.text() | st.just("\udcff"))
def test_a_result_reads_back_or_is_refused_and_the_trial_stays_open(
    distance: Any, seconds: Any, note: dict[str, Any] | None, failure: str
) -> None:
    store = Store()
    store.add([(TRIAL, RUN, None)])
    ended = replace(TRIAL, state="completed", executed=True, distance=distance, seconds=seconds, note=TrialNote(note))
    try:
        store.close_trials([(ended, RUN)])
    except InputError:
        assert store.trials()[0].state == "open"
        assert store.trajectory(0, "system") is None
        store.close_trials([(replace(TRIAL, state="failed", executed=True, failure=failure), None)])
        assert store.trials()[0].failure is not None
    else:
        (back,) = store.trials()
        assert (back.distance, back.seconds) == (float(distance), None if seconds is None else float(seconds))
        assert stored(store) == [row_of(ended)]


@given(arrays.arrays(np.float64, (3, 2), elements=st.floats()), arrays.arrays(np.float32, (2, 1)))
def test_trajectories_read_back_with_every_bit(states: Any, inputs: Any) -> None:
    store, run = Store(), Trajectory(np.array([0, -0.0, 5e-324]), states, inputs, "ended \udcff")
    store.add([(TRIAL, run, run)])
    for side in ("model", "system"):
        back = store.trajectory(0, side)  # type: ignore[arg-type]
        assert back is not None
        assert back.states.tobytes() == run.states.tobytes()
        assert (back.times.tobytes(), back.inputs.tobytes()) == (run.times.tobytes(), run.inputs.tobytes())


@given(NUMBERS)
def test_a_threshold_reads_back_or_is_refused(number: Any) -> None:
    store = Store()
    store.describe_first({"name": "rig"})
    try:
        store.state_threshold(number)
    except CtxvalError:
        assert store.thresholds() == ()
    else:
        assert [stated.threshold for stated in store.thresholds() or ()] == [float(number)]


@given(
    st.recursive(
        NUMBERS | st.text() | st.just(object()), lambda inner: st.lists(inner) | st.dictionaries(NUMBERS, inner)
    )
)
def test_settings_and_changes_read_back_or_are_refused(value: Any) -> None:
    store = Store()
    for write in (
        lambda: store.keep_settings({"value": value}),
        lambda: store.describe_anew({"value": value}, Change("accepted", "\udcff", {"value": value})),
    ):
        with suppress(CtxvalError):
            write()
        assert len(store.settings()) <= 1
        assert len(store.description()) <= 1
        assert len(store.history()) <= 1


@pytest.mark.parametrize("depth", [40, 60, 100_000])
def test_what_is_nested_too_deeply_to_be_read_is_not_stored(depth: int) -> None:
    value: Any = 0
    for _ in range(depth):
        value = [value]
    store = Store()
    for write in (
        lambda: store.keep_settings({"value": value}),
        lambda: store.add([(replace(TRIAL, note=TrialNote({"value": value})), None, None)]),
    ):
        if depth > 50:
            with pytest.raises(InputError):
                write()
        else:
            write()
    assert (len(store.settings()), len(store.trials())) == ((0, 0) if depth > 50 else (1, 1))


def test_another_task_than_that_of_the_row_is_not_committed() -> None:
    store, point = Store(), np.array([0.25])
    store.add([(replace(TRIAL, unit_point=point), None, None)])
    point[0] = 0.75  # code of others that changes an array in place
    with pytest.raises(InputError):
        store.close_trials([(replace(TRIAL, unit_point=point, state="failed", executed=True, failure="x"), None)])
    assert store.trials()[0].unit_point.tolist() == [0.25]
