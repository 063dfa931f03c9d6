from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.optimize import check_grad, minimize
from scipy.stats import chi2, kstest, t

from ctxval.gp.hyperposterior import EXACT, Conditioned, Hyperparameters, Paths, condition, draw_paths, maxima


def given(
    n: int = 8, d: int = 2, nu: float = 2.5, scale: float = 0.4, noise: float = EXACT
) -> tuple[Conditioned, np.ndarray, np.ndarray]:
    rng = np.random.default_rng([n, d])
    X = rng.random((n, d))
    y = 3 + 2 * np.sin(5 * X).sum(axis=1)
    return condition(Hyperparameters(nu, np.full(d, np.log(scale)), float(np.log(noise))), X, y), X, y


def paths_given(count: int = 5, seed: int = 0, **chosen: float) -> Paths:
    conditioned, X, _ = given(**chosen)  # type: ignore[arg-type]
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
    conditioned, X, y = given(nu=nu)
    paths = draw_paths(conditioned, X, 6, np.random.default_rng(0))
    np.testing.assert_allclose(paths(X), np.repeat(y[:, None], 6, axis=1), atol=3e-4 * np.sqrt(conditioned.scale2))
    apart = paths(np.array([[0.99, 0.01]]))
    assert np.ptp(apart) > 0.01  # they are six paths, not one


@pytest.mark.parametrize(("nu", "noise"), [(1.5, EXACT), (2.5, EXACT), (2.5, 0.1)])
def test_many_paths_have_the_exact_mean_spread_and_correlations(nu: float, noise: float) -> None:
    conditioned, X, y = given(nu=nu, noise=noise)
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
    conditioned, X, y = given(n=5)
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
    conditioned, X, _ = given()

    def once(seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        return maxima(draw_paths(conditioned, X, 4, rng), X, rng)[0]

    np.testing.assert_array_equal(once(1), once(1))
    assert (once(1) != once(2)).all()


def test_noisy_paths_stay_off_the_data_by_what_the_noise_allows() -> None:
    conditioned, X, y = given(noise=0.5)
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
    starts = rng.random((4, 150, d))

    def negative(flat: np.ndarray) -> tuple[float, np.ndarray]:
        values, slopes = paths.own_with_gradient(flat.reshape(starts.shape))
        return -float(values.sum()), -slopes.ravel()

    bounds = [(0.0, 1.0)] * starts.size
    climbed = minimize(negative, starts.ravel(), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 150})
    brute = paths.own(climbed.x.reshape(starts.shape)).max(axis=1)
    assert np.mean((brute - tops) / paths.scales) < missed
