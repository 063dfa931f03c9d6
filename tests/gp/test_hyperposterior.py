from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import check_grad, minimize
from scipy.stats import chi2, kstest, norm, t

from ctxval.errors import InputError
from ctxval.gp.hyperposterior import (
    EXACT,
    Conditioned,
    Hyperparameters,
    Paths,
    Prior,
    Warp,
    condition,
    draw_hyperparameters,
    draw_paths,
    maxima,
)
from facts import refuses
from rig_thorough import more

NOISE = 0.02


def data(n: int = 7, d: int = 2, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng([seed, n, d])
    X = rng.random((n, d))
    return X, np.sin(5 * X).sum(axis=1) + 0.1 * rng.normal(size=n)


def hyperparameters(nu: float = 1.5, scales: tuple[float, ...] = (0.4, 0.9), noise: float = NOISE) -> Hyperparameters:
    return Hyperparameters(nu, np.log(scales), float(np.log(noise)))


def dense(hyper: Hyperparameters, X: np.ndarray) -> np.ndarray:
    """The correlations of the observations, written out apart from the kernels of the package."""
    r = np.sqrt((((X[:, None] - X[None]) / np.exp(hyper.log_scales)) ** 2).sum(axis=-1))
    s = np.sqrt(2 * hyper.nu) * r
    profile = (1 + s + (0 if hyper.nu == 1.5 else s**2 / 3)) * np.exp(-s)
    return profile + np.exp(hyper.log_noise) * np.eye(len(X))


def log_scales(draws: list[Conditioned]) -> np.ndarray:
    return np.array([draw.hyperparameters.log_scales for draw in draws])


def quadrature(prior: Prior, X: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The posterior of one length-scale's logarithm: a grid, and its weights for each smoothness, shape ``(k, m)``."""
    grid = np.linspace(-9.0, 7.0, 401)
    logs = np.empty((len(prior.smoothness), len(grid)))
    for row, nu in enumerate(prior.smoothness):
        for column, value in enumerate(grid):
            K = dense(Hyperparameters(nu, np.array([value]), float(np.log(prior.noise[0]))), X)
            inverse, ones = np.linalg.inv(K), np.ones(len(y))
            precision = ones @ inverse @ ones
            rest = y - (ones @ inverse @ y) / precision
            logs[row, column] = (
                -0.5 * np.linalg.slogdet(K)[1]
                - 0.5 * np.log(precision)
                - 0.5 * (len(y) - 1) * np.log(rest @ inverse @ rest)
                + norm(np.log(prior.length_scale), prior.deviation).logpdf(value)
            )
    weights = np.exp(logs - logs.max())
    return grid, weights / weights.sum()


# The closed forms


@pytest.mark.parametrize("nu", [1.5, 2.5])
@pytest.mark.parametrize("noise", [EXACT, NOISE])
def test_mean_and_scale_are_those_of_generalised_least_squares(nu: float, noise: float) -> None:
    (X, y), hyper = data(), hyperparameters(nu, noise=noise)
    seen = condition(hyper, X, y)
    inverse, ones = np.linalg.inv(dense(hyper, X)), np.ones(len(y))
    mean = (ones @ inverse @ y) / (ones @ inverse @ ones)
    assert seen.mean == pytest.approx(mean, rel=1e-8)
    assert seen.mean_variance == pytest.approx(1 / (ones @ inverse @ ones), rel=1e-8)
    assert seen.scale2 == pytest.approx((y - mean) @ inverse @ (y - mean) / (len(y) - 1), rel=1e-8)
    np.testing.assert_allclose(seen.factor.L @ seen.factor.L.T, dense(hyper, X), atol=1e-12)


def test_the_likelihood_is_the_integral_over_mean_and_scale() -> None:
    X, y = data(6)
    mean, log_scale = np.linspace(-60, 60, 3001)[:, None], np.linspace(-5, 6, 1101)

    def integral(hyper: Hyperparameters) -> float:
        K = dense(hyper, X)
        inverse, ones = np.linalg.inv(K), np.ones(len(y))
        quadratic = y @ inverse @ y - 2 * mean * (ones @ inverse @ y) + mean**2 * (ones @ inverse @ ones)
        logs = -len(y) * log_scale - 0.5 * np.linalg.slogdet(K)[1] - 0.5 * quadratic / np.exp(2 * log_scale)
        return float(np.log(np.exp(logs).sum()))

    short, long = hyperparameters(scales=(0.02, 0.02)), hyperparameters(2.5, scales=(1.5, 1.5), noise=0.01)
    ours = condition(short, X, y).log_likelihood - condition(long, X, y).log_likelihood
    assert ours == pytest.approx(integral(short) - integral(long), abs=1e-3)
    assert abs(ours) > 0.5


@given(st.floats(1e-3, 1e3), st.floats(-100, 100), st.booleans())
def test_units_do_not_matter(a: float, b: float, mirrored: bool) -> None:
    (X, y), hyper = data(), hyperparameters()
    a = -a if mirrored else a
    plain, moved = condition(hyper, X, y), condition(hyper, X, a * y + b)
    assert moved.mean == pytest.approx(a * plain.mean + b, rel=1e-6, abs=1e-6 * abs(a))
    assert moved.scale2 == pytest.approx(a**2 * plain.scale2, rel=1e-4)
    shift = (len(y) - 1) * np.log(abs(a))
    assert moved.log_likelihood + shift == pytest.approx(plain.log_likelihood, abs=1e-3)


def test_draws_do_not_depend_on_units() -> None:
    X, y = data(12)
    prior = Prior(offset=None)
    plain = draw_hyperparameters(X, y, 8, np.random.default_rng(1), prior)
    moved = draw_hyperparameters(X, 4 * y + 3, 8, np.random.default_rng(1), prior)
    np.testing.assert_allclose(log_scales(moved), log_scales(plain), rtol=0, atol=1e-6)
    assert [m.hyperparameters.nu for m in moved] == [p.hyperparameters.nu for p in plain]
    np.testing.assert_allclose([m.scale2 for m in moved], [16 * p.scale2 for p in plain], rtol=1e-5)


# The scale of the values


@given(st.floats(1e-3, 1e3), st.lists(st.floats(0, 1e3), min_size=1, max_size=9))
def test_a_scale_and_back_is_where_one_was(offset: float, values: list[float]) -> None:
    for warp in (Warp(), Warp(offset)):
        np.testing.assert_allclose(warp.backward(warp.forward(values)), values, rtol=1e-9, atol=1e-9 * offset)
    y, step = np.array(values), 1e-6 * (np.array(values) + offset)
    slopes = (Warp(offset).forward(y + step) - Warp(offset).forward(y - step)) / (2 * step)
    assert Warp(offset).log_slope(y) == pytest.approx(np.log(slopes).sum(), abs=1e-4)


def test_the_likelihood_on_the_logarithms_is_a_density_of_the_values_themselves() -> None:
    (X, y), hyper, warp = data(), hyperparameters(), Warp(0.3)
    y = np.exp(y)
    logs, own = condition(hyper, X, np.log(y + 0.3)), condition(hyper, X, y, warp)
    assert own.log_likelihood == pytest.approx(logs.log_likelihood - np.log(y + 0.3).sum())
    assert (own.mean, own.scale2) == (pytest.approx(logs.mean), pytest.approx(logs.scale2))


def test_the_logarithm_is_recognised_and_never_taken_of_negative_values() -> None:
    X = np.linspace(0, 1, 30)[:, None]
    z = np.linalg.cholesky(dense(hyperparameters(2.5, (0.2,), 1e-9), X)) @ np.random.default_rng(2).normal(size=30)

    def share(y: np.ndarray) -> float:
        draws = draw_hyperparameters(X, y, 10, np.random.default_rng(0), Prior(spread_share=1.0))
        return float(np.mean([np.isfinite(draw.warp.offset) for draw in draws]))

    assert share(np.exp(2 * z)) > 0.9
    assert share(z + 1.01 - z.min()) < 0.5
    assert share(z) == 0


# The sampler


@pytest.mark.slow
def test_a_length_scale_is_drawn_from_its_posterior() -> None:
    X = np.array([[0.05], [0.2], [0.35], [0.6], [0.7], [0.95]])
    y = np.sin(6 * X[:, 0])
    prior = Prior(length_scale=0.5, noise=(1e-4, 1e-4), offset=None)
    grid, weights = quadrature(prior, X, y)
    draws = draw_hyperparameters(X, y, 120, np.random.default_rng(5), prior)
    drawn, exact = log_scales(draws)[:, 0], weights.sum(axis=0)
    mean = exact @ grid
    deviation = np.sqrt(exact @ (grid - mean) ** 2)
    # A chain tells less than as many independent draws: allow for a quarter of them.
    effective = len(drawn) / 4
    assert abs(drawn.mean() - mean) < 4 * deviation / np.sqrt(effective)
    for level in (0.1, 0.5, 0.9):
        below = (drawn <= grid[np.searchsorted(exact.cumsum(), level)]).mean()
        assert abs(below - level) < 4 * np.sqrt(level * (1 - level) / effective)
    rough = weights[0].sum()
    share = np.mean([draw.hyperparameters.nu == 1.5 for draw in draws])
    assert abs(share - rough) < 4 * np.sqrt(rough * (1 - rough) / effective)
    assert 0.05 < rough < 0.95  # else the shares would say nothing


@pytest.mark.thorough
def test_where_the_data_say_nothing_the_draws_are_the_prior() -> None:
    # Length-scales far below the gaps: whatever they are, the values are uncorrelated.
    X, y = np.array([[0.1, 0.9], [0.5, 0.5], [0.9, 0.1], [0.2, 0.2]]), np.array([0.3, -1.0, 0.4, 2.0])
    prior = Prior(length_scale=1e-4, deviation=0.5, noise=(1e-4, 1e-2))
    draws = draw_hyperparameters(X, y, 250, np.random.default_rng(2), prior)
    centre = np.log(1e-4 * np.sqrt(2))
    for column in log_scales(draws)[::3].T:
        assert kstest((column - centre) / 0.5, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(log_scales(draws).T)[0, 1]) < 0.15
    share = np.mean([draw.hyperparameters.nu == 1.5 for draw in draws])
    assert abs(share - 0.5) < 4 * 0.5 / np.sqrt(250)
    # Noise of independent values cannot be told from their own variance: it stays as believed.
    noise = np.array([draw.hyperparameters.log_noise for draw in draws[::3]])
    assert kstest((noise - np.log(1e-4)) / np.log(100), "uniform").pvalue > 1e-3


def test_the_prior_draws_what_it_says() -> None:
    prior, rng = Prior(noise=(1e-4, 1e-2)), np.random.default_rng(3)
    draws = [prior.draw(3, rng) for _ in range(2000)]
    scales = (np.array([draw.log_scales for draw in draws]) - np.log(0.3 * np.sqrt(3))) / prior.deviation
    assert kstest(scales.ravel(), "norm").pvalue > 1e-3
    assert kstest((np.array([d.log_noise for d in draws]) - np.log(1e-4)) / np.log(100), "uniform").pvalue > 1e-3
    assert abs(np.mean([draw.nu == 2.5 for draw in draws]) - 0.5) < 4 * 0.5 / np.sqrt(2000)


@pytest.mark.parametrize(("nu", "other"), [(1.5, 2.5), (2.5, 1.5)])
def test_the_smoothness_of_the_data_is_recognised(nu: float, other: float) -> None:
    X = np.linspace(0, 1, 80)[:, None]
    K = dense(hyperparameters(nu, (0.3,), 1e-9), X)
    shares = []
    for seed in range(3):
        y = np.linalg.cholesky(K) @ np.random.default_rng(seed).normal(size=len(X))
        draws = draw_hyperparameters(X, y, 10, np.random.default_rng(seed))
        shares.append(np.mean([draw.hyperparameters.nu == nu for draw in draws]))
    assert np.mean(shares) > 0.8, f"taken for {other}"


@pytest.mark.parametrize("deviation", [0.0, 0.3])
def test_noise_is_recovered(deviation: float) -> None:
    rng = np.random.default_rng(7)
    X = np.linspace(0, 1, 50)[:, None]
    y = 2 * np.sin(5 * X[:, 0]) + deviation * rng.normal(size=50)
    draws = draw_hyperparameters(X, y, 40, rng, Prior(noise=(1e-6, 1.0)))
    found = np.sqrt([np.exp(draw.hyperparameters.log_noise) * draw.scale2 for draw in draws])
    assert abs(np.median(found) - deviation) < 0.08


def test_one_dimension_that_does_not_matter_gets_a_long_length_scale() -> None:
    X, _ = data(25)
    draws = draw_hyperparameters(X, np.sin(6 * X[:, 0]), 20, np.random.default_rng(0))
    short, long = np.median(np.exp(log_scales(draws)), axis=0)
    assert long > 3 * short


@pytest.mark.parametrize("y", [[0.1, 0.2], [1.0, 1.0, 1.0, 1.0], [0.1, np.nan, 0.3], [0.1, np.inf, 0.3]])
def test_values_that_say_nothing_are_refused(y: list[float]) -> None:
    with refuses(InputError, y):
        draw_hyperparameters(np.linspace(0, 1, len(y))[:, None], np.array(y), 3, np.random.default_rng(0))


def test_correlations_that_cannot_be_factored_are_refused() -> None:
    X = np.zeros((3, 1))
    with refuses(InputError, 3):
        condition(Hyperparameters(1.5, np.zeros(1), -80.0), X, np.arange(3.0))


# Sample paths


def conditioned_on(
    n: int = 8, d: int = 2, nu: float = 2.5, scale: float = 0.4, noise: float = EXACT
) -> tuple[Conditioned, np.ndarray, np.ndarray]:
    rng = np.random.default_rng([n, d])
    X = rng.random((n, d))
    y = 3 + 2 * np.sin(5 * X).sum(axis=1)
    return condition(Hyperparameters(nu, np.full(d, np.log(scale)), float(np.log(noise))), X, y), X, y


def paths_given(count: int = 5, seed: int = 0, **chosen: float) -> Paths:
    conditioned, X, _ = conditioned_on(**chosen)  # type: ignore[arg-type]
    return draw_paths(conditioned, X, count, np.random.default_rng(seed))


def exact(conditioned: Conditioned, X: np.ndarray, y: np.ndarray, Z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance over sigma^2 of ordinary kriging, dense."""
    kernel = conditioned.hyperparameters.kernel
    inverse = np.linalg.inv(kernel(X, X) + np.exp(conditioned.hyperparameters.log_noise) * np.eye(len(X)))
    k, ones = kernel(Z, X), np.ones(len(X))
    mu = (ones @ inverse @ y) / (ones @ inverse @ ones)
    missing = 1 - k @ inverse @ ones
    covariance = kernel(Z, Z) - k @ inverse @ k.T + np.outer(missing, missing) / (ones @ inverse @ ones)
    return mu + k @ inverse @ (y - mu), covariance


@pytest.mark.parametrize("nu", [1.5, 2.5])
def test_paths_pass_through_exact_data(nu: float) -> None:
    conditioned, X, y = conditioned_on(nu=nu)
    paths = draw_paths(conditioned, X, 6, np.random.default_rng(0))
    np.testing.assert_allclose(paths(X), np.repeat(y[:, None], 6, axis=1), atol=3e-4 * np.sqrt(conditioned.scale2))
    apart = paths(np.array([[0.99, 0.01]]))
    assert np.ptp(apart) > 0.01  # they are six paths, not one


@pytest.mark.parametrize(("nu", "noise"), [(1.5, EXACT), (2.5, 0.1), *more((2.5, EXACT))])
def test_many_paths_have_the_exact_mean_spread_and_correlations(nu: float, noise: float) -> None:
    conditioned, X, y = conditioned_on(nu=nu, noise=noise)
    Z = np.array([[0.5, 0.5], [0.45, 0.6], [0.02, 0.9], [0.9, 0.95]])
    mean, covariance = exact(conditioned, X, y, Z)
    rng = np.random.default_rng(11)
    values = np.concatenate([draw_paths(conditioned, X, 4, rng)(Z).T for _ in range(500)])
    unit = np.sqrt(conditioned.scale2 * np.diag(covariance))
    # Unknown mean and variance make each value a Student t with n - 1 degrees of freedom.
    for column in ((values - mean) / unit).T:
        assert kstest(column, t(len(y) - 1).cdf).pvalue > 1e-3
    correlations = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(np.corrcoef(values.T), correlations, atol=0.15)


def test_means_and_scales_are_drawn_from_their_posterior() -> None:
    conditioned, X, y = conditioned_on(n=5)
    paths = draw_paths(conditioned, X, 3000, np.random.default_rng(12))
    assert kstest((len(y) - 1) * conditioned.scale2 / paths.scales**2, chi2(len(y) - 1).cdf).pvalue > 1e-3
    unit = np.sqrt(conditioned.scale2 * conditioned.mean_variance)
    assert kstest((paths.means - conditioned.mean) / unit, t(len(y) - 1).cdf).pvalue > 1e-3


def test_own_points_are_the_diagonal_of_common_points() -> None:
    paths = paths_given()
    Z = np.random.default_rng(1).random((5, 3, 2))
    together = paths(Z.reshape(-1, 2)).reshape(5, 3, 5)
    np.testing.assert_allclose(paths.own(Z), [together[s, :, s] for s in range(5)], rtol=1e-10)


@pytest.mark.parametrize("nu", [1.5, 2.5])
def test_gradients_are_differences(nu: float) -> None:
    paths = paths_given(1, nu=nu)
    for z in np.random.default_rng(2).random((5, 2)):
        error = check_grad(
            lambda p: float(paths.own(p[None, None])[0, 0]),
            lambda p: paths.own_with_gradient(p[None, None])[1][0, 0],
            z,
            epsilon=1e-6,
        )
        assert error < 1e-3 * float(paths.scales[0])


@pytest.mark.parametrize(("d", "scale"), [(1, 0.08), (2, 0.2)])
@pytest.mark.parametrize("nu", [1.5, 2.5])
def test_maxima_are_not_below_those_of_a_dense_grid(d: int, scale: float, nu: float) -> None:
    paths = paths_given(12, n=6 * d, d=d, nu=nu, scale=scale)
    axis = np.linspace(0, 1, 2001 if d == 1 else 101)
    grid = np.stack(np.meshgrid(*[axis] * d, indexing="ij"), axis=-1).reshape(-1, d)
    tops, where = maxima(paths, paths.X, np.random.default_rng(3))
    assert (tops >= paths(grid).max(axis=0) - 2e-3 * paths.scales).all()
    assert ((where >= 0) & (where <= 1)).all()
    np.testing.assert_allclose(paths.own(where[:, None])[:, 0], tops, rtol=1e-9)  # attained, not extrapolated


def test_maxima_at_corners_of_six_dimensions_are_found() -> None:
    rng = np.random.default_rng(4)
    X, slope = rng.random((30, 6)), rng.normal(size=6)
    conditioned = condition(Hyperparameters(2.5, np.full(6, np.log(8.0)), float(np.log(EXACT))), X, X @ slope)
    paths = draw_paths(conditioned, X, 8, rng)
    corners = np.array(list(itertools.product([0.0, 1.0], repeat=6)))
    tops, where = maxima(paths, X[np.argsort(-(X @ slope))], rng)
    assert (tops >= paths(corners).max(axis=0) - 1e-6).all()
    assert np.mean(np.isclose(where, slope > 0)) > 0.9


def test_the_seed_decides_everything() -> None:
    conditioned, X, _ = conditioned_on()

    def once(seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        return maxima(draw_paths(conditioned, X, 4, rng), X, rng)[0]

    np.testing.assert_array_equal(once(1), once(1))
    assert (once(1) != once(2)).all()


def test_noisy_paths_stay_off_the_data_by_what_the_noise_allows() -> None:
    conditioned, X, y = conditioned_on(noise=0.5)
    rng = np.random.default_rng(6)
    values = np.concatenate([draw_paths(conditioned, X, 4, rng)(X) for _ in range(200)], axis=1)
    mean, covariance = exact(conditioned, X, y, X)
    spread = np.sqrt(conditioned.scale2 * np.diag(covariance) * (len(y) - 1) / (len(y) - 3))
    np.testing.assert_allclose(values.mean(axis=1), mean, atol=5 * spread.max() / np.sqrt(800))
    np.testing.assert_allclose(values.std(axis=1), spread, rtol=0.25)
    assert np.abs(mean - y).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("d", "missed"), [(6, 0.003), pytest.param(11, 0.003, marks=pytest.mark.thorough)])
def test_maxima_in_many_dimensions_are_found_but_for_a_little(d: int, missed: float) -> None:
    rng = np.random.default_rng(d)
    X = rng.random((8 * d, d))
    conditioned = condition(
        Hyperparameters(1.5, np.full(d, np.log(0.35 * np.sqrt(d))), np.log(EXACT)), X, np.sin(5 * X).sum(1)
    )
    paths = draw_paths(conditioned, X, 4, rng)
    tops, _ = maxima(paths, X, rng)
    starts = rng.random((4, 60, d))

    def negative(flat: np.ndarray) -> tuple[float, np.ndarray]:
        values, slopes = paths.own_with_gradient(flat.reshape(starts.shape))
        return -float(values.sum()), -slopes.ravel()

    bounds = [(0.0, 1.0)] * starts.size
    climbed = minimize(negative, starts.ravel(), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 150})
    brute = paths.own(climbed.x.reshape(starts.shape)).max(axis=1)
    assert np.mean((brute - tops) / paths.scales) < missed
