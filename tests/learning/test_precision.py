from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctxval import Task, TaskSpace, Validation, controllers, distances, models, systems
from ctxval.learning import DynamicsStudy
from ctxval.learning.precision import AgreeingDynamics
from ctxval.learning.residual_data import epsilons, floors

A, B = np.array([[1.0, 0.05], [0.0, 1.0]]), np.array([[0.0], [0.05]])


def cart(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.asarray(x @ A.T + u @ B.T)


def study_of(step: Any, tasks: int = 4) -> tuple[DynamicsStudy, list[Any], np.ndarray]:
    """Return a study, executions of some tasks, and their distances."""
    validation = Validation(
        space=TaskSpace(goal=(-1.0, 1.0)),
        task=lambda p: Task([0 * p.goal, 0 * p.goal], goal=[p.goal, 0], horizon=20, dt=0.05),
        system=systems.Simulated(step, vectorized=True),
        model=models.Linear(A, B),
        synthesizer=controllers.LQR([10, 1], [0.1]),
        distance=distances.MaximumDeviation(components=[0]),
    )
    executed, measured = [], []
    for unit in np.linspace(0, 1, tasks)[:, None]:
        plan = validation.plan(validation.space.from_unit(unit))
        trajectory = validation.system.execute(plan.controller, plan.task)
        executed.append((unit, trajectory))
        measured.append(float(validation.distance(plan.model_trajectory, trajectory, plan.task)))
    return DynamicsStudy(validation), executed, np.array(measured)


@given(arrays(np.float64, (5, 2), elements=st.floats(-1e30, 1e30)))
def test_single_precision_is_seen_in_the_values(values: np.ndarray) -> None:
    single = values.astype(np.float32).astype(np.float64)
    assert (epsilons(single) == np.finfo(np.float32).eps).all()
    assert set(epsilons(values)) <= {np.finfo(np.float32).eps, np.finfo(np.float64).eps}


def test_one_state_of_double_precision_does_not_change_the_others() -> None:
    values = np.stack([np.full(3, 0.1), np.array([0.5, 0.25, 1.0])], axis=1)
    assert epsilons(values).tolist() == [np.finfo(np.float64).eps, np.finfo(np.float32).eps]


def test_rounding_is_measured_in_the_scale_of_states_and_of_their_changes() -> None:
    states = np.array([[1000.1], [1000.2], [1000.1]])
    changes = np.array([[1.0], [-1.0], [1.0]])
    assert floors(states, 1e3 * changes)[0] == pytest.approx(1e-7 * 1e3, rel=0.1)
    assert floors(states, 1e-9 * changes)[0] == pytest.approx(16 * np.finfo(np.float64).eps * 1000.2, abs=0)


@pytest.mark.parametrize("error", [0.0, 1e-12, 1e-9])
def test_executions_that_m_explains_bound_its_errors(error: float) -> None:
    study, executed, measured = study_of(lambda x, u: cart(x, u * (1 + error)))
    learned = study.learn(executed)
    assert isinstance(learned, AgreeingDynamics)
    assert measured.max() <= learned.negligible <= max(100 * measured.max(), 1e-13)
    worst = learned.worst_case_of(19)
    assert len(worst.maxima) == 19
    assert (worst.maxima == learned.negligible).all()
    predicted = learned.predict(np.array([0.3]))
    assert predicted is not None
    assert predicted.median == 0


def test_an_error_is_learned_unless_distances_under_it_are_allowed() -> None:
    study, executed, measured = study_of(lambda x, u: cart(x, u * 1.001))
    assert not isinstance(study.learn(executed), AgreeingDynamics)
    assert isinstance(study.learn(executed, (), 1.0), AgreeingDynamics)
    assert not isinstance(study.learn(executed, (), 1.01 * measured.max()), AgreeingDynamics)


def test_one_execution_with_an_error_ends_the_agreement() -> None:
    study, executed, _ = study_of(lambda x, u: cart(x, u) - np.where(x > 0.5, 0.01, 0.0))
    assert isinstance(study.learn(executed[:2]), AgreeingDynamics)
    assert not isinstance(study.learn(executed), AgreeingDynamics)


def test_executions_are_predicted_from_each_other() -> None:
    study, executed, _ = study_of(cart)
    learned = study.learn(executed)
    assert learned is not None
    without = study.without(learned, 1)
    assert isinstance(without, AgreeingDynamics)
    assert len(without.executed) == len(executed) - 1
    expected = study.as_if_executed(learned, executed, learned.trajectories(np.array([[0.45]])))
    assert isinstance(expected, AgreeingDynamics)
    assert len(expected.executed) == len(executed) + 1
