from __future__ import annotations

import numpy as np
import pytest

from ctxval._util.arrays import Array
from ctxval.errors import InputError
from ctxval.gp.cholesky import factorise, tenfold


def covariance(n: int = 7) -> Array:
    A = np.random.default_rng(0).normal(size=(n, n))
    return np.asarray(A @ A.T + 0.1 * np.eye(n))


def test_everything_agrees_with_dense_linear_algebra() -> None:
    K, right = covariance(), np.random.default_rng(1).normal(size=(7, 3))
    factor = factorise(K, 0.5)
    inverse = np.linalg.inv(K + 0.5 * np.eye(7))
    np.testing.assert_allclose(factor.L, np.linalg.cholesky(K + 0.5 * np.eye(7)), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(factor.solve(right), inverse @ right, rtol=1e-9)
    np.testing.assert_allclose(factor.solve(right[:, 0]), inverse @ right[:, 0], rtol=1e-9)
    np.testing.assert_allclose(factor.whiten(right).T @ factor.whiten(right), right.T @ inverse @ right, rtol=1e-9)
    for columns in (np.asfortranarray(right), np.ascontiguousarray(right)):
        np.testing.assert_allclose(factor.whiten_many(columns.copy("K")), factor.whiten(right), rtol=1e-9)
    np.testing.assert_allclose(factor.inverse(), inverse, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(factor.inverse_factor @ factor.L, np.eye(7), atol=1e-12)
    rows = np.array([6, 0, 3])
    np.testing.assert_allclose(factor.precisions_of(rows), np.diag(inverse)[rows], rtol=1e-9)
    sign, log_determinant = np.linalg.slogdet(K + 0.5 * np.eye(7))
    assert (sign, 2 * factor.half_log_determinant()) == pytest.approx((1.0, log_determinant), rel=1e-12)


def test_the_covariance_is_not_changed() -> None:
    K = covariance()
    before = K.copy()
    factorise(K, 0.5)
    np.testing.assert_array_equal(K, before)


def test_noise_variances_are_tried_in_their_order() -> None:
    ones = np.ones((3, 3))
    np.testing.assert_array_equal(factorise(ones, (-1.0, 0.5, 2.0)).L, factorise(ones, 0.5).L)
    with pytest.raises(InputError, match=r"covariance of 3 observations .* raise the noise"):
        factorise(ones, (-1.0, -0.5))
    assert [noise for noise, _ in zip(tenfold(0.5), range(3), strict=False)] == [0.5, 5.0, 50.0]


def test_a_covariance_that_is_no_number_is_not_positive_definite() -> None:
    K = covariance()
    K[3, 3] = np.nan
    with pytest.raises(InputError, match="not positive definite"):
        factorise(K, tenfold(1e-6))
