from __future__ import annotations

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Task, TaskSpace, Transitions, Validation, controllers, distances, models, systems
from ctxval.arrays import Array
from ctxval.cases import linear
from ctxval.dynamics import CorrectedModel, Residual, Staying, learn_corrected, learn_residual, predict_distance
from ctxval.trajectory import Trajectory

MODEL = models.Linear([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]])


def truth(x: Array, u: Array) -> Array:
    """A smooth system that a linear model misses."""
    return MODEL.step(x, u) + 0.05 * np.stack([np.sin(2 * x[..., 0]) * u[..., 0], np.cos(x[..., 1])], axis=-1)


def record(count: int, seed: int = 0, reach: float = 1.0) -> Transitions:
    rng = np.random.default_rng(seed)
    x, u = rng.uniform(-reach, reach, (count, 2)), rng.uniform(-reach, reach, (count, 1))
    return Transitions(x, u, truth(x, u))


def learn(data: Transitions, model: models.Model = MODEL) -> Residual:
    residual = learn_residual(model, data, np.full(len(data), -1))
    assert residual is not None
    return residual


def executed(validation: Validation, points: Array) -> list[tuple[Array, Trajectory]]:
    space = validation.space
    return [(point, validation.outcome(space.from_unit(point)).system_trajectory) for point in points]


# The residual


def test_a_corrected_model_predicts_what_the_model_misses() -> None:
    hat, fresh = CorrectedModel(MODEL, learn(record(400))), record(200, seed=1, reach=0.9)
    error = np.abs(hat.step(fresh.x, fresh.u) - fresh.x_next).max()
    assert error < 0.01 * np.abs(MODEL.step(fresh.x, fresh.u) - fresh.x_next).max()


def test_a_corrected_model_takes_one_state_and_whole_batches_alike() -> None:
    hat, data = CorrectedModel(MODEL, learn(record(60))), record(12, seed=1)
    batch = hat.step(data.x.reshape(3, 4, 2), data.u.reshape(3, 4, 1))
    assert batch.shape == (3, 4, 2)
    np.testing.assert_allclose(hat.step(data.x[5], data.u[5]), batch[1, 1], rtol=1e-10)


def test_a_linear_residual_is_learned_everywhere_from_few_transitions() -> None:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(8, 2)), rng.normal(size=(8, 1))
    other = models.Linear([[1.02, 0.05], [0.1, 0.9]], [[0.05], [0.08]])
    residual = learn(Transitions(x, u, other.step(x, u)))
    far, push = 10 * rng.normal(size=(50, 2)), rng.normal(size=(50, 1))
    hat = CorrectedModel(MODEL, residual)
    bounded = (np.abs(other.step(far, push) - MODEL.step(far, push)) < 0.9 * residual.limit * residual.scale_out).all(1)
    assert bounded.sum() > 5
    np.testing.assert_allclose(hat.step(far, push)[bounded], other.step(far, push)[bounded], atol=1e-3)


def test_far_from_the_data_it_never_corrects_much_more_than_was_ever_recorded() -> None:
    data = record(100)
    largest = np.abs(data.x_next - MODEL.step(data.x, data.u)).max(axis=0)
    far = 1e6 * np.random.default_rng(2).normal(size=(200, 3))
    assert (np.abs(learn(data)(far[:, :2], far[:, 2:])) <= 5.001 * largest).all()


def test_what_was_seen_is_familiar_and_what_was_not_is_not() -> None:
    residual = learn(record(200))
    here, far = residual.variance(np.zeros(2), np.zeros(1)), residual.variance(np.full(2, 6.0), np.zeros(1))
    assert here < 1e-3 * far


def test_noise_in_the_recordings_is_not_learned() -> None:
    data, rng = record(300), np.random.default_rng(3)
    noisy = Transitions(data.x, data.u, data.x_next + 0.01 * rng.normal(size=data.x.shape))
    fresh = record(200, seed=1, reach=0.9)
    error = CorrectedModel(MODEL, learn(noisy)).step(fresh.x, fresh.u) - fresh.x_next
    assert np.sqrt((error**2).mean()) < 0.01


def test_a_model_without_error_leaves_nothing_to_be_learned() -> None:
    data = record(50)
    exact = Transitions(data.x, data.u, MODEL.step(data.x, data.u))
    assert learn_residual(MODEL, exact, np.full(50, -1)) is None


def test_recordings_that_repeat_themselves_and_ones_that_diverged_do_no_harm() -> None:
    data = record(40)
    twice = Transitions.joined([data, data, Transitions(data.x * 1e150, data.u, data.x_next * 1e160)])
    residual = learn(twice)
    assert np.isfinite(residual(data.x, data.u)).all()
    assert np.isfinite(residual.typical_error())


def test_recordings_that_are_not_finite_are_left_out() -> None:
    data = record(100)
    broken = Transitions(data.x, data.u, np.where(np.arange(100)[:, None] % 7 == 0, np.nan, data.x_next))
    assert np.isfinite(learn(broken)(data.x, data.u)).all()
    assert learn_residual(MODEL, Transitions(data.x, data.u, data.x_next * np.nan), np.full(100, -1)) is None


def test_around_a_model_that_is_rougher_than_the_system_the_steps_are_learned_instead() -> None:
    rough = models.Function(lambda x, u: MODEL.step(x, u) + 0.3 * np.sign(np.sin(9 * x)), vectorized=True)
    data = record(400)
    corrected = [learn_corrected(model, data, np.full(400, -1), 200) for model in (MODEL, rough)]
    assert [type(hat.model) for hat in corrected if hat is not None] == [models.Linear, Staying]


# The predicted distance


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
    values = validation.distances(validation.space.from_unit(np.array([point for point, _ in runs])))
    np.testing.assert_allclose(prediction.left_out(np.arange(5)), values, rtol=0.1)
    assert prediction.left_out(np.array([3])).shape == (1,)


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
