from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import pytest

from ctxval import Task, TaskSpace, Trajectory, Transitions, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.gp.ascent import ascend
from ctxval.learning import worst_case
from ctxval.learning.closed_loops import LoopPlanner, loop_pairs
from ctxval.learning.draws import DynamicsDraws
from ctxval.learning.dynamics_posterior import DynamicsPosterior, PosteriorSettings, learn_posterior
from ctxval.learning.worst_case import WorstCase, WorstCaseSearch, WorstCaseSettings
from rig_thorough import more

MODEL = models.Linear([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]])


def truth(x: Array, u: Array) -> Array:
    return np.asarray(MODEL.step(x, u) + 0.05 * np.sin(2 * x) * (1 + u))


def make_planner(dimension: int) -> LoopPlanner:
    space = TaskSpace(start=([-2.0, -1.0][:dimension], [2.0, 1.0][:dimension]))
    return LoopPlanner(
        Validation(
            space=space,
            task=lambda p: Task([p.start[..., 0], p.start[..., 1] if dimension == 2 else 0.4], horizon=12, dt=0.1),
            system=systems.Simulated(truth, vectorized=True),
            model=MODEL,
            synthesizer=controllers.LQR([1.0, 0.1], [0.1]),
            distance=distances.MeanDeviation(),
        )
    )


def weights(height: float) -> Callable[[int, Array, Task], Array]:
    """Return a controller whose gain is larger in bands of the initial state that are far narrower than the space."""

    def act(t: int, x: Array, task: Task) -> Array:
        gain = 1 + height * (np.sin(2000 * task.initial_state[..., :1]) > 0.9)
        return np.asarray(-gain * (0.5 * x[..., :1] + 0.5 * x[..., 1:]))

    return act


def jumping(height: float) -> LoopPlanner:
    smooth = make_planner(2).validation
    return LoopPlanner(
        Validation(
            space=smooth.space,
            task=smooth.task,
            system=smooth.system,
            model=MODEL,
            synthesizer=controllers.Policy(weights(height), vectorized=True),
            distance=distances.MeanDeviation(),
        )
    )


@dataclass(frozen=True, eq=False, repr=False)
class Remembering(DynamicsPosterior):
    """A posterior that keeps the draws that a search takes from it."""

    taken: list[DynamicsDraws] = field(default_factory=list)

    def draw(self, relevant: Array, rng: np.random.Generator, *how: int | None) -> DynamicsDraws:
        self.taken.append(super().draw(relevant, rng, *how))
        return self.taken[-1]


@functools.cache
def learned() -> DynamicsPosterior:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(14, 2)), rng.normal(size=(14, 1))
    settings = PosteriorSettings(hyperparameters=4, functions=2)
    transitions = Transitions(x, u, truth(x, u))
    found = learn_posterior(MODEL, transitions, np.zeros(14, dtype=np.intp), settings=settings)
    assert found is not None
    return found


def remembering() -> Remembering:
    known = learned()
    return Remembering(**{one.name: getattr(known, one.name) for one in fields(known) if one.init})


def maxima(search: WorstCaseSearch, posterior: DynamicsPosterior, known: Array, rng: np.random.Generator) -> WorstCase:
    (of_pool,) = search.planner.distances(posterior.mean, search.plans, len(search.pool))
    return search.maxima(
        posterior, search.on_mean(posterior, of_pool, known, rng), known, rng, posterior.functions_for(1)
    )


def grid(dimension: int) -> Array:
    side = np.linspace(0, 1, 401 if dimension == 1 else 41)
    return np.stack(np.meshgrid(*[side] * dimension), axis=-1).reshape(-1, dimension)


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [1, 2])
@pytest.mark.parametrize("seed", [0, *more(1)])
def test_maxima_are_those_of_a_dense_grid(dimension: int, seed: int) -> None:
    planner, posterior = make_planner(dimension), remembering()
    search = WorstCaseSearch(planner, seed, WorstCaseSettings.for_dimension(dimension))
    found = maxima(search, posterior, np.empty((0, dimension)), np.random.default_rng(seed))
    (draws,) = posterior.taken
    points = grid(dimension)
    plans = planner.plan(points)
    largest = planner.distances(draws, plans, len(points)).max(axis=1)
    assert len(found.maxima) == len(draws) == 8
    # A draw may have a narrow peak that the search misses.
    assert (found.maxima >= 0.95 * largest).sum() >= 7
    assert (found.maxima >= 0.8 * largest).all()
    assert np.median(found.maxima / largest) > 0.995
    of_mean = planner.distances(posterior.mean, plans, len(points)).max()
    assert found.highest >= 0.995 * of_mean


@pytest.mark.slow
def test_maxima_are_distances_at_their_points() -> None:
    planner, posterior = make_planner(2), remembering()
    search = WorstCaseSearch(planner, 0, WorstCaseSettings.for_dimension(2))
    found = maxima(search, posterior, np.empty((0, 2)), np.random.default_rng(0))
    again = planner.own_distances(posterior.taken[0], found.points[:, None])[:, 0]
    np.testing.assert_allclose(found.maxima, again, rtol=1e-7)
    assert ((found.points >= 0) & (found.points <= 1)).all()
    np.testing.assert_allclose(
        planner.distances(posterior.mean, planner.plan(found.local_maxima[:1]), 1), found.highest, rtol=1e-7
    )
    assert found.left_out == posterior.taken[0].left_out


@pytest.mark.slow
@pytest.mark.parametrize(("height", "jumps"), [(0.0, False), (1.0, True)])
def test_controllers_that_jump_from_task_to_task_are_seen(height: float, jumps: bool) -> None:
    search = WorstCaseSearch(jumping(height), 0, WorstCaseSettings.for_dimension(2))
    found = maxima(search, learned(), np.empty((0, 2)), np.random.default_rng(0))
    share = search.largest_jump(learned()) / found.highest
    assert (found.peak_ratio > 0.05) == jumps
    assert (share > 0.01) == jumps
    if not jumps:
        assert share < 1e-3


class Folded(distances.MeanDeviation):
    """A distance that is continuous in the trajectories, and steep with many kinks."""

    def __call__(self, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> Array:
        plain = super().__call__(model_trajectory, system_trajectory, task)
        return np.asarray(np.abs((500 * plain) % 2 - 1))


class Kinked(Folded):
    kinked = True


@pytest.mark.slow
def test_kinks_of_a_distance_that_says_so_are_no_jumps_and_jumps_are_still_seen() -> None:
    def largest(height: float, distance: distances.Distance) -> float:
        planner = LoopPlanner(jumping(height).validation.with_parts(distance=distance))
        settings = replace(WorstCaseSettings.for_dimension(2), pool=256)
        return WorstCaseSearch(planner, 0, settings).largest_jump(learned())

    assert largest(0.0, Folded()) > 0.05
    assert largest(0.0, Kinked()) < 0.01
    assert largest(1.0, Kinked()) > 0.2


FEW = WorstCaseSettings(pool=64, evaluations=300, local_maxima=6, shared=6, moves=4, relevant=100)


@pytest.mark.slow
@pytest.mark.thorough
def test_equal_seeds_give_equal_maxima_whatever_was_computed_before() -> None:
    known, posterior = np.array([[0.9, 0.2]]), learned()
    used = WorstCaseSearch(make_planner(2), 3, FEW)
    maxima(used, posterior, known, np.random.default_rng(8))
    np.random.default_rng().random()
    fresh = WorstCaseSearch(make_planner(2), 3, FEW)
    first, second = (maxima(one, posterior, known, np.random.default_rng(4)) for one in (used, fresh))
    np.testing.assert_array_equal(first.maxima, second.maxima)
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(first.local_maxima, second.local_maxima)
    other = maxima(fresh, posterior, known, np.random.default_rng(5))
    assert not np.array_equal(first.maxima, other.maxima)


def test_the_pool_covers_the_cube_and_its_faces() -> None:
    pool = WorstCaseSearch(make_planner(2), 0, FEW).pool
    assert pool.shape == (64, 2)
    assert ((pool >= 0) & (pool <= 1)).all()
    at_bounds = np.isin(pool, [0.0, 1.0]).any(axis=1)
    assert not at_bounds[::2].any()
    assert at_bounds[1::2].mean() > 0.3
    np.testing.assert_array_equal(pool, WorstCaseSearch(make_planner(2), 0, FEW).pool)
    assert not np.array_equal(pool, WorstCaseSearch(make_planner(2), 1, FEW).pool)


def test_known_tasks_are_run_on_all_draws() -> None:
    posterior, known = remembering(), np.array([[0.31, 0.77], [1.0, 1.0]])
    planner = make_planner(2)
    found = maxima(WorstCaseSearch(planner, 0, FEW), posterior, known, np.random.default_rng(0))
    there = planner.distances(posterior.taken[0], planner.plan(known), 2).max(axis=1)
    assert (found.maxima >= there * (1 - 1e-9)).all()


def test_drawn_loops_that_diverge_have_an_infinite_maximum() -> None:
    planner = make_planner(1)
    planner.validation.synthesizer = controllers.Policy(lambda t, x, task: 1e80 * x[..., :1] ** 3)
    planner.validation.model = models.Function(lambda x, u: 0.5 * x, vectorized=True)
    found = maxima(WorstCaseSearch(planner, 0, FEW), learned(), np.empty((0, 1)), np.random.default_rng(0))
    assert np.isinf(found.maxima).all()


def test_the_number_of_loops_is_counted() -> None:
    found = maxima(WorstCaseSearch(make_planner(2), 0, FEW), learned(), np.empty((0, 2)), np.random.default_rng(0))
    on_draws = found.evaluations - FEW.evaluations
    each = len(found.local_maxima) + FEW.shared + 4 * (4 + FEW.moves + 1)
    # Each draw also tries the best tasks of the others, of which there are at most eight.
    assert 8 * (each + 1) <= on_draws <= 8 * (each + 8)


def test_an_approximation_that_is_the_mean_itself_is_not_searched_first(monkeypatch: pytest.MonkeyPatch) -> None:
    search, roughs = WorstCaseSearch(make_planner(1), 0), list[object]()

    def spied(*arguments: Any) -> Any:
        roughs.append(arguments[5])
        return ascend(*arguments)

    monkeypatch.setattr(worst_case, "ascend", spied)
    exact, rough = replace(learned()), replace(learned())
    assert exact.rough_mean is exact.mean
    rough.__dict__["rough_mean"] = copy.copy(rough.mean)
    for posterior in (exact, rough):
        rng, of_pool = np.random.default_rng(0), np.zeros(len(search.pool))
        search.on_mean(posterior, of_pool, search.pool[:1], rng, globally=False)
    assert [given is None for given in roughs] == [True, False]


def test_pairs_of_loops_are_those_that_the_mean_visits() -> None:
    planner, posterior = make_planner(2), learned()
    tasks = np.random.default_rng(0).random((5, 2))
    (loops,) = planner.run(posterior.mean, planner.plan(tasks))
    pairs = np.concatenate([loops.states[0, :, :-1], loops.inputs[0]], axis=-1).reshape(-1, 3)
    expected = (pairs - posterior.data.shift) / posterior.data.scale
    np.testing.assert_allclose(loop_pairs(planner, posterior, tasks), expected)


def test_pairs_of_loops_that_diverge_are_left_out() -> None:
    planner, posterior = make_planner(2), learned()
    planner.validation.synthesizer = controllers.Policy(
        lambda t, x, task: np.where(task.initial_state[..., :1] > 0, 1e5 * x[..., :1], 0 * x[..., :1])
    )
    pairs = loop_pairs(planner, posterior, np.array([[0.1, 0.5], [0.9, 0.5]]))
    assert 12 <= len(pairs) < 24
    assert np.abs(pairs).max() < 1e3


@pytest.mark.parametrize(("dimension", "evaluations"), [(1, 512), (2, 2048), (3, 4096), (4, 6000), (20, 12000)])
def test_few_task_parameters_need_fewer_loops(dimension: int, evaluations: int) -> None:
    assert WorstCaseSettings.for_dimension(dimension).evaluations == evaluations


class Counting(LoopPlanner):
    """A planner that counts the batches of tasks of the draws' own."""

    batches = 0

    def own_distances(self, draws: DynamicsDraws, points: Array) -> Array:
        self.batches += 1
        return super().own_distances(draws, points)


def test_loops_whose_distance_is_known_are_not_run_again() -> None:
    planner = Counting(make_planner(1).validation)
    search = WorstCaseSearch(planner, 0, WorstCaseSettings(pool=16, evaluations=80, local_maxima=4, shared=4, rounds=3))
    maxima(search, learned(), np.empty((0, 1)), np.random.default_rng(0))
    assert planner.batches == 3  # with one task parameter, all moves that help together are one of the moves
