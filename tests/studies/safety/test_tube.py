from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctxval import Task, TaskSpace, Validation, controllers, distances, models, rollout, systems
from ctxval.core.controller import AffineFeedback, Limits
from ctxval.errors import InputError, ShapeError
from ctxval.studies.safety import Disturbance, Tube, tube, tube_of
from facts import refuses

A, B, H = np.array([[1.0, 0.1], [0.0, 0.95]]), np.array([[0.0], [0.1]]), 12
MODEL = models.Linear(A, B)
W = np.array([0.01, 0.05])
TASK = Task([0.0, 0.0], goal=[1.0, 0.0], horizon=H, dt=0.1)
VALIDATION = Validation(
    space=TaskSpace(goal=(0.5, 1.5)),
    task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=H, dt=0.1),
    system=systems.Simulated(MODEL),
    model=MODEL,
    synthesizer=controllers.LQR([1.0, 0.1], [0.1]),
    distance=distances.MaximumDeviation(),
)


def made() -> Tube:
    disturbance = Disturbance(W, 0.05, 0.95, 59, 0, W)
    return tube_of(VALIDATION, VALIDATION.plan([1.0]), disturbance)


def disturbed(w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far a disturbed closed loop is from that of the model: states ``(H + 1, 2)``, inputs ``(H, 1)``."""
    plan = VALIDATION.plan([1.0])
    x, states, inputs = np.zeros(2), [np.zeros(2)], []
    for t in range(H):
        u = np.asarray(plan.controller(t, x))
        x = MODEL.step(x, u) + w[t]
        states.append(x)
        inputs.append(u)
    return np.array(states) - plan.model_trajectory.states, np.array(inputs) - plan.model_trajectory.inputs


@given(arrays(np.float64, (H, 2), elements=st.floats(-1, 1)))
def test_every_disturbed_loop_stays_in_the_tube(shares: np.ndarray) -> None:
    states, inputs = disturbed(shares * W)
    assert (np.abs(states) <= made().states + 1e-12).all()
    assert (np.abs(inputs) <= made().inputs + 1e-12).all()


def test_the_tube_is_reached_by_the_worst_disturbance() -> None:
    found, plan = made(), VALIDATION.plan([1.0])
    loops = found.loops
    for direction in (np.array([1.0, 0.0]), np.array([0.6, -0.8])):
        w, row = np.zeros((H, 2)), direction.copy()
        for t in reversed(range(H)):  # the sign of each disturbance that moves the last state farthest
            w[t] = np.sign(row) * W
            row = row @ loops[t]
        assert disturbed(w)[0][-1] @ direction == pytest.approx(found.support(direction)[-1])
    np.testing.assert_allclose(found.support([0.0, 1.0]), found.states[:, 1])
    assert plan.model_trajectory.horizon == len(found.inputs) == H


def test_tightened_limits_leave_room_for_the_tube() -> None:
    found = made()
    limits = found.tightened({"low": [-1.0, -np.inf], "high": [2.0, 1.0]})
    np.testing.assert_allclose(limits.high, [2.0, 1.0] - found.states.max(axis=0))
    assert limits.low[1] == -np.inf
    np.testing.assert_allclose(found.tightened(3.0, "inputs").high, 3.0 - found.inputs.max(axis=0))
    with refuses(InputError, -0.01, 0.01, 1):
        found.tightened(0.01)
    with refuses(InputError, "of", "states", "inputs"):
        found.tightened(1.0, "outputs")


@pytest.mark.slow
def test_a_plan_of_mpc_within_tightened_limits_keeps_the_given_ones() -> None:
    pytest.importorskip("casadi")
    found, limit = made(), 0.9
    steep = Task([0.0, 0.0], goal=[2.0, 0.0], horizon=H, dt=0.1)
    gains, w = VALIDATION.plan([1.0]).controller.gains, np.zeros((H, 2))  # type: ignore[attr-defined]
    row = np.array([0.0, 1.0])
    for t in reversed(range(H)):  # pushes the speed up as far as it goes
        w[t], row = np.sign(row) * W, row @ found.loops[t]
    fastest = {}
    given_limits = Limits([-np.inf, -limit], [np.inf, limit])
    for name, speeds in (("given", given_limits), ("tightened", found.tightened(given_limits))):
        mpc = controllers.MPC([5.0, 0.0], [0.01], steps=8, state_limits=speeds)
        planned = rollout(MODEL.step, mpc.design(steep, MODEL), steep)
        followed = AffineFeedback(gains, planned.inputs, planned.states)
        x, fastest[name] = np.zeros(2), 0.0
        for t in range(H):
            x = MODEL.step(x, followed(t, x)) + w[t]
            fastest[name] = max(fastest[name], float(x[1]))
        assert planned.states[:, 1].max() > 0.9 * speeds.high[1]  # the limit matters
    assert fastest["given"] > limit
    assert fastest["tightened"] <= limit + 1e-9


def test_what_has_no_tube_is_refused() -> None:
    with refuses(ShapeError, "tube", "half_widths"):
        tube(A, B, np.zeros((3, 2, 1)), W)
    with refuses(ShapeError, "direction", (2,), (3,)):
        made().support([1.0, 0.0, 0.0])
    disturbance = Disturbance(W, 0.05, 0.95, 59, 0, W)
    policy = VALIDATION.with_parts(synthesizer=controllers.Policy(lambda t, x, task: x[..., :1]))
    with refuses(InputError, "tube"):
        tube_of(policy, policy.plan([1.0]), disturbance)
    curved = VALIDATION.with_parts(model=lambda x, u: MODEL.step(x, u) + 0.01 * np.sin(x))
    with refuses(InputError, "tube", "model"):
        tube_of(curved, curved.plan([1.0]), disturbance)
