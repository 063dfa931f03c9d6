from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ctxval import Transitions, models
from ctxval._util.arrays import Array, Rows
from ctxval.core.model import Model
from ctxval.gp.cholesky import factorise
from ctxval.learning.dynamics_posterior import (
    DynamicsPosterior,
    PosteriorSettings,
    condition,
    learn_covariances,
    learn_posterior,
)
from ctxval.learning.hyperparameters import FAMILIES, ResidualHyperparameters, ResidualKernel
from ctxval.learning.kernel_expansion import Component, draw_functions
from facts import refuses
from rig_thorough import more

MODEL = models.Linear([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]])
OTHER = models.Linear([[1.02, 0.05], [0.1, 0.9]], [[0.05], [0.08]], [0.01, -0.02])
THETA = np.log([1.0, 2.0, 0.5, 0.3])
NOISE = 1e-4


def record(count: int, *, truth: models.Model = OTHER, noise: float = 0.0, seed: int = 0) -> Transitions:
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=(count, 2)), rng.normal(size=(count, 1))
    return Transitions(x, u, truth.step(x, u) + noise * rng.normal(size=x.shape))


def rough(x: Array, u: Array) -> Array:
    """A smooth system that is not linear."""
    return np.asarray(OTHER.step(x, u) + 0.1 * np.sin(2 * x) * u)


def learn(transitions: Transitions, seed: int = 0, settings: PosteriorSettings | None = None) -> DynamicsPosterior:
    sources = np.zeros(len(transitions), dtype=np.intp)
    posterior = learn_posterior(MODEL, transitions, sources, (seed,), settings)
    assert posterior is not None
    return posterior


def component(count: int = 15, family: tuple[float, float] = (2.5, 1.0), seed: int = 0) -> Component:
    rng = np.random.default_rng(seed)
    own = ResidualHyperparameters(ResidualKernel(*family, 1), THETA, NOISE)
    Z = rng.normal(size=(count, 2))
    return Component.conditioned(own, Z, np.sin(Z @ np.array([[1.0, 0.5], [0.2, 2.0]])), rng)


def exact(one: Component, Z: Array) -> tuple[Array, Array]:
    """Return mean ``(N, n)`` and covariance ``(N, N)`` of the posterior by matrices without a factor."""
    kernel, theta = one.hyperparameters.kernel, one.hyperparameters.theta
    K = one.factor.L @ one.factor.L.T
    cross = kernel(theta, one.centres, Z)
    return cross.T @ one.weights, kernel(theta, Z, Z) - cross.T @ np.linalg.solve(K, cross)


# One set of hyperparameters


@pytest.mark.parametrize("family", FAMILIES)
def test_mean_and_variance_are_those_of_the_normal_distribution(family: tuple[float, float]) -> None:
    one = component(family=family)
    Z = 2 * np.random.default_rng(1).normal(size=(30, 2))
    mean, covariance = exact(one, Z)
    np.testing.assert_allclose(one.mean(Z[None])[0], mean, atol=1e-8)
    np.testing.assert_allclose(one.whitened(Z)[1], np.diag(covariance), rtol=1e-6, atol=1e-9)


def test_the_mean_passes_through_the_observations_within_the_noise() -> None:
    one = component()
    Z = one.centres
    Y = np.sin(Z @ np.array([[1.0, 0.5], [0.2, 2.0]]))
    np.testing.assert_allclose(one.mean(Z[None])[0], Y, atol=5 * np.sqrt(NOISE))


@pytest.mark.slow
def test_the_amplitudes_are_draws_of_their_posterior() -> None:
    rng, one = np.random.default_rng(0), component()
    Y = one.factor.L @ one.factor.L.T @ one.weights
    drawn = [Component.conditioned(one.hyperparameters, one.centres, Y, rng).amplitudes ** -2 for _ in range(600)]
    # N / (y' K^-1 y) is the mean of the precision of a normal distribution of N numbers with a flat prior.
    expected = len(Y) / (Y * one.weights).sum(axis=0)
    np.testing.assert_allclose(np.mean(drawn, axis=0) / expected, 1, atol=5 * np.sqrt(2 / 15 / 600))


def test_transitions_that_add_nothing_are_left_out() -> None:
    known = record(40, truth=models.Function(rough, vectorized=True))
    posterior = learn(Transitions.joined([known, known]))
    assert 10 < len(posterior.rows) <= 40
    np.testing.assert_array_equal(posterior.most_probable.centres, posterior.data.pairs[posterior.rows])


def moments(one: Component, relevant: Array, at: Array, pivots: int, count: int = 4000) -> tuple[Array, Array, float]:
    """Return mean and covariance of draws of the first output at pairs, relative to the amplitude, and what is left."""
    expansion, left_out = draw_functions([one], relevant, count, pivots, np.random.default_rng(5))
    values = expansion(np.repeat(at[None], count, axis=0))[..., 0]
    return values.mean(axis=0), np.cov(values.T) / one.amplitudes[0] ** 2, left_out


def require_close(found: Array, expected: Array, count: int = 4000) -> None:
    """Require a sample covariance to be within five standard errors of the exact one."""
    variances = np.diag(expected)
    errors = np.sqrt((np.outer(variances, variances) + expected**2) / count)
    assert (np.abs(found - expected) <= 5 * errors + 2e-3 * variances.max()).all()


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_draws_have_the_moments_of_the_posterior_at_pivots(family: tuple[float, float]) -> None:
    one, pivots = component(family=family), 2 * np.random.default_rng(1).normal(size=(12, 2))
    mean, covariance, left_out = moments(one, pivots, pivots, 12)
    true_mean, true_covariance = exact(one, pivots)
    require_close(covariance, true_covariance)
    deviations = one.amplitudes[0] * np.sqrt(np.diag(true_covariance))
    assert (np.abs(mean - true_mean[:, 0]) <= 5 * deviations / np.sqrt(4000) + 1e-6).all()
    assert left_out < 2e-3


@pytest.mark.slow
@pytest.mark.thorough
def test_between_many_pivots_draws_have_the_moments_of_the_posterior_too() -> None:
    rng, one = np.random.default_rng(1), component()
    relevant, between = rng.uniform(-2, 2, (400, 2)), rng.uniform(-1.9, 1.9, (12, 2))
    mean, covariance, left_out = moments(one, relevant, between, 200)
    assert left_out < 2e-3
    require_close(covariance, exact(one, between)[1])
    deviations = one.amplitudes[0] * np.sqrt(np.diag(covariance))
    assert (np.abs(mean - exact(one, between)[0][:, 0]) <= 5 * deviations / np.sqrt(4000) + 1e-6).all()


@pytest.mark.slow
@pytest.mark.parametrize("pivots", [3, 8])
def test_with_few_pivots_draws_leave_out_as_much_variance_as_they_say(pivots: int) -> None:
    rng, one = np.random.default_rng(1), component(8)
    relevant = rng.uniform(-4, 4, (60, 2))
    _, covariance, left_out = moments(one, relevant, relevant, pivots)
    exact_variances = np.diag(exact(one, relevant)[1])
    missing = (exact_variances - np.diag(covariance)) / exact_variances.max()
    assert left_out > 0.05
    assert missing.max() == pytest.approx(left_out, abs=5 * np.sqrt(2 / 4000))
    # What is left out never makes a draw too wide.
    assert (missing > -5 * np.sqrt(2 / 4000)).all()


def test_draws_differ_even_if_less_than_the_noise() -> None:
    rng = np.random.default_rng(0)
    own = ResidualHyperparameters(ResidualKernel(2.5, 0.0, 1), THETA, 0.5)
    Z = rng.normal(size=(400, 2))
    one = Component.conditioned(own, Z, np.sin(Z), rng)
    relevant = rng.uniform(-1, 1, (30, 2))
    assert one.whitened(relevant)[1].max() < 0.5
    _, covariance, left_out = moments(one, relevant, relevant, 50, 1000)
    assert left_out < 2e-3
    np.testing.assert_allclose(np.diag(covariance) / np.diag(exact(one, relevant)[1]), 1, atol=0.3)


def test_without_pairs_to_choose_pivots_from_draws_are_the_mean() -> None:
    one = component()
    expansion, _ = draw_functions([one], np.empty((0, 2)), 2, 50, np.random.default_rng(0))
    Z = np.random.default_rng(1).normal(size=(20, 2))
    np.testing.assert_allclose(expansion(np.repeat(Z[None], 2, 0)), np.repeat(one.mean(Z[None]), 2, 0), atol=1e-9)


def test_without_pivots_draws_are_the_mean() -> None:
    one = component()
    Z = np.random.default_rng(1).normal(size=(20, 2))
    expansion, left_out = draw_functions([one], Z, 3, 0, np.random.default_rng(0))
    np.testing.assert_allclose(expansion(np.repeat(Z[None], 3, 0)), np.repeat(one.mean(Z[None]), 3, 0), atol=1e-9)
    assert left_out == 1


def test_outputs_of_a_draw_are_independent() -> None:
    one = component()
    pivot = np.array([[3.0, 3.0]])
    expansion, _ = draw_functions([one], pivot, 4000, 1, np.random.default_rng(0))
    values = expansion(np.repeat(pivot[None], 4000, axis=0))[:, 0]
    assert abs(np.corrcoef(values.T)[0, 1]) < 5 / np.sqrt(4000)


# Linear systems


def test_as_the_matern_part_vanishes_the_posterior_is_that_of_linear_regression() -> None:
    rng = np.random.default_rng(0)
    Z, new = rng.normal(size=(3, 4)), rng.normal(size=(6, 4))
    Y = Z @ rng.normal(size=(4, 2)) + 0.5
    slope, noise = 1e6, 0.3
    theta = np.log([100.0, 100.0, 100.0, 100.0, 1.0, slope])
    own = ResidualHyperparameters(ResidualKernel(2.5, 0.0, 1), theta, noise)
    one = Component.conditioned(own, Z, Y, rng)
    # The Matern part is constant up to 1e-3 here, so the constant has variance 2.
    prior = np.diag([1 / 2.0, *[1 / slope] * 4])
    features, at = np.c_[np.ones(3), Z], np.c_[np.ones(6), new]
    covariance = np.linalg.inv(features.T @ features / noise + prior)
    mean = at @ covariance @ features.T @ Y / noise
    np.testing.assert_allclose(one.mean(new[None])[0], mean, rtol=2e-2, atol=2e-2)
    np.testing.assert_allclose(one.whitened(new)[1], np.diag(at @ covariance @ at.T), rtol=1e-2, atol=1e-2)


def test_draws_of_a_linear_system_are_that_system() -> None:
    posterior, (x, u) = learn(record(60)), np.random.default_rng(1).normal(size=(2, 40, 3)) @ np.eye(3)
    x, u = x[:, :2], u[:, :1]
    draws = posterior.draw(posterior.data.standardised(x, u), np.random.default_rng(2))
    S = len(draws)
    found = draws.step(np.repeat(x[None], S, 0), np.repeat(u[None], S, 0))
    np.testing.assert_allclose(found, np.repeat(OTHER.step(x, u)[None], S, 0), atol=1e-6)


def test_too_few_transitions_leave_a_linear_system_uncertain_where_they_do_not_lead() -> None:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(20, 2)), np.zeros((20, 1))
    posterior = learn(Transitions(x, u, OTHER.step(x, u)))
    new, push = np.zeros((1, 2)), np.ones((1, 1))
    draws = posterior.draw(posterior.data.standardised(new, push), rng)
    pushed = draws.step(np.zeros((len(draws), 1, 2)), np.ones((len(draws), 1, 1)))[:, 0]
    still = draws.step(np.zeros((len(draws), 1, 2)), np.zeros((len(draws), 1, 1)))[:, 0]
    assert (still.std(axis=0) < 1e-4).all()
    assert (pushed.std(axis=0) > 1e-3).all()


# What is learned


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *more(1, 2)])
@pytest.mark.parametrize("deviation", [0.01, 0.05])
def test_noise_is_learned_within_a_factor_of_two(deviation: float, seed: int) -> None:
    transitions = record(250, truth=models.Function(rough, vectorized=True), noise=deviation, seed=seed)
    posterior = learn(transitions, seed)
    expected = (deviation / posterior.data.sizes.min()) ** 2
    assert 0.5 < posterior.noise / expected < 2


@pytest.mark.slow
def test_a_system_without_noise_is_learned_as_one() -> None:
    assert learn(record(120, truth=models.Function(rough, vectorized=True))).noise < 1e-5


def test_draws_pass_through_what_was_recorded() -> None:
    transitions = record(40, truth=models.Function(rough, vectorized=True))
    posterior = learn(transitions)
    draws = posterior.draw(posterior.data.pairs, np.random.default_rng(0))
    S = len(draws)
    found = draws.step(np.repeat(transitions.x[None], S, 0), np.repeat(transitions.u[None], S, 0))
    np.testing.assert_allclose(found, np.repeat(transitions.x_next[None], S, 0), atol=5e-3)


def test_a_state_that_m_explains_stays_that_of_m() -> None:
    truth = models.Function(
        lambda x, u: MODEL.step(x, u) + np.stack([0 * x[..., 0], np.sin(x[..., 0])], -1), vectorized=True
    )
    posterior = learn(record(40, truth=truth))
    draws = posterior.draw(posterior.data.pairs, np.random.default_rng(0))
    x, u = np.random.default_rng(1).normal(size=(len(draws), 5, 2)), np.zeros((len(draws), 5, 1))
    np.testing.assert_array_equal(draws.step(x, u)[..., 0], MODEL.step(x, u)[..., 0])
    assert np.isfinite(posterior.components[0].amplitudes).all()


def test_a_model_without_error_has_no_posterior() -> None:
    transitions = record(30, truth=MODEL)
    assert learn_posterior(MODEL, transitions, np.zeros(30, dtype=np.intp)) is None


@pytest.mark.slow
def test_seeds_alone_decide_the_draws() -> None:
    transitions, found = record(30, truth=models.Function(rough, vectorized=True)), []
    for seed in (0, 0, 1):
        posterior = learn(transitions, seed)
        draws = posterior.draw(posterior.data.pairs + 0.1, np.random.default_rng(seed))
        found.append(draws.step(np.ones((len(draws), 1, 2)), np.ones((len(draws), 1, 1))))
    np.testing.assert_array_equal(found[0], found[1])
    assert not np.array_equal(found[0], found[2])


# Draws as models


def test_one_draw_is_a_model_for_one_pair_and_for_batches() -> None:
    posterior = learn(record(30, truth=models.Function(rough, vectorized=True)))
    draws = posterior.draw(posterior.data.pairs, np.random.default_rng(0))
    x, u = np.random.default_rng(1).normal(size=(3, 4, 2)), np.random.default_rng(2).normal(size=(3, 4, 1))
    together = draws.step(np.repeat(x.reshape(1, 12, 2), len(draws), 0), np.repeat(u.reshape(1, 12, 1), len(draws), 0))
    for index in (0, 1, len(draws) - 1):
        batch = draws[index].step(x, u)
        np.testing.assert_allclose(batch.reshape(12, 2), together[index], atol=1e-9)
        np.testing.assert_allclose(draws[index].step(x[1, 2], u[1, 2]), batch[1, 2], atol=1e-9)
    with refuses(IndexError, 40, len(draws)):
        draws[len(draws)]


def test_a_draw_stays_finite_at_states_that_diverged() -> None:
    posterior = learn(record(30, truth=models.Function(rough, vectorized=True)))
    draws = posterior.draw(posterior.data.pairs, np.random.default_rng(0))
    x = np.full((len(draws), 3, 2), [np.nan, np.inf])
    x[:, 1] = 1e200
    x[:, 2] = 1.0
    found = draws.step(x, np.zeros((len(draws), 3, 1)))
    assert np.isfinite(found[:, 1:]).all()


@pytest.mark.parametrize(("horizon", "centres"), [(10, 400), (100, 300), (1000, 150)])
def test_long_horizons_have_fewer_centres(horizon: int, centres: int) -> None:
    assert PosteriorSettings.for_horizon(horizon).centres == centres


def test_factors_are_of_the_covariance_of_the_centres() -> None:
    one = component()
    kernel, theta = one.hyperparameters.kernel, one.hyperparameters.theta
    np.testing.assert_allclose(one.factor.L, factorise(kernel(theta, one.centres, one.centres), NOISE).L)


def test_components_of_equal_hyperparameters_are_drawn_as_if_alone() -> None:
    posterior = learn(record(40, truth=models.Function(rough, vectorized=True)))
    names = [id(one.factor) for one in posterior.components]
    assert len(set(names)) < len(names)  # resampling repeats likely hyperparameters
    together = posterior.draw(posterior.data.pairs, np.random.default_rng(0))
    rng = np.random.default_rng(0)
    settings = posterior.covariances.settings
    alone = [
        draw_functions([one], posterior.data.pairs, settings.functions, settings.pivots, rng)[0]
        for one in posterior.components
    ]
    assert len(together) == sum(len(one.weights) for one in alone)
    found = [weights for one in together.expansions for weights in one.weights]
    for weights, expected in zip(found, (weights for one in alone for weights in one.weights), strict=True):
        np.testing.assert_array_equal(weights[: len(expected)], expected)


def test_pairs_that_are_not_finite_have_a_finite_residual() -> None:
    posterior = learn(record(20, truth=models.Function(rough, vectorized=True)))
    draws = posterior.draw(posterior.data.pairs, np.random.default_rng(0))
    x, u = np.zeros((len(draws), 4, 2)), np.zeros((len(draws), 4, 1))
    u[:, :, 0] = [np.nan, np.inf, -np.inf, 1e300]
    still = models.Function(lambda x, u: x, vectorized=True)
    residuals = replace(draws, model=still).step(x, u)
    assert np.isfinite(residuals).all()


def test_few_draws_do_not_depend_on_what_was_computed_before() -> None:
    transitions, found = record(40, truth=models.Function(rough, vectorized=True)), []
    for whole in (False, True):
        posterior = learn(transitions)
        if whole:
            assert len(posterior.components) == posterior.covariances.settings.hyperparameters
        draws = posterior.draw(posterior.data.pairs + 0.1, np.random.default_rng(0), 1, 8)
        found.append(draws.step(np.ones((len(draws), 1, 2)), np.ones((len(draws), 1, 1))))
    np.testing.assert_array_equal(*found)


# The mean of the posterior as a model: what it predicts, how sure it is, and what it would be without executions


def truth(x: Array, u: Array) -> Array:
    """A smooth system that a linear model misses."""
    return MODEL.step(x, u) + 0.05 * np.stack([np.sin(2 * x[..., 0]) * u[..., 0], np.cos(x[..., 1])], axis=-1)


def sampled_pairs(count: int, seed: int = 0, reach: float = 1.0) -> Transitions:
    rng = np.random.default_rng(seed)
    x, u = rng.uniform(-reach, reach, (count, 2)), rng.uniform(-reach, reach, (count, 1))
    return Transitions(x, u, truth(x, u))


def learned_from(data: Transitions, sources: Rows | None = None, centres: int = 400) -> DynamicsPosterior:
    of = np.full(len(data), -1) if sources is None else sources
    found = learn_posterior(MODEL, data, of, settings=PosteriorSettings(centres=centres, of_steps=False))
    assert found is not None
    return found


def mean(posterior: DynamicsPosterior) -> Model:
    return posterior.mean


def test_it_predicts_what_the_model_misses() -> None:
    fresh = sampled_pairs(200, seed=1, reach=0.9)
    error = np.abs(mean(learned_from(sampled_pairs(400))).step(fresh.x, fresh.u) - fresh.x_next).max()
    assert error < 0.01 * np.abs(MODEL.step(fresh.x, fresh.u) - fresh.x_next).max()


def test_a_linear_residual_is_learned_everywhere_from_few_transitions() -> None:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(8, 2)), rng.normal(size=(8, 1))
    other = models.Linear([[1.02, 0.05], [0.1, 0.9]], [[0.05], [0.08]])
    posterior = learned_from(Transitions(x, u, other.step(x, u)))
    far, push = 10 * rng.normal(size=(50, 2)), rng.normal(size=(50, 1))
    largest = 0.9 * posterior.limit * posterior.data.units
    bounded = (np.abs(other.step(far, push) - MODEL.step(far, push)) < largest).all(axis=1)
    assert bounded.sum() > 5
    np.testing.assert_allclose(mean(posterior).step(far, push)[bounded], other.step(far, push)[bounded], atol=1e-3)


def test_far_from_the_data_it_never_corrects_much_more_than_was_ever_recorded() -> None:
    data = sampled_pairs(100)
    largest = np.abs(data.x_next - MODEL.step(data.x, data.u)).max(axis=0)
    far = 1e6 * np.random.default_rng(2).normal(size=(200, 3))
    corrected = mean(learned_from(data)).step(far[:, :2], far[:, 2:]) - MODEL.step(far[:, :2], far[:, 2:])
    assert (np.abs(corrected) <= 5.001 * largest + 1e-9 * np.abs(far[:, :2])).all()


def test_noise_in_the_recordings_is_not_learned() -> None:
    data, rng = sampled_pairs(300), np.random.default_rng(3)
    noisy = Transitions(data.x, data.u, data.x_next + 0.01 * rng.normal(size=data.x.shape))
    fresh = sampled_pairs(200, seed=1, reach=0.9)
    error = mean(learned_from(noisy)).step(fresh.x, fresh.u) - fresh.x_next
    assert np.sqrt((error**2).mean()) < 0.01


def test_what_was_seen_is_familiar_and_what_was_not_is_not() -> None:
    posterior = learned_from(sampled_pairs(200))
    states = np.zeros((2, 9, 2))
    states[1] = 6.0
    here, far = posterior.unfamiliarity(states, np.zeros((2, 8, 1)))
    assert here < 0.05 * far


def test_the_doubt_is_the_deviation_of_draws_as_a_share_of_a_typical_step() -> None:
    posterior = learned_from(sampled_pairs(25, reach=0.5))
    most, data, place = posterior.most_probable, posterior.data, np.array([[0.9, 0.9, 0.9]])
    found = posterior.unfamiliarity(np.tile(place[:, None, :2], (1, 2, 1)), place[:, None, 2:])
    z = data.standardised(place[:, :2], place[:, 2:])
    deviations = np.sqrt(most.whitened(z)[1] * most.squares / len(most.centres)) * data.sizes / data.steps
    np.testing.assert_allclose(found, np.sqrt((deviations**2).mean()), rtol=1e-9)


def test_recordings_that_repeat_themselves_and_ones_that_diverged_do_no_harm() -> None:
    data = sampled_pairs(40)
    twice = Transitions.joined([data, data, Transitions(data.x * 1e150, data.u, data.x_next * 1e160)])
    assert np.isfinite(mean(learned_from(twice)).step(data.x, data.u)).all()


def test_recordings_that_are_not_finite_are_left_out() -> None:
    data = sampled_pairs(100)
    broken = Transitions(data.x, data.u, np.where(np.arange(100)[:, None] % 7 == 0, np.nan, data.x_next))
    assert np.isfinite(mean(learned_from(broken)).step(data.x, data.u)).all()
    nothing = Transitions(data.x, data.u, data.x_next * np.nan)
    assert learn_covariances(MODEL, nothing, np.full(100, -1)) is None


def test_means_without_executions_are_those_conditioned_on_the_other_ones() -> None:
    data, of = sampled_pairs(90), np.repeat(np.arange(6), 15)
    posterior = learned_from(data, of, centres=60)
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
    data = sampled_pairs(400)
    posterior = learned_from(data)
    (rough,) = posterior.rough_mean.expansions
    assert rough.centres.shape[1] < len(posterior.rows)
    fine, coarse = (one.step(data.x, data.u) for one in (posterior.mean, posterior.rough_mean))
    size = np.abs(fine - MODEL.step(data.x, data.u)).max()
    np.testing.assert_allclose(coarse, fine, atol=0.05 * size)


def test_hyperparameters_that_were_learned_earlier_keep_their_physical_length_scales() -> None:
    data = sampled_pairs(200)
    learned = learn_covariances(MODEL, data, np.full(200, -1), settings=PosteriorSettings(hyperparameters=4))
    assert learned is not None
    wider = Transitions.joined([data, sampled_pairs(100, seed=4, reach=3.0)])
    posterior = condition(learned, wider, np.full(300, -1))
    assert posterior is not None
    for one, drawn in zip(posterior.components, learned.drawn, strict=True):
        scales = np.exp(one.hyperparameters.theta[:-2]) * posterior.data.scale
        np.testing.assert_allclose(scales, np.exp(drawn.theta[:-2]) * learned.scale)
