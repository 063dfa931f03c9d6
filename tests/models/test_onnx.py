"""ONNX networks, built here with onnx itself, as models."""

from __future__ import annotations

import os
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import Task, controllers, testing
from ctxval._util.arrays import Array
from ctxval._util.describe import describe, first_difference
from ctxval.core.model import linearize
from ctxval.core.rollout import rollout
from ctxval.errors import InputError, ModelError, ShapeError
from ctxval.models import Onnx
from facts import refuses

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

RNG = np.random.default_rng(0)
W1, b1, W2 = 0.5 * RNG.normal(size=(3, 8)), 0.1 * RNG.normal(size=8), 0.3 * RNG.normal(size=(8, 2))
DOUBLE, SINGLE = TensorProto.DOUBLE, TensorProto.FLOAT


def expected(x: Array, u: Array) -> Array:
    return np.tanh(np.concatenate([x, u], axis=-1) @ W1 + b1) @ W2


def network(
    kind: int = DOUBLE, rows: Any = "N", two_inputs: bool = False, width: int = 3, outputs: int = 2, flat: bool = False
) -> bytes:
    """Return ``tanh((x, u) W1 + b1) W2`` as ONNX."""

    def shape(size: Any) -> list[Any]:
        return [size] if flat else [rows, size]

    names = {"x": 2, "u": width - 2} if two_inputs else {"xu": width}
    weights = {"W1": W1[:width], "b1": b1, "W2": W2[:, :outputs]}
    dtype = helper.tensor_dtype_to_np_dtype(kind)
    nodes = [
        *([helper.make_node("Concat", ["x", "u"], ["xu"], axis=-1)] if two_inputs else []),
        helper.make_node("MatMul", ["xu", "W1"], ["a"]),
        helper.make_node("Add", ["a", "b1"], ["b"]),
        helper.make_node("Tanh", ["b"], ["c"]),
        helper.make_node("MatMul", ["c", "W2"], ["y"]),
    ]
    graph = helper.make_graph(
        nodes,
        "network",
        [helper.make_tensor_value_info(name, kind, shape(size)) for name, size in names.items()],
        [helper.make_tensor_value_info("y", kind, shape(outputs))],
        [numpy_helper.from_array(value.astype(dtype), name) for name, value in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    content: bytes = model.SerializeToString()
    return content


VARIANTS: dict[str, dict[str, Any]] = {
    "batched": {},
    "two inputs": {"two_inputs": True},
    "one row": {"rows": 1},
    "flat": {"flat": True},
    "two flat inputs": {"two_inputs": True, "flat": True},
}


@pytest.mark.parametrize("increments", [False, True])
@pytest.mark.parametrize("variant", VARIANTS)
def test_a_step_is_what_the_network_says(variant: str, increments: bool) -> None:
    model = Onnx(network(**VARIANTS[variant]), increments=increments)
    x, u = RNG.normal(size=(4, 3, 2)), RNG.normal(size=(4, 3, 1))
    np.testing.assert_allclose(model.step(x, u), expected(x, u) + increments * x, rtol=0, atol=1e-12)
    testing.check_model(model, states=2, inputs=1)


@pytest.mark.parametrize("increments", [False, True])
def test_single_precision_has_a_jacobian_that_can_be_used(increments: bool) -> None:
    model, exact = Onnx(network(SINGLE), increments=increments), Onnx(network(), increments=increments)
    x, u = RNG.normal(size=(5, 2)), RNG.normal(size=(5, 1))
    np.testing.assert_allclose(model.step(x, u), exact.step(x, u), rtol=0, atol=1e-6)
    for found, true in zip(linearize(model, x, u), linearize(exact, x, u), strict=True):
        np.testing.assert_allclose(found, true, rtol=0, atol=1e-3)
    testing.check_model(model, states=2, inputs=1, tolerance=5e-7)


def test_controllers_are_designed_on_a_file(tmp_path: Path) -> None:
    path = tmp_path / "model.onnx"
    path.write_bytes(network(SINGLE))
    task = Task([[0.3, 0.1], [0.5, -0.2]], goal=[0.2, 0.0], horizon=12, dt=0.1)
    model, exact = Onnx(path), Onnx(network())
    synthesizer = controllers.ILQR([1.0, 0.1], [0.1])
    found, true = (rollout(m.step, synthesizer.design(task, m), task).states for m in (model, exact))
    np.testing.assert_allclose(found, true, atol=1e-3)


def test_states_and_inputs_broadcast() -> None:
    model = Onnx(network())
    x, u = RNG.normal(size=(4, 2)), RNG.normal(size=1)
    np.testing.assert_allclose(model.step(x, u), expected(x, np.tile(u, (4, 1))), atol=1e-12)


def test_it_can_be_described_and_sent_to_another_process() -> None:
    model = Onnx(network())
    other = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(other.step(np.ones(2), np.ones(1)), model.step(np.ones(2), np.ones(1)))
    assert first_difference(describe(model), describe(other)) is None
    assert first_difference(describe(model), describe(Onnx(network(SINGLE)))) is not None


def test_weights_may_stand_in_a_second_file(tmp_path: Path) -> None:
    def saved(name: str, scale: float) -> Path:
        content = onnx.load_from_string(network())
        for tensor in content.graph.initializer:
            tensor.CopyFrom(numpy_helper.from_array(scale * numpy_helper.to_array(tensor), tensor.name))
        onnx.save(content, tmp_path / name, save_as_external_data=True, location=f"{name}.data", size_threshold=0)
        return tmp_path / name

    model = Onnx(saved("model.onnx", 1.0))
    x, u = np.ones(2), np.ones(1)
    np.testing.assert_allclose(model.step(x, u), expected(x, u), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(model)).step(x, u), model.step(x, u))
    before = describe(model)
    assert first_difference(before, describe(Onnx(saved("model.onnx", 2.0)))) is not None


# What the user may get wrong


def test_shapes_must_fit() -> None:
    model = Onnx(network())
    with refuses(ShapeError, "xu", 3, 4):
        model.step(np.zeros(2), np.zeros(2))
    with refuses(ShapeError, 1, 2):
        model.step(np.zeros(1), np.zeros(2))
    with refuses(ShapeError, "u", 1, 2):
        Onnx(network(two_inputs=True)).step(np.zeros(2), np.zeros(2))


def test_an_open_width_is_checked_when_it_is_used() -> None:
    content = onnx.load_from_string(network())
    content.graph.input[0].type.tensor_type.shape.dim[1].dim_param = "k"
    model = Onnx(content.SerializeToString())
    np.testing.assert_allclose(model.step(np.ones(2), np.ones(1)), expected(np.ones(2), np.ones(1)), atol=1e-12)
    with refuses(ModelError, 1, 59):
        model.step(np.zeros(2), np.zeros(2))


def test_other_networks_and_files_are_refused(tmp_path: Path) -> None:
    with refuses(InputError, "rows", 4):
        Onnx(network(rows=4))
    with refuses(InputError, "INVALID_PROTOBUF", 7):
        Onnx(b"junk")
    with refuses(InputError, "none.onnx"):
        Onnx(tmp_path / "none.onnx")
    os.mkfifo(tmp_path / "fifo.onnx")
    with refuses(InputError, "fifo.onnx", "FIFO"):
        Onnx(tmp_path / "fifo.onnx")
    content = onnx.load_from_string(network(two_inputs=True))
    content.graph.input.append(helper.make_tensor_value_info("extra", DOUBLE, ["N", 1]))
    with refuses(InputError, "extra", "model"):
        Onnx(content.SerializeToString())
    whole = helper.make_graph(
        [helper.make_node("Identity", ["i"], ["y"])],
        "integers",
        [helper.make_tensor_value_info("i", TensorProto.INT64, ["N", 3])],
        [helper.make_tensor_value_info("y", TensorProto.INT64, ["N", 3])],
    )
    model = helper.make_model(whole, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    with refuses(InputError, "i", "N"):
        Onnx(model.SerializeToString())


def test_without_onnxruntime_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with refuses(InputError, "ctxval[onnx]"):
        Onnx(network())
