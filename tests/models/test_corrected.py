"""Models with a correction: their Jacobian, their files, and what is learned from executions of a refined model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctxval import Transitions, models
from ctxval.core.model import central_differences
from ctxval.errors import InputError, ShapeError
from ctxval.models.corrected import before_refinement
from ctxval.models.saved import is_savable, read_note
from ctxval.studies.fitting.model_file import write_onnx
from facts import refuses

LINEAR = models.Linear([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]], [0.1, 0.0])


def correction(seed: int = 0, centres: int = 10) -> models.Correction:
    rng = np.random.default_rng(seed)
    k, n = 3, 2
    return models.Correction(
        *(rng.normal(size=k), rng.uniform(0.5, 2, k), rng.normal(size=(centres, k)), rng.uniform(0.5, 2, k)),
        *(rng.normal(size=(centres, n)), rng.normal(size=(k + 1, n)), -np.ones(k), np.ones(k)),
        *(rng.uniform(0.5, 1, k), np.array([2.0, 3.0])),
    )


def pairs(seed: int = 1, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return 2 * rng.normal(size=(count, 2)), 2 * rng.normal(size=(count, 1))


@given(seed=st.integers(0, 200))
def test_the_jacobian_is_that_of_differences(seed: int) -> None:
    model = models.Corrected(LINEAR, correction(seed))
    x, u = pairs(seed)
    for own, expected in zip(model.jacobian(x, u), central_differences(model.step, x, u), strict=True):
        np.testing.assert_allclose(own, expected, atol=1e-7)


def test_shapes_broadcast_and_one_pair_is_a_row_of_a_batch() -> None:
    model = models.Corrected(LINEAR, correction())
    x, u = pairs()
    assert model.step(x.reshape(3, 20, 2), u.reshape(3, 20, 1)).shape == (3, 20, 2)
    assert model.jacobian(x.reshape(3, 20, 2), u.reshape(3, 20, 1))[0].shape == (3, 20, 2, 2)
    np.testing.assert_allclose(model.step(x[3], u[3]), model.step(x, u)[3], rtol=1e-12)


@given(seed=st.integers(0, 200))
def test_far_from_all_records_the_model_is_as_before(seed: int) -> None:
    found = correction(seed)
    x, u = 1e3 * (1 + np.abs(pairs(seed)[0])), pairs(seed)[1]
    assert not found(x, u).any()


@given(seed=st.integers(0, 200))
def test_a_correction_keeps_its_limits(seed: int) -> None:
    found = correction(seed)
    assert (np.abs(found(*pairs(seed))) <= found.limit).all()


def test_states_that_are_not_chosen_are_not_corrected() -> None:
    found = correction().of_states(np.array([True, False]))
    values = found(*pairs())
    assert values[:, 0].any()
    assert not values[:, 1].any()


def test_the_jacobian_of_the_model_before_can_be_kept() -> None:
    model = models.Corrected(LINEAR, correction(), linearised="model")
    A, B = model.jacobian(*pairs())
    assert A is LINEAR.A
    assert B is LINEAR.B
    assert not np.allclose(model.step(*pairs()), LINEAR.step(*pairs()))


@pytest.mark.parametrize("linearised", ["corrected", "model"])
def test_a_corrected_model_is_read_as_it_was_written(tmp_path: Path, linearised: Any) -> None:
    x, u = pairs()
    data = Transitions(x, u, x)
    model = models.Refined(models.Corrected(LINEAR, correction(), linearised=linearised, data=data), data, LINEAR)
    models.write_model(tmp_path / "m.npz", model, {"method": "residual"})
    read: Any = models.read_model(tmp_path / "m.npz")
    np.testing.assert_array_equal(read.step(x, u), model.step(x, u))
    assert (read.linearised, len(read.data)) == (linearised, 60)
    assert read_note(tmp_path / "m.npz") == {"method": "residual"}
    assert not list(tmp_path.glob("*.part"))


def test_a_correction_of_a_function_is_read_with_that_function(tmp_path: Path) -> None:
    function = models.Function(LINEAR.step, vectorized=True)
    models.write_model(tmp_path / "m.npz", models.Corrected(function, correction()))
    with refuses(InputError, "m.npz", "read_refined"):
        models.read_model(tmp_path / "m.npz")
    read = models.read_refined(tmp_path / "m.npz", function)
    np.testing.assert_array_equal(read.step(*pairs()), models.Corrected(LINEAR, correction()).step(*pairs()))
    assert is_savable(read)
    assert not is_savable(function)


def test_a_file_of_onnx_gives_the_same_steps_without_ctxval(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    x, u = pairs()
    data = Transitions(x, u, x + 0.1 * np.sin(x) + 0.05 * u)
    gaussian = models.GaussianProcessModel.fit(data, 30)
    for number, model in enumerate((models.Corrected(LINEAR, correction()), gaussian)):
        write_onnx(tmp_path / f"{number}.onnx", model)
        read = models.Onnx(tmp_path / f"{number}.onnx")
        np.testing.assert_allclose(read.step(x, u), model.step(x, u), atol=1e-10)
    with refuses(InputError, "Function", "Linear.step"):
        write_onnx(tmp_path / "no.onnx", models.Corrected(models.Function(LINEAR.step), correction()))


def test_executions_teach_the_residual_of_the_model_before() -> None:
    x, u = pairs()
    corrected = models.Corrected(LINEAR, correction())
    first = models.Refined(corrected, Transitions(x, u, x), LINEAR)
    again = models.Refined(corrected, Transitions(x, u, x), first)
    assert before_refinement(first) is before_refinement(again) is before_refinement(corrected) is LINEAR
    assert before_refinement(LINEAR) is LINEAR
    assert hasattr(first, "jacobian")
    assert not hasattr(models.Refined(models.Function(LINEAR.step), Transitions(x, u, x), LINEAR), "jacobian")


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"limit": np.ones(3)}, ShapeError),
        ({"weights": np.ones((9, 2))}, ShapeError),
        ({"fade": np.zeros(3)}, InputError),
        ({"shift": np.full(3, np.nan)}, InputError),
    ],
)
def test_arrays_that_do_not_fit_are_refused(change: dict[str, np.ndarray], error: type[Exception]) -> None:
    with pytest.raises(error):
        replace(correction(), **change)


def test_a_correction_may_be_of_states_alone_and_has_at_least_one() -> None:
    alone, first = correction(), np.arange(2)
    of_pairs = ("shift", "scale", "centres", "length_scales", "low", "high", "fade")
    parts = {name: getattr(alone, name)[..., first] for name in of_pairs}
    found = replace(alone, **parts, linear=alone.linear[[0, 1, 3]])
    x = pairs()[0]
    assert found(x, np.empty((len(x), 0))).shape == x.shape
    assert found.jacobian(x, np.empty((len(x), 0))).shape == (*x.shape, 2)
    with refuses(ShapeError, 3, 1, 4):
        replace(alone, limit=np.ones(4))
