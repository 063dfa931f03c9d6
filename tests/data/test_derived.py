"""States that follow from records: derivatives, and records of earlier steps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval.data import LogMapping, MemoryTable, Observer, Recordings, recordings_of
from ctxval.errors import InputError
from ctxval.studies.fitting import fit
from facts import assert_names, refuses

T = 0.1 * np.arange(40)


def read(columns: dict[str, Any], **mapping: Any) -> Recordings:
    return recordings_of([MemoryTable("run", {"t": T, **columns})], LogMapping.from_table(mapping))


@given(st.tuples(*[st.floats(-2, 2)] * 3), st.sampled_from([3, 5, 7, 11]))
def test_the_derivative_of_a_parabola_is_exact(of: tuple[float, float, float], window: int) -> None:
    a, b, c = of
    states = {"rate": {"derivative_of": "angle", "window": window}, "angle": {"path": "q", "unit": "rad"}}
    recordings = read({"q": a + b * T + c * T**2, "u": T}, states=states, inputs={"u": "u"})
    (run,) = recordings.runs
    assert list(recordings.states.items()) == [("rate", "rad/s"), ("angle", "rad")]
    assert np.allclose(run.trajectory.states[:, 0], b + 2 * c * T, atol=1e-9)
    assert f"looks {window // 2 * 0.1:.3g} s ahead" in recordings.notes[-1]


def test_earlier_records_are_states() -> None:
    recordings = read({"y": np.sin(T), "u": np.cos(T)}, states={"y": "y"}, inputs={"u": "u"}, lags=2)
    (run,) = recordings.runs
    names = ["y", "y a step before", "y 2 steps before", "u a step before", "u 2 steps before"]
    assert list(recordings.states) == names
    assert run.start == pytest.approx(0.2)
    x = run.trajectory.states
    assert np.allclose(x[:, 0], np.sin(T[2:]))
    assert np.allclose(x[:, 2], np.sin(T[:-2]))
    assert np.allclose(x[:, 3], np.cos(T[1:-1]))
    assert np.allclose(run.trajectory.inputs[:, 0], np.cos(T[2:-1]))
    assert run.trajectory.horizon == len(T) - 3


def test_a_state_that_is_not_recorded_is_made_good_by_the_past() -> None:
    rng, logs = np.random.default_rng(0), []
    for _ in range(4):
        u, x = rng.normal(size=len(T)), np.zeros((len(T), 2))
        for k in range(len(T) - 1):
            x[k + 1] = x[k] + 0.1 * np.array([x[k, 1], u[k] - x[k, 0] - 0.5 * x[k, 1]])
        logs.append(MemoryTable("run", {"t": T, "y": x[:, 0], "u": u}))

    def error(lags: int) -> float:
        mapping = LogMapping.from_table({"states": {"y": "y"}, "inputs": {"u": "u"}, "lags": lags})
        return fit(recordings_of(logs, mapping), ["linear"]).fitted[0].errors[0].relative

    assert error(0) > 0.1
    assert error(1) < 1e-9  # output and input of one step before determine a linear state of two


def test_recordings_that_are_too_short_are_left_out_and_said() -> None:
    y = np.sin(T)
    y[[3, 25]] = np.nan
    recordings = read({"y": y, "u": T}, states={"y": "y", "v": {"derivative_of": "y", "window": 5}}, inputs={"u": "u"})
    assert len(recordings.runs) == 2
    assert_names(str(recordings.breaks[-1]), 5)
    with refuses(InputError, 41):
        read({"y": T, "u": T}, states={"y": "y", "v": {"derivative_of": "y", "window": 41}}, inputs={"u": "u"})


@pytest.mark.parametrize(
    ("mapping", "facts"),
    [
        ({"states": {"v": {"derivative_of": "y"}}}, ("log",)),
        ({"states": {"y": "y", "v": {"derivative_of": "z"}}}, ("v", "z")),
        ({"states": {"y": "y", "v": {"derivative_of": "y", "path": "u"}}}, ("v", "y")),
        ({"states": {"y": "y", "v": {"derivative_of": "y", "window": 4}}}, ("window", "v")),
        ({"states": {"y": "y"}, "inputs": {"v": {"derivative_of": "y"}}}, ("v",)),
        ({"states": {"y": "y"}, "lags": -1}, ("lags", 0)),
        ({"states": {"y": "y"}, "lags": 1.5}, ("lags", 0)),
    ],
)
def test_what_cannot_be_derived_is_refused(mapping: dict[str, Any], facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        read({"y": T, "u": T}, **mapping)


# Observers


def settling(y: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
    """Return the record and its backward difference, which the first record has not."""
    rate = np.vstack([[np.nan], np.diff(y, axis=0) / dt])
    return np.hstack([y, rate])


def observed(observer: Any, **mapping: Any) -> Recordings:
    log = MemoryTable("run", {"t": T, "y": 2 * T, "u": np.cos(T)})
    return recordings_of([log], LogMapping({"y": "y"}, {"u": "u"}, observer=observer, **mapping))


def test_an_observer_estimates_states() -> None:
    recordings = observed(Observer(settling, {"angle": "rad", "rate": "rad/s"}))
    (run,) = recordings.runs
    assert recordings.states == {"angle": "rad", "rate": "rad/s"}
    assert run.start == pytest.approx(0.1)
    assert np.allclose(run.trajectory.states, np.stack([2 * T[1:], np.full(39, 2.0)], axis=-1))
    assert np.allclose(run.trajectory.inputs[:, 0], np.cos(T[1:-1]))
    assert_names(recordings.notes[-1], "settling", "y")
    assert list(observed(settling).states) == ["x0", "x1"]
    assert list(observed(lambda y, u, dt: 2 * y).states) == ["y"]
    assert list(observed(settling, lags=1).states)[:3] == ["x0", "x1", "x0 a step before"]


@pytest.mark.parametrize(
    ("observer", "facts"),
    [
        (lambda y, u, dt: y[1:], ((39, 1),)),
        (lambda y, u, dt: 1 / 0, ("ZeroDivisionError",)),
        (lambda y, u, dt: np.where(y > 1, np.nan, y), (6,)),
        (lambda y, u, dt: np.full_like(y, np.nan), ()),
        (Observer(settling, {"a": "", "b": "", "c": ""}), ("settling", 3, "b")),
        (Observer(None, reference="a:b"), ("observer",)),
    ],
)
def test_an_observer_that_cannot_be_used_is_refused(observer: Any, facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        observed(observer)


def test_an_observer_is_a_function() -> None:
    with refuses(InputError, "observer", 3):
        observed(3)
