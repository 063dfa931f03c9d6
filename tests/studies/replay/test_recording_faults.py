"""Faults of recordings that look like errors of a model."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import Trajectory
from ctxval.data import Recording, Recordings
from ctxval.models import Linear
from ctxval.studies.replay import replay
from ctxval.studies.replay.causes import faults

DT, STEPS = 0.02, 400


def spun(seed: int, *, spin: float = 0.0) -> Trajectory:
    """Return a motor under random torques: angle and rate."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-2, 2, STEPS // 10), 10) + spin
    x = np.zeros((STEPS + 1, 2))
    for k in range(STEPS):
        x[k + 1] = x[k] + DT * np.array([x[k, 1], u[k] - 0.3 * x[k, 1]])
    return Trajectory(DT * np.arange(STEPS + 1), x + 1e-4 * rng.normal(size=x.shape), u[:, None])


def recorded(*runs: Trajectory) -> Recordings:
    whole = tuple(Recording(f"run{k}.csv", 0.0, run) for k, run in enumerate(runs))
    return Recordings(whole, (), DT, {"angle": "rad", "rate": "rad/s"}, {"torque": "N m"})


TRUE = Linear([[1.0, DT], [0.0, 1 - 0.3 * DT]], [[0.0], [DT]])
CLEAN = [spun(seed) for seed in range(4)]


def changed(run: Trajectory, states: np.ndarray) -> Trajectory:
    return Trajectory(run.times, states, run.inputs)


def test_clean_recordings_have_no_fault() -> None:
    assert not faults(TRUE, recorded(*CLEAN), range(4))


@given(st.integers(0, 2**31))
def test_noise_is_no_fault(seed: int) -> None:
    rng = np.random.default_rng(seed)
    noisy = [changed(run, run.states + 0.02 * rng.normal(size=run.states.shape)) for run in CLEAN]
    assert not any(fault.explains for fault in faults(TRUE, recorded(*noisy), range(4)))


@pytest.mark.parametrize("counts", [64, 1024, 4096])
def test_an_encoder_is_no_fault(counts: int) -> None:
    width = 2 * np.pi / counts
    coarse = [changed(run, np.rint(run.states / width) * width) for run in CLEAN]
    assert not any(fault.explains for fault in faults(TRUE, recorded(*coarse), range(4)))


@pytest.mark.parametrize("turn", [2 * np.pi, 360.0])
def test_an_angle_that_is_kept_within_a_turn_is_found_with_its_share(turn: float) -> None:
    runs = [spun(seed, spin=3.0) for seed in range(3)]
    wrapped = []
    for run in runs:
        states = run.states * [turn / (2 * np.pi), 1.0]
        states[:, 0] = (states[:, 0] + turn / 2) % turn - turn / 2
        wrapped.append(changed(run, states))
    (first, *_) = faults(TRUE, recorded(*wrapped), range(3))
    assert (first.kind, first.state) == ("turn", "angle")
    assert first.share > 0.5
    assert "angle = true" in first.sentence
    jumps = sum(int((np.abs(np.diff(run.states[:, 0])) > turn / 2).sum()) for run in wrapped)
    assert first.steps == jumps


def test_a_frozen_sensor_is_found_and_hides_other_causes() -> None:
    states = CLEAN[1].states.copy()
    states[150:250, 1] = states[150, 1]
    report = replay(TRUE, recorded(CLEAN[0], changed(CLEAN[1], states), CLEAN[2]))
    (first, *_) = report.faults
    assert (first.kind, first.state, first.source) == ("frozen", "rate", "run1.csv")
    assert first.share > 0.5
    assert any("frozen sensor" in sentence for sentence in report.insights)
    assert not any("noise" in sentence or "not recorded" in sentence for sentence in report.insights)


def test_a_system_that_stands_still_is_not_frozen() -> None:
    resting = []
    for run in CLEAN:
        states = run.states.copy()
        states[100:200] = states[100]
        resting.append(changed(run, states))
    assert not any(fault.kind == "frozen" for fault in faults(TRUE, recorded(*resting), range(4)))


def test_single_values_far_from_their_neighbours_are_found() -> None:
    states, rng = CLEAN[0].states.copy(), np.random.default_rng(0)
    states[rng.choice(np.arange(5, 395, 3), 20, replace=False), 0] += 5.0
    (first, *_) = faults(TRUE, recorded(changed(CLEAN[0], states), *CLEAN[1:]), range(4))
    assert (first.kind, first.state, first.source) == ("spike", "angle", "run0.csv")
    assert first.share > 0.9
    assert first.steps == 40


def test_one_file_that_differs_is_named_also_if_the_model_was_learned_from_it() -> None:
    odd = Trajectory(CLEAN[2].times, CLEAN[2].states, np.random.default_rng(0).normal(size=CLEAN[2].inputs.shape))
    whole = recorded(CLEAN[0], CLEAN[1], odd, CLEAN[3])
    for used in ([0], [0, 1, 2, 3]):
        (named,) = [fault for fault in faults(TRUE, whole, used) if fault.kind == "file"]
        assert named.source == "run2.csv"
        assert named.explains


def test_a_wrong_model_is_not_blamed_on_the_recordings() -> None:
    wrong = Linear([[1.0, DT], [0.0, 1.0]], [[0.0], [0.5 * DT]])
    assert not any(fault.explains for fault in faults(wrong, recorded(*CLEAN), range(4)))
