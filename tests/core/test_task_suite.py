"""Suites of named tasks in the place of a box."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import Task, TaskSpace, TaskSuite, Validation, controllers, distances, models, systems
from ctxval.core.exchange import read_task, write_task
from ctxval.errors import InputError, UnknownNameError
from facts import refuses

LIFTS = {
    "slow lift": {"speed": 0.2, "path": "lift"},
    "fast lift": {"speed": 1.0, "path": "lift"},
    "fast turn": {"speed": 1.0, "path": "turn"},
}
SUITE = TaskSuite(LIFTS, {"speed": "m/s"})

suites = st.lists(st.tuples(st.integers(0, 5), st.integers(-3, 3)), min_size=2, max_size=12, unique=True).filter(
    lambda rows: len({row[0] for row in rows}) > 1 and len({row[1] for row in rows}) > 1
)


def of_rows(rows: list[tuple[int, int]]) -> TaskSuite:
    return TaskSuite({f"task {k}": {"kind": f"kind {a}", "size": 0.1 * b} for k, (a, b) in enumerate(rows)})


@given(suites, st.integers(0, 2**32 - 1))
def test_every_point_of_the_cube_stands_for_a_task(rows: list[tuple[int, int]], seed: int) -> None:
    suite = of_rows(rows)
    unit = np.random.default_rng(seed).random((7, 2))
    members = {row.tobytes() for row in suite.members}
    assert all(row.tobytes() in members for row in suite.rounded(unit))
    assert np.array_equal(suite.from_unit(suite.rounded(unit)), suite.from_unit(unit))
    assert np.array_equal(suite.to_unit(suite.from_unit(unit)), suite.rounded(unit))
    assert all(row.tobytes() in members for row in suite.unit_draws(5, np.random.default_rng(seed)))


def test_a_search_may_choose_the_members_of_a_suite_and_any_point_of_a_box() -> None:
    points = np.random.default_rng(0).random((3, SUITE.dimension))
    box = TaskSpace(**dict.fromkeys(SUITE.names, (0.0, 1.0)))
    np.testing.assert_array_equal(SUITE.candidates(points), SUITE.members)
    np.testing.assert_array_equal(box.candidates(points), points)
    rng = np.random.default_rng(0)
    assert box.examples(4, rng).shape == (7, SUITE.dimension)
    assert {tuple(row) for row in SUITE.examples(100, rng)} == {tuple(row) for row in SUITE.from_unit(SUITE.members)}
    assert SUITE.near(0.02) < box.near(0.02) == 0.02


@given(suites, st.data())
def test_executed_and_remaining_tasks_are_all_tasks(rows: list[tuple[int, int]], data: st.DataObject) -> None:
    suite = of_rows(rows)
    known = data.draw(st.lists(st.integers(0, len(suite) - 1), unique=True))
    left = suite.remaining(suite.members[known])
    assert sorted([*known, *suite.rows_at(left).tolist()]) == list(range(len(suite)))


@given(suites)
def test_a_suite_is_read_from_its_description_and_its_tasks_by_their_names(rows: list[tuple[int, int]]) -> None:
    suite = of_rows(rows)
    again = TaskSuite.described(suite.describe())
    assert again.describe() == suite.describe()
    assert np.array_equal(again.members, suite.members)
    for name, point in zip(suite.task_names, suite.grid(3), strict=True):
        assert suite.describe_point(point) == {"task": name}
        assert np.array_equal(suite.point({"task": name}), point)


def test_a_task_function_gets_numbers_and_texts() -> None:
    one, all_ = SUITE.parameters(SUITE.point({"task": "fast turn"})), SUITE.parameters(SUITE.grid(2))
    assert (one.path, float(one.speed), one.task) == ("turn", 1.0, "fast turn")
    assert all_.path.tolist() == ["lift", "lift", "turn"]
    assert all_.task.tolist() == list(SUITE.task_names)
    assert SUITE["slow lift"] == LIFTS["slow lift"]
    assert SUITE.labels == ("speed [m/s]", "path")


def test_names_alone_are_a_category() -> None:
    suite = TaskSuite(["a", "b", "c"])
    assert suite.names == ("task",)
    assert suite.parameters(suite.grid(2)).task.tolist() == ["a", "b", "c"]


def validation() -> Validation:
    return Validation(
        space=SUITE,
        task=lambda p: Task(np.stack([0 * p.speed] * 2, -1), goal=[p.speed, 0 * p.speed], horizon=5, dt=0.1),
        system=systems.Simulated(models.Linear([[1, 0.1], [0, 1]], [[0], [0.1]])),
        model=models.Linear([[1, 0.1], [0, 0.9]], [[0], [0.1]]),
        synthesizer=controllers.LQR([1, 1], [1]),
        distance=distances.MaximumDeviation(),
    )


def test_tasks_are_called_by_their_names(tmp_path: Path) -> None:
    given = validation()
    plan = given.plan(SUITE.point({"task": "fast lift"}))
    assert plan.task.name == "fast lift"
    assert "fast lift" in repr(plan.task)
    assert [each.task.name for each in given.plans(SUITE.grid(2))] == list(SUITE.task_names)
    batch = Task.stacked([each.task for each in given.plans(SUITE.grid(2))])
    assert [batch[k].name for k in range(3)] == list(SUITE.task_names) == batch.name.tolist()
    assert batch[1:].name.tolist() == list(SUITE.task_names[1:])
    write_task(tmp_path / "task.json", plan.task)
    assert read_task(tmp_path / "task.json").name == "fast lift"


@pytest.mark.parametrize(
    ("tasks", "units", "facts"),
    [
        ({"a": {"x": 1.0}}, None, ("tasks", "suite")),
        (["a", "a"], None, ("tasks", "suite")),
        ("ab", None, ("tasks", "suite")),
        ({"a": {"x": 1.0}, "b": {"y": 1.0}}, None, ("a", "x", "b")),
        ({"a": {"x": 1.0}, "b": {"x": "one"}}, None, ("tasks", "x")),
        ({"a": {"x": 1.0, "y": 2}, "b": {"x": 2.0, "y": 2}}, None, ("y", 2)),
        ({"a": {"x": 1, "y": 1}, "b": {"x": 2, "y": 2}, "c": {"x": 1, "y": 1}}, None, ("a", "c")),
        ({"a": {"x": float("nan")}, "b": {"x": 1.0}}, None, ("x",)),
        ({"a": {"x": [1, 2]}, "b": {"x": [3, 4]}}, None, ("x", [1, 2])),
        ({"a": {}, "b": {}}, None, ("a",)),
        ({"a": {"task": 1}, "b": {"task": 2}}, None, ("task", "suite")),
        ({"a": {"x": 1.0}, "b": {"x": 2.0}}, {"y": "m"}, ("y", "task")),
    ],
)
def test_what_is_no_suite_is_refused(tasks: Any, units: Any, facts: tuple[object, ...]) -> None:
    with refuses((InputError, UnknownNameError), *facts):
        TaskSuite(tasks, units)


def test_unknown_tasks_and_distributions_are_refused() -> None:
    with refuses(UnknownNameError, "fast turn", "task"):
        SUITE.point({"task": "fast turns"})
    with refuses(UnknownNameError, "x", "task"):
        SUITE["x"]
    with refuses(InputError, "task", "speed"):
        SUITE.point({"speed": 0.2, "path": "lift"})
    with refuses(InputError, "suite"):
        SUITE.distributed()
    with refuses(InputError, "suite"):
        SUITE.sampled(lambda rng, n: rng.random((n, 2)))
