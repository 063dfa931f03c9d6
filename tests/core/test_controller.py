from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import Task, controllers
from ctxval._util.describe import describe
from ctxval.core.controller import AffineFeedback, Limits, Policy, Synthesizer
from ctxval.errors import InputError, ShapeError
from ctxval.models import Linear
from facts import refuses


def feedback(batch: tuple[int, ...] = (), shared: bool = False) -> AffineFeedback:
    rng = np.random.default_rng(0)
    gains = rng.normal(size=(*(() if shared else batch), 4, 2, 3))
    return AffineFeedback(gains, rng.normal(size=(*batch, 4, 2)), rng.normal(size=(*batch, 4, 3)))


@pytest.mark.parametrize("t", [0, 3])
def test_affine_feedback_adds_the_gain_times_the_deviation(t: int) -> None:
    pi, x = feedback(), np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(pi(t, x), pi.inputs[t] + pi.gains[t] @ (x - pi.states[t]), rtol=1e-14)


@pytest.mark.parametrize("shared", [False, True])
def test_a_batch_of_feedbacks_is_the_loop_over_them(shared: bool) -> None:
    pi, x = feedback((5,), shared), np.random.default_rng(1).normal(size=(5, 3))
    for i in range(5):
        np.testing.assert_allclose(pi(2, x)[i], pi[i](2, x[i]), rtol=1e-14)
        assert pi[i].gains.shape == (4, 2, 3)


def test_one_feedback_serves_a_batch_of_states() -> None:
    pi, x = feedback(), np.random.default_rng(1).normal(size=(2, 6, 3))
    for i in np.ndindex(2, 6):
        np.testing.assert_allclose(pi(1, x)[i], pi(1, x[i]), rtol=1e-13)


def test_a_policy_sees_the_step_the_state_and_the_task() -> None:
    task, model = Task([[1.0, 2.0]], goal=[[5.0, 7.0]], horizon=3, dt=0.1), Linear([[1.0]], [[1.0]])
    pi = Policy(lambda t, x, task: t + 2 * (task.goal - x)).design(task, model)
    np.testing.assert_array_equal(pi(3, task.initial_state), [[11], [13]])


def test_a_policy_may_return_a_list() -> None:
    pi = Policy(lambda t, x, task: [1, 2]).design(Task([0.0], horizon=1, dt=1), Linear([[1.0]], [[1.0, 1.0]]))
    assert pi(0, np.zeros(1)).dtype == np.float64


@pytest.mark.parametrize(
    "synthesizer", [Policy(lambda t, x, task: x), controllers.LQR([1], [1]), controllers.ILQR([1], [1])]
)
def test_the_ready_made_synthesizers_are_synthesizers_that_take_batches(synthesizer: object) -> None:
    assert isinstance(synthesizer, Synthesizer)
    assert synthesizer.batched


def test_what_has_no_design_is_no_synthesizer() -> None:
    assert not isinstance(feedback(), Synthesizer)


# Limits


def test_affine_feedback_stays_within_its_limits_and_is_itself_inside() -> None:
    free, limits = feedback((5,)), Limits([-0.5, -np.inf], 0.7)
    limited = AffineFeedback(free.gains, free.inputs, free.states, limits)
    x = 3 * np.random.default_rng(1).normal(size=(5, 3))
    np.testing.assert_array_equal(limited(2, x), np.clip(free(2, x), [-0.5, -np.inf], 0.7))
    assert (limited(2, x) < -0.5).any()  # the second input, which has no lower limit
    np.testing.assert_array_equal(limited[3](2, x[3]), limited(2, x)[3])


@pytest.mark.parametrize(
    ("given", "low", "high"),
    [
        (2.0, [-2, -2], [2, 2]),
        (np.inf, [-np.inf, -np.inf], [np.inf, np.inf]),
        (Limits(low=0, high=8), [0, 0], [8, 8]),
        ([[0, 8], [0, 8]], [0, 0], [8, 8]),
        ([(0, 8), (-1, 1)], [0, -1], [8, 1]),
        (((0, 8), [-1, 1]), [0, -1], [8, 1]),
        (np.array([[0, 8], [-np.inf, 1]]), [0, -np.inf], [8, 1]),
    ],
)
def test_limits_are_given_as_numbers_or_rows(given: Any, low: list[float], high: list[float]) -> None:
    limits = Limits.of(given, 2)
    assert limits.low.tolist() == low
    assert limits.high.tolist() == high
    assert Limits.of(limits, 2).high.tolist() == high


@pytest.mark.parametrize("kind", [list, tuple, np.array])
def test_a_flat_list_is_refused(kind: Any) -> None:
    for flat in ([1.0, 8.0], [3.0], [3.0, -3.0]):
        with refuses(InputError, "limits"):
            Limits.of(kind(flat), len(flat))


@pytest.mark.parametrize(
    ("given", "facts"),
    [
        ({"low": 1.0}, ("low", "high")),
        ({"lower": 0, "upper": 8}, ("lower", "upper")),
        ((-1.0, [5.0, 30.0]), ("limits",)),
        ("eight", ("limits", "eight")),
        (np.zeros((2, 3)), ("limits", (2, 3))),
        ([], ("limits", (0,))),
        ({"low": [0, -1], "high": 5}, ("table", "[[0.0, 5.0], [-1.0, 5.0]]")),
        ({"low": [0, 0, 0], "high": [1, 1]}, ("table", "[low, high]")),
        ({"low": [[0]], "high": [[1]]}, ("table", "[low, high]")),
    ],
)
def test_what_are_no_limits_is_refused_with_the_right_spellings(given: Any, facts: tuple[object, ...]) -> None:
    with refuses((InputError, ShapeError), *facts):
        Limits.of(given, 2)


def test_limits_that_make_no_sense_are_refused() -> None:
    for wrong in (0.0, -1.0, [[0, 1], [2, 1]], float("nan")):
        with refuses(InputError, "low", "high"):
            Limits.of(wrong, 2)
    with refuses(ShapeError, (2,), (3,)):
        Limits.of([[-1, 1], [-2, 2], [-3, 3]], 2)


EDGES = st.floats(-100, 100) | st.just(np.inf)


@given(st.lists(st.tuples(EDGES, st.floats(0.1, 100)), min_size=1, max_size=4))
def test_every_spelling_of_the_same_limits_is_the_same(pairs: list[tuple[float, float]]) -> None:
    rows = [[low if np.isfinite(low) else -np.inf, low + width] for low, width in pairs]
    limits = Limits([row[0] for row in rows], [row[1] for row in rows])
    for given_ in (limits, rows, tuple(map(tuple, rows)), np.array(rows)):
        assert Limits.of(given_, len(rows)).describe() == limits.describe()


def test_limits_are_described_by_what_they_allow() -> None:
    stored = {"type": "Limits", "low": [-2.0, 0.0], "high": [2.0, 8.0]}
    rows = [[-2, 2], [0, 8]]
    for kind in (controllers.LQR, controllers.StationaryLQR, controllers.ILQR):
        assert describe(kind([1], [1, 1], limits=rows))["limits"] == stored
    assert describe(Policy(np.sum, limits=rows))["limits"] == stored
    assert describe(Policy(np.sum, limits=2.0))["limits"] == {"type": "Limits", "low": -2.0, "high": 2.0}


def test_a_policy_can_be_limited() -> None:
    task, model = Task([1.0, 2.0], horizon=3, dt=0.1), Linear(np.eye(2), np.eye(2))
    pi = Policy(lambda t, x, task: 10 * x, limits=Limits(low=-1.0, high=[5.0, 30.0])).design(task, model)
    np.testing.assert_array_equal(pi(0, task.initial_state), [5, 20])
    np.testing.assert_array_equal(pi(0, -task.initial_state), [-1, -1])
    assert "limits" in describe(Policy(np.sum, limits=1.0))
    assert "limits" not in describe(Policy(np.sum))


def test_a_policy_that_takes_one_state_says_so() -> None:
    assert not Policy(lambda t, x, task: x, vectorized=False).batched


def double(t: int, x: np.ndarray, task: Task) -> np.ndarray:
    return 2 * x


def test_a_bound_policy_can_go_to_another_process() -> None:
    pi = Policy(double, limits=3.0).design(Task([1.0], horizon=3, dt=0.1), Linear([[1.0]], [[1.0]]))
    assert pickle.loads(pickle.dumps(pi))(0, np.array([1.0])).tolist() == [2.0]


@pytest.mark.parametrize("step", [-1, 4])
def test_a_step_that_the_task_does_not_have_is_refused(step: int) -> None:
    with refuses(InputError, 0, 3, step):
        feedback()(step, np.zeros(3))
