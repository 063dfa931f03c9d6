from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import Task, TaskSpace, Trajectory, Transitions, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval.core.coverage import StateInputCoverage
from ctxval.learning.closed_loops import LoopPlanner, Loops
from ctxval.learning.coverage import (
    away_from_executions,
    largest_pocket,
    position_states,
    unsampled_corner,
)
from ctxval.learning.coverage import coverage as coverage_of
from ctxval.learning.dynamics_posterior import DynamicsPosterior, PosteriorSettings, learn_posterior

TASKS = np.random.default_rng(3).random((9, 2))


def make_planner(states: int = 2, horizon: int = 15) -> LoopPlanner:
    A = 0.9 * np.eye(states) + 0.05 * np.eye(states, k=1)
    return LoopPlanner(
        Validation(
            space=TaskSpace(start=([-2.0, -1.0], [2.0, 1.0])),
            task=lambda p: Task([p.start[..., 0], p.start[..., 1], *[1.0] * (states - 2)], horizon=horizon, dt=0.1),
            system=systems.Simulated(lambda x, u: x, vectorized=True),
            model=models.Linear(A, np.full((states, 1), 0.1)),
            synthesizer=controllers.LQR([1.0] * states, [0.1]),
            distance=distances.MeanDeviation(),
        )
    )


def learn(planner: LoopPlanner, x: Array, u: Array) -> DynamicsPosterior:
    x_next = planner.validation.model.step(x, u) + 0.02 * np.sin(x)
    settings = PosteriorSettings(hyperparameters=2, functions=1)
    sources = np.zeros(len(x), dtype=np.intp)
    found = learn_posterior(planner.validation.model, Transitions(x, u, x_next), sources, settings=settings)
    assert found is not None
    return found


def coverage(planner: LoopPlanner, posterior: DynamicsPosterior, tasks: Array) -> StateInputCoverage:
    planned = planner.plan(tasks)
    labels = [f"z{i}" for i in range(posterior.data.pairs.shape[1])]
    return coverage_of(posterior, tasks, planned, planner.run(posterior.mean, planned), labels)


def visited(planner: LoopPlanner, posterior: DynamicsPosterior) -> Array:
    """Return the pairs ``(q, H, k)`` of the mean's closed loops, in the system's units."""
    (loops,) = planner.run(posterior.mean, planner.plan(TASKS))
    return np.concatenate([loops.states[0, :, :-1], loops.inputs[0]], axis=-1)


def nearest(recorded: Array, there: Array) -> Array:
    """Return, for each row of ``there``, the distance to the nearest recorded row in the largest coordinate."""
    return np.asarray(np.abs(there[:, None] - recorded[None]).max(axis=-1).min(axis=1))


@pytest.mark.parametrize("reach", [0.3, 1.0, 3.0])
def test_gaps_are_those_of_all_pairs_compared(reach: float) -> None:
    rng, planner = np.random.default_rng(1), make_planner()
    x, u = reach * rng.normal(size=(20, 2)), reach * rng.normal(size=(20, 1))
    posterior = learn(planner, x, u)
    there = visited(planner, posterior)
    width = np.diff(np.quantile(there, [1e-3, 1 - 1e-3], axis=(0, 1)), axis=0)[0]
    recorded, flat = np.concatenate([x, u], axis=1) / width, (there / width).reshape(-1, 3)
    marginal = np.stack([nearest(recorded[:, [i]], flat[:, [i]]) for i in range(3)], axis=1)
    paired = np.max([nearest(recorded[:, [i, j]], flat[:, [i, j]]) for i, j in combinations(range(3), 2)], axis=0)
    beyond = np.maximum(np.maximum(flat - recorded.max(axis=0), recorded.min(axis=0) - flat), 0.0)
    found = coverage(planner, posterior, TASKS)
    assert found.marginal.size == pytest.approx(marginal.max(), rel=1e-6)
    assert found.beyond.size == pytest.approx(beyond.max(), rel=1e-6)
    assert found.pair is not None
    assert found.pair.size == pytest.approx(paired.max(), rel=1e-6)
    for gap, of in ((found.marginal, marginal), (found.beyond, beyond)):
        assert gap.coordinates == (f"z{np.unravel_index(of.argmax(), of.shape)[1]}",)
        np.testing.assert_allclose(list(gap.place.values()), there.reshape(-1, 3)[of.max(axis=1).argmax()], rtol=1e-6)
    np.testing.assert_allclose(list(found.resolution.values()), marginal.max(axis=0) * width, rtol=1e-6)
    of_gaps = (marginal.max(axis=1) + 0.3 * paired).reshape(there.shape[:2]).max(axis=1)
    of_range = 10 * beyond.max(axis=1).reshape(there.shape[:2]).max(axis=1)
    np.testing.assert_array_equal(found.task, TASKS[(of_gaps + of_range).argmax()])
    assert found.tasks == len(TASKS)


def test_what_is_recorded_on_the_same_loops_leaves_no_gap() -> None:
    planner = make_planner()
    first = learn(planner, *np.split(np.random.default_rng(0).normal(size=(20, 3)), [2], axis=1))
    there = visited(planner, first).reshape(-1, 3)
    # The residual is that of the first posterior's mean, so that its loops are visited again.
    x, u = there[:, :2], there[:, 2:]
    again = learn(planner, x, u)
    found = coverage(planner, again, TASKS)
    assert found.marginal.size < 0.05
    assert found.pair is not None
    assert found.pair.size < 0.05


def test_an_input_that_was_never_used_is_named() -> None:
    rng, planner = np.random.default_rng(1), make_planner()
    x = np.stack(np.meshgrid(np.linspace(-3, 3, 12), np.linspace(-2, 2, 12)), axis=-1).reshape(-1, 2)
    posterior = learn(planner, x + 1e-3 * rng.normal(size=x.shape), 1e-3 * rng.normal(size=(144, 1)))
    found = coverage(planner, posterior, TASKS)
    assert found.marginal.coordinates == ("z2",)
    assert found.resolution["z2"] == pytest.approx(abs(found.marginal.place["z2"]), abs=0.01)


def test_with_many_coordinates_pairs_are_not_compared() -> None:
    planner = make_planner(6)
    rng = np.random.default_rng(0)
    posterior = learn(planner, rng.normal(size=(30, 6)), rng.normal(size=(30, 1)))
    found = coverage(planner, posterior, TASKS)
    assert found.pair is None
    assert found.marginal.size > 0


def test_of_long_loops_steps_from_start_to_end_are_compared() -> None:
    planner = make_planner(horizon=200)
    rng = np.random.default_rng(0)
    posterior = learn(planner, 0.01 * rng.normal(size=(30, 2)), 0.01 * rng.normal(size=(30, 1)))
    starts = planner.validation.space.from_unit(TASKS)
    # Only the starts are far from what is recorded near the origin.
    found = coverage(planner, posterior, TASKS)
    there = found.marginal.place["z0"], found.marginal.place["z1"]
    assert np.abs(starts - there).max(axis=1).min() < 1e-9 or found.marginal.coordinates == ("z2",)


def test_one_recorded_coordinate_that_never_changes_is_allowed() -> None:
    rng, planner = np.random.default_rng(1), make_planner()
    posterior = learn(planner, rng.normal(size=(20, 2)), np.zeros((20, 1)))
    assert np.isfinite(coverage(planner, posterior, TASKS).marginal.size)


def test_tasks_that_cannot_be_planned_are_not_counted() -> None:
    class Right:
        batched = True

        def design(self, task: Task, model: models.Model) -> controllers.Controller:  # type: ignore[name-defined]
            if (task.initial_state[..., 0] > 0).any():
                raise ValueError("not here")
            return controllers.LQR([1.0, 1.0], [0.1]).design(task, model)

    planner = make_planner()
    posterior = learn(planner, *np.split(np.random.default_rng(0).normal(size=(20, 3)), [2], axis=1))
    planner.validation.synthesizer = Right()
    left = TASKS[:, 0] < 0.5
    found = coverage(planner, posterior, TASKS)
    assert found.tasks == left.sum()
    assert (found.task == TASKS[left]).all(axis=1).any()


# Pockets


def trajectory(*states: list[float]) -> Trajectory:
    times = np.linspace(0.0, 1.0, len(states))
    return Trajectory(times, np.array(states), np.zeros((len(states) - 1, 1)))


def test_the_largest_pocket_of_a_plane_is_a_circle_around_a_place_that_loops_visit() -> None:
    rng = np.random.default_rng(4)
    visited = np.column_stack([rng.uniform([-1, -0.5], [1, 0.5], (3000, 2)), 0.1 * rng.normal(size=(3000, 2))])
    around = [[-1.0, -0.5, 0, 0], [1.0, -0.5, 0, 0], [1.0, 0.5, 0, 0], [-1.0, 0.5, 0, 0], [-1.0, -0.5, 0, 0]]
    found = largest_pocket(visited, [trajectory(*around)], ["x [m]", "y [m]", "vx [m/s]", "vy [m/s]"])
    assert found is not None
    assert list(found.place) == ["x [m]", "y [m]"]
    assert found.within["x [m]"] == found.within["y [m]"]
    assert found.within["x [m]"] == pytest.approx(0.5, abs=0.03)  # half of the shorter side
    assert abs(found.place["y [m]"]) < 0.02
    assert (visited[:, :2] == list(found.place.values())).all(axis=1).any()


@given(st.integers(0, 2**32 - 1), st.sampled_from([["m"] * 3, ["", "", ""], ["m", "rad", "m/s"], ["m/s", "m/s", "m"]]))
def test_no_execution_came_nearer_to_a_pocket(seed: int, units: list[str]) -> None:
    rng = np.random.default_rng(seed)
    visited = rng.normal(size=(500, 3)) * [1, 20, 300]
    executed = [trajectory(*(rng.normal(size=(6, 3)) * [1, 20, 300]).tolist()) for _ in range(3)]
    labels = [f"x{i} [{unit}]" if unit else f"x{i}" for i, unit in enumerate(units)]
    found = largest_pocket(visited, executed, labels)
    assert found is not None
    place, within = (np.array(list(of.values())) for of in (found.place, found.within))
    recorded = np.concatenate([each.states for each in executed])[:, [labels.index(label) for label in found.place]]
    nearest = np.sqrt((((recorded - place) / within) ** 2).sum(axis=1)).min()
    assert nearest >= 1 - 1e-9
    assert nearest <= 20
    assert (within > 0).all()


def test_the_next_task_leaves_the_smallest_pocket_and_the_other_leads_into_it() -> None:
    """Runs are lines in a square; one was executed at its lower end."""
    heights = np.linspace(-1, 1, 21)
    lines = [np.column_stack([np.linspace(-1, 1, 41), np.full(41, height)]) for height in heights]
    visited, of_task = np.concatenate(lines), np.repeat(np.arange(21), 41)
    tasks = (heights[:, None] + 1) / 2
    executed = [trajectory([-1.0, -0.9], [1.0, -0.9])]
    found = largest_pocket(visited, executed, ["x", "y"], [[0, 1]], of_task, tasks)
    assert found is not None
    best, inside = (2 * task[0] - 1 for task in found.tasks)
    assert inside == pytest.approx(found.place["y"])
    assert 0.2 <= best <= 0.8  # between the executed line and the farthest one
    assert largest_pocket(visited, executed, ["x", "y"]) is not None
    assert largest_pocket(visited, executed, ["x", "y"], [], of_task, tasks).tasks == ()  # type: ignore[union-attr]


def test_coordinates_of_a_position_are_states_that_begin_at_it_or_have_it_as_goal() -> None:
    validation = Validation(
        space=TaskSpace(goal=([-1.0, -1.0], [1.0, 1.0], "m"), start=([-1.0, -1.0], [0.0, 1.0], "m"), load=(1, 2, "kg")),
        task=lambda p: Task(
            np.stack([0 * p.load, p.start[..., 1], p.start[..., 0], 0 * p.load], axis=-1),
            goal=np.stack([0 * p.load, 0 * p.load, p.goal[..., 0], p.goal[..., 1]], axis=-1), horizon=5, dt=0.1,
        ),
        system=systems.Simulated(lambda x, u: x, vectorized=True),
        model=models.Linear(0.9 * np.eye(4), np.full((4, 1), 0.1)),
        synthesizer=controllers.LQR([1.0] * 4, [0.1]),
        distance=distances.MeanDeviation(),
    )  # fmt: skip
    points = np.random.default_rng(0).random((5, 5))
    planned = LoopPlanner(validation).plan(points)
    unknown = ["x[0]", "x[1]", "x[2]", "x[3]"]
    assert position_states(validation.space, unknown, planned, points) == [[2, 3], [2, 1]]
    assert position_states(validation.space, unknown, planned, points, goals=False) == [[2, 1]]


def test_coordinates_of_a_position_may_have_another_unit_origin_and_direction() -> None:
    validation = make_planner(states=4).validation.with_parts(
        space=TaskSpace(start=([-500.0, -500.0], [500.0, 500.0], "mm"), height=(0, 1, "m")),
        task=lambda p: Task(
            np.stack([0 * p.height, p.height, 0.3 - p.start[..., 1] / 1000, p.start[..., 0] / 1000], axis=-1),
            horizon=5, dt=0.1,
        ),
    )  # fmt: skip
    points = np.random.default_rng(0).random((5, 3))
    planned = LoopPlanner(validation).plan(points)
    assert position_states(validation.space, ["x[0]", "x[1]", "x[2]", "x[3]"], planned, points) == [[3, 2]]


@pytest.mark.parametrize(
    ("labels", "expected"),
    [
        (["x [m]", "y [m]", "vx [m/s]", "vy [m/s]"], [[0, 1]]),
        (["east [km]", "north [km]", "vx [m/s]", "vy [m/s]"], [[0, 1]]),
        (["tool_x", "tool_y", "rate_1", "rate_2"], [[0, 1]]),
        (["vx", "vy", "x", "y"], []),
        (["x[0]", "x[1]", "x[2]", "x[3]"], []),
        (["q1 [rad]", "q2 [rad]", "w1 [rad/s]", "w2 [rad/s]"], []),
        (["x [m]", "z [m]", "vx [m/s]", "vz [m/s]"], []),
        (["vx [m/s]", "vy [m/s]", "x [m]", "y [m]"], []),  # where runs end does not vary in these
    ],
)
def test_goals_by_radius_and_angle_are_places_if_labels_of_states_say_so(
    labels: list[str], expected: list[list[int]]
) -> None:
    validation = make_planner(states=4).validation.with_parts(
        space=TaskSpace(radius=(0.4, 1, "m"), angle=(0, 6, "rad")),
        task=lambda p: Task(
            np.zeros((*np.shape(p.angle), 4)),
            goal=np.stack([p.radius * np.cos(p.angle), p.radius * np.sin(p.angle), 0 * p.angle, 0 * p.angle], axis=-1),
            horizon=5, dt=0.1,
        ),
    )  # fmt: skip
    points = np.random.default_rng(0).random((9, 2))
    planned = LoopPlanner(validation).plan(points)
    assert position_states(validation.space, labels, planned, points) == expected
    assert position_states(validation.space, labels, planned, points, goals=False) == []


def test_loops_are_as_far_from_executions_as_their_farthest_place() -> None:
    """All places of the pool's loops lie on the line from 0 to 1, of which an execution entered the lower half."""
    line = np.stack([np.linspace(0, 1, 201), np.zeros(201)], axis=-1)
    states = np.stack([line[:101:5], line[100:201:5], np.full((21, 2), np.nan)])[None]
    pool = Loops(np.zeros((1, 1)), line[None, None], np.zeros((1, 1, 200, 1)))
    loops = Loops(np.zeros((1, 3)), states, np.zeros((1, 3, 20, 1)))
    executed = [trajectory([0.0, 0.0], [0.5, 0.0])]
    (away,) = away_from_executions(executed, [[0, 1]], [pool], [loops])
    np.testing.assert_allclose(away[:2], [0, 0.5], atol=0.07)
    assert away[2] > 100  # nothing is known of a loop that diverges
    (none,) = away_from_executions(executed, [], [pool], [loops])
    np.testing.assert_array_equal(none, 0)


def test_two_states_on_one_line_are_no_place() -> None:
    validation = make_planner(states=2).validation.with_parts(
        space=TaskSpace(along=(-1, 1)),
        task=lambda p: Task(np.stack([p.along, 2 * p.along], axis=-1), horizon=5, dt=0.1),
    )
    points = np.random.default_rng(0).random((9, 1))
    planned = LoopPlanner(validation).plan(points)
    assert position_states(validation.space, ["x [m]", "y [m]"], planned, points) == []


def test_where_an_execution_moves_in_one_step_there_is_no_pocket() -> None:
    visited = np.column_stack([np.linspace(-1, 1, 400), np.zeros(400)])
    found = largest_pocket(visited, [trajectory([-1.0, 0.0], [1.0, 0.0])], ["x [m]", "y [m]"])
    assert found is not None
    assert found.size < 0.2


def test_one_state_has_no_pocket_and_neither_has_what_was_not_executed() -> None:
    assert largest_pocket(np.zeros((9, 1)), [trajectory([0.0], [1.0])], ["x [m]"]) is None
    assert largest_pocket(np.zeros((9, 2)), [], ["x [m]", "y [m]"]) is None


@pytest.mark.parametrize("components", [2, 3])
def test_four_tasks_try_the_corners_of_all_positions(components: int) -> None:
    """Of positions with three components, they try all corners of each pair: an orthogonal array of strength two."""
    low, high = [-1.0] * components, [2.0] * components
    space = TaskSpace(load=(0, 1, "kg"), start=(low, high, "m"), goal=(low, high, "m"))
    executed = 0.3 + 0.4 * np.random.default_rng(components).random((2, space.dimension))
    while (corner := unsampled_corner(executed, space, np.full(space.dimension, 0.4))) is not None:
        assert corner.gap >= 0.3
        assert set(corner.place.values()) <= {-1.0, 2.0}
        assert corner.task[0] == 0.4
        assert set(corner.task[1:].tolist()) <= {0.0, 1.0}
        executed = np.concatenate([executed, corner.task[None]])
    assert len(executed) == 6
    for i, j in (pair for at in space.positions for pair in combinations(range(at.start, at.stop), 2)):
        assert {(row[i], row[j]) for row in executed[2:]} == {(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)}


def test_before_the_first_execution_every_corner_is_untried() -> None:
    corner = unsampled_corner(np.empty((0, 2)), TaskSpace(goal=([0, 0], [1, 1], "m")), np.array([0.4, 0.6]))
    assert corner is not None
    assert corner.gap == 1


def test_without_a_position_no_corner_is_asked_for() -> None:
    assert unsampled_corner(TASKS, TaskSpace(angles=([0, 0], [1, 1], "rad")), TASKS[0]) is None
