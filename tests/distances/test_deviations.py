from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctxval import Task, Trajectory
from ctxval._util.describe import describe
from ctxval.distances import (
    AtCrossing,
    AtTimes,
    ComposedDistance,
    CrossingTime,
    Distance,
    FinalState,
    GoalError,
    MaximumDeviation,
    MeanDeviation,
    RelativeDeviation,
    StateNorm,
    TrackingError,
    WholeTrajectory,
)
from ctxval.errors import InputError, ShapeError, UnknownNameError
from facts import refuses

HORIZON, N = 4, 3
NORMS = [1, 2, np.inf]
METRICS = [
    *(
        cls(norm, components)
        for cls in (FinalState, WholeTrajectory, MeanDeviation, MaximumDeviation)
        for norm in NORMS
        for components in (None, (0, 2))
    ),
    WholeTrajectory(2, per_step=True),
    FinalState(2, weights=[1, 0, 3], scales=[0.1, 2, 5]),
    WholeTrajectory(1, (0, 2), scales=[0.1, 2]),
    FinalState(2, angles=[0, 2], weights=[1, 2, 3]),
    MeanDeviation(1, angles=[1]),
    MaximumDeviation(np.inf, (1, 0), angles=[0], scales=[3, 1]),
    AtTimes(2, times=[0.0, 0.21, 0.4]),
    AtTimes(np.inf, (1,), times=[0.3]),
    AtCrossing(2, state=1, level=0.1),
    AtCrossing(1, (0, 2), state=0, direction="up", crossings=2, scales=[1, 2]),
    AtCrossing(2, state=2, angles=[2], crossings=2),
    CrossingTime(1, 0.1, "down"),
    CrossingTime(1, 0.1, angle=True),
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
    (MaximumDeviation, lambda M, S, p: max(norm(S[t] - M[t], p) for t in range(HORIZON + 1))),
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
@pytest.mark.parametrize(("make", "formula"), FORMULAS[:4])
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
@settings(max_examples=5)
@given(STATES, STATES, STATES)
def test_a_distance_of_trajectories_is_a_metric(
    distance: Distance, a: np.ndarray, b: np.ndarray, c: np.ndarray
) -> None:
    def d(x: np.ndarray, y: np.ndarray) -> float:
        return float(distance(trajectory(x), trajectory(y), task()))

    assert d(a, b) >= 0
    assert d(a, a) == 0
    assert d(a, b) == d(b, a)
    rounding = 1e-12 if getattr(distance, "angles", ()) or isinstance(distance, AtCrossing) else 0
    assert d(a, c) <= (d(a, b) + d(b, c)) * (1 + 1e-12) + rounding * (1 + np.abs([a, b, c]).max())


@pytest.mark.parametrize("distance", [each for each in METRICS if getattr(each, "monotone", False)])
@given(states=STATES, others=STATES)
@settings(max_examples=8, deadline=None)
def test_no_further_deviation_makes_a_monotone_distance_smaller(
    distance: Distance, states: np.ndarray, others: np.ndarray
) -> None:
    values = [
        float(distance(trajectory(others), trajectory(np.concatenate([states[:k], others[k:]])), task()))
        for k in range(1, HORIZON + 2)
    ]
    assert all(after >= before * (1 - 1e-12) for before, after in pairwise(values))


def test_the_goal_error_depends_on_the_system_alone() -> None:
    (M, S), (other, _) = pair(), pair(seed=5)
    first, second = (GoalError()(trajectory(model), trajectory(S), task()) for model in (M, other))
    assert first == second > 0
    reached = S.copy()
    reached[-1] = task().goal
    assert GoalError()(trajectory(M), trajectory(reached), task()) == 0


@pytest.mark.parametrize("cls", [FinalState, WholeTrajectory, MeanDeviation, MaximumDeviation, GoalError])
@pytest.mark.parametrize("order", [0, 3, np.nan])
def test_another_norm_is_refused_by_value(cls: type, order: float) -> None:
    with refuses(InputError, "norm", 1, order):
        cls(norm=order)


@pytest.mark.parametrize("distance", [*METRICS, RelativeDeviation(least=[1, 1, 1])])
def test_the_ready_made_distances_are_distances(distance: object) -> None:
    assert isinstance(distance, Distance)


WEIGHTED: list[Callable[..., StateNorm]] = [
    FinalState,
    GoalError,
    WholeTrajectory,
    MeanDeviation,
    MaximumDeviation,
    lambda *args, **options: AtTimes(*args, times=[0.1, 0.3], **options),
    lambda *args, **options: AtCrossing(*args, state=0, level=0.2, **options),
    lambda *args, **options: RelativeDeviation(*args, least=[0.1, 0.1, 0.1], **options),
]


@pytest.mark.parametrize("make", WEIGHTED)
@given(
    STATES,
    STATES,
    st.sampled_from(NORMS),
    arrays(np.float64, N, elements=st.floats(1e-3, 1e3)),
    st.floats(1e-3, 1e3),
)
def test_scales_are_reciprocal_weights_and_the_distance_is_homogeneous_in_them(
    make: Callable[..., Distance], a: np.ndarray, b: np.ndarray, order: float, weights: np.ndarray, factor: float
) -> None:
    M, S = trajectory(a), trajectory(b)
    d = make(order, weights=weights)(M, S, task())
    assert make(order, scales=1 / weights)(M, S, task()) == pytest.approx(d, rel=1e-12)
    assert make(order, weights=factor * weights)(M, S, task()) == pytest.approx(factor * d, rel=1e-12)
    assert make(order, weights=weights, scales=np.full(N, factor))(M, S, task()) == pytest.approx(d / factor, rel=1e-12)


@pytest.mark.parametrize("make", WEIGHTED[:6])
@given(STATES, STATES, st.sampled_from(NORMS), arrays(np.float64, N, elements=st.floats(1e-3, 1e3)))
def test_with_scales_the_distance_does_not_depend_on_the_units_of_the_states(
    make: Callable[..., Distance], a: np.ndarray, b: np.ndarray, order: float, factors: np.ndarray
) -> None:
    goal = np.array([1.0, -2.0, 0.5])
    d = make(order, scales=[0.1, 2.0, 5.0])(trajectory(a), trajectory(b), task(goal))
    converted = make(order, scales=factors * [0.1, 2.0, 5.0])
    assert converted(trajectory(a * factors), trajectory(b * factors), task(goal * factors)) == pytest.approx(
        d, rel=1e-9, abs=1e-9
    )


@given(STATES, STATES, arrays(np.int64, N, elements=st.integers(-3, 3)), st.sampled_from(NORMS))
def test_an_angle_is_the_same_after_any_number_of_turns(
    a: np.ndarray, b: np.ndarray, turns: np.ndarray, order: float
) -> None:
    a, b = a / 100, b / 100
    for make in (FinalState, WholeTrajectory, MeanDeviation, MaximumDeviation, GoalError):
        distance = make(order, angles=[0, 1, 2])
        d = distance(trajectory(a), trajectory(b), task())
        assert distance(trajectory(a), trajectory(b + 2 * np.pi * turns), task()) == pytest.approx(d, abs=1e-12)
        assert d <= make(order)(trajectory(a), trajectory(b), task()) * (1 + 1e-12)


def test_a_difference_of_angles_is_the_angle_between_two_directions() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-20, 20, (2, 50, HORIZON + 1, N))
    d = FinalState(angles=[1], components=[1])(trajectory(a), trajectory(b), task())
    cosines = np.cos(a[:, -1, 1]) * np.cos(b[:, -1, 1]) + np.sin(a[:, -1, 1]) * np.sin(b[:, -1, 1])
    np.testing.assert_allclose(d, np.arccos(np.clip(cosines, -1, 1)), atol=1e-7)
    start, end = trajectory(np.full((HORIZON + 1, N), np.pi - 0.1)), trajectory(np.full((HORIZON + 1, N), -np.pi + 0.1))
    assert FinalState(components=[0], angles=[0])(start, end, task()) == pytest.approx(0.2, rel=1e-12)


def test_the_distance_at_times_takes_the_nearest_steps() -> None:
    M, S = pair()
    d = AtTimes(2, times=[0.1, 0.29])(trajectory(M), trajectory(S), task())
    assert d == pytest.approx(max(norm(S[t] - M[t], 2) for t in (1, 3)), rel=1e-14)
    with refuses(InputError, "times", 0.4, 0.5):
        AtTimes(times=[0.1, 0.5])(trajectory(M), trajectory(S), task())


def ramp(speed: float, start: float = 0.0) -> Trajectory:
    """Return a state that moves at constant speed, the other states being its square root and a constant."""
    position = start + speed * np.arange(HORIZON + 1)
    return trajectory(np.stack([position, 10 * position, np.full(HORIZON + 1, 2.0)], axis=-1))


def test_a_crossing_is_interpolated_between_the_samples() -> None:
    M, S = ramp(0.4), ramp(0.5)
    assert CrossingTime(0, 0.9)(M, S, task()) == pytest.approx(0.1 * (0.9 / 0.4 - 0.9 / 0.5), rel=1e-12)
    # At the level, both have the same states, although at different times.
    assert AtCrossing(2, state=0, level=0.9)(M, S, task()) == pytest.approx(0, abs=1e-12)
    assert AtCrossing(2, (1,), state=0, level=0.9)(M, ramp(0.5, -3.0), task()) == pytest.approx(9.0 + 10, rel=1e-12)


def test_a_trajectory_that_does_not_cross_is_compared_at_its_end() -> None:
    M, S = ramp(0.4), ramp(0.1)
    assert CrossingTime(0, 1.0)(M, S, task()) == pytest.approx(0.1 * (4 - 2.5), rel=1e-12)
    assert AtCrossing(1, (0,), state=0, level=1.0)(M, S, task()) == pytest.approx(1.0 - 0.4, rel=1e-12)
    assert CrossingTime(0, 1.0, "down")(M, S, task()) == 0


def test_only_crossings_in_the_direction_count() -> None:
    states = np.zeros((HORIZON + 1, N))
    states[:, 0] = [-1, 1, -1, 1, -1]
    M, S = trajectory(np.zeros_like(states)), trajectory(states)
    assert CrossingTime(0, 0.0, "up")(M, S, task()) == pytest.approx(0.4 - 0.05, rel=1e-12)
    assert CrossingTime(0, 0.0, "down")(M, S, task()) == pytest.approx(0.4 - 0.15, rel=1e-12)
    third = AtCrossing(1, (0,), state=0, level=0.5, direction="up", crossings=3)
    assert third(M, S, task()) == pytest.approx(1.0, rel=1e-12)  # the third one is missing: the final state


def test_an_angle_crosses_a_level_on_the_circle_and_not_its_opposite_point() -> None:
    turning = np.zeros((HORIZON + 1, N))
    turning[:, 0] = [2.9, 3.1, -3.05, -2.8, -2.5]  # it passes pi between the steps 1 and 2
    still = np.full((HORIZON + 1, N), 2.9)
    M, S = trajectory(still), trajectory(turning)
    assert CrossingTime(0, 0.0, angle=True)(M, S, task()) == 0
    assert CrossingTime(0, np.pi, "up", angle=True)(M, S, task()) == pytest.approx(
        0.1 * (4 - 1 - (np.pi - 3.1) / (2 * np.pi - 6.15)), rel=1e-12
    )


def test_the_relative_deviation_divides_by_the_motion_of_the_model() -> None:
    M, S = pair()
    gap = np.abs(S - M) / np.maximum(np.ptp(M, axis=0), [0.1, 0.1, 50])
    d = RelativeDeviation(least=[0.1, 0.1, 50])(trajectory(M), trajectory(S), task())
    assert d == pytest.approx(gap.max(), rel=1e-14)
    assert RelativeDeviation(least=[1e-9] * 3)(trajectory(1e3 * M), trajectory(1e3 * S), task()) == pytest.approx(
        RelativeDeviation(least=[1e-9] * 3)(trajectory(M), trajectory(S), task()), rel=1e-12
    )
    resting = trajectory(np.zeros((HORIZON + 1, N)))
    moving = trajectory(np.full((HORIZON + 1, N), 0.2))
    assert RelativeDeviation(least=[0.1] * 3)(resting, moving, task()) == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("make", "error", "facts"),
    [
        (lambda: FinalState(weights=[1, -1]), InputError, ("weights", 0)),
        (lambda: FinalState(weights=[0, 0]), InputError, ("weights", 0)),
        (lambda: FinalState(scales=[1, 0]), InputError, ("scales", [1, 0])),
        (lambda: FinalState(scales=[np.nan]), InputError, ("scales",)),
        (lambda: FinalState(scales=2.0), InputError, ("scales", 2.0)),
        (lambda: FinalState(2, (0, 1), weights=[1]), ShapeError, (2, "weights")),
        (
            lambda: FinalState(angles=[0.5]),
            InputError,
            ([0.5], "angles"),
        ),
        (lambda: AtTimes(), ShapeError, ("times", ())),
        (lambda: RelativeDeviation(), ShapeError, ("least", ())),
        (lambda: FinalState(components=[]), InputError, ("components",)),
        (lambda: AtCrossing(crossings=0), InputError, ("crossings", 0)),
        (lambda: AtCrossing(level=np.inf), InputError, ("level",)),
        (lambda: CrossingTime(direction="upp"), UnknownNameError, ("up", "direction")),
    ],
)
def test_arguments_that_cannot_be_used_are_refused(
    make: Callable[[], object], error: type[Exception], facts: tuple[object, ...]
) -> None:
    with refuses(error, *facts):
        make()


@pytest.mark.parametrize(
    ("distance", "facts"),
    [
        (FinalState(weights=[1, 2]), (3, 2)),
        (FinalState(angles=[3]), ("angles", 3, 0)),
        (FinalState(components=[-4]), ("components", 3, 0)),
        (CrossingTime(state=5), ("state", 3)),
    ],
)
def test_indices_and_numbers_that_do_not_fit_the_states_are_refused(
    distance: Distance, facts: tuple[object, ...]
) -> None:
    M, S = (trajectory(states) for states in pair())
    with refuses(ShapeError, *facts):
        distance(M, S, task())


def test_a_description_names_only_what_changes_the_distance() -> None:
    plain = describe(FinalState(norm=1))
    assert plain == {"type": "FinalState", "norm": 1, "components": None}
    assert describe(FinalState(norm=1, weights=(1, 1), scales=(1.0, 1.0))) == plain
    assert describe(FinalState(norm=1, weights=[1, 2])) == plain | {"factors": [1.0, 2.0]}
    assert describe(FinalState(norm=1, scales=[1, 0.5])) == plain | {"factors": [1.0, 2.0]}
    assert describe(FinalState(norm=1, angles=[0])) == plain | {"angles": [0]}


@pytest.mark.parametrize(
    ("distance", "added"),
    [
        (FinalState(), ("m", "rad")),
        (MaximumDeviation(np.inf), ("m", "rad")),
        (FinalState(components=(0, 2)), ("m",)),
        (FinalState(components=(0, -2)), ("m", "rad")),
        (FinalState(weights=[1, 1, 1]), ()),
        (FinalState(scales=[1, 1, 1]), ()),
        (RelativeDeviation(least=[1, 1, 1]), ()),
    ],
)
def test_a_distance_knows_which_units_it_adds(distance: StateNorm, added: tuple[str, ...]) -> None:
    assert distance.added_units(["m", "rad", ""]) == added


def test_a_tracking_error_is_that_between_s_and_its_reference() -> None:
    reference = np.arange(5.0)[:, None] * np.array([1.0, 0.0, 0.0])
    along = Task([0.0] * N, reference=reference, horizon=HORIZON, dt=0.1)
    system = trajectory(reference + np.array([[9.0], [0.0], [3.0], [-1.0], [0.0]]) * np.array([0, 1, 0]))
    elsewhere = trajectory(np.full((HORIZON + 1, N), 100.0))
    assert TrackingError()(elsewhere, system, along) == 3.0
    assert TrackingError(1, over="mean")(elsewhere, system, along) == 1.0
    assert TrackingError(2, (1,), scales=[0.5])(elsewhere, system, along) == 6.0
    with refuses(UnknownNameError, "maximum", "over"):
        TrackingError(over="maximun")  # type: ignore[arg-type]
