from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctxval import Task, Trajectory
from ctxval.distances import ComposedDistance, Distance, FinalState, GoalError, MeanDeviation, WholeTrajectory
from ctxval.errors import InputError

HORIZON, N = 4, 3
NORMS = [1, 2, np.inf]
METRICS = [
    *(
        cls(norm, components)
        for cls in (FinalState, WholeTrajectory, MeanDeviation)
        for norm in NORMS
        for components in (None, (0, 2))
    ),
    WholeTrajectory(2, per_step=True),
]
STATES = arrays(np.float64, (HORIZON + 1, N), elements=st.floats(-1e3, 1e3))


def trajectory(states: np.ndarray) -> Trajectory:
    return Trajectory(np.arange(HORIZON + 1), states, np.zeros((*states.shape[:-2], HORIZON, 1)))


def task(goal: object = (1.0, -2.0, 0.5)) -> Task:
    return Task([0.0] * N, goal=goal, horizon=HORIZON, dt=0.1)


def pair(batch: tuple[int, ...] = (), seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(*batch, HORIZON + 1, N)), rng.normal(size=(*batch, HORIZON + 1, N))


def norm(vector: np.ndarray, order: float) -> float:
    return float({1: np.sum(np.abs(vector)), 2: np.sqrt(np.sum(vector**2)), np.inf: np.max(np.abs(vector))}[order])


Formula = Callable[[np.ndarray, np.ndarray, float], float]
FORMULAS: list[tuple[Callable[..., Distance], Formula]] = [
    (FinalState, lambda M, S, p: norm(S[-1] - M[-1], p)),
    (WholeTrajectory, lambda M, S, p: norm((S - M).ravel(), p)),
    (MeanDeviation, lambda M, S, p: sum(norm(S[t] - M[t], p) for t in range(1, HORIZON + 1)) / HORIZON),
    (GoalError, lambda M, S, p: norm(S[-1] - np.array([1.0, -2.0, 0.5]), p)),
]


@pytest.mark.parametrize("order", NORMS)
@pytest.mark.parametrize(("make", "formula"), FORMULAS)
def test_a_distance_is_its_formula(make: Callable[..., Distance], formula: Formula, order: float) -> None:
    M, S = pair()
    d = make(norm=order)(trajectory(M), trajectory(S), task())
    assert np.shape(d) == ()
    assert d == pytest.approx(formula(M, S, order), rel=1e-14)


@pytest.mark.parametrize("order", NORMS)
@pytest.mark.parametrize(("make", "formula"), FORMULAS[:3])
def test_only_the_chosen_components_count(make: Callable[..., Distance], formula: Formula, order: float) -> None:
    M, S = pair()
    d = make(norm=order, components=[2, 0])(trajectory(M), trajectory(S), task())
    assert d == pytest.approx(formula(M[:, [2, 0]], S[:, [2, 0]], order), rel=1e-14)


def test_the_goal_error_counts_the_chosen_components() -> None:
    M, S = pair()
    d = GoalError(norm=1, components=[1])(trajectory(M), trajectory(S), task())
    assert d == pytest.approx(abs(S[-1, 1] + 2.0), rel=1e-14)


def test_the_distance_per_step_divides_by_the_horizon() -> None:
    M, S = pair()
    d = WholeTrajectory(2, per_step=True)(trajectory(M), trajectory(S), task())
    assert d == pytest.approx(np.linalg.norm(S - M) / HORIZON, rel=1e-14)


def test_the_error_of_the_final_state_is_signed() -> None:
    M, S = pair()
    np.testing.assert_array_equal(FinalState().error(trajectory(M), trajectory(S), task()), S[-1] - M[-1])


@pytest.mark.parametrize("distance", [FinalState(norm=1), FinalState(norm=2, components=(0,)), GoalError(norm=np.inf)])
def test_a_composed_distance_is_composed_of_its_vector(distance: ComposedDistance) -> None:
    assert isinstance(distance, ComposedDistance)
    assert not isinstance(WholeTrajectory(), ComposedDistance)
    M, S = (trajectory(states) for states in pair((6,)))
    vector = distance.error(M, S, task())
    np.testing.assert_array_equal(distance.compose(vector), distance(M, S, task()))  # type: ignore[operator]
    np.testing.assert_array_equal(distance.compose(np.stack([vector] * 2)), [distance.compose(vector)] * 2)


def test_defaults_are_those_of_the_paper() -> None:
    assert FinalState().norm == 1
    assert WholeTrajectory().norm == np.inf
    assert not WholeTrajectory().per_step


@pytest.mark.parametrize("batch", [(6,), (2, 3)])
@pytest.mark.parametrize("distance", [*METRICS, GoalError(1), GoalError(2, (1,)), GoalError(np.inf)])
def test_a_batch_of_distances_is_the_loop_over_them(distance: Distance, batch: tuple[int, ...]) -> None:
    M, S = pair(batch)
    goals = np.random.default_rng(1).normal(size=(N, *batch))
    d = distance(trajectory(M), trajectory(S), task(list(goals)))
    assert d.shape == batch
    for i in np.ndindex(batch):
        alone = distance(trajectory(M[i]), trajectory(S[i]), task(list(goals[(slice(None), *i)])))
        assert d[i] == pytest.approx(alone, rel=1e-13)


@pytest.mark.parametrize("distance", METRICS)
@settings(max_examples=10, deadline=None)
@given(STATES, STATES, STATES)
def test_a_distance_of_trajectories_is_a_metric(
    distance: Distance, a: np.ndarray, b: np.ndarray, c: np.ndarray
) -> None:
    def d(x: np.ndarray, y: np.ndarray) -> float:
        return float(distance(trajectory(x), trajectory(y), task()))

    assert d(a, b) >= 0
    assert d(a, a) == 0
    assert d(a, b) == d(b, a)
    assert d(a, c) <= (d(a, b) + d(b, c)) * (1 + 1e-12)


def test_the_goal_error_depends_on_the_system_alone() -> None:
    (M, S), (other, _) = pair(), pair(seed=5)
    first, second = (GoalError()(trajectory(model), trajectory(S), task()) for model in (M, other))
    assert first == second > 0
    reached = S.copy()
    reached[-1] = task().goal
    assert GoalError()(trajectory(M), trajectory(reached), task()) == 0


@pytest.mark.parametrize("cls", [FinalState, WholeTrajectory, MeanDeviation, GoalError])
@pytest.mark.parametrize("order", [0, 3, np.nan])
def test_another_norm_is_refused_by_value(cls: type, order: float) -> None:
    with pytest.raises(InputError, match=rf"norm must be 1, 2 or inf, got {order}"):
        cls(norm=order)


@pytest.mark.parametrize("distance", METRICS)
def test_the_ready_made_distances_are_distances(distance: object) -> None:
    assert isinstance(distance, Distance)
