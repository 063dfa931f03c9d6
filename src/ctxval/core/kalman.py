"""The extended Kalman filter of M and its outputs, for one state estimate or a batch ``(...)``."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctxval._util.arrays import Array
from ctxval.core.model import Model, linearize
from ctxval.core.system import Outputs


class Estimate(NamedTuple):
    """A normal distribution of states: means ``(..., n)`` and covariances ``(..., n, n)``."""

    mean: Array
    covariance: Array


def predicted(model: Model, known: Estimate, u: Array, process: Array) -> tuple[Estimate, Array]:
    """Return the next state, and A = df/dx at the present one.

    Args:
        u: inputs ``(..., m)``.
        process: covariance ``(..., n, n)`` of what M misses in one step.
    """
    A, _ = linearize(model, known.mean, u)
    covariance = A @ known.covariance @ np.swapaxes(A, -1, -2) + process
    return Estimate(np.asarray(model.step(known.mean, u), dtype=np.float64), covariance), A


def corrected(outputs: Outputs, prior: Estimate, y: Array, measurement: Array) -> tuple[Estimate, Array]:
    """Return the state after outputs ``(..., p)`` were recorded, and the innovation ``(..., p)``.

    Args:
        measurement: covariance ``(p, p)`` of the errors of the recorded outputs.
    """
    C = outputs.jacobian(prior.mean)
    C_t = np.swapaxes(C, -1, -2)
    innovation = y - outputs(prior.mean)
    spread = C @ prior.covariance @ C_t + measurement
    gain = np.swapaxes(np.linalg.solve(spread, C @ prior.covariance), -1, -2)
    mean = prior.mean + (gain @ innovation[..., None])[..., 0]
    # The form of Joseph, which stays positive semidefinite if it is rounded.
    kept = np.eye(prior.mean.shape[-1]) - gain @ C
    covariance = kept @ prior.covariance @ np.swapaxes(kept, -1, -2)
    return Estimate(mean, covariance + gain @ measurement @ np.swapaxes(gain, -1, -2)), innovation


def smoothed(filtered: Estimate, A: Array, prior: Estimate, later: Array) -> Array:
    """Return the mean of a state if the next one is ``later``; ``prior`` is the next one's prediction with A.

    Rauch, Tung and Striebel (1965), "Maximum likelihood estimates of linear dynamic systems".
    """
    gain_t = np.linalg.solve(prior.covariance, A @ filtered.covariance)
    return np.asarray(filtered.mean + (np.swapaxes(gain_t, -1, -2) @ (later - prior.mean)[..., None])[..., 0])
