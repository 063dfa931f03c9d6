"""Do the bounds hold as often as they say? Thousands of seeded campaigns on functions whose maximum is known.

``python benchmarks/calibrate.py`` runs what is not stored yet; ``calibration_page.py`` writes ``docs/calibration.md``.
Each campaign is GP-UCB, as the paper has it, on a function of the unit cube; the posterior bound is drawn at a few
sizes of its history. The paper's own systems are taken from the stored runs of ``make reproduce``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.optimize import minimize

from ctxval import cases
from ctxval._util.arrays import Array, single_threaded
from ctxval.certificates import DistanceBound, Sample, draw_maxima
from ctxval.errors import CertificateError
from ctxval.gp.hyperposterior import Prior
from ctxval.searches import GPUCB
from json_lines import JsonLines
from reproduce.jobs import Job, Results

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
REPRODUCED = RESULTS / "reproduce"
"""The runs that ``make reproduce`` stores."""

CONFIDENCES = (0.9, 0.95, 0.99)
DRAWS, PATHS = 64, 4
CHECKPOINTS = {1: (8, 12, 20), 2: (15, 30), 4: (25, 50)}

_SHARE = {1: 1.0, 2: 0.4, 4: 0.1}
"""Of the campaigns asked for, by dimension: a campaign of four dimensions costs ten times one of one."""

_SEEDS = 10
"""Stored campaigns of each of the paper's systems."""

Values = Callable[[Array], Array]
Asked = TypeVar("Asked")


# Functions of the unit cube


def from_prior(d: int, rng: np.random.Generator, prior: Prior | None = None, waves: int = 2048) -> Values:
    """Return a path of the process itself, hyperparameters drawn too."""
    drawn = (Prior() if prior is None else prior).draw(d, rng)
    spread = np.sqrt(2 * drawn.nu / rng.chisquare(2 * drawn.nu, (waves, 1)))
    frequencies = rng.normal(size=(waves, d)) * spread / np.exp(drawn.log_scales)
    cosines, sines = rng.normal(size=(2, waves)) / np.sqrt(waves)

    def values(Z: Array) -> Array:
        phases = Z @ frequencies.T
        return np.asarray(np.cos(phases) @ cosines + np.sin(phases) @ sines)

    return values


def kinks(d: int, rng: np.random.Generator) -> Values:
    """Return the size of a difference that changes sign: smooth, but for kinks at its zeros and at a hinge."""
    smooth = from_prior(d, rng, Prior(smoothness=(2.5,), length_scale=0.5, deviation=0.3))
    normal, offset = rng.normal(size=d), rng.uniform(0.3, 0.7, d)

    def values(Z: Array) -> Array:
        return np.abs(smooth(Z)) + np.maximum(0.0, (Z - offset) @ normal)

    return values


def narrow_peaks(d: int, rng: np.random.Generator) -> Values:
    """Return a slow slope with three bumps, of widths between 0.05 and 0.15 in each dimension."""
    slope = rng.normal(size=d)
    centres, widths = rng.random((3, d)), np.sqrt(d) * rng.uniform(0.05, 0.15, 3)
    heights = rng.uniform(0.5, 1.5, 3)

    def values(Z: Array) -> Array:
        gaps = ((Z[:, None, :] - centres) ** 2).sum(axis=-1) / widths**2
        return 0.3 * Z @ slope + (heights * np.exp(-0.5 * gaps)).sum(axis=1)

    return values


def heavy_tails(d: int, rng: np.random.Generator) -> Values:
    """Return the exponential of a path: its peaks are far above the rest."""
    path = from_prior(d, rng, Prior(length_scale=0.4, deviation=0.3))
    return lambda Z: np.exp(1.5 * path(Z))


def bifurcation(d: int, rng: np.random.Generator) -> Values:
    """Return a path that jumps across a plane, as a distance does where a controller takes another way."""
    prior = Prior(smoothness=(2.5,), length_scale=0.5, deviation=0.3)
    one, other, jump = from_prior(d, rng, prior), from_prior(d, rng, prior), rng.uniform(0.5, 2.0)
    normal, centre = rng.normal(size=d), rng.uniform(0.3, 0.7, d)

    def values(Z: Array) -> Array:
        return np.where((Z - centre) @ normal > 0, one(Z) + jump, other(Z))

    return values


def linear_l1(d: int, rng: np.random.Generator) -> Values:
    """Return the l1 norm of a random linear map, the distance of the paper's linear systems."""
    matrix = rng.normal(size=(max(2, d // 2), d))
    return lambda Z: np.abs((2 * Z - 1) @ matrix.T).sum(axis=1)


def smooth_wave(d: int, rng: np.random.Generator) -> Values:
    """Return a few sine waves: smoother than any Matern path."""
    frequencies, phases = rng.normal(0, 4.0, (4, d)), rng.uniform(0, 2 * np.pi, 4)
    return lambda Z: np.sin(Z @ frequencies.T + phases).sum(axis=1)


FAMILIES: dict[str, tuple[Callable[[int, np.random.Generator], Values], tuple[int, ...]]] = {
    "prior": (from_prior, (1, 2, 4)),
    "kinks": (kinks, (1, 2, 4)),
    "narrow peaks": (narrow_peaks, (1, 2)),
    "heavy tails": (heavy_tails, (1, 2, 4)),
    "bifurcation": (bifurcation, (1, 2, 4)),
    "linear-l1": (linear_l1, (2, 4)),
    "smooth waves": (smooth_wave, (1, 2, 4)),
}


NOISY: dict[str, str] = {"noisy paths": "prior", "noisy kinks": "kinks"}
"""Families whose values come with noise, with those of their expected values. The tasks are random draws."""

NOISE = 0.2
"""Standard deviation of that noise, as a share of that of the expected values."""

NOISY_CHECKPOINTS = {1: (12, 24), 2: (30,)}


def maximum(values: Values, d: int) -> float:
    """Return the maximum over the unit cube: a dense sample, and climbs from its best points."""
    rng = np.random.default_rng(0)
    sample = np.linspace(0, 1, 4001)[:, None] if d == 1 else rng.random(({2: 10000, 3: 20000, 4: 20000}[d], d))
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * d, indexing="ij"), axis=-1).reshape(-1, d)
    sample = np.concatenate([sample, corners])
    heights = np.concatenate([values(part) for part in np.array_split(sample, 1 + len(sample) // 1000)])
    best = float(heights.max())
    for start in sample[np.argsort(-heights)[:12]]:
        climbed = minimize(lambda z: -float(values(z[None])[0]), start, method="L-BFGS-B", bounds=[(0, 1)] * d)
        polished = minimize(lambda z: -float(values(np.clip(z, 0, 1)[None])[0]), climbed.x, method="Nelder-Mead")
        best = max(best, -float(climbed.fun), -float(polished.fun))
    return best


# The paper's systems


@dataclass(frozen=True)
class System:
    """A case whose campaigns ``make reproduce`` has stored.

    Attributes:
        case, options: as on the command line.
        budget: of the stored campaigns.
        dimension: of the task space.
        checkpoints: after how many executions to certify.
    """

    case: str
    options: tuple[tuple[str, Any], ...]
    budget: int
    dimension: int
    checkpoints: tuple[int, ...]


SYSTEMS: dict[str, System] = {
    "pendulum": System("pendulum", (), 100, 1, (8, 12, 20)),
    "arm, network": System("arm", (("model", "fnn"),), 60, 2, (15, 30, 60)),
    "arm, Gaussian process": System("arm", (("model", "gp"),), 60, 2, (15, 30, 60)),
    "arm, linear": System("arm", (("model", "linear"),), 60, 2, (15, 30, 60)),
    "linear, 1 state": System("linear", (("dim", 1),), 100, 2, (15, 30)),
    "linear, 2 states": System("linear", (("dim", 2),), 100, 4, (25, 50)),
    "linear, 5 states": System("linear", (("dim", 5),), 100, 10, (25, 50)),
    "Dubins car": System("dubins", (), 100, 11, (50, 100)),
}


def stored_history(system: System, seed: int) -> tuple[Array, Array, float]:
    """Return points of the unit cube, distances and d* of a stored campaign."""
    results = Results(REPRODUCED)
    search = results[Job("search", system.case, seed, system.options, "gp-ucb", system.budget)]
    truth = results[Job("truth", system.case, seed, system.options)]["distance"]
    space = cases.by_name(system.case, seed, **dict(system.options)).validation.space
    distances = np.array(search["distances"])
    # What was found may exceed what a search or a grid knows of the truth.
    return space.to_unit(np.array(search["points"])), distances, max(truth, float(distances.max()))


# One campaign


@dataclass(frozen=True)
class Run:
    """One campaign, fully said by its fields."""

    family: str
    dimension: int
    seed: int

    @property
    def checkpoints(self) -> tuple[int, ...]:
        """After how many executions to certify."""
        if self.family in SYSTEMS:
            return SYSTEMS[self.family].checkpoints
        if self.family in NOISY:
            return NOISY_CHECKPOINTS[self.dimension]
        return CHECKPOINTS[self.dimension]


def history(run: Run) -> tuple[Array, Array, float]:
    """Return points, values and the true maximum of one campaign."""
    if run.family in SYSTEMS:
        return stored_history(SYSTEMS[run.family], run.seed)
    family = NOISY.get(run.family, run.family)
    make, _ = FAMILIES[family]
    rng = np.random.default_rng([run.seed, run.dimension, sorted(FAMILIES).index(family)])
    values = make(run.dimension, rng)
    truth = maximum(values, run.dimension)
    if run.family in NOISY:
        points = rng.random((run.checkpoints[-1], run.dimension))
        spread = float(values(rng.random((2000, run.dimension))).std())
        return points, values(points) + NOISE * spread * rng.normal(size=len(points)), truth
    search = GPUCB()
    search.reset(run.dimension, run.seed)
    for _ in range(run.checkpoints[-1]):
        point = search.ask()
        search.tell(point, values(point))
    return search.points, search.values, truth


def certified(
    points: Array, values: Array, seed: int, prior: Prior | None = None, *, stochastic: bool = False
) -> dict[str, Any]:
    """Return the bounds after a history, and what the diagnosis says."""
    states = ["completed"] * len(values)
    sample = Sample(points, values, ["acquisition"] * len(values), states)  # type: ignore[list-item, arg-type]
    try:
        found = draw_maxima(sample, draws=DRAWS, paths=PATHS, seed=seed, prior=prior, stochastic=stochastic)
    except CertificateError as error:
        return {"n": len(values), "refused": str(error)}
    details = DistanceBound().certify_drawn(sample, found).details
    return {
        "n": len(values),
        "best": sample.best,
        "bounds": [found.upper(confidence) for confidence in CONFIDENCES],
        "max_ucb": (details["instantaneous"] or {}).get("max_ucb"),
        "surprise": details["diagnosis"]["surprise"],
        "left_out": details["diagnosis"]["left_out"],
        "farthest": details["diagnosis"]["farthest"],
        "logarithm": details["logarithm"],
    }


def campaign(run: Run) -> dict[str, Any]:
    """Run one campaign and certify it at its checkpoints; return what is stored of it."""
    with single_threaded():
        points, values, truth = history(run)
        noisy = run.family in NOISY
        checks = [certified(points[:n], values[:n], run.seed, stochastic=noisy) for n in run.checkpoints]
        exact = []
        if run.family == "prior":  # the same draws, once more as Bayes has it
            exact = [certified(points[:n], values[:n], run.seed, Prior(spread_share=1.0)) for n in run.checkpoints]
    key = {"family": run.family, "dimension": run.dimension, "seed": run.seed}
    return {**key, "truth": truth, "checks": checks, "exact": exact}


# The stored runs

STORED = JsonLines(RESULTS / "calibrate.jsonl", ("family", "dimension", "seed"))


def stored(family: str, dimension: int) -> list[dict[str, Any]]:
    """Return the stored campaigns of a family."""
    return STORED.select(family=family, dimension=dimension)


def missing(campaigns: int) -> Iterator[Run]:
    """Yield the campaigns that are not stored: families of few dimensions, systems, families of more dimensions."""
    families = [(family, d) for family, (_, dimensions) in FAMILIES.items() for d in dimensions]
    noisy = [(family, d) for family in NOISY for d in NOISY_CHECKPOINTS]
    yield from _in_turn([*noisy, *(name for name in families if name[1] <= 2)], campaigns)
    yield from _in_turn([(name, system.dimension) for name, system in SYSTEMS.items()], campaigns)
    yield from _in_turn([name for name in families if name[1] > 2], campaigns)


def _in_turn(names: list[tuple[str, int]], campaigns: int) -> Iterator[Run]:
    for seed in range(campaigns):
        for family, d in names:
            most = _SEEDS if family in SYSTEMS else campaigns * _SHARE[d]
            if seed < most and (family, d, seed) not in STORED:
                yield Run(family, d, seed)


def all_of(campaign: Callable[[Asked], dict[str, Any]], runs: list[Asked], workers: int) -> Iterator[dict[str, Any]]:
    """Yield the results of campaigns as they end, and say how many have."""
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        asked = [pool.submit(campaign, run) for run in runs]
        for done, ended in enumerate(as_completed(asked), start=1):
            yield ended.result()
            print(f"\r{done}/{len(runs)}", end="", flush=True)
    print()


def main() -> None:
    """Run what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=200, help="for each family and dimension up to 2")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    for result in all_of(campaign, list(missing(arguments.campaigns)), arguments.workers):
        STORED.append(result)


if __name__ == "__main__":
    main()
