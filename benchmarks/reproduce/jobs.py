"""The single runs that the paper's figures are made of: stored as lines of files, with what computed them."""

from __future__ import annotations

import functools
import hashlib
import importlib
import inspect
import json
import platform
import re
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from threadpoolctl import threadpool_info

import ctxval
from ctxval import Campaign, Experiment, Validation, cases, searches
from ctxval._util.arrays import Array, single_threaded
from ctxval._util.code_digest import module_digest
from ctxval.distances import TrackingError
from ctxval.gp.kernels import Matern
from ctxval.gp.surrogate import fit_surrogate
from ctxval.paper.cases import arm
from json_lines import JsonLines
from reproduce.frameworks import PAPER, closed_loops, frameworks

SEARCHES = ("gp", "searches")  #: the folders of the package that choose tasks from distances

AUTO = (*SEARCHES, "learning")  #: the folders of the package that choose tasks from trajectories

_PACKAGE = Path(ctxval.__file__).parent


@functools.cache
def source_digest(*folders: str) -> str:
    """Return a digest of what the modules of some folders of the package compute, whatever their texts and layout."""
    files = [file for folder in folders for file in sorted((_PACKAGE / folder).rglob("*.py"))]
    text = [f"{file.relative_to(_PACKAGE).as_posix()} {module_digest(file.read_text())}" for file in files]
    return hashlib.sha256("\n".join(text).encode()).hexdigest()[:16]


@functools.cache
def libraries() -> str:
    """Return the versions of Python, numpy and scipy, and the linear algebra with the kernels that it chose."""
    pools = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
    blas = {f"{pool['internal_api']} {pool['version']} {pool.get('architecture', '')}".strip() for pool in pools}
    versions = [f"Python {platform.python_version()}", f"numpy {np.__version__}", f"scipy {scipy.__version__}"]
    return ", ".join([*versions, *sorted(blas)])


def provenance(folders: tuple[str, ...] = SEARCHES) -> dict[str, Any]:
    """Return the fields that a stored result keeps of its making: a digest of the sources, and the libraries."""
    return {"sources": source_digest(*folders), "libraries": libraries()}


def measured_with(results: Iterable[Mapping[str, Any]], folders: tuple[str, ...] = SEARCHES) -> str:
    """Return sentences on the revision of the sources and on the libraries that results were measured with."""
    known, present = list(results), source_digest(*folders)
    names = ", ".join(f"`{folder}`" for folder in folders)
    without = sum("sources" not in result for result in known)
    before = sum(result.get("sources", present) != present for result in known)
    counts = {f"with the present sources of {names}": len(known) - before - without}
    counts |= {
        "before the last change of the source": before,
        "before results named their sources and libraries": without,
    }
    measured = "; ".join(f"{when}: {count:,}" for when, count in counts.items() if count)
    used = sorted({result["libraries"] for result in known if "libraries" in result})
    return f"Results measured {measured}." + (f" Libraries: {'; '.join(used)}." if used else "")


Result = dict[str, Any]


@dataclass(frozen=True)
class Job:
    """One run, completely defined by its fields."""

    kind: str  #: ``search``, ``truth``, ``profile``, ``frameworks``, ``aspects`` or ``loops``
    case: str
    seed: int  #: seed of the data, the model and the search
    options: tuple[tuple[str, Any], ...] = ()  #: options of the case, as pairs of name and value
    search: str = ""  #: the name of the search, for the kind ``search``
    budget: int = 0  #: the number of executions, or of grid points on each axis

    @property
    def key(self) -> str:
        """A readable name, by which the result is stored."""
        options = [f"{name}-{value}" for name, value in self.options]
        budget = f"{self.budget}" if self.budget else ""
        parts = [self.kind, self.case, *options, self.search, budget, f"seed{self.seed}"]
        return re.sub(r"[^a-zA-Z0-9._-]+", "-", "_".join(filter(None, parts)))

    def experiment(self) -> Experiment:
        return cases.by_name(self.case, self.seed, **dict(self.options))


INFORMED = ("gp-ucb-prior-mean", "gp-ucb-hyperprior")
"""Searches that know the distance of another trial's model, for a one-dimensional task space."""


def _informed(job: Job) -> searches.Search:
    """Return GP-UCB whose prior mean is the distance of the next seed's model, or with about its length-scale."""
    before = replace(job, seed=job.seed + 1).experiment().validation
    goals = before.space.grid(101)
    distances = before.distances(goals)
    if job.search == "gp-ucb-prior-mean":
        known = before.space.unit_function(lambda p: np.interp(p.goal, goals[:, 0], distances))
        return searches.GPUCB(prior_mean=known)
    surrogate = fit_surrogate(before.space.to_unit(goals), distances)
    length = float(np.exp(surrogate.process.theta[1]))
    return searches.GPUCB(kernel=Matern(1.5, length_scale=(length / 1.5, length * 1.5)))


def records(distances: Array) -> list[list[float]]:
    """Return ``[index, distance]`` of the distances among the six largest so far: all that SC and SD depend on."""
    largest, pairs = list[float](), []
    for index, distance in enumerate(distances.tolist()):
        if distance > (largest[-1] if len(largest) > PAPER.discarded else -np.inf):
            largest = sorted([*largest, distance], reverse=True)[: PAPER.discarded + 1]
            pairs.append([index, distance])
    return pairs


def distances_of(result: Result) -> Array:
    """Return the distances of a search in order; NaN for distances that are not records."""
    if "distances" in result:
        return np.array(result["distances"], dtype=np.float64)
    distances = np.full(result["executions"], np.nan)
    for index, distance in result["records"]:
        distances[int(index)] = distance
    return distances


def run_job(job: Job) -> Result:
    """Run one job on one thread."""
    with single_threaded():
        if job.kind == "frameworks":
            return frameworks(job.seed, per_axis=job.budget)
        experiment = job.experiment()
        validation = experiment.validation
        if job.kind == "search":
            # The points and distances of one campaign in order, or only the records for independent draws.
            search = _informed(job) if job.search in INFORMED else searches.by_name(job.search)
            if searches.BaseSearch.of(search).iid:
                # The points do not depend on the distances, so all of them are executed in one batch.
                search.reset(validation.space.dimension, job.seed)
                points = validation.space.from_unit(search.ask(job.budget))
                return {"executions": job.budget, "records": records(validation.distances(points))}
            campaign = Campaign(validation, search=search, seed=job.seed, name=experiment.name)
            campaign.run(job.budget, explore=True)
            points = validation.space.from_unit(np.array([trial.unit_point for trial in campaign.trials]))
            distances = [np.nan if trial.distance is None else trial.distance for trial in campaign.trials]
            return {"points": points.tolist(), "distances": distances}
        if job.kind == "truth":
            assert experiment.truth is not None  # each case of the paper has one
            truth = experiment.truth()
            return {"distance": truth.distance, "point": truth.parameters.points.tolist(), "method": truth.method}
        if job.kind == "profile":
            points = validation.space.grid(job.budget)
            return {"points": points[:, 0].tolist(), "distances": validation.distances(points).tolist()}
        if job.kind == "aspects":
            return _aspects(job, validation)
        # How far the closed loops on M and on S go below the paper's goal, and how far they are apart.
        model, system = closed_loops(validation, validation.task(validation.space.parameters([PAPER.goal])))
        loops = {"model": model, "system": system}
        gap = np.abs(system.states - model.states)
        below = {f"{name}_undershoot": PAPER.goal - float(loop.states[:, 0].min()) for name, loop in loops.items()}
        return {**below, "apart": float(gap.max()), "end": float(gap[-1].sum())}


def _aspects(job: Job, validation: Validation) -> Result:
    """Return how far model and system are from completing their tasks (Remark 1)."""
    if job.case == "arm":  # the final distance from a grid of targets
        errors = arm.aspects(job.seed, **dict(job.options), per_axis=job.budget)
        return {"model_error": errors.model_error.tolist(), "system_error": errors.system_error.tolist()}
    # The mean distance of the position from the reference of random tasks, beside that of a car straight ahead.
    points = validation.space.iid(job.budget, np.random.default_rng(job.seed))
    missed = TrackingError(components=(0, 1), over="mean")
    references = validation.task(validation.space.parameters(points)).reference
    sides = {"model_error": validation.on_model(missed), "system_error": validation.with_parts(distance=missed)}
    errors_of = {name: side.distances(points).tolist() for name, side in sides.items()}
    return {**errors_of, "size": np.abs(references[..., 1:, 1]).mean(axis=-1).tolist()}


class Results:
    """Stored results, a file of JSON lines for each kind of job; those of a case that has changed since do not count.

    A change of the searches makes no result invalid: the table says which results were measured before it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self._files = folder, dict[str, JsonLines]()

    def __contains__(self, job: Job) -> bool:
        result = self._of_kind(job.kind).get((job.key,))
        return result is not None and result["case_digest"] == case_digest(job.case)

    def __getitem__(self, job: Job) -> Result:
        return self._of_kind(job.kind)[job.key,]

    def fill(self, jobs: Iterable[Job], workers: int, on_done: Callable[[Job], None]) -> None:
        """Run the jobs that are not stored yet, in parallel; each result is stored as soon as it is complete."""
        missing = [job for job in dict.fromkeys(jobs) if job not in self]
        if not missing:
            return
        # New interpreters, because a forked one would inherit locks of threads that it does not have.
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            waiting = {pool.submit(run_job, job): job for job in missing}
            try:
                for future in as_completed(waiting):
                    job, plain = waiting[future], json.dumps(future.result())
                    # More than ten digits are in no figure, and double the size.
                    result = json.loads(plain, parse_float=lambda text: float(f"{float(text):.10g}"))
                    stored = {"key": job.key, **result, "case_digest": case_digest(job.case), **provenance()}
                    self._of_kind(job.kind).append(stored)
                    on_done(job)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise

    def _of_kind(self, kind: str) -> JsonLines:
        if kind not in self._files:
            self._files[kind] = JsonLines(self.folder / f"{kind}.jsonl", ("key",))
        return self._files[kind]


@functools.cache
def case_digest(case: str) -> str:
    """Return a digest of what a case's source computes, whatever its imports, docstrings, annotations and layout."""
    return module_digest(inspect.getsource(importlib.import_module(f"ctxval.paper.cases.{case}")))
