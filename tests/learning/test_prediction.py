from __future__ import annotations

import os
from typing import Any

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Task, TaskSpace, Validation, controllers, distances, models, systems
from ctxval._util.arrays import Array
from ctxval._util.progress import Progress, listening, stage
from ctxval.core.controller import Controller, Synthesizer
from ctxval.core.trajectory import Trajectory
from ctxval.errors import ShapeError
from ctxval.gp.kernels import Matern
from ctxval.gp.regression import log_likelihood_of_outputs
from ctxval.learning import DynamicsStudy
from ctxval.learning.dynamics_study import LearningSettings
from ctxval.learning.prediction import predict_composed
from ctxval.paper.cases import linear
from ctxval.searches import Prediction, TrustRegion
from facts import refuses
from rig_thorough import more

MODEL = models.Linear([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]])


def predict_distance(
    validation: Validation, runs: list[tuple[Array, Trajectory]], **settings: float
) -> Prediction | None:
    study = DynamicsStudy(validation, settings=LearningSettings(**settings))
    return study.prediction_of(study.learn(runs), runs)


def executed(validation: Validation, points: Array) -> list[tuple[Array, Trajectory]]:
    space = validation.space
    return [(point, validation.outcome(space.from_unit(point)).system_trajectory) for point in points]


def test_the_model_s_own_data_predict_the_distance_before_any_execution() -> None:
    validation = make_validation()
    prediction = predict_distance(validation, [])
    assert prediction is not None
    points = np.linspace(0, 1, 41)[:, None]
    expected, doubt = prediction.expected(points)
    np.testing.assert_allclose(expected, validation.distances(validation.space.from_unit(points)), rtol=0.02, atol=1e-3)
    assert (doubt >= 0).all()


def test_without_executions_and_data_nothing_is_predicted() -> None:
    assert predict_distance(linear.experiment(0, dim=2).validation, []) is None


def test_linear_dynamics_are_known_once_every_goal_s_direction_was_seen() -> None:
    validation = linear.experiment(0, dim=2).validation
    rng = np.random.default_rng(0)
    prediction = predict_distance(validation, executed(validation, rng.random((4, 4))))
    assert prediction is not None
    points = rng.random((50, 4))
    np.testing.assert_allclose(
        prediction.expected(points)[0], validation.distances(validation.space.from_unit(points)), rtol=1e-2
    )


def test_an_execution_left_out_is_predicted_from_the_others() -> None:
    validation = linear.experiment(0, dim=1).validation
    runs = executed(validation, np.random.default_rng(1).random((5, 2)))
    prediction = predict_distance(validation, runs)
    assert prediction is not None
    points = np.array([point for point, _ in runs])
    values = validation.distances(validation.space.from_unit(points))
    np.testing.assert_allclose(prediction.left_out(points), values, rtol=0.1)
    assert prediction.left_out(points[3:4]).shape == (1,)
    new = np.array([[0.5, 0.5]])
    np.testing.assert_array_equal(prediction.left_out(np.concatenate([new, points]))[1:], prediction.left_out(points))
    np.testing.assert_array_equal(prediction.left_out(new), prediction.expected(new)[0])


def test_a_distance_composed_of_a_vector_has_a_second_prediction_from_the_vectors() -> None:
    validation = linear.experiment(0, dim=2).validation
    rng = np.random.default_rng(0)
    prediction = predict_distance(validation, executed(validation, rng.random((12, 4))))
    assert prediction is not None
    assert prediction.otherwise is not None
    second = prediction.otherwise()
    assert second is not None
    points = rng.random((50, 4))
    values = validation.distances(validation.space.from_unit(points))
    assert np.abs(second.expected(points)[0] - values).max() < 0.05 * values.max()
    validation.distance = distances.WholeTrajectory()
    first = predict_distance(validation, executed(validation, rng.random((2, 4))))
    assert first is not None
    assert first.otherwise is not None
    assert first.otherwise() is None


@pytest.mark.parametrize("batched", [True, False])
def test_a_task_that_cannot_be_planned_has_no_prediction_and_costs_the_others_nothing(batched: bool) -> None:
    class Picky(controllers.LQR):
        def design(self, task: Task, model: models.Model) -> controllers.AffineFeedback:
            if (np.abs(task.goal[..., 0]) > 2.9).any():
                raise RuntimeError("out of reach")
            return super().design(task, model)

    validation = make_validation()
    validation.synthesizer = Picky([1.0, 0.1], [1e-2], [10.0, 1.0])
    validation.synthesizer.batched = batched  # type: ignore[misc]
    prediction = predict_distance(validation, [])
    assert prediction is not None
    expected, doubt = prediction.expected(np.array([[0.001], [0.3], [0.5], [0.999]]))
    assert np.isfinite(expected).tolist() == np.isfinite(doubt).tolist() == [False, True, True, False]


def test_a_synthesizer_that_designs_one_by_one_has_a_smaller_budget_and_the_same_prediction() -> None:
    class OneByOne(controllers.LQR):
        batched = False

    validation, slow = make_validation(), make_validation()
    slow.synthesizer = OneByOne([1.0, 0.1], [1e-2], [10.0, 1.0])
    points = np.array([[0.2], [0.7]])
    fast_prediction, slow_prediction = predict_distance(validation, []), predict_distance(slow, [])
    assert fast_prediction is not None
    assert slow_prediction is not None
    assert slow_prediction.budget < fast_prediction.budget
    np.testing.assert_allclose(slow_prediction.expected(points)[0], fast_prediction.expected(points)[0], rtol=0.02)


def test_nothing_is_predicted_where_no_task_can_be_planned() -> None:
    def refuse(p: object) -> Task:
        raise RuntimeError("not today")

    plain = make_validation()
    validation = Validation(
        space=TaskSpace(goal=(-3.0, 3.0)),
        task=refuse,
        system=systems.Simulated(MODEL),
        model=plain.model,
        synthesizer=plain.synthesizer,
        distance=distances.FinalState(norm=1),
    )
    assert predict_distance(validation, []) is None


def test_slow_designs_are_spread_over_processes_and_come_out_the_same() -> None:
    class Seen(controllers.LQR):
        batched = False

        def design(self, task: Task, model: models.Model) -> controllers.AffineFeedback:
            designers.append(os.getpid())
            return super().design(task, model)

    designers: list[int] = []
    validation, points = make_validation(), np.linspace(0.1, 0.9, 6)[:, None]
    validation.synthesizer = Seen([1.0, 0.1], [1e-2], [10.0, 1.0])
    results = []
    for slow in (np.inf, 0.0):
        predicted = predict_distance(validation, [], slow_loop=slow)
        assert predicted is not None
        before = len(designers)
        results.append(np.array(predicted.expected(points)))
        # What other processes design leaves no trace here.
        assert (len(designers) > before) == (slow > 0)
    np.testing.assert_array_equal(*results)


def test_progress_counts_each_predicted_task_once() -> None:
    validation = make_validation()
    prediction = predict_distance(validation, [])
    assert prediction is not None
    prediction.expected(np.array([[0.05]]))  # it finds out first whether controllers are designed in batches
    heard: list[Progress] = []
    with listening(heard.append), stage("choosing a task", unit="designs"):
        prediction.expected(np.linspace(0, 1, 7)[:, None])
    assert heard[-1].done == 7


class InPlace:
    """A distance that changes the arrays that it is given."""

    def __call__(self, model: Trajectory, system: Trajectory, task: Task) -> Array:
        for one in (model, system):
            one.states[..., 0] -= 1.0
        return np.asarray(np.abs(model.states[..., -1, 0] - system.states[..., -1, 0]))


def test_a_distance_that_changes_its_arrays_does_not_change_later_predictions() -> None:
    validation = make_validation().with_parts(distance=InPlace())
    points = np.linspace(0.1, 0.9, 4)[:, None]
    prediction = predict_distance(validation, executed(validation, points))
    assert prediction is not None
    first = prediction.left_out(points)
    np.testing.assert_array_equal(prediction.left_out(points), first)


class OneByOne:
    """A synthesizer without batches, which counts its designs."""

    batched = False

    def __init__(self, inner: Synthesizer) -> None:
        self.inner, self.designed = inner, 0

    def design(self, task: Task, model: models.Model) -> Controller:
        self.designed += 1
        return self.inner.design(task, model)


@pytest.mark.usefixtures("few_loops")
def test_the_vectors_need_no_design_of_a_task_that_is_planned() -> None:
    validation = linear.experiment(0, dim=2).validation
    validation.synthesizer = synthesizer = OneByOne(validation.synthesizer)
    points = np.random.default_rng(0).random((6, 4))
    prediction = predict_distance(validation, executed(validation, points))
    assert prediction is not None
    assert prediction.otherwise is not None
    prediction.left_out(points)
    designed = synthesizer.designed
    second = prediction.otherwise()
    assert second is not None
    assert np.isfinite(second.left_out(points)).all()
    assert synthesizer.designed == designed


@pytest.mark.usefixtures("few_loops")
@pytest.mark.parametrize("part", ["model", "synthesizer"])
def test_parts_that_are_changed_in_place_are_seen(part: str) -> None:
    validation = linear.experiment(0, dim=2).validation
    runs = executed(validation, np.random.default_rng(0).random((4, 4)))
    points = np.random.default_rng(1).random((5, 4))
    study = DynamicsStudy(validation)
    parts, before = study.state_of_parts(), study.prediction_of(study.learn(runs), runs)
    assert before is not None
    first = before.expected(points)[0]
    changed: Any = getattr(validation, part)
    if part == "model":
        changed.A = 0.9 * changed.A
    else:
        changed.limits = 0.1
    assert study.state_of_parts() != parts
    after = predict_distance(validation, runs)
    assert after is not None
    assert not np.allclose(after.expected(points)[0], first)


# Vector


C = np.random.default_rng(3).normal(size=(4, 8))


def affine_map(X: Array) -> Array:
    return (X - 0.4) @ C.T


def bent(X: Array) -> Array:
    return affine_map(X) + 0.3 * np.sin(4 * X[:, :1])


def norm(vectors: Array) -> Array:
    return np.abs(vectors).sum(axis=-1)


def points(n: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).random((n, 8))


def test_a_linear_vector_is_known_from_little_more_points_than_there_are_dimensions() -> None:
    prediction = predict_composed(points(12), affine_map(points(12)), norm)
    assert prediction is not None
    expected, doubt = prediction.expected(points(50, 1))
    np.testing.assert_allclose(expected, norm(affine_map(points(50, 1))), rtol=0.05)
    assert doubt.max() < 0.2


def test_doubt_is_nothing_at_known_points_and_large_where_little_is_known() -> None:
    X = points(6)
    prediction = predict_composed(X, bent(X), norm)
    assert prediction is not None
    expected, doubt = prediction.expected(X)
    np.testing.assert_allclose(expected, norm(bent(X)), rtol=1e-3)
    assert doubt.max() < 1e-2
    assert prediction.expected(points(20, 1))[1].min() > 0.02


def test_a_point_left_out_is_predicted_from_the_others_with_the_same_hyperparameters() -> None:
    X = points(30)
    whole, without = predict_composed(X, bent(X), norm), predict_composed(X[:-1], bent(X[:-1]), norm)
    assert whole is not None
    assert without is not None
    assert whole.left_out(X[-1:])[0] == pytest.approx(without.expected(X[-1:])[0][0], rel=0.02)
    assert whole.left_out(X[[4, 7]]).shape == (2,)
    new = points(3, 1)
    np.testing.assert_array_equal(whole.left_out(new), whole.expected(new)[0])


def test_the_units_do_not_matter() -> None:
    X = points(12)
    metres, millimetres = predict_composed(X, bent(X), norm), predict_composed(X, 1e3 * bent(X), norm)
    assert metres is not None
    assert millimetres is not None
    expected, doubt = metres.expected(points(5, 1))
    np.testing.assert_allclose(millimetres.expected(points(5, 1))[0], 1e3 * expected, rtol=1e-3)
    np.testing.assert_allclose(millimetres.expected(points(5, 1))[1], doubt, rtol=1e-3)


def test_it_is_a_plain_function_whatever_points_are_asked_about_together() -> None:
    prediction = predict_composed(points(6), bent(points(6)), norm)
    assert prediction is not None
    together = prediction.expected(points(4, 1))
    alone = [prediction.expected(point[None]) for point in points(4, 1)]
    np.testing.assert_allclose(together[0], [value[0] for value, _ in alone], rtol=1e-9)
    np.testing.assert_allclose(together[1], [doubt[0] for _, doubt in alone], rtol=1e-6)


def test_points_that_repeat_themselves_do_no_harm() -> None:
    X = np.repeat(points(5), 3, axis=0)
    prediction = predict_composed(X, affine_map(X), norm)
    assert prediction is not None
    assert np.isfinite(prediction.expected(points(5, 1))[0]).all()


def test_nothing_is_expected_of_one_vector_or_of_vectors_that_vanish() -> None:
    assert predict_composed(points(1), affine_map(points(1)), norm) is None
    assert predict_composed(points(5), np.zeros((5, 2)), norm) is None


def test_points_and_vectors_that_do_not_fit_are_refused_with_both_shapes() -> None:
    with refuses(ShapeError, (5, 8), (4, 4)):
        predict_composed(points(5), affine_map(points(4)), norm)


def test_the_gradient_of_the_likelihood_agrees_with_finite_differences() -> None:
    X, theta = points(12), np.random.default_rng(0).normal(-1, 0.3, size=11)
    kernel = Matern(2.5, ard=True, linear=(1e-6, 1e3))

    def log_likelihood(theta: Array) -> tuple[float, Array]:
        value, W = log_likelihood_of_outputs(kernel(theta, X, X), 1e-8, bent(X))
        return value, kernel.weighted_gradient(theta, X, W)

    _, gradient = log_likelihood(theta)
    steps = 1e-6 * np.eye(11)
    numeric = [(log_likelihood(theta + e)[0] - log_likelihood(theta - e)[0]) / 2e-6 for e in steps]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("seed", [0, *more(1, 2)])
def test_climbs_on_it_find_the_largest_norm_soon(seed: int) -> None:
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 8, indexing="ij"), axis=-1).reshape(-1, 8)
    search = TrustRegion()
    search.reset(8, seed)
    for _ in range(14):
        search.use_prediction(predict_composed(search.points, affine_map(search.points), norm))
        point = search.ask(1)
        search.tell(point, norm(affine_map(point)))
    assert search.values.max() > 0.99 * norm(affine_map(corners)).max()
