from __future__ import annotations

import numpy as np
import pytest

from ctxval import Task, controllers
from ctxval.controller import AffineFeedback, Policy, Synthesizer
from ctxval.models import Linear


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
