from __future__ import annotations

import numpy as np
import pytest

from ctxval import Transitions, models
from ctxval._util.arrays import Array
from ctxval.core.model import Step
from ctxval.learning.dynamics_posterior import PosteriorSettings, learn_posterior
from ctxval.learning.residual_data import ResidualData, residual_data, smoother_than

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


# Without model


SETTINGS = PosteriorSettings(hyperparameters=4)


def system(x: Array, u: Array) -> Array:
    """Return the next states of a damped pendulum."""
    angle, rate = x[..., 0], x[..., 1]
    return np.stack([angle + 0.1 * rate, 0.98 * rate - 0.1 * np.sin(angle) + 0.1 * u[..., 0]], axis=-1)


def linear_system(x: Array, u: Array) -> Array:
    """Return the next states of the pendulum for small angles."""
    angle, rate = x[..., 0], x[..., 1]
    return np.stack([angle + 0.1 * rate, 0.98 * rate - 0.1 * angle + 0.1 * u[..., 0]], axis=-1)


def rough(step: Step) -> models.Function:
    """Return a model with waves that are far shorter than those of the system."""
    return models.Function(lambda x, u: step(x, u) + 0.03 * np.sin(25 * x + 40 * u), vectorized=True)


def smooth(step: Step) -> models.Function:
    """Return a nonlinear model whose error of the rate is smooth."""
    return models.Function(lambda x, u: step(x, u) + 0.01 * np.cos(x) * np.array([0, 1]), vectorized=True)


def transitions(step: Step, count: int = 200) -> Transitions:
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-2, 2, (count, 2)), rng.uniform(-1, 1, (count, 1))
    return Transitions(x, u, step(x, u))


def compared(model: models.Model, known: Transitions) -> bool:
    data = residual_data(model, known, np.zeros(len(known), dtype=np.intp))
    assert data is not None
    return smoother_than(data, 80) is not None


@pytest.mark.parametrize("step", [system, linear_system])
def test_a_model_that_is_rougher_than_the_system_is_replaced(step: Step) -> None:
    assert compared(rough(step), transitions(step))


def test_a_smooth_model_is_kept() -> None:
    known = transitions(system)
    assert not compared(smooth(system), known)
    assert not compared(models.Linear.fit(known), known)


def test_a_rough_system_keeps_its_model() -> None:
    def waves(x: Array, u: Array) -> Array:
        return np.asarray(system(x, u) + 0.03 * np.sin(25 * x + 40 * u) * np.array([0, 1]))

    assert not compared(smooth(waves), transitions(waves))


def test_few_transitions_do_not_replace_a_model() -> None:
    assert not compared(rough(system), transitions(system, 39))
    assert compared(rough(system), transitions(system, 60))


def test_the_linear_model_has_the_least_squared_errors() -> None:
    known = transitions(system)
    data = residual_data(rough(system), known, np.zeros(len(known), dtype=np.intp))
    assert data is not None
    found = smoother_than(data, 80)
    assert found is not None
    assert isinstance(found[0], models.Linear)
    expected = models.Linear.fit(known)
    np.testing.assert_allclose(found[0].A, expected.A, atol=1e-12)
    np.testing.assert_allclose(found[0].B, expected.B, atol=1e-12)
    np.testing.assert_allclose(found[0].c, expected.c, atol=1e-12)


def test_an_input_that_never_varies_has_no_weight() -> None:
    known = transitions(system)
    still = Transitions(known.x, np.ones_like(known.u), system(known.x, np.ones_like(known.u)))
    data = residual_data(rough(system), still, np.zeros(len(known), dtype=np.intp))
    assert data is not None
    found = smoother_than(data, 80)
    assert found is not None
    assert isinstance(found[0], models.Linear)
    np.testing.assert_array_equal(found[0].B, 0)
    assert np.abs(found[1].outputs * found[1].units).max() < 0.3


def test_without_a_rough_model_the_system_is_learned_far_more_accurately() -> None:
    known, rng = transitions(system), np.random.default_rng(1)
    posterior = learn_posterior(rough(system), known, np.zeros(len(known), dtype=np.intp), settings=SETTINGS)
    assert posterior is not None
    assert posterior.covariances.without_model
    assert isinstance(posterior.covariances.model, models.Linear)
    x, u = rng.uniform(-1.5, 1.5, (100, 2)), rng.uniform(-0.8, 0.8, (100, 1))
    errors = posterior.mean.step(x[None], u[None])[0] - system(x, u)
    assert np.abs(errors).max() < 1e-3  # the waves of the model are 0.03


def test_a_smooth_model_is_that_of_the_posterior() -> None:
    known, model = transitions(system), smooth(system)
    posterior = learn_posterior(model, known, np.zeros(len(known), dtype=np.intp), settings=SETTINGS)
    assert posterior is not None
    assert not posterior.covariances.without_model
    assert posterior.covariances.model is model
    assert posterior.covariances.settings == SETTINGS


def test_numbers_that_are_too_large_for_a_linear_model_keep_the_model() -> None:
    known = transitions(system)
    huge = Transitions(known.x.copy(), known.u, known.x_next.copy())
    huge.x[:5] *= 1e90
    huge.x_next[:5] *= 1e90
    model, sources = rough(system), np.zeros(len(known), dtype=np.intp)
    with np.errstate(all="ignore"):
        posterior = learn_posterior(model, huge, sources, np.random.default_rng(1), SETTINGS)
    assert posterior is None or posterior.covariances.model is model
