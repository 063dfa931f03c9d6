"""How much sooner several workers find the worst task: simulated time until an execution is within 1 % of d*.

Each execution lasts one unit and a seeded random part of half a unit; choosing a task takes no time.
``python benchmarks/study_workers.py`` runs what is not stored yet and prints a table, or with
``linear-lag --seeds 3`` a part of it. ``--store FILE`` keeps the results of another version apart. A campaign either
explores (the search ``auto`` alone) or decides (without a threshold, to 1 %).
"""

from __future__ import annotations

import argparse
import heapq
import statistics
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from calibrate import RESULTS, all_of
from ctxval import (
    Campaign,
    Experiment,
    Task,
    TaskSpace,
    Transitions,
    Validation,
    cached_truth,
    cases,
    controllers,
    distances,
    models,
    rollout,
    search_truth,
    searches,
    systems,
)
from ctxval._util.arrays import Array, single_threaded
from ctxval.campaign.choices import Choice, Execution
from ctxval.campaign.execution import ExecutionLoop
from ctxval.campaign.suite_intervals import interval_search
from ctxval.campaign.workers import WorkerPool, execute_task
from ctxval.certificates import CertificateOptions
from ctxval.core.plan import Plan
from ctxval.core.trial import Trial
from ctxval.paper.cases.linear import Feedback, LinearSystem, Settings, draw
from dynamics_systems import PartlySeen, RandomFunction
from json_lines import JsonLines
from reproduce.jobs import AUTO, provenance
from study_auto import ROOT, results_of
from study_auto import experiment as of_search_study
from study_auto import truth as truth_of_search_study

STATES = 5
WORKERS = (1, 2, 4, 8)
MODES = ("explore", "decide")
WITHIN = 0.01
SPREAD = 0.5
LONGEST, MOST = 30.0, 48
"""Simulated time and number of executions at which a campaign ends."""
KEY = ("system", "mode", "workers", "seed")
FIRST = 0
"""The first seed that is reported; the choices of several workers were developed with seeds from 100 on."""


# Linear systems of five states, and nonlinear systems that M takes for linear


def _parts(seed: int) -> tuple[np.random.Generator, Array, LinearSystem, models.Linear]:
    """Return a generator, a random feedback, a random system, and a model that is another random system."""
    *draws, rest = np.random.default_rng([seed, 41]).spawn(4)
    settings, gain = Settings(), draws[0].normal(scale=STATES**-0.5, size=(STATES, STATES))
    return rest, gain, draw(draws[1], gain, settings), draw(draws[2], gain, settings).discretised(settings.dt)


def _experiment(name: str, system: systems.System, model: models.Linear, gain: Array) -> Experiment:
    box, settings = (-np.ones(STATES), np.ones(STATES)), Settings()
    validation = Validation(
        space=TaskSpace(x_init=box, x_final=box),
        task=lambda p: Task(p.x_init, goal=p.x_final, horizon=settings.horizon, dt=settings.dt),
        system=system,
        model=model,
        synthesizer=controllers.Policy(Feedback(gain)),
        distance=distances.FinalState(norm=1),
    )
    return Experiment(name, validation)


def paper(seed: int) -> Experiment:
    """Return the paper's random system with a random model."""
    return cases.by_name("linear", seed, dim=STATES)


def with_data(seed: int) -> Experiment:
    """Return the same with eight transitions of the system from small states, too few to determine it."""
    found, rng = paper(seed), np.random.default_rng([seed, 43])
    system, push = found.validation.system, 0.3 * rng.normal(size=(8, STATES))
    assert isinstance(system, systems.Simulated)
    found.validation.model.data = rollout(  # type: ignore[attr-defined]
        system.model.step, lambda t, x: push[t], Task(0.3 * rng.normal(size=STATES), horizon=8, dt=Settings().dt)
    ).transitions()
    assert isinstance(found.validation.model.data, Transitions)  # type: ignore[attr-defined]
    return found


def drawn(seed: int) -> Experiment:
    """Return a system that a smooth random function of states and inputs is added to."""
    rng, gain, system, model = _parts(seed)
    scales = np.exp(rng.uniform(np.log(3.0), np.log(8.0), 2 * STATES))
    residual = RandomFunction.draw(rng, scales, rng.uniform(0.05, 0.15, STATES))
    exact = system.discretised(Settings().dt)

    def step(x: Array, u: Array) -> Array:
        return np.asarray(exact.step(x, u) + residual(np.concatenate([x, u], axis=-1)))

    return _experiment("linear-drawn", systems.Simulated(step, vectorized=True), model, gain)


def saturated(seed: int) -> Experiment:
    """Return a system whose inputs saturate."""
    rng, gain, system, model = _parts(seed)
    exact, most = system.discretised(Settings().dt), rng.uniform(0.4, 1.0, STATES)

    def step(x: Array, u: Array) -> Array:
        return exact.step(x, most * np.tanh(u / most))

    return _experiment("linear-saturated", systems.Simulated(step, vectorized=True), model, gain)


def bilinear(seed: int) -> Experiment:
    """Return a system in which the gains of the inputs depend on the states."""
    rng, gain, system, model = _parts(seed)
    exact, factors = system.discretised(Settings().dt), rng.normal(scale=0.01, size=(STATES, STATES, STATES))

    def step(x: Array, u: Array) -> Array:
        return np.asarray(exact.step(x, u) + np.einsum("ijk,...j,...k->...i", factors, np.tanh(x), u))

    return _experiment("linear-bilinear", systems.Simulated(step, vectorized=True), model, gain)


def lag(seed: int) -> Experiment:
    """Return a system whose inputs act through lags that are not recorded."""
    rng, gain, system, model = _parts(seed)
    rates = 1 / rng.uniform(0.05, 0.4, STATES)

    def derivative(x: Array, u: Array) -> Array:
        state, held = x[..., :STATES], x[..., STATES:]
        return np.concatenate([state @ system.A.T + held @ system.B.T, rates * (u - held)], axis=-1)

    return _experiment("linear-lag", PartlySeen(derivative, Settings().dt, STATES), model, gain)


LINEAR: dict[str, Callable[[int], Experiment]] = {
    "linear": paper,
    "linear-data": with_data,
    "linear-drawn": drawn,
    "linear-saturated": saturated,
    "linear-bilinear": bilinear,
    "linear-lag": lag,
}
OTHERS = ("pendulum", "dubins-basin", "arm-linear")
SYSTEMS = (*LINEAR, *OTHERS)


def case(system: str, seed: int) -> tuple[Validation, float]:
    """Return a validation and its d*."""
    folder = ROOT / "runs" / "truth"
    if system in OTHERS:
        found = of_search_study(system, seed)
        known = results_of("auto")
        if (system, seed, "auto") in known:
            return found.validation, known[system, seed, "auto"]["truth"]
        return found.validation, truth_of_search_study(system, found, folder)
    found = LINEAR[system](seed)
    if found.truth is not None:
        return found.validation, found.truth().distance
    compute = partial(search_truth, repeats=3, generations=60, climbs=20)
    return found.validation, cached_truth(found.validation, compute, folder).distance


# Simulated time


class SimulatedPool(WorkerPool):
    """Workers in simulated time; the duration of an execution depends on the seed and the number of its trial."""

    def __init__(self, system: systems.System, size: int, seed: int) -> None:
        self.system, self.size, self.seed, self.now = system, size, seed, 0.0
        self._running: list[tuple[float, int, Plan]] = []

    def start(self, number: int, plan: Plan) -> None:
        """Start the execution of a trial on a free worker."""
        lasts = 1 + SPREAD * np.random.default_rng([self.seed, number, 47]).random()
        heapq.heappush(self._running, (self.now + lasts, number, plan))

    def wait(self) -> list[tuple[int, Execution]]:
        """Go on to the time at which the next execution ends."""
        self.now, number, plan = heapq.heappop(self._running)
        return [(number, execute_task(self.system, plan.controller, plan.task))]

    def close(self) -> None:
        """End all executions."""
        self._running.clear()


def study(one: tuple[str, str, int, int]) -> dict[str, Any]:
    """Return the executions of one campaign in the order of their ends, with their times and shares of d*."""
    system, mode, workers, seed = one
    ended: list[tuple[float, int, float]] = []
    with single_threaded():
        validation, largest = case(system, seed)
        campaign = Campaign(validation, search=searches.Auto("thorough"), seed=seed)
        recorder, pool = campaign.recorder, SimulatedPool(validation.system, workers, seed)
        decides = None
        if mode == "decide":
            decides = interval_search(recorder, CertificateOptions.or_automatic(None, 0.95, 0.1), 1000, within=WITHIN)

        def rule() -> Choice | None:
            over = pool.now >= LONGEST or len(ended) + len(recorder.executing) >= MOST
            if over or any(share >= 1 - WITHIN for _, _, share in ended):
                return None
            return Choice() if decides is None else decides.choose()

        def note(trial: Trial) -> None:
            ended.append((round(pool.now, 4), trial.number, (trial.distance or 0.0) / largest))

        with recorder.predicting(decides is not None and decides.predicts):
            ExecutionLoop(recorder, rule, pool, note).run()
    return {**dict(zip(KEY, one, strict=True)), "ended": ended, **provenance((*AUTO, "campaign"))}


def time_of(line: dict[str, Any]) -> float:
    """Return the simulated time to within 1 % of d*; infinity if the campaign ended before."""
    return next((now for now, _, share in line["ended"] if share >= 1 - WITHIN), np.inf)


def rows(stored: JsonLines, systems_: list[str], modes: list[str], seeds: list[int]) -> list[str]:
    """Return a row of the table for each system and mode."""
    found = []
    for system, mode in product(systems_, modes):
        lines = {
            workers: [stored[key] for seed in seeds if (key := (system, mode, workers, seed)) in stored]
            for workers in WORKERS
        }
        times = {workers: [time_of(line) for line in lines[workers]] for workers in WORKERS}
        if not times[1] or len(times[1]) != len(times[8]):
            continue
        hits = [[one[2] >= 1 - WITHIN for one in line["ended"]] for line in lines[1]]
        count = statistics.median(hit.index(True) + 1 if True in hit else np.inf for hit in hits)
        medians = {workers: statistics.median(of) if of else np.nan for workers, of in times.items()}
        slower = sum(eight > one for one, eight in zip(times[1], times[8], strict=True))
        found.append(
            f"| {system} | {mode} | {len(hits)} | {count:g} | {' | '.join(f'{medians[w]:.2f}' for w in WORKERS)} "
            f"| {medians[1] / medians[8]:.2f} | {slower} |"
        )
    return found


def main() -> None:
    """Run all campaigns that are not stored, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("systems", nargs="*", default=list(SYSTEMS), help=f"of {', '.join(SYSTEMS)}")
    parser.add_argument("--modes", nargs="+", default=list(MODES))
    parser.add_argument("--workers", nargs="+", type=int, default=list(WORKERS))
    parser.add_argument("--first", type=int, default=FIRST)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--store", type=Path, default=RESULTS / "several_workers.jsonl")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    stored, seeds = JsonLines(options.store, KEY), list(range(options.first, options.first + options.seeds))
    asked = [
        (system, mode, workers, seed)
        for mode, seed, system, workers in product(options.modes, seeds, options.systems, options.workers)
        if (system, mode, workers, seed) not in stored
    ]
    for line in all_of(study, asked, options.processes):
        stored.append(line)
    by_workers = " | ".join(f"time, {workers}" for workers in WORKERS)
    print(f"| system | mode | seeds | executions, 1 | {by_workers} | ratio of 1 to 8 | 8 slower than 1 |")
    print("|---" * (6 + len(WORKERS)) + "|")
    print("\n".join(rows(stored, options.systems, options.modes, seeds)))


if __name__ == "__main__":
    main()
