"""Derivatives of composed maps against complex steps, which have no truncation error."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctxval.models.smooth_maps import Affine, Chain, Monomials, Network, Scaled, SideBySide, SmoothMap

RNG = np.random.default_rng(0)
ROWS = RNG.normal(size=(5, 3))


def network(activation: str) -> Network:
    widths = [3, 6, 5, 2]
    weights = [RNG.normal(size=pair) for pair in itertools.pairwise(widths)]
    return Network(weights, [RNG.normal(size=width) for width in widths[1:]], activation)


def by_complex_steps(smooth: SmoothMap, Z: np.ndarray, h: float = 1e-30) -> np.ndarray:
    columns = [np.imag(smooth.value(Z + 1j * h * move)) / h for move in np.eye(Z.shape[1])]
    return np.stack(columns, axis=-1)


AFFINE = Affine(RNG.normal(size=(3, 2)), RNG.normal(size=2))
POWERS = Monomials(np.array([[0, 0, 0], [1, 0, 0], [2, 1, 0], [0, 0, 3], [1, 1, 1]]))
MAPS = [
    AFFINE,
    Scaled(np.array([2.0, -1.0, 0.5]), np.array([1.0, 0.0, 2.0])),
    Scaled(3.0, 1.0),
    POWERS,
    Chain([Scaled(0.5, 0.1), POWERS, Affine(RNG.normal(size=(5, 2)), np.zeros(2))]),
    SideBySide([AFFINE, POWERS, AFFINE]),
    network("tanh"),
    network("identity"),
]


@pytest.mark.parametrize("smooth", MAPS, ids=repr)
def test_derivatives_are_those_of_complex_steps(smooth: SmoothMap) -> None:
    found = smooth.jacobian(ROWS)
    np.testing.assert_allclose(found, by_complex_steps(smooth, ROWS), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(smooth.linearised(ROWS)[0], smooth.value(ROWS))
    if smooth.constant:
        np.testing.assert_allclose(found, np.broadcast_to(found[:1], found.shape), rtol=0, atol=1e-14)


@pytest.mark.parametrize("activation", ["relu", "logistic"])
def test_units_that_take_no_complex_numbers_agree_with_differences(activation: str) -> None:
    smooth, h = network(activation), 1e-6
    differences = [(smooth.value(ROWS + h * move) - smooth.value(ROWS - h * move)) / (2 * h) for move in np.eye(3)]
    np.testing.assert_allclose(smooth.jacobian(ROWS), np.stack(differences, axis=-1), rtol=0, atol=1e-7)


def test_only_maps_with_one_derivative_are_constant() -> None:
    known = [Affine(np.eye(2), np.zeros(2)), Scaled(1.0, 0.0), Monomials(np.eye(2, dtype=int)), network("identity")]
    assert all(one.constant for one in [*known, Chain(known), SideBySide(known)])
    for one in (POWERS, network("relu")):
        assert not any(other.constant for other in (one, Chain([known[0], one]), SideBySide([known[0], one])))


@settings(max_examples=30, deadline=None)
@given(st.lists(st.lists(st.integers(0, 4), min_size=2, max_size=2), min_size=1, max_size=6), st.integers(0, 99))
def test_products_of_powers_have_their_derivatives(powers: list[list[int]], seed: int) -> None:
    smooth = Monomials(np.array(powers))
    Z = np.random.default_rng(seed).uniform(-2, 2, (4, 2))
    np.testing.assert_allclose(smooth.value(Z), (Z[:, None, :] ** np.array(powers)).prod(axis=-1), rtol=1e-12)
    np.testing.assert_allclose(smooth.jacobian(Z), by_complex_steps(smooth, Z), rtol=1e-10, atol=1e-12)
