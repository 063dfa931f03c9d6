"""Are draws of the residual dynamics as uncertain as they should be? Ranks of the truth (Talts et al. 2018).

The residual of each system is drawn from exactly the prior that the posterior assumes. The posterior is learned from
transitions of the system, and the rank of the true value among the draws is stored: for the residual at new state-input
pairs, and for the distance of closed loops on new tasks. If the posterior is right, then all ranks are equally likely.
Amplitudes are scaled so that the recorded residuals have a given size: the prior of the amplitudes is flat, and the
ranks do not depend on it.

Transitions are recorded at random pairs, or on closed loops of random tasks. Only the first are standardised by
numbers that do not depend on the residual, so only for them is the prior exact. Ranks are stored in a file, a line for
a system, so a stopped study goes on; then a table is printed.
``python benchmarks/study_posterior_ranks.py --seeds 100 --states 1 2``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats
from scipy.linalg import solve_triangular

from ctxval import Task, TaskSpace, Trajectory, Transitions, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.core.model import Step
from ctxval.core.rollout import rollout
from ctxval.learning.closed_loops import LoopPlanner, loop_pairs
from ctxval.learning.dynamics_posterior import PosteriorSettings, learn_posterior
from ctxval.learning.hyperparameters import ResidualHyperparameters, draw_prior
from ctxval.models.increments import standard_deviations
from json_lines import JsonLines

KEY = ("design", "states", "seed")
STORED = Path(__file__).parent / "results" / "posterior_ranks.jsonl"
DESIGNS = ("pairs", "loops")
STATES = (1, 2, 3, 4, 5, 6)
FRESH = 1000
"""First of the seeds with which nothing was chosen."""
COUNTS = (25, 60, 120, 240)
"""Numbers of transitions; each seed has one of them."""
HORIZON = 20
SIZE = 0.1
"""Root mean square of the recorded residuals as a share of the typical change of the state."""
TASKS = 16
"""Number of new tasks whose closed loops on the mean give the pairs from which pivots are chosen."""
RANKED = 4
"""Number of new pairs, and of new tasks, that are ranked for each system."""
RANKS = 20
"""Number of possible ranks: that of draws that are compared, and one."""
_JITTER = 1e-10


class PriorResidual:
    """A function with one value for each state, drawn from the prior; it is drawn where it is evaluated.

    Args:
        hyperparameters: the covariance, and its hyperparameters.
        states: the number n of its values.
        rng: the source of the function.
    """

    def __init__(self, hyperparameters: ResidualHyperparameters, states: int, rng: np.random.Generator) -> None:
        self._kernel, self._theta, self._rng = hyperparameters.kernel, hyperparameters.theta, rng
        constant, slope = np.exp(0.5 * self._theta[-2:])
        self._constant = constant * rng.standard_normal(states)
        self._slopes = slope * rng.standard_normal((len(self._theta) - 2, states))
        self._pairs = np.empty((0, len(self._theta) - 2))
        self._white = np.empty((0, states))
        self._factor = np.empty((0, 0))

    def __call__(self, Z: Array) -> Array:
        """Return the values ``(q, n)`` at standardised pairs ``(q, k)``, given all values that were drawn before."""
        cross = solve_triangular(self._factor, self._rough(self._pairs, Z), lower=True)
        values, vectors = np.linalg.eigh(self._rough(Z, Z) - cross.T @ cross)
        own = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(values, _JITTER))).T, mode="r")).T
        white = self._rng.standard_normal((len(Z), self._white.shape[1]))
        self._factor = np.block([[self._factor, np.zeros((len(self._pairs), len(Z)))], [cross.T, own]])
        self._pairs, self._white = np.concatenate([self._pairs, Z]), np.concatenate([self._white, white])
        return np.asarray(cross.T @ self._white[: -len(Z)] + own @ white + self._constant + Z @ self._slopes)

    def _rough(self, X: Array, Z: Array) -> Array:
        """Return the covariances of the Matern part."""
        nothing = np.concatenate([self._theta[:-2], [-np.inf, -np.inf]])
        return self._kernel(nothing, X, Z)


@dataclass(frozen=True, eq=False)
class Truth:
    """A system whose residual is drawn from the prior.

    Attributes:
        model: the model M.
        residual: the residual as a function of standardised pairs.
        shift, scale: constants that standardise pairs.
        sizes: factors of the residual of each state.
    """

    model: models.Linear
    residual: PriorResidual
    shift: Array
    scale: Array
    sizes: Array

    def missed(self, x: Array, u: Array) -> Array:
        """Return the residuals ``(q, n)`` of states ``(q, n)`` and inputs ``(q, m)``."""
        Z = np.concatenate([x, u], axis=1)
        return self.sizes * self.residual((Z - self.shift) / self.scale)

    def step(self, x: Array, u: Array) -> Array:
        """Return the next states ``(q, n)``; a loop that has diverged stays where it is."""
        here = np.clip(np.nan_to_num(x), -1e3, 1e3), np.clip(np.nan_to_num(u), -1e3, 1e3)
        return self.model.step(x, u) + self.missed(*here)


def make_validation(states: int, rng: np.random.Generator) -> tuple[Validation, models.Linear]:
    """Return tasks that lead a random stable linear model from a start to the origin; its system is never executed."""
    A = rng.normal(size=(states, states))
    A *= rng.uniform(0.7, 1.0) / np.abs(np.linalg.eigvals(A)).max()
    model = models.Linear(A, rng.normal(size=(states, 1)))
    validation = Validation(
        space=TaskSpace(start=([-2.0] * states, [2.0] * states)),
        task=lambda p: Task(p.start, horizon=HORIZON, dt=0.1),
        system=systems.Simulated(model.step, vectorized=True),
        model=model,
        synthesizer=controllers.LQR([1.0] * states, [1.0]),
        distance=distances.MeanDeviation(),
    )
    return validation, model


def random_loops(step: Step, validation: Validation, points: Array) -> Trajectory:
    """Return closed loops on the tasks at points ``(q, d)`` of the unit cube."""
    task = validation.task(validation.space.parameters(validation.space.from_unit(points)))
    return rollout(step, validation.synthesizer.design(task, validation.model), task)


def recorded(
    design: str, validation: Validation, model: models.Linear, count: int, rng: np.random.Generator
) -> tuple[Truth, Transitions]:
    """Return a system that is drawn from the prior, and noisy transitions of it."""
    n, tasks = validation.space.dimension, rng.random((-(-count // HORIZON), validation.space.dimension))
    if design == "pairs":
        x, u = rng.normal(size=(count, n)), rng.normal(size=(count, 1))
    else:
        of_model = random_loops(model.step, validation, tasks).transitions()
        x, u = of_model.x, of_model.u
    hyperparameters = draw_prior(n + 1, 1, rng)
    pairs = np.concatenate([x, u], axis=1)
    shift, scale = pairs.mean(axis=0), standard_deviations(pairs)
    residual = PriorResidual(hyperparameters, n, rng)
    noise = np.sqrt(hyperparameters.noise) * rng.standard_normal((len(x), n))
    values = residual((pairs - shift) / scale) + noise
    sizes = SIZE * standard_deviations(model.step(x, u) - x) / np.sqrt((values**2).mean(axis=0))
    truth = Truth(model, residual, shift, scale, sizes)
    if design == "pairs":
        return truth, Transitions(x, u, model.step(x, u) + sizes * values)
    executed = random_loops(truth.step, validation, tasks).transitions()
    return truth, Transitions(executed.x, executed.u, executed.x_next + sizes * noise)


def ranks(design: str, states: int, seed: int) -> dict[str, Any]:
    """Return the ranks of one system that is drawn from the prior."""
    rng = np.random.default_rng([DESIGNS.index(design), states, seed])
    validation, model = make_validation(states, rng)
    truth, transitions = recorded(design, validation, model, COUNTS[seed % len(COUNTS)], rng)
    started = time.process_time()
    settings = PosteriorSettings.for_horizon(HORIZON)
    posterior = learn_posterior(model, transitions, np.zeros(len(transitions), dtype=np.intp), (seed,), settings)
    seconds = time.process_time() - started
    assert posterior is not None, "the residual of this system is not negligible"
    tasks, planner = rng.random((TASKS, states)), LoopPlanner(validation)
    x, u = rng.normal(size=(RANKED, states)), rng.normal(size=(RANKED, 1))
    relevant = np.concatenate([loop_pairs(planner, posterior, tasks), posterior.data.standardised(x, u)])
    draws = posterior.draw(relevant, rng)
    one_each = range(settings.functions, len(draws), settings.functions)
    of_state = np.arange(RANKED), np.arange(RANKED) % states
    residuals = np.array([(draws[s].step(x, u) - model.step(x, u))[of_state] for s in one_each])
    planned = planner.plan(tasks[:RANKED])
    loops = random_loops(truth.step, validation, tasks[:RANKED])
    with np.errstate(all="ignore"):
        d = np.where(loops.finite, validation.distance(planned[0].nominal, loops, planned[0].task), np.inf)
    return {
        "transitions": len(transitions),
        "residual": ranked(truth.missed(x, u)[of_state], residuals, rng),
        "distance": ranked(d, planner.distances(draws, planned, RANKED)[one_each], rng),
        "left_out": draws.left_out,
        "noise": posterior.noise,
        "seconds": seconds,
    }


def ranked(true: Array, drawn: Array, rng: np.random.Generator) -> list[int]:
    """Return the rank of each true value ``(q,)`` among draws ``(S, q)``; equal values are ordered at random."""
    below, equal = (drawn < true).sum(axis=0), (drawn == true).sum(axis=0)
    return [int(rank) for rank in below + rng.integers(equal + 1)]


def row(name: str, of: str, results: Sequence[dict[str, Any]], possible: int) -> list[str]:
    """Return how often the truth is below and above all draws, and how probable that is."""
    each = np.array([result[of] for result in results])
    first = np.bincount(each[:, 0], minlength=possible)
    p_value = stats.chisquare(first.reshape(-1, 2).sum(axis=1)).pvalue
    cells = [f"{100 * part:.1f} %" for part in ((each == 0).mean(), (each == possible - 1).mean())]
    spread = ((each + 0.5) / possible).var() * 12
    return [name, of, str(len(results)), *cells, f"{spread:.2f}", f"{p_value:.2g}"]


HEADER = ("transitions, states", "value", "systems", "below all draws", "above all draws", "spread", "p")


def rows(
    results: JsonLines, seeds: range, designs: Sequence[str] = DESIGNS, states: Sequence[int] = STATES
) -> list[list[str]]:
    """Return the table of the ranks that are stored of these seeds."""
    found = list[list[str]]()
    for design, of in product(designs, ("residual", "distance")):
        each = {n: [one for one in results.select(design=design, states=n) if one["seed"] in seeds] for n in states}
        found += [row(f"{design}, {n}", of, chosen, RANKS) for n, chosen in each.items()]
        found.append(row(f"{design}, all", of, [one for chosen in each.values() for one in chosen], RANKS))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=60)
    parser.add_argument(
        "--first", type=int, default=FRESH, help="the first seed; the method was chosen on seeds 0 to 26"
    )
    parser.add_argument("--states", type=int, nargs="+", default=STATES)
    parser.add_argument("--designs", nargs="+", default=DESIGNS, choices=DESIGNS)
    parser.add_argument("--results", type=Path, default=STORED)
    options = parser.parse_args()
    results = JsonLines(options.results, KEY)
    seeds = range(options.first, options.first + options.seeds)
    for seed, design, states in product(seeds, options.designs, options.states):
        if (design, states, seed) not in results:
            results.append({"design": design, "states": states, "seed": seed, **ranks(design, states, seed)})
    for line in rows(results, seeds, options.designs, options.states):
        print(*line, sep=" | ")


if __name__ == "__main__":
    main()
