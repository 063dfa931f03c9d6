"""Quaternions of recordings: found by their length, continued with one sign, and interpolated on the sphere."""

from __future__ import annotations

import numpy as np

from ctxval import Trajectory
from ctxval._util.quaternions import continued, interpolated, quaternions_in
from ctxval.data.sampling import Channel, sampled

TIMES = np.linspace(0, 2, 21)


def turning(times: np.ndarray) -> np.ndarray:
    """Return a height and the quaternion of a turn about z, (N, 5)."""
    angle = 2.0 * times
    return np.stack([times, np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=-1)


def flipped(states: np.ndarray) -> np.ndarray:
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(states))
    return np.concatenate([states[:, :1], states[:, 1:] * signs[:, None]], axis=1)


def misses(states: np.ndarray, times: np.ndarray) -> float:
    return float(np.abs(np.abs((states[:, 1:] * turning(times)[:, 1:]).sum(axis=1)) - 1).max())


def test_quaternions_are_found_by_their_length() -> None:
    assert quaternions_in(list(turning(TIMES).T)) == [slice(1, 5)]
    assert quaternions_in(list(np.random.default_rng(0).standard_normal((9, 20)))) == []
    assert np.abs(np.diff(continued(flipped(turning(TIMES))[:, 1:]), axis=0)).max() < 0.11


def test_interpolation_does_not_pass_through_the_middle_of_the_sphere() -> None:
    fine, recorded = np.linspace(0, 2, 133), flipped(turning(TIMES))
    states = interpolated(fine, TIMES, recorded)
    assert misses(states, fine) < 1e-6
    assert np.abs(np.linalg.norm(states[:, 1:], axis=1) - 1).max() < 1e-15
    assert np.array_equal(states[:, 0], np.interp(fine, TIMES, recorded[:, 0]))
    run = Trajectory(TIMES, recorded, np.zeros((20, 1))).resampled(np.arange(0, 1.9, 0.08))
    assert misses(run.states, run.times) < 1e-6


def test_logs_are_sampled_with_one_sign() -> None:
    recorded = flipped(turning(TIMES))
    channels = [Channel(f"x{k}", "", False, TIMES, column) for k, column in enumerate(recorded.T)]
    channels.append(Channel("u", "", True, TIMES, np.ones(21)))
    [(start, run)], _ = sampled("log", channels, 0.04, 0.0, None)
    assert misses(run.states, start + run.times) < 1e-6
    assert np.abs(np.diff(run.states[:, 1:], axis=0)).max() < 0.05
