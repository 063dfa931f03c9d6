from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.linear_model import LinearRegression

from ctxval import Transitions
from ctxval.errors import InputError, ShapeError
from ctxval.models import Linear, Model
from facts import refuses


def draw_model(n: int, m: int, seed: int) -> Linear:
    rng = np.random.default_rng(seed)
    return Linear(rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.normal(size=n))


def record(model: Linear, count: int, seed: int, noise: float = 0.0) -> Transitions:
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=(count, len(model.A))), rng.normal(size=(count, model.B.shape[1]))
    return Transitions(x, u, model.step(x, u) + noise * rng.normal(size=x.shape))


def test_a_step_is_the_affine_map() -> None:
    model = Linear([[1, 2], [3, 4]], [[5], [6]], [7, 8])
    assert model.step(np.array([1.0, -1.0]), np.array([2.0])).tolist() == [1 - 2 + 10 + 7, 3 - 4 + 12 + 8]
    assert isinstance(model, Model)


def test_the_offset_is_zero_unless_given() -> None:
    assert Linear([[1, 2], [3, 4]], [[5], [6]]).step(np.zeros(2), np.zeros(1)).tolist() == [0, 0]


@pytest.mark.parametrize("shape", [(6,), (2, 3)])
def test_a_batch_of_steps_is_the_loop_over_them(shape: tuple[int, ...]) -> None:
    model, rng = draw_model(3, 2, 0), np.random.default_rng(1)
    x, u = rng.normal(size=(*shape, 3)), rng.normal(size=(*shape, 2))
    for i in np.ndindex(shape):
        np.testing.assert_allclose(model.step(x, u)[i], model.A @ x[i] + model.B @ u[i] + model.c, rtol=1e-12)


def test_the_jacobian_is_the_matrices() -> None:
    model = draw_model(3, 2, 0)
    A, B = model.jacobian(np.zeros((5, 3)), np.zeros((5, 2)))
    assert A is model.A
    assert B is model.B


@given(st.integers(1, 4), st.integers(0, 3), st.integers(0, 10_000), st.booleans())
def test_a_fit_to_exact_data_recovers_the_model(n: int, m: int, seed: int, intercept: bool) -> None:
    truth = draw_model(n, m, seed)
    if not intercept:
        truth = Linear(truth.A, truth.B)
    fitted = Linear.fit(record(truth, 4 * (n + m + 1), seed), intercept=intercept)
    for name in ("A", "B", "c"):
        np.testing.assert_allclose(getattr(fitted, name), getattr(truth, name), atol=1e-8)


@pytest.mark.parametrize("intercept", [True, False])
def test_a_fit_to_noisy_data_is_that_of_scikit_learn(intercept: bool) -> None:
    data = record(draw_model(3, 2, 5), 50, 6, noise=0.3)
    fitted = Linear.fit(data, intercept=intercept)
    oracle = LinearRegression(fit_intercept=intercept).fit(np.hstack([data.x, data.u]), data.x_next)
    np.testing.assert_allclose(np.hstack([fitted.A, fitted.B]), oracle.coef_, atol=1e-12)
    np.testing.assert_allclose(fitted.c, oracle.intercept_, atol=1e-12)


def test_a_fitted_model_keeps_its_data() -> None:
    data = record(draw_model(2, 1, 0), 20, 0)
    assert Linear.fit(data).data is data


def test_too_few_transitions_are_refused_with_their_rank() -> None:
    with refuses(InputError, 3, 2, 1):
        Linear.fit(record(draw_model(2, 1, 0), 3, 0))
    assert np.isfinite(Linear.fit(record(draw_model(2, 1, 0), 3, 0), intercept=False).A).all()


def test_an_input_that_never_moves_is_refused() -> None:
    data = record(draw_model(2, 1, 0), 30, 0)
    with refuses(InputError, 30, 2):
        Linear.fit(Transitions(data.x, np.zeros_like(data.u), data.x_next))


@pytest.mark.parametrize("name", ["x", "u", "x_next"])
def test_transitions_that_are_not_finite_are_refused(name: str) -> None:
    data = record(draw_model(2, 1, 0), 30, 0)
    parts = {key: getattr(data, key).copy() for key in ("x", "u", "x_next")}
    parts[name][4, 0] = np.nan
    with refuses(InputError, "model", "NaN"):
        Linear.fit(Transitions(**parts))


@pytest.mark.parametrize(
    ("A", "B", "c"),
    [((2, 3), (2, 1), (2,)), ((2, 2), (3, 1), (2,)), ((2, 2), (2,), (2,)), ((2, 2), (2, 1), (3,)), ((), (1, 1), (1,))],
)
def test_matrices_that_do_not_fit_are_refused_with_all_shapes(
    A: tuple[int, ...], B: tuple[int, ...], c: tuple[int, ...]
) -> None:
    with pytest.raises(ShapeError) as caught:
        Linear(np.zeros(A), np.zeros(B), np.zeros(c))
    assert f"got {A}, {B} and {c}" in str(caught.value)


def test_a_matrix_that_is_not_finite_is_refused_by_name() -> None:
    with refuses(InputError, "A"):
        Linear([[np.nan]], [[1.0]])


def test_inputs_that_hardly_move_by_themselves_are_refused_by_name() -> None:
    data = record(draw_model(3, 2, 0), 60, 0)
    rng = np.random.default_rng(1)
    # Feedback: the second input is a combination of states, up to the rounding of a sensor.
    u = np.stack([data.u[:, 0], 2 * data.x[:, 0] - data.x[:, 2] + 1e-11 * rng.normal(size=60)], axis=1)
    with refuses(InputError, "x0", "x2", "u1"):
        Linear.fit(Transitions(data.x, u, data.x_next))


def test_units_do_not_decide_whether_data_are_enough() -> None:
    truth = draw_model(2, 1, 0)
    data = record(truth, 40, 0)
    units = np.array([1e-5, 1e5])
    fitted = Linear.fit(Transitions(data.x * units, data.u, data.x_next * units))
    np.testing.assert_allclose(fitted.A, truth.A * units[:, None] / units, rtol=1e-8)


def test_states_and_data_of_another_size_are_refused_in_one_sentence() -> None:
    data = Transitions(np.ones((4, 3)), np.ones((4, 1)), np.ones((4, 3)))
    with refuses(ShapeError, 2, 1, 3):
        Linear(np.eye(2), np.ones((2, 1)), data=data)
    with refuses(ShapeError, 2, 1, (3,)):
        Linear(np.eye(2), np.ones((2, 1))).step(np.ones(3), np.ones(1))


def test_a_file_is_no_transitions() -> None:
    with refuses(InputError, "data", "run1.csv"):
        Linear.fit("run1.csv")  # type: ignore[arg-type]
