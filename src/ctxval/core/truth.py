"""The true maximum d* of simulated systems, which can be executed any number of times."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from ctxval._util.arrays import Array
from ctxval._util.boxes import climb
from ctxval._util.checked import NonNegativeInt, PositiveFloat, PositiveInt, checked
from ctxval._util.describe import describe, without_numbers
from ctxval._util.files import written_whole
from ctxval._util.progress import stage
from ctxval._util.representation import ShortRepr
from ctxval.core.space import AxisPoints, Parameters
from ctxval.core.validation import CostWarning, Validation
from ctxval.errors import InputError


@dataclass(frozen=True, eq=False)
class Truth(ShortRepr):
    """The largest distance over the task space that a method found."""

    distance: float
    parameters: Parameters
    method: str


@checked
def grid_truth(validation: Validation, per_axis: AxisPoints = 2001, refinements: NonNegativeInt = 6) -> Truth:
    """Return the maximum on a dense grid, refined around its best points.

    S is executed ``per_axis ** d`` times, and ``72 ** d`` times at most in a refinement of d parameters. A CostWarning
    says so if these are more than ten million executions.

    Raises:
        InputError: if every execution fails.
    """
    space = validation.space
    cell = (space.high - space.low) / (per_axis - 1)
    corners = np.meshgrid(*[np.linspace(-1, 1, 9)] * len(cell), indexing="ij")
    offsets = np.stack(corners, axis=-1).reshape(-1, len(cell))
    count = per_axis**space.dimension + 8 * refinements * len(offsets)
    if count > 10_000_000:
        sentence = f"grid_truth executes S {count:,} times; a smaller per_axis or search_truth takes fewer"
        warnings.warn(f"{sentence}.", CostWarning, stacklevel=3)
    points, best, best_value = space.grid(per_axis), space.low, -np.inf
    with stage("searching the largest distance", count, "executions"):
        for refinement in range(refinements + 1):
            values = np.nan_to_num(validation.distances(points), nan=-np.inf)
            if values.max() > best_value:
                best, best_value = points[values.argmax()], float(values.max())
            if best_value == -np.inf:
                raise InputError("the truth is unknown: every execution on the grid failed.")
            centres = points[np.argsort(-values)[:8]]
            points = (centres[:, None, :] + offsets * cell * 0.25**refinement).reshape(-1, len(cell))
            points = points.clip(space.low, space.high)
    grid = f"{per_axis:,} points" + (" an axis" if space.dimension > 1 else "")
    return Truth(best_value, space.parameters(best), f"dense grid of {grid}, refined {refinements} times")


@checked
def search_truth(
    validation: Validation,
    *,
    seed: NonNegativeInt = 0,
    agreement: PositiveFloat = 1e-3,
    repeats: PositiveInt = 6,
    population: PositiveInt = 20,
    generations: PositiveInt = 150,
    climbs: NonNegativeInt = 60,
) -> Truth:
    """Return the largest distance that a large search finds, for spaces with too many dimensions for a grid.

    Each repeat runs differential evolution (Storn and Price 1997), climbs from its best point, and climbs from random
    points, because repeats of evolution alone can agree on a basin that is wide but not the highest. The search ends
    when the two best repeats agree. S is executed some hundred thousand times, in batches.

    Args:
        agreement: relative difference of the two best repeats at which the search ends.
        population: number of points in a generation, for each dimension.
        generations: largest number of generations in one repeat.
        climbs: climbs from random starts in one repeat; each starts at the best of sixteen random points.

    Raises:
        InputError: if every execution fails.
    """
    space, d, evaluations = validation.space, validation.space.dimension, 0

    def values(unit_points: Array) -> Array:
        nonlocal evaluations
        evaluations += len(unit_points)
        distances = validation.distances(space.from_unit(unit_points))
        return np.where(np.isnan(distances), -np.inf, distances)

    def climbed(value: float, point: Array) -> Array:
        scale = value if 0 < value < np.inf else 1.0  # L-BFGS-B's tolerances suit values about 1

        def sloped(points: Array) -> tuple[Array, Array]:
            up, down = (np.clip(points + moves, 0, 1) for moves in (1e-6 * np.eye(d), -1e-6 * np.eye(d)))
            heights = values(np.concatenate([points, up, down])) / scale
            slope = (heights[1 : d + 1] - heights[d + 1 :]) / (np.diagonal(up) - np.diagonal(down))
            return heights[:1], np.where(np.isfinite(slope), slope, 0.0)[None]

        with np.errstate(all="ignore"):
            end, top = climb(sloped, point[None], np.zeros(d), np.ones(d))
        return end[0] if top * scale > value else point

    def repeat(rng: np.random.Generator) -> tuple[float, Array]:
        evolved = scipy.optimize.differential_evolution(
            lambda columns: -values(columns.T),
            scipy.optimize.Bounds(np.zeros(d), np.ones(d)),
            popsize=population,
            maxiter=generations,
            tol=1e-4,
            polish=False,
            updating="deferred",
            vectorized=True,
            rng=rng,
        )
        tops = [(-float(evolved.fun), np.asarray(evolved.x))]
        for _ in range(climbs):
            starts = rng.random((16, d))
            heights = values(starts)
            tops.append((float(heights.max()), starts[np.argmax(heights)]))
        points = np.array([climbed(*top) for top in tops])
        # A diverging loop amplifies the rounding of a batch, so the distance of the task executed alone counts.
        alone = np.array([values(point[None])[0] for point in points])
        return float(alone.max()), points[np.argmax(alone)]

    maxima: list[tuple[float, Array]] = []
    with stage("searching the largest distance", unit="executions"):
        while len(maxima) < repeats and not _gap(maxima) <= agreement:
            maxima.append(repeat(np.random.default_rng([seed, len(maxima)])))
    distance, unit_point = max(maxima, key=lambda maximum: maximum[0])
    if not math.isfinite(distance):
        raise InputError("the truth is unknown: every execution of the search failed.")
    doubt = "" if _gap(maxima) <= agreement else ", so the maximum may well be larger"
    method = (
        f"best known value of {evaluations:,} evaluations: differential evolution and {climbs} climbs from "
        f"elsewhere, {len(maxima)} repeats, of which the two best differ by {_gap(maxima):.2%}{doubt}"
    )
    return Truth(distance, space.parameters(space.from_unit(unit_point)), method)


def _gap(maxima: list[tuple[float, Array]]) -> float:
    values = sorted((value for value, _ in maxima if math.isfinite(value)), reverse=True)
    if len(values) < 2:
        return math.inf
    return (values[0] - values[1]) / values[0] if values[0] > 0 else 0.0


@checked
def cached_truth(
    validation: Validation, compute: Callable[[Validation], Truth], folder: str | Path = "runs/truth"
) -> Truth:
    """Return a truth from its file in a folder, or find it and write that file.

    The name of the file is a digest of the sources and settings of the validation and of the method, for instance
    ``functools.partial(search_truth, seed=1)``. The file keeps the truths of systems that differ in numbers alone; a
    truth is used only if new executions of S on its task and on some others give the stored distances again.
    """
    # The signature adds the default values, which the description of a function leaves out.
    parts = [describe(compute), str(inspect.signature(compute))]
    identity = json.dumps([validation.space.describe(), without_numbers(validation.describe()), *parts], sort_keys=True)
    path = Path(folder) / f"{hashlib.sha256(identity.encode()).hexdigest()[:32]}.json"
    probes = validation.space.iid(16, np.random.default_rng(0))  # their distances show that a truth is of this system
    stored = list[Any]()
    with suppress(OSError, ValueError):
        read = json.loads(path.read_text(encoding="utf-8"))
        stored = read if isinstance(read, list) else stored
    for known in stored:
        with suppress(ValueError, KeyError, TypeError):
            point = validation.space.point(dict(known["parameters"]))
            distances = np.array([known["distance"], *known["probes"]], dtype=np.float64)
            present = validation.distances(np.vstack([point, probes]))
            if np.allclose(present, distances, rtol=1e-6, atol=1e-12, equal_nan=True):
                return Truth(float(known["distance"]), validation.space.parameters(point), str(known["method"]))
    truth = compute(validation)
    content = {
        "distance": truth.distance,
        "parameters": validation.space.describe_point(truth.parameters.points),
        "method": truth.method,
        "probes": [str(value) for value in validation.distances(probes)],
    }
    # If the folder cannot be written, this call still returns the truth; the next call must find it again.
    with suppress(OSError, InputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(path) as file:
            file.write(json.dumps([*stored, content], indent=1).encode())
    return truth
