from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctxval import Task, specs
from ctxval.errors import InputError, ShapeError, UnknownNameError
from ctxval.specs import SETS, Ball, Box, Outside, Polytope, Set, Union
from facts import refuses

TASK = Task([0.0, 0.0], horizon=4, dt=0.5, environment={"obstacle": [1.0, -0.5], "drift": [0.5, 0.0]})
TRIANGLE = Polytope(A=[[-1.0, 0.0], [0.0, -2.0], [3.0, 3.0]], b=[0.0, 0.0, 3.0])

FIXED = [
    Ball([0.3, -0.2], radius=0.5),
    Box(low=[-1.0, -0.5], high=[0.5, 2.0]),
    Box(low=[-np.inf, 0.2], high=[np.inf, np.inf]),
    TRIANGLE,
    Union([Ball([1.0, 1.0], radius=0.3), Box(low=[-1, -1], high=[0, 0])]),
    Outside(Box(low=[-1, -1], high=[1, 1])),
]
MOVING = [
    Ball("obstacle", radius=0.5),
    Ball("obstacle", velocity="drift", radius=0.5),
    Box([0.2, 0.1], velocity=[-1.0, 2.0], low=[-0.5, -0.5], high=[0.5, 0.5]),
    Ball(np.linspace([0, 0], [1, 1], 5), radius=0.4),
]
PLACES = arrays(np.float64, (5, 2), elements=st.floats(-3, 3))


def contains(of: Set, x: np.ndarray, t: int) -> bool:
    """Return whether a position is in a set at a step, from the definition of the set."""
    if isinstance(of, Outside):
        return not contains(of.of, x, t)
    if isinstance(of, Union):
        return any(contains(one, x, t) for one in of.sets)
    assert isinstance(of, Ball | Box | Polytope)
    center = TASK.environment[of.center] if isinstance(of.center, str) else np.asarray(of.center)
    center = center[t] if center.ndim == 2 else center
    if of.velocity is not None:
        velocity = TASK.environment[of.velocity] if isinstance(of.velocity, str) else np.asarray(of.velocity)
        center = center + velocity * 0.5 * t
    at = x - center
    if isinstance(of, Ball):
        return bool(at @ at <= of.radius**2)
    if isinstance(of, Box):
        return bool((np.asarray(of.low) <= at).all() and (at <= np.asarray(of.high)).all())
    return bool((np.asarray(of.A) @ at <= np.asarray(of.b)).all())


@pytest.mark.parametrize("of", [*FIXED, *MOVING])
@given(PLACES)
def test_the_sign_says_where_a_position_is(of: Set, positions: np.ndarray) -> None:
    for t, distance in enumerate(of.signed_distance(positions, TASK)):
        if abs(distance) > 1e-9:
            assert (distance < 0) == contains(of, positions[t], t)


@pytest.mark.parametrize("of", [*FIXED, *MOVING])
@given(PLACES, PLACES)
def test_a_signed_distance_changes_by_at_most_the_way(of: Set, positions: np.ndarray, others: np.ndarray) -> None:
    change = np.abs(of.signed_distance(positions, TASK) - of.signed_distance(others, TASK))
    assert (change <= np.linalg.norm(positions - others, axis=1) + 1e-9).all()


@pytest.mark.parametrize("of", FIXED[:5])
@given(PLACES, st.floats(-0.1, 1.0))
def test_a_set_that_grows_contains_all_positions_up_to_that_distance(of: Set, at: np.ndarray, by: float) -> None:
    before, after = of.signed_distance(at, TASK), of.grown(by).signed_distance(at, TASK)
    assert (after <= before - by + 1e-9).all() if by > 0 else (after >= before - by - 1e-9).all()


def test_signed_distances_of_a_box_are_euclidean() -> None:
    box = Box(low=[-1, -1], high=[1, 1])
    positions = np.array([[4.0, 5.0], [0.5, 0.0], [1.0, 3.0], [0.0, 0.0], [-2.0, 0.0]])
    np.testing.assert_allclose(box.signed_distance(positions, TASK), [5.0, -0.5, 2.0, -1.0, 1.0])


def test_a_box_may_lack_ends() -> None:
    for of in (Box(low=[0.0, 1.0]), Box(low=[0.0, 1.0], high=[None, None]), Box(low=[0, 1], high=[np.inf, np.inf])):
        np.testing.assert_array_equal(of.signed_distance(np.array([[2.0, 0.5], [3.0, 3.0]]), TASK), [0.5, -2.0])


def test_batches_of_tasks_have_obstacles_of_their_own() -> None:
    tasks = Task(np.zeros((3, 2)), horizon=4, dt=0.5, environment={"obstacle": [np.array([0.0, 1.0, 2.0]), 0.0]})
    distances = Ball("obstacle", radius=0.5).signed_distance(np.zeros((7, 3, 5, 2)), tasks)
    assert distances.shape == (7, 3, 5)
    np.testing.assert_allclose(distances[4, :, 2], [-0.5, 0.5, 1.5])


def test_what_shrinks_away_is_refused() -> None:
    with refuses(InputError, "radius", 0.5, 0.6):
        Ball([0, 0], radius=0.5).grown(-0.6)
    with refuses(InputError, 0.5):
        Box(low=[0, 0], high=[1, 3]).grown(-0.5)
    with refuses(InputError, 1):
        TRIANGLE.grown(-1.0)
    both = Union([Ball([0, 0], radius=0.5), Ball([3, 0], radius=2.0)])
    assert len(both.grown(-0.6).sets) == 1
    with refuses(InputError, 2):
        both.grown(-2.0)
    with refuses(InputError, 0.5):
        Outside(Box(low=[0, 0], high=[1, 1])).grown(0.5)


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda: Ball([0, 0], radius=-1.0), ("radius", -1.0)),
        (lambda: Ball([np.nan, 0], radius=1.0), ("Ball",)),
        (lambda: Box(low=[0, 0], high=[1]), ("low", "high")),
        (lambda: Box(low=[0, 2], high=[1, 1]), ("low", "high", [0.0, 2.0])),
        (lambda: Box(low=[-np.inf], high=[np.inf]), ("Box",)),
        (lambda: Box(), ("low", "high")),
        (lambda: Box(low=["a"]), ("low", "Box")),
        (lambda: Polytope(A=[1.0, 2.0], b=[1.0]), ("A", "b", (2,))),
        (lambda: Polytope(A=[[0.0, 0.0]], b=[1.0]), ("Polytope",)),
        (lambda: Polytope(A=[[1.0], [-1.0]], b=[0.0, -1.0]), ("Polytope", "b")),
        (lambda: Union([]), ("Union",)),
        (lambda: Union([3]), ("Union", 3)),
        (lambda: specs.SETS.make("Cube", low=[0], high=[1]), ("Cube",)),
    ],
)
def test_a_set_that_cannot_be_is_refused(make: Any, facts: tuple[object, ...]) -> None:
    with refuses((InputError, ShapeError, UnknownNameError), *facts):
        make()


def test_sets_of_other_dimensions_are_refused_in_one_sentence() -> None:
    for of in (Box(low=[0], high=[1]), Polytope(A=[[1.0], [-1.0]], b=[1.0, 1.0]), Ball([0.0], radius=1.0)):
        with refuses(ShapeError, 2, 1, type(of).__name__):
            of.signed_distance(np.zeros((5, 2)), TASK)
    with refuses(ShapeError, 5, 3):
        Ball(np.zeros((3, 2)), radius=1.0).signed_distance(np.zeros((5, 2)), TASK)
    with refuses(UnknownNameError, "obstacel", "obstacle"):
        Ball("obstacel", radius=1.0).signed_distance(np.zeros((5, 2)), TASK)


def test_sets_are_made_from_tables() -> None:
    made = Union(
        [{"type": "Ball", "center": "obstacle", "radius": 0.5}, {"type": "Box", "low": [0, 0], "high": [1, 1]}]
    )
    assert [type(one) for one in made.sets] == [Ball, Box]
    assert set(SETS.built_in) == {"Ball", "Box", "Outside", "Polytope", "Union"}
