from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctxval import Transitions, models
from ctxval._util.arrays import Array, Rows
from ctxval.learning.dynamics import CorrectedModel, Identity, Residual, learn_covariance, learn_residual

MODEL = models.Linear([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]])


def truth(x: Array, u: Array) -> Array:
    """A smooth system that a linear model misses."""
    return MODEL.step(x, u) + 0.05 * np.stack([np.sin(2 * x[..., 0]) * u[..., 0], np.cos(x[..., 1])], axis=-1)


def record(count: int, seed: int = 0, reach: float = 1.0) -> Transitions:
    rng = np.random.default_rng(seed)
    x, u = rng.uniform(-reach, reach, (count, 2)), rng.uniform(-reach, reach, (count, 1))
    return Transitions(x, u, truth(x, u))


def learn(data: Transitions, sources: Rows | None = None, centres: int = 450) -> Residual:
    of = np.full(len(data), -1) if sources is None else sources
    learned = learn_covariance(MODEL, data, of, centres)
    assert learned is not None
    residual = learn_residual(replace(learned, model=MODEL), data, of, centres)
    assert residual is not None
    return residual


def test_a_corrected_model_predicts_what_the_model_misses() -> None:
    hat, fresh = CorrectedModel(MODEL, learn(record(400))), record(200, seed=1, reach=0.9)
    error = np.abs(hat.step(fresh.x, fresh.u) - fresh.x_next).max()
    assert error < 0.01 * np.abs(MODEL.step(fresh.x, fresh.u) - fresh.x_next).max()


def test_a_corrected_model_takes_one_state_and_whole_batches_alike() -> None:
    hat, data = CorrectedModel(MODEL, learn(record(60))), record(12, seed=1)
    batch = hat.step(data.x.reshape(3, 4, 2), data.u.reshape(3, 4, 1))
    assert batch.shape == (3, 4, 2)
    np.testing.assert_allclose(hat.step(data.x[5], data.u[5]), batch[1, 1], rtol=1e-10)


def test_a_linear_residual_is_learned_everywhere_from_few_transitions() -> None:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(8, 2)), rng.normal(size=(8, 1))
    other = models.Linear([[1.02, 0.05], [0.1, 0.9]], [[0.05], [0.08]])
    residual = learn(Transitions(x, u, other.step(x, u)))
    far, push = 10 * rng.normal(size=(50, 2)), rng.normal(size=(50, 1))
    hat = CorrectedModel(MODEL, residual)
    bounded = (np.abs(other.step(far, push) - MODEL.step(far, push)) < 0.9 * residual.limit * residual.scale_out).all(1)
    assert bounded.sum() > 5
    np.testing.assert_allclose(hat.step(far, push)[bounded], other.step(far, push)[bounded], atol=1e-3)


def test_far_from_the_data_it_never_corrects_much_more_than_was_ever_recorded() -> None:
    data = record(100)
    largest = np.abs(data.x_next - MODEL.step(data.x, data.u)).max(axis=0)
    far = 1e6 * np.random.default_rng(2).normal(size=(200, 3))
    assert (np.abs(learn(data)(far[:, :2], far[:, 2:])) <= 5.001 * largest).all()


def test_what_was_seen_is_familiar_and_what_was_not_is_not() -> None:
    residual = learn(record(200))
    here, far = residual.variance(np.zeros(2), np.zeros(1)), residual.variance(np.full(2, 6.0), np.zeros(1))
    assert here < 1e-3 * far


def test_noise_in_the_recordings_is_not_learned() -> None:
    data, rng = record(300), np.random.default_rng(3)
    noisy = Transitions(data.x, data.u, data.x_next + 0.01 * rng.normal(size=data.x.shape))
    fresh = record(200, seed=1, reach=0.9)
    error = CorrectedModel(MODEL, learn(noisy)).step(fresh.x, fresh.u) - fresh.x_next
    assert np.sqrt((error**2).mean()) < 0.01


def test_a_model_without_error_leaves_nothing_to_be_learned() -> None:
    data = record(50)
    exact = Transitions(data.x, data.u, MODEL.step(data.x, data.u))
    assert learn_covariance(MODEL, exact, np.full(50, -1), 100) is None


def test_recordings_that_repeat_themselves_and_ones_that_diverged_do_no_harm() -> None:
    data = record(40)
    twice = Transitions.joined([data, data, Transitions(data.x * 1e150, data.u, data.x_next * 1e160)])
    residual = learn(twice)
    assert np.isfinite(residual(data.x, data.u)).all()
    assert np.isfinite(residual.typical_error())


def test_recordings_that_are_not_finite_are_left_out() -> None:
    data = record(100)
    broken = Transitions(data.x, data.u, np.where(np.arange(100)[:, None] % 7 == 0, np.nan, data.x_next))
    assert np.isfinite(learn(broken)(data.x, data.u)).all()
    assert learn_covariance(MODEL, Transitions(data.x, data.u, data.x_next * np.nan), np.full(100, -1), 100) is None


def test_around_a_model_that_is_rougher_than_the_system_the_steps_are_learned_instead() -> None:
    rough = models.Function(lambda x, u: MODEL.step(x, u) + 0.3 * np.sign(np.sin(9 * x)), vectorized=True)
    data = record(400)
    learned = [learn_covariance(model, data, np.full(400, -1), 200) for model in (MODEL, rough)]
    assert [type(one.model) for one in learned if one is not None] == [models.Linear, Identity]


def test_residuals_without_executions_are_those_conditioned_on_the_other_ones() -> None:
    data, of = record(90), np.repeat(np.arange(6), 15)
    residual = learn(data, of, centres=60)
    together = residual.without([{2}, {0, 5}, set()])
    everything = residual.without([set()] * 3)
    x, u = data.x[:3], data.u[:3]
    np.testing.assert_allclose(together(x, u)[2], everything(x, u)[2])
    np.testing.assert_allclose(together[np.array([1])](x[1:2], u[1:2])[0], together(x, u)[1])
    for row, gone in enumerate([[2], [0, 5]]):
        # All transitions are centres or replacements, so the others are conditioned on directly.
        centres, outputs, sources = (
            np.concatenate([used, unused])
            for used, unused in zip(
                (residual.centres, residual.outputs, residual.sources), residual.unused, strict=True
            )
        )
        kept = ~np.isin(sources, gone)
        alone = replace(residual, centres=centres[kept], outputs=outputs[kept], sources=sources[kept])
        np.testing.assert_allclose(together(x, u)[row], alone(x, u)[row], rtol=0.05, atol=1e-3)


def test_a_rough_residual_has_fewer_centres_and_almost_the_same_values() -> None:
    data = record(400)
    residual = learn(data)
    rough = residual.rough(100)
    assert len(rough.centres) == 100 < len(residual.centres)
    size = np.abs(residual(data.x, data.u)).max()
    np.testing.assert_allclose(rough(data.x, data.u), residual(data.x, data.u), atol=0.02 * size)


def test_a_covariance_that_was_learned_earlier_keeps_its_physical_length_scales() -> None:
    data = record(200)
    learned = learn_covariance(MODEL, data, np.full(200, -1), 200)
    assert learned is not None
    wider = Transitions.joined([data, record(100, seed=4, reach=3.0)])
    residual = learn_residual(learned, wider, np.full(300, -1), 200)
    assert residual is not None
    np.testing.assert_allclose(
        np.exp(residual.theta[1:-2]) * residual.scale_in, np.exp(learned.residual.theta[1:-2]) * learned.scale
    )
