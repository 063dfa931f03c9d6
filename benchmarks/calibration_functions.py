"""Functions of the unit cube on which verdicts are measured: some to choose by, others to report on.

A rule of the package (how near the trials must come to a task, say) may be chosen by what it does on ``FAMILIES`` of
``calibrate.py`` and on ``DEVELOPMENT``. ``REPORTING`` was written down before any of it was run, its shapes are others,
and nothing is ever chosen by it: only its figures say how often a verdict is false. All are cheap, and their maxima
are found by a dense sample, all corners and climbs (``calibrate.maximum``).
"""

from __future__ import annotations

import zlib
from collections.abc import Callable

import numpy as np

from calibrate import Values, from_prior
from ctxval._util.arrays import Array
from ctxval.gp.hyperposterior import Prior

Make = Callable[[int, np.random.Generator], Values]

DIMENSIONS = (1, 2, 3)


def _background(d: int, rng: np.random.Generator) -> Values:
    return from_prior(d, rng, Prior(smoothness=(2.5,), length_scale=0.5, deviation=0.2), waves=256)


def _waves(d: int, rng: np.random.Generator) -> Values:
    frequencies, phases = rng.normal(0, 3.0, (3, d)), rng.uniform(0, 2 * np.pi, 3)
    return lambda Z: np.asarray(np.sin(Z @ frequencies.T + phases).mean(axis=1))


def _direction(d: int, rng: np.random.Generator) -> Array:
    normal = rng.normal(size=d)
    return np.asarray(normal / np.linalg.norm(normal))


def _along(d: int, rng: np.random.Generator) -> Values:
    """Return a coordinate from 0 to 1 from one corner to the other one, in a random direction."""
    normal = _direction(d, rng)
    low, high = np.minimum(normal, 0).sum(), np.maximum(normal, 0).sum()
    return lambda Z: np.asarray((Z @ normal - low) / (high - low))


def _vertex(d: int, rng: np.random.Generator) -> Array:
    return rng.integers(0, 2, d).astype(np.float64)


# To choose by


def corner_cusp(d: int, rng: np.random.Generator) -> Values:
    """Return a path and an exponential that falls from a corner, at least a tenth of the range above the path."""
    path, vertex = _background(d, rng), _vertex(d, rng)
    sample = path(np.random.default_rng(0).random((2000, d)))
    top = float(sample.max() + rng.uniform(0.1, 1.0) * np.ptp(sample))
    height, width = top - float(path(vertex[None])[0]), np.sqrt(d) * rng.uniform(0.02, 0.1)
    return lambda Z: path(Z) + height * np.exp(-np.linalg.norm(Z - vertex, axis=1) / width)


def corner_bump(d: int, rng: np.random.Generator) -> Values:
    """Return a path and half a bell, or less, whose top is on the boundary, in a corner as often as not."""
    path, top = _background(d, rng), _vertex(d, rng)
    if rng.random() < 0.5:
        free = rng.permutation(d)[: d - 1]
        top[free] = rng.random(len(free))
    height, width = rng.uniform(1.0, 4.0), np.sqrt(d) * rng.uniform(0.06, 0.2)
    return lambda Z: path(Z) + height * np.exp(-0.5 * ((Z - top) ** 2).sum(axis=1) / width**2)


def plateau_ridge(d: int, rng: np.random.Generator) -> Values:
    """Return a plateau that is crossed by a straight ridge, which rises slowly along its way."""
    normal, through = _direction(d, rng), rng.uniform(0.1, 0.9, d)
    width, slope = np.sqrt(d) * rng.uniform(0.04, 0.12), 0.3 * rng.normal(size=d)
    height = rng.uniform(0.5, 2.0)
    return lambda Z: 1.0 + height * np.exp(Z @ slope - 0.5 * ((Z - through) @ normal) ** 2 / width**2)


def chirp(d: int, rng: np.random.Generator) -> Values:
    """Return a wave whose frequency grows linearly from one side to the other, and whose height may grow too."""
    along, other = _along(d, rng), _background(d, rng)
    first, last, phase = rng.uniform(0.3, 1.0), rng.uniform(1.5, 4.0), rng.uniform(0, 2 * np.pi)
    growth = rng.uniform(0.0, 1.0)

    def values(Z: Array) -> Array:
        s = along(Z)
        cycles = first * s + 0.5 * (last - first) * s**2
        return np.asarray((1 + growth * s) * np.sin(2 * np.pi * cycles + phase) + 0.3 * other(Z))

    return values


def saturated(d: int, rng: np.random.Generator) -> Values:
    """Return a path that is cut off between half and nine tenths of its range."""
    path = from_prior(d, rng, Prior(length_scale=0.35, deviation=0.3), waves=256)
    sample = path(np.random.default_rng(0).random((2000, d)))
    cap = sample.min() + rng.uniform(0.5, 0.9) * np.ptp(sample)
    return lambda Z: np.minimum(path(Z), cap)


DEVELOPMENT: dict[str, Make] = {
    "corner cusp": corner_cusp,
    "corner bump": corner_bump,
    "plateau with a ridge": plateau_ridge,
    "chirp": chirp,
    "saturated path": saturated,
}
"""Chosen by, together with ``calibrate.FAMILIES``."""


# To report on


def corner_root(d: int, rng: np.random.Generator) -> Values:
    """Return waves and a root or a cone that falls from a corner to nothing, in one of three norms."""
    waves, vertex = _waves(d, rng), _vertex(d, rng)
    norm, power = rng.choice([1.0, 2.0, np.inf]), rng.uniform(0.4, 1.0)
    reach, height = np.sqrt(d) * rng.uniform(0.1, 0.35), rng.uniform(0.6, 2.5)

    def values(Z: Array) -> Array:
        gap = np.linalg.norm(Z - vertex, ord=norm, axis=1) / reach
        return np.asarray(waves(Z) + height * np.maximum(0.0, 1 - gap**power))

    return values


def corner_power(d: int, rng: np.random.Generator) -> Values:
    """Return waves and a product of powers that grows towards a corner, or in some coordinates towards a face."""
    waves, vertex = _waves(d, rng), _vertex(d, rng)
    powers = rng.uniform(2.0, 8.0, d)
    powers[rng.permutation(d)[: rng.integers(0, d)]] = 0.0
    height = rng.uniform(1.0, 3.0)
    return lambda Z: waves(Z) + height * ((1 - np.abs(Z - vertex)) ** powers).prod(axis=1)


def plateau_arc(d: int, rng: np.random.Generator) -> Values:
    """Return a plateau with an edge, and on it a roof-shaped ridge along an arc, which is higher on one side."""
    centre, radius = rng.uniform(-0.3, 1.3, d), 0.0
    radius = float(np.linalg.norm(rng.uniform(0.15, 0.85, d) - centre))
    half, height = np.sqrt(d) * rng.uniform(0.1, 0.25), rng.uniform(0.5, 2.0)
    side, edge, at = _along(d, rng), _along(d, rng), rng.uniform(0.0, 0.4)

    def values(Z: Array) -> Array:
        off = np.abs(np.linalg.norm(Z - centre, axis=1) - radius) / half
        level = 1 / (1 + np.exp((at - edge(Z)) / 0.08))
        return np.asarray(level + height * (0.6 + 0.4 * side(Z)) * np.maximum(0.0, 1 - off))

    return values


def sweep(d: int, rng: np.random.Generator) -> Values:
    """Return a wave whose frequency grows by a factor on each stretch, or the size of it, with other slow waves."""
    along, waves = _along(d, rng), _waves(d, rng)
    factor, cycles, phase = rng.uniform(2.0, 8.0), rng.uniform(1.0, 2.0), rng.uniform(0, 2 * np.pi)
    rectified, decay = rng.random() < 0.5, rng.uniform(-0.7, 0.7)

    def values(Z: Array) -> Array:
        s = along(Z)
        wave = np.sin(2 * np.pi * cycles * (factor**s - 1) / (factor - 1) + phase)
        return np.asarray(np.exp(decay * s) * (np.abs(wave) if rectified else wave) + 0.3 * waves(Z))

    return values


def saturated_norm(d: int, rng: np.random.Generator) -> Values:
    """Return the norm of an affine map of the squares and products of parameters, cut off at a part of its maximum."""
    matrix, offset = rng.normal(size=(3, d + d * d)), rng.normal(size=3)
    share = rng.uniform(0.6, 1.0)

    def raw(Z: Array) -> Array:
        V = 2 * Z - 1
        features = np.concatenate([V, (V[:, :, None] * V[:, None, :]).reshape(len(Z), -1)], axis=1)
        return np.asarray(np.linalg.norm(features @ matrix.T + offset, axis=1))

    cap = share * float(raw(np.random.default_rng(0).random((4000, d))).max())
    return lambda Z: np.minimum(raw(Z), cap)


def hinges(d: int, rng: np.random.Generator) -> Values:
    """Return the largest of a few planes plus another hinge: creases, and slopes up to the boundary."""
    normals, offsets = rng.normal(size=(4, d)), rng.normal(0, 0.3, 4)
    hinge, at = 2 * rng.normal(size=d), rng.uniform(0.2, 0.8, d)
    return lambda Z: (Z @ normals.T + offsets).max(axis=1) + np.maximum(0.0, (Z - at) @ hinge)


def regimes(d: int, rng: np.random.Generator) -> Values:
    """Return waves that jump up inside a ball, as where a controller takes another way."""
    inside, outside = _waves(d, rng), _waves(d, rng)
    centre, radius = rng.random(d), np.sqrt(d) * rng.uniform(0.2, 0.5)
    jump = rng.uniform(0.5, 2.0)
    return lambda Z: np.where(np.linalg.norm(Z - centre, axis=1) < radius, inside(Z) + jump, outside(Z))


REPORTING: dict[str, Make] = {
    "corner root": corner_root,
    "corner power": corner_power,
    "plateau with an arc": plateau_arc,
    "sweep": sweep,
    "saturated norm": saturated_norm,
    "hinges": hinges,
    "regimes": regimes,
}
"""Reported on, and never chosen by."""


def generator(family: str, dimension: int, seed: int) -> np.random.Generator:
    """Return where the parameters of one function come from."""
    return np.random.default_rng([seed, dimension, zlib.crc32(family.encode())])
