from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ctxval.core.model import Function, Model, as_model, central_differences, linearize
from ctxval.errors import InputError, ModelError
from ctxval.models import Linear
from facts import refuses


def bend(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return x_next of a smooth function with 2 states and 1 input, on batches or on one."""
    return np.stack([x[..., 0] + np.sin(x[..., 1]), np.exp(-(x[..., 0] ** 2)) * u[..., 0]], axis=-1)


def bend_jacobian(x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    (a, b), hump = x, np.exp(-(x[0] ** 2))
    return np.array([[1, np.cos(b)], [-2 * a * hump * u[0], 0]]), np.array([[0], [hump]])


def batch(shape: tuple[int, ...], seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(*shape, 2)), rng.normal(size=(*shape, 1))


@pytest.mark.parametrize("shape", [(), (1,), (5,), (2, 3)])
def test_a_plain_function_is_looped_over_a_batch(shape: tuple[int, ...]) -> None:
    x, u = batch(shape)

    def one(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        assert (x.shape, u.shape) == ((2,), (1,))
        return bend(x, u)

    np.testing.assert_array_equal(Function(one).step(x, u), bend(x, u))
    np.testing.assert_array_equal(Function(bend, vectorized=True).step(x, u), bend(x, u))


@pytest.mark.parametrize("shape", [(), (1,), (5,), (2, 3)])
def test_a_plain_function_may_have_no_input(shape: tuple[int, ...]) -> None:
    x = batch(shape)[0]
    np.testing.assert_array_equal(Function(lambda x, u: 2 * x).step(x, x[..., :0]), 2 * x)


def test_one_input_serves_a_batch_of_states() -> None:
    x, u = batch((4,))
    expected = bend(x, np.broadcast_to(u[0], (4, 1)))
    np.testing.assert_array_equal(Function(bend).step(x, u[0]), expected)


def test_a_function_may_return_a_list() -> None:
    x, u = batch((3,))
    np.testing.assert_array_equal(Function(lambda x, u: [x[1], u[0]]).step(x, u), np.stack([x[:, 1], u[:, 0]], -1))


def test_a_model_stays_itself_and_a_function_becomes_a_model() -> None:
    linear = Linear([[1.0]], [[1.0]])
    assert as_model(linear) is linear
    made = as_model(bend)
    assert isinstance(made, Model)
    np.testing.assert_array_equal(made.step(*batch((3,))), bend(*batch((3,))))


def test_what_is_no_model_is_refused_by_value() -> None:
    with refuses(InputError, "step", "model.onnx"):
        as_model("model.onnx")


@pytest.mark.parametrize("vectorized", [False, True])
def test_differences_agree_with_the_derivative_in_a_batch_and_alone(vectorized: bool) -> None:
    model, (x, u) = Function(bend, vectorized=vectorized), batch((3, 2))
    A, B = linearize(model, x, u)
    assert (A.shape, B.shape) == ((3, 2, 2, 2), (3, 2, 2, 1))
    for i in np.ndindex(3, 2):
        expected = bend_jacobian(x[i], u[i])
        np.testing.assert_allclose(A[i], expected[0], atol=1e-8)
        np.testing.assert_allclose(B[i], expected[1], atol=1e-8)
        for alone, in_batch in zip(linearize(model, x[i], u[i]), (A[i], B[i]), strict=True):
            np.testing.assert_allclose(alone, in_batch, rtol=0, atol=1e-12)


@pytest.mark.parametrize("magnitude", [1e-3, 1.0, 1e3, 1e6])
def test_differences_keep_their_accuracy_at_large_states(magnitude: float) -> None:
    x = np.array([magnitude])
    A, _ = linearize(Function(lambda x, u: x**3 / magnitude**2), x, np.zeros(1))
    np.testing.assert_allclose(A, [[3.0]], rtol=1e-4)


def test_differences_of_a_linear_model_are_its_matrices() -> None:
    rng = np.random.default_rng(0)
    model = Linear(rng.normal(size=(3, 3)), rng.normal(size=(3, 2)), rng.normal(size=3))
    A, B = linearize(Function(model.step, vectorized=True), rng.normal(size=(5, 3)), rng.normal(size=(5, 2)))
    np.testing.assert_allclose(A, np.broadcast_to(model.A, A.shape), atol=1e-9)
    np.testing.assert_allclose(B, np.broadcast_to(model.B, B.shape), atol=1e-9)


def test_differences_of_a_horizon_and_a_batch_take_one_call_and_many_points_take_several() -> None:
    sizes = []

    def counted(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        sizes.append(len(x))
        return bend(x, u)

    model = Function(counted, vectorized=True)
    linearize(model, *batch((40, 8)))
    assert sizes == [3 * 4, 40 * 8 * 2 * 3]  # the first call finds out the precision of the model
    x, u = batch((2000,))
    A, B = linearize(model, x, u)
    assert max(sizes) <= 4096
    for i in (0, 681, 682, 683, 1999):
        expected = bend_jacobian(x[i], u[i])
        np.testing.assert_allclose(A[i], expected[0], atol=1e-8)
        np.testing.assert_allclose(B[i], expected[1], atol=1e-8)


RNG = np.random.default_rng(0)
INWARD, SHIFT, OUTWARD = RNG.normal(size=(3, 16)), RNG.normal(size=16), 0.3 * RNG.normal(size=(16, 2))


def small_network(x: np.ndarray, u: np.ndarray, kind: type = np.float64) -> np.ndarray:
    """Return a network that computes in this type, as a callable of torch or JAX does."""
    hidden = np.tanh(np.concatenate([x, u], axis=-1).astype(kind) @ INWARD.astype(kind) + SHIFT.astype(kind))
    return hidden @ OUTWARD.astype(kind)


@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("count", [1, 2, 40])
def test_a_model_in_single_precision_is_differentiated_with_steps_that_suit_it(count: int, scaled: bool) -> None:
    def step(kind: type) -> Function:
        def increments(x: np.ndarray, u: np.ndarray) -> np.ndarray:
            return x + 0.1 + 0.3 * small_network(x, u, kind)

        def plain(x: np.ndarray, u: np.ndarray) -> np.ndarray:
            return small_network(x, u, kind)

        return Function(increments if scaled else plain, vectorized=True)

    x, u = RNG.normal(size=(count, 2)), RNG.normal(size=(count, 1))
    for found, exact in zip(linearize(step(np.float32), x, u), linearize(step(np.float64), x, u), strict=True):
        np.testing.assert_allclose(found, exact, rtol=0, atol=3e-4)  # steps of 6e-6 err by 1e-2
    for alone, together in zip(linearize(step(np.float32), x[0], u[0]), linearize(step(np.float32), x, u), strict=True):
        np.testing.assert_allclose(alone, together[0], rtol=0, atol=1e-4)


@pytest.mark.parametrize("at", [0.0, 1.0, 1e3])
@pytest.mark.parametrize(
    "step", [np.sin, np.cos, np.abs, lambda x: np.maximum(x, 0.5), lambda x: x**3, lambda x: 0 * x]
)
def test_a_model_in_double_precision_keeps_its_fine_steps(step: Callable[[np.ndarray], np.ndarray], at: float) -> None:
    x = at + RNG.uniform(0.1, 0.2, size=(5, 1))
    found, fine = (central_differences(lambda x, u: step(x), x, np.zeros((5, 0)), of) for of in (None, 2.0**-52))
    np.testing.assert_array_equal(found[0], fine[0])


def test_the_own_jacobian_of_a_model_is_taken() -> None:
    class Own:
        def step(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
            raise AssertionError("not needed")

        def jacobian(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.array([[2.0]]), np.array([[3.0]])

    A, B = linearize(Own(), np.zeros(1), np.zeros(1))
    assert (A.tolist(), B.tolist()) == ([[2.0]], [[3.0]])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_jacobian_that_is_not_finite_is_refused(bad: float) -> None:
    with refuses(ModelError, "Jacobian"), np.errstate(invalid="ignore"):
        linearize(Function(lambda x, u: x * bad), np.ones(2), np.zeros(1))


def test_a_step_of_another_shape_is_named() -> None:
    wrong = Function(lambda x, u: np.zeros((*x.shape[:-1], 3)), vectorized=True)
    with refuses(ModelError, "model", (12, 2), (12, 3)):
        linearize(wrong, np.zeros((4, 2)), np.zeros((4, 1)))


def test_complex_states_are_refused() -> None:
    for function in (Function(lambda x, u: x + 1j), Function(lambda x, u: x + 1j, vectorized=True)):
        for x in (np.zeros(2), np.zeros((3, 2))):
            with refuses(InputError, "step"):
                function.step(x, x[..., :1])
