"""The mean of the posterior as a model: what it predicts, how sure it is, and what it would be without executions."""

from __future__ import annotations

import numpy as np

from ctxval import Transitions, models
from ctxval._util.arrays import Array, Rows
from ctxval.core.model import Model
from ctxval.learning.dynamics_posterior import (
    DynamicsPosterior,
    PosteriorSettings,
    condition,
    learn_covariances,
    learn_posterior,
)
from ctxval.learning.kernel_expansion import Component

MODEL = models.Linear([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]])


def truth(x: Array, u: Array) -> Array:
    """A smooth system that a linear model misses."""
    return MODEL.step(x, u) + 0.05 * np.stack([np.sin(2 * x[..., 0]) * u[..., 0], np.cos(x[..., 1])], axis=-1)


def record(count: int, seed: int = 0, reach: float = 1.0) -> Transitions:
    rng = np.random.default_rng(seed)
    x, u = rng.uniform(-reach, reach, (count, 2)), rng.uniform(-reach, reach, (count, 1))
    return Transitions(x, u, truth(x, u))


def learn(data: Transitions, sources: Rows | None = None, centres: int = 400) -> DynamicsPosterior:
    of = np.full(len(data), -1) if sources is None else sources
    found = learn_posterior(MODEL, data, of, settings=PosteriorSettings(centres=centres, of_steps=False))
    assert found is not None
    return found


def mean(posterior: DynamicsPosterior) -> Model:
    return posterior.mean.model_of(0)


def test_it_predicts_what_the_model_misses() -> None:
    fresh = record(200, seed=1, reach=0.9)
    error = np.abs(mean(learn(record(400))).step(fresh.x, fresh.u) - fresh.x_next).max()
    assert error < 0.01 * np.abs(MODEL.step(fresh.x, fresh.u) - fresh.x_next).max()


def test_a_linear_residual_is_learned_everywhere_from_few_transitions() -> None:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(8, 2)), rng.normal(size=(8, 1))
    other = models.Linear([[1.02, 0.05], [0.1, 0.9]], [[0.05], [0.08]])
    posterior = learn(Transitions(x, u, other.step(x, u)))
    far, push = 10 * rng.normal(size=(50, 2)), rng.normal(size=(50, 1))
    largest = 0.9 * posterior.limit * posterior.data.units
    bounded = (np.abs(other.step(far, push) - MODEL.step(far, push)) < largest).all(axis=1)
    assert bounded.sum() > 5
    np.testing.assert_allclose(mean(posterior).step(far, push)[bounded], other.step(far, push)[bounded], atol=1e-3)


def test_far_from_the_data_it_never_corrects_much_more_than_was_ever_recorded() -> None:
    data = record(100)
    largest = np.abs(data.x_next - MODEL.step(data.x, data.u)).max(axis=0)
    far = 1e6 * np.random.default_rng(2).normal(size=(200, 3))
    corrected = mean(learn(data)).step(far[:, :2], far[:, 2:]) - MODEL.step(far[:, :2], far[:, 2:])
    assert (np.abs(corrected) <= 5.001 * largest + 1e-9 * np.abs(far[:, :2])).all()


def test_noise_in_the_recordings_is_not_learned() -> None:
    data, rng = record(300), np.random.default_rng(3)
    noisy = Transitions(data.x, data.u, data.x_next + 0.01 * rng.normal(size=data.x.shape))
    fresh = record(200, seed=1, reach=0.9)
    error = mean(learn(noisy)).step(fresh.x, fresh.u) - fresh.x_next
    assert np.sqrt((error**2).mean()) < 0.01


def test_what_was_seen_is_familiar_and_what_was_not_is_not() -> None:
    posterior = learn(record(200))
    states = np.zeros((2, 9, 2))
    states[1] = 6.0
    here, far = posterior.unfamiliarity(states, np.zeros((2, 8, 1)))
    assert here < 0.05 * far


def test_the_doubt_is_the_deviation_of_draws_as_a_share_of_a_typical_step() -> None:
    posterior = learn(record(25, reach=0.5))
    most, data, place = posterior.most_probable, posterior.data, np.array([[0.9, 0.9, 0.9]])
    found = posterior.unfamiliarity(np.tile(place[:, None, :2], (1, 2, 1)), place[:, None, 2:])
    z = data.standardised(place[:, :2], place[:, 2:])
    deviations = np.sqrt(most.variance(z) * most.squares / len(most.centres)) * data.sizes / data.steps
    np.testing.assert_allclose(found, np.sqrt((deviations**2).mean()), rtol=1e-9)


def test_recordings_that_repeat_themselves_and_ones_that_diverged_do_no_harm() -> None:
    data = record(40)
    twice = Transitions.joined([data, data, Transitions(data.x * 1e150, data.u, data.x_next * 1e160)])
    assert np.isfinite(mean(learn(twice)).step(data.x, data.u)).all()


def test_recordings_that_are_not_finite_are_left_out() -> None:
    data = record(100)
    broken = Transitions(data.x, data.u, np.where(np.arange(100)[:, None] % 7 == 0, np.nan, data.x_next))
    assert np.isfinite(mean(learn(broken)).step(data.x, data.u)).all()
    nothing = Transitions(data.x, data.u, data.x_next * np.nan)
    assert learn_covariances(MODEL, nothing, np.full(100, -1)) is None


def test_means_without_executions_are_those_conditioned_on_the_other_ones() -> None:
    data, of = record(90), np.repeat(np.arange(6), 15)
    posterior = learn(data, of, centres=60)
    x, u = data.x[:3, None], data.u[:3, None]
    together = posterior.means_without([{2}, {0, 5}, set()]).step(x, u)[:, 0]
    everything = posterior.means_without([set()] * 3).step(x, u)[:, 0]
    np.testing.assert_allclose(together[2], everything[2])
    most = posterior.most_probable.hyperparameters
    for row, gone in enumerate([[2], [0, 5]]):
        # All transitions are centres or replacements, so the others are conditioned on directly.
        kept = np.flatnonzero(~np.isin(posterior.data.sources, gone))
        Z, Y = posterior.data.pairs[kept], posterior.data.outputs[kept]
        alone = Component.conditioned(most, Z, Y, np.random.default_rng(0)).mean(
            posterior.data.pairs[None, row : row + 1]
        )
        expected = MODEL.step(x[row], u[row])[0] + alone[0, 0] * posterior.data.units
        np.testing.assert_allclose(together[row], expected, rtol=0.05, atol=1e-3)


def test_a_rough_mean_has_fewer_centres_and_almost_the_same_values() -> None:
    data = record(400)
    posterior = learn(data)
    (rough,) = posterior.rough_mean.expansions
    assert rough.centres.shape[1] < len(posterior.rows)
    fine, coarse = (one.model_of(0).step(data.x, data.u) for one in (posterior.mean, posterior.rough_mean))
    size = np.abs(fine - MODEL.step(data.x, data.u)).max()
    np.testing.assert_allclose(coarse, fine, atol=0.05 * size)


def test_hyperparameters_that_were_learned_earlier_keep_their_physical_length_scales() -> None:
    data = record(200)
    learned = learn_covariances(MODEL, data, np.full(200, -1), settings=PosteriorSettings(hyperparameters=4))
    assert learned is not None
    wider = Transitions.joined([data, record(100, seed=4, reach=3.0)])
    posterior = condition(learned, wider, np.full(300, -1))
    assert posterior is not None
    for one, drawn in zip(posterior.components, learned.drawn, strict=True):
        scales = np.exp(one.hyperparameters.theta[:-2]) * posterior.data.scale
        np.testing.assert_allclose(scales, np.exp(drawn.theta[:-2]) * learned.scale)
