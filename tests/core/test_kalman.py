"""The filter and the smoother agree with the normal distribution of all states at once."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval.core.kalman import Estimate, corrected, predicted, smoothed
from ctxval.core.system import Outputs
from ctxval.models import Linear

H = 6


def linear_case(seed: int) -> tuple[Linear, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    A, B, C = 0.6 * rng.normal(size=(3, 3)), rng.normal(size=(3, 1)), rng.normal(size=(2, 3))
    return Linear(A, B), C, np.diag([0.1, 0.2, 0.3]), np.diag([0.05, 0.02]), rng.normal(size=(H, 1)), rng.normal(size=3)


@pytest.mark.parametrize("seed", range(3))
def test_estimates_are_those_of_one_large_regression(seed: int) -> None:
    model, C, Q, R, u, start = linear_case(seed)
    outputs, y = Outputs(lambda x: x @ C.T), np.random.default_rng(9).normal(size=(H + 1, 2))
    # All states as one normal vector: X = means + L w, with the noises w of the start and of each step.
    A = model.A
    steps = np.eye(3 * (H + 1)) - np.kron(np.eye(H + 1, k=-1), A)
    means = np.linalg.solve(steps, np.concatenate([start, *(model.B @ row for row in u)]))
    L = np.linalg.inv(steps)
    P = L @ np.kron(np.eye(H + 1), Q) @ L.T

    def given(count: int) -> np.ndarray:
        """The means of all states after so many outputs."""
        S = np.kron(np.eye(count), C) @ np.eye(3 * count, 3 * (H + 1))
        gain = P @ S.T @ np.linalg.inv(S @ P @ S.T + np.kron(np.eye(count), R))
        return (means + gain @ (y[:count].ravel() - S @ means)).reshape(H + 1, 3)

    known, _ = corrected(outputs, Estimate(start, Q), y[0], R)
    filtered, priors, jacobians = [known], [], []
    for t in range(H):
        prior, jacobian = predicted(model, known, u[t], Q)
        known, innovation = corrected(outputs, prior, y[t + 1], R)
        assert innovation == pytest.approx(y[t + 1] - C @ prior.mean)
        assert known.mean == pytest.approx(given(t + 2)[t + 1])
        filtered.append(known)
        priors.append(prior)
        jacobians.append(jacobian)
    states = [known.mean]
    for t in reversed(range(H)):
        states.append(smoothed(filtered[t], jacobians[t], priors[t], states[-1]))
    assert np.array(states[::-1]) == pytest.approx(given(H + 1))


def test_a_batch_is_the_same_as_one_by_one() -> None:
    def pendulum(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.stack([x[..., 0] + 0.1 * x[..., 1], x[..., 1] - np.sin(x[..., 0]) + u[..., 0]], axis=-1)

    class Model:
        step = staticmethod(pendulum)

    rng, outputs = np.random.default_rng(0), Outputs(lambda x: np.sin(x[..., :1]))
    means, u, y = rng.normal(size=(4, 2)), rng.normal(size=(4, 1)), rng.normal(size=(4, 1))
    covariances = np.repeat(np.diag([0.1, 0.3])[None], 4, axis=0)
    process, measurement = np.diag([0.01, 0.1]), np.diag([0.02])
    prior, _ = predicted(Model(), Estimate(means, covariances), u, process)
    known, _ = corrected(outputs, prior, y, measurement)
    for k in range(4):
        alone, _ = predicted(Model(), Estimate(means[k], covariances[k]), u[k], process)
        alone, _ = corrected(outputs, alone, y[k], measurement)
        for part, of_one in zip(known, alone, strict=True):
            assert part[k] == pytest.approx(of_one, abs=1e-12)
