"""A trained policy as an ONNX file, built here with onnx itself."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from ctxval import Task, testing
from ctxval._util.arrays import Array
from ctxval._util.describe import describe, first_difference
from ctxval.controllers import OnnxPolicy, RecurrentPolicy
from ctxval.core.rollout import rollout
from ctxval.errors import InputError, ShapeError
from ctxval.models import Linear
from facts import refuses

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

CART = Linear([[1.0, 0.1], [0.0, 0.95]], [[0.0], [0.1]])
TASKS = Task([np.linspace(-1, 1, 4), 0.0], goal=[0.3, 0.0], horizon=12, dt=0.1)
GAIN = np.array([[-1.0], [-1.5]], dtype=np.float32)


def policy(rows: object = "N", inputs: int = 1) -> bytes:
    """Return ``tanh(x GAIN)`` as ONNX."""
    names = ["x", "y"][:inputs]
    nodes = [helper.make_node("MatMul", ["x", "K"], ["a"]), helper.make_node("Tanh", ["a"], ["u"])]
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [rows, 2]) for name in names],
        [helper.make_tensor_value_info("u", TensorProto.FLOAT, [rows, 1])],
        [numpy_helper.from_array(GAIN, "K")],
    )
    content: bytes = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8
    ).SerializeToString()
    return content


def deviation(t: int, x: Array, task: Task) -> Array:
    return x - task.goal


@pytest.mark.parametrize("rows", ["N", 1])
def test_inputs_are_what_the_network_says(rows: object) -> None:
    controller = OnnxPolicy(policy(rows), observe=deviation, scale=2.0).design(TASKS, CART)
    x = np.random.default_rng(0).normal(size=(4, 2))
    np.testing.assert_allclose(controller(0, x), 2 * np.tanh((x - TASKS.goal) @ GAIN), rtol=0, atol=1e-6)


@pytest.mark.parametrize("rows", ["N", 1])
def test_it_keeps_the_contract_of_a_synthesizer(rows: object) -> None:
    testing.check_synthesizer(OnnxPolicy(policy(rows), observe=deviation), TASKS, Linear(CART.A, np.float64(CART.B)))


def test_states_are_observed_unless_said_otherwise_and_limits_clip(tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    path.write_bytes(policy())
    controller = OnnxPolicy(path, scale=5.0, limits=1.0).design(TASKS[0], CART)
    np.testing.assert_array_equal(controller(0, np.array([9.0, 0.0])), [-1.0])
    assert rollout(CART.step, controller, TASKS[0]).inputs.shape == (12, 1)


def test_it_can_be_described_and_sent_to_another_process() -> None:
    synthesizer = OnnxPolicy(policy(), observe=deviation, limits=1.0)
    other = pickle.loads(pickle.dumps(synthesizer.design(TASKS, CART)))
    x = TASKS.initial_state
    np.testing.assert_array_equal(other(0, x), synthesizer.design(TASKS, CART)(0, x))
    assert (
        first_difference(describe(synthesizer), describe(OnnxPolicy(policy(), observe=deviation, limits=1.0))) is None
    )
    assert first_difference(describe(synthesizer), describe(OnnxPolicy(policy(), observe=deviation))) is not None


def test_it_is_described_by_its_settings() -> None:
    synthesizer = OnnxPolicy(policy(), observe=deviation, limits=1.0)
    assert list(describe(synthesizer)) == ["type", "network", "observe", "scale", "limits"]
    assert describe(synthesizer)["limits"] == {"type": "Limits", "low": -1.0, "high": 1.0}
    assert describe(OnnxPolicy(policy()))["limits"] is None


def recurrent(rows: object = "N", layers: int | None = None, open_width: bool = False) -> bytes:
    """Return a leaky integrator ``h' = 0.5 h + x[0]``, ``u = -h'[0] - h'[1]``, with a value as its second output."""
    shape = [rows, 2] if layers is None else [layers, rows, 2]
    nodes = [
        helper.make_node("Mul", ["h", "half"], ["a"]),
        helper.make_node("MatMul", ["x", "W"], ["b"]),
        helper.make_node("Add", ["a", "b"], ["h_new"]),
        helper.make_node("MatMul", ["h_new", "minus"], ["c"]),
        helper.make_node(
            "Identity" if layers is None else "ReduceSum", ["c"] if layers is None else ["c", "axis"], ["u"]
        ),
        helper.make_node("Identity", ["x"], ["value"]),
    ]
    if layers is not None:
        nodes[4].attribute.append(helper.make_attribute("keepdims", 0))
    graph = helper.make_graph(
        nodes,
        "recurrent",
        [
            helper.make_tensor_value_info("x", TensorProto.FLOAT, [rows, 2]),
            helper.make_tensor_value_info("h", TensorProto.FLOAT, [*shape[:-1], "K" if open_width else 2]),
        ],
        [
            helper.make_tensor_value_info("u", TensorProto.FLOAT, [rows, 1]),
            helper.make_tensor_value_info("value", TensorProto.FLOAT, [rows, 2]),
            helper.make_tensor_value_info("h_new", TensorProto.FLOAT, shape),
        ],
        [
            numpy_helper.from_array(np.array(0.5, dtype=np.float32), "half"),
            numpy_helper.from_array(np.array([[1.0, 0.2], [0.0, 0.1]], dtype=np.float32), "W"),
            numpy_helper.from_array(-np.ones((2, 1), dtype=np.float32), "minus"),
            numpy_helper.from_array(np.array([0], dtype=np.int64), "axis"),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return bytes(model.SerializeToString())


@pytest.mark.parametrize(("rows", "layers"), [("N", None), (1, None), ("N", 1), ("N", 3), (1, 2)])
def test_states_of_a_network_are_the_memory_of_its_controller(rows: object, layers: int | None) -> None:
    synthesizer = OnnxPolicy(recurrent(rows, layers), observe=deviation, scale=0.5, limits=2.0)
    testing.check_synthesizer(synthesizer, TASKS, Linear(CART.A, np.float64(CART.B)))
    controller = synthesizer.design(TASKS, CART)
    assert isinstance(controller, RecurrentPolicy)
    controller = pickle.loads(pickle.dumps(controller))
    loop = rollout(CART.step, controller, TASKS)
    h = np.zeros((4, 2))
    for t in range(TASKS.horizon):
        h = 0.5 * h + (loop.states[:, t] - TASKS.goal) @ [[1.0, 0.2], [0.0, 0.1]]
        u = -0.5 * (layers or 1) * h.sum(axis=1, keepdims=True)
        np.testing.assert_allclose(loop.inputs[:, t], np.clip(u, -2, 2), atol=1e-5)
    starts = np.stack([TASKS.initial_state, TASKS.initial_state + 0.1])
    drawn = Task(starts, horizon=TASKS.horizon, dt=TASKS.dt, reference=TASKS.reference)
    np.testing.assert_allclose(rollout(CART.step, controller, drawn).states[0], loop.states, atol=1e-6)


def test_states_that_do_not_fit_are_refused() -> None:
    with refuses(InputError, "h_new", "state"):
        OnnxPolicy(recurrent(open_width=True))


def test_other_networks_and_observations_are_refused() -> None:
    with refuses(InputError, "network"):
        OnnxPolicy(policy(inputs=2))
    with refuses(ShapeError, "x", 2, 3):
        OnnxPolicy(policy()).design(Task(np.zeros(3), horizon=2, dt=0.1), CART)(0, np.zeros(3))
