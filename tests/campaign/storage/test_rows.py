"""What a row must be to be a trial."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from ctxval import Trial
from ctxval.campaign.storage.rows import COLUMNS, checksum_of, follows, read_json, read_pairs, read_trial, row_of
from ctxval.errors import InputError

NAMES = [name.strip() for name in COLUMNS.split(",")]
WHOLE = Trial(
    *(0, "iid", "completed", np.array([0.25, 1.0]), {"a": 1.5, "b": [1.0, -2.0]}, 1, True, 0.5),
    *(None, 2.0, {"engine": "climb", "expected": 0.5}),
)


def read(row: tuple[Any, ...]) -> Trial | None:
    """Read a row of which the checksum fits, as anybody can compute one."""
    return read_trial(row, checksum_of(row))


def changed(**values: Any) -> tuple[Any, ...]:
    row = dict(zip(NAMES, row_of(WHOLE), strict=True))
    return tuple((row | values).values())


def test_a_whole_row_is_read() -> None:
    trial = read(row_of(WHOLE))
    assert trial is not None
    assert (trial.parameters, trial.distance, trial.note) == (WHOLE.parameters, 0.5, WHOLE.note)
    assert read(changed(state="failed", distance=None, failure="it broke", seconds=None, note=None)) is not None
    assert read(changed(state="open", distance=None, executed=0)) is not None


@pytest.mark.parametrize(
    "values",
    [
        {"distance": np.inf},
        {"distance": -np.inf},
        {"distance": np.nan},
        {"distance": -0.5},
        {"distance": "0.5"},
        {"distance": b"0.5"},
        {"distance": 1},
        {"state": "failed"},
        {"distance": None},
        {"state": "open", "distance": None},
        {"state": "done"},
        {"state": b"completed"},
        {"origin": "guessed"},
        {"origin": None},
        {"attempts": -1},
        {"attempts": "1" + "0" * 300},
        {"attempts": 1.5},
        {"attempts": 2**60},
        {"number": -1},
        {"number": "0"},
        {"number": 0.0},
        {"executed": 2},
        {"executed": "yes"},
        {"seconds": -1.0},
        {"seconds": np.inf},
        {"seconds": np.nan},
        {"seconds": "long"},
        {"failure": b"bytes"},
        {"failure": 3},
        {"unit_point": "[1.5, 0.5]"},
        {"unit_point": "[-1e-9]"},
        {"unit_point": "[NaN]"},
        {"unit_point": "[Infinity]"},
        {"unit_point": "[]"},
        {"unit_point": "0.5"},
        {"unit_point": "[[0.5]]"},
        {"unit_point": '["0.5"]'},
        {"unit_point": "[true]"},
        {"unit_point": '{"0": 0.5}'},
        {"unit_point": b"[0.5]"},
        {"unit_point": None},
        {"unit_point": "[0.5"},
        {"unit_point": "[" * 100_000},
        {"parameters": "[1.0]"},
        {"parameters": "null"},
        {"parameters": '"goal"'},
        {"parameters": '{"a": true}'},
        {"parameters": '{"a": NaN}'},
        {"parameters": '{"a": 1' + "0" * 400 + "}"},
        {"parameters": '{"a": {"b": 1.0}}'},
        {"parameters": '{"a": ' + "[" * 500 + "]" * 500 + "}"},
        {"parameters": '{"a": ' + "[" * 100_000 + "]" * 100_000 + "}"},
        {"state": "unmeasured"},
        {"state": "unmeasured", "distance": None, "executed": 0},
        {"because": b"bytes"},
        {"because": 3},
        {"note": "[1]"},
        {"note": "{"},
        {"note": 3},
    ],
)
def test_a_row_that_no_trial_has_is_damaged(values: dict[str, Any]) -> None:
    assert read(changed(**values)) is None


def test_a_row_needs_its_checksum() -> None:
    row = row_of(WHOLE)
    assert read_trial(row, None) is None
    assert read_trial(row, checksum_of(row) + 1) is None


ANYTHING = st.one_of(
    st.none(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(),
    st.text(st.characters(exclude_categories=["Cs"])),
    st.binary(),
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    ).map(json.dumps),
)


@given(st.dictionaries(st.sampled_from(NAMES), ANYTHING, max_size=4))
@example(dict.fromkeys(NAMES))
def test_any_row_is_a_trial_that_can_be_or_none(values: dict[str, Any]) -> None:
    trial = read(changed(**values))
    if trial is None:
        return
    assert trial.unit_point.ndim == 1
    assert ((trial.unit_point >= 0) & (trial.unit_point <= 1)).all()
    assert (trial.distance is not None) == (trial.state == "completed")
    assert trial.distance is None or 0 <= trial.distance < np.inf
    assert isinstance(trial.failure, str | None)
    json.dumps(trial.parameters, allow_nan=False)


def test_a_trial_follows_those_of_its_space() -> None:
    other = Trial(1, "iid", "open", np.array([0.5]), {"a": 1.0})
    assert follows(WHOLE, [])
    assert not follows(other, [])
    assert not follows(other, [WHOLE])
    assert follows(Trial(1, "iid", "open", np.array([0.5, 0.5]), {}), [WHOLE])


@pytest.mark.parametrize(
    "rows",
    [[("a", "1"), ("a", "2")], [(b"a", "1")], [(None, "1")], [("a", b"1")], [("a", "{")], [("a", "[" * 60 + "]" * 60)]],
)
def test_a_table_of_keys_must_be_one(rows: list[tuple[Any, Any]]) -> None:
    with pytest.raises(InputError):
        read_pairs(rows)


def test_an_endless_table_is_left_at_the_first_key_that_comes_again() -> None:
    def endless() -> Any:
        while True:
            yield "a", "1"

    with pytest.raises(InputError, match="occurs once"):
        read_pairs(endless())


def test_json_is_json() -> None:
    assert read_json("[1, null]") == [1, None]
    assert np.isnan(read_json("NaN", finite=False))
    with pytest.raises(InputError, match="NaN is not a number"):
        read_json("NaN")
