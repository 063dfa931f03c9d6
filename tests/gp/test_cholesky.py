from __future__ import annotations

import numpy as np
import pytest

from ctxval._util.arrays import Array
from ctxval.errors import InputError
from ctxval.gp.cholesky import factorise
from facts import refuses


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
    np.testing.assert_allclose(factor.unwhiten(factor.whiten(right)), factor.solve(right), rtol=1e-9)
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


def test_to_insist_is_to_raise_the_noise_tenfold_until_it_suffices() -> None:
    K = np.array([[1.0, 1.2], [1.2, 1.0]])
    with refuses(InputError, 2):
        factorise(K, 0.005)
    np.testing.assert_allclose(factorise(K, 0.005, insist=True).L, factorise(K, 0.5).L, rtol=1e-14)


def test_a_covariance_that_is_no_number_is_not_positive_definite() -> None:
    K = covariance()
    K[3, 3] = np.nan
    with refuses(InputError, 7):
        factorise(K, 1e-6, insist=True)
