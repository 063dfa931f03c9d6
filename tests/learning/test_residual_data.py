from __future__ import annotations

import numpy as np
import pytest

from ctxval import Transitions, models
from ctxval.learning.residual_data import ResidualData, residual_data

MODEL = models.Linear([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]])


def record(count: int = 50, seed: int = 0) -> Transitions:
    """Return transitions of a system whose second state M does not explain."""
    rng = np.random.default_rng(seed)
    x, u = 3 + 2 * rng.normal(size=(count, 2)), 0.1 * rng.normal(size=(count, 1))
    missed = np.stack([np.zeros(count), 0.05 * np.sin(x[:, 0])], axis=1)
    return Transitions(x, u, MODEL.step(x, u) + missed)


def residuals_of(transitions: Transitions) -> ResidualData:
    data = residual_data(MODEL, transitions, np.arange(len(transitions)))
    assert data is not None
    return data


def test_pairs_have_mean_0_and_variance_1_and_residuals_a_mean_square_of_1() -> None:
    data = residuals_of(record())
    np.testing.assert_allclose(data.pairs.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(data.pairs.std(axis=0), 1)
    np.testing.assert_allclose((data.outputs**2).mean(axis=0), [0, 1])


def test_units_and_constants_return_the_recorded_numbers() -> None:
    transitions = record()
    data = residuals_of(transitions)
    missed = transitions.x_next - MODEL.step(transitions.x, transitions.u)
    np.testing.assert_allclose(data.outputs * data.units, missed, atol=1e-14)
    np.testing.assert_allclose(data.standardised(transitions.x, transitions.u), data.pairs)
    np.testing.assert_allclose(data.steps, (transitions.x_next - transitions.x).std(axis=0))


def test_a_state_that_m_explains_is_not_learned() -> None:
    data = residuals_of(record())
    np.testing.assert_array_equal(data.learned, [False, True])
    assert data.units[0] == 0
    assert data.inputs == 1


def test_transitions_that_diverged_are_left_out_with_their_sources() -> None:
    good = record(20)
    far = np.full((3, 2), [1e150, 1.0])
    broken = Transitions.joined([good, Transitions(far, np.zeros((3, 1)), far), record(5, seed=1)])
    broken.x_next[2, 0] = np.nan
    data = residuals_of(broken)
    np.testing.assert_array_equal(data.sources, [*range(2), *range(3, 20), *range(23, 28)])
    assert np.isfinite(data.pairs).all()
    assert np.isfinite(data.outputs).all()


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_transitions_give_nothing(count: int) -> None:
    transitions = record(2)
    few = Transitions(transitions.x[:count], transitions.u[:count], transitions.x_next[:count])
    assert residual_data(MODEL, few, np.zeros(count, dtype=np.intp)) is None


def test_a_model_that_explains_everything_leaves_nothing() -> None:
    transitions = record()
    exact = Transitions(transitions.x, transitions.u, MODEL.step(transitions.x, transitions.u))
    assert residual_data(MODEL, exact, np.zeros(len(exact), dtype=np.intp)) is None


def test_a_constant_column_is_not_divided_by_its_deviation() -> None:
    transitions = record()
    still = Transitions(transitions.x, np.full((50, 1), 4.0), transitions.x_next)
    data = residuals_of(still)
    assert data.scale[2] == 1
    np.testing.assert_array_equal(data.pairs[:, 2], 0)
