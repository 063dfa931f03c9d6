"""A crane whose model is a network in single precision, on which iLQR often stops before it has converged.

Newton's equations of a trolley with a load on a rope (Spong, Hutchinson and Vidyasagar, *Robot Modeling and Control*).
The load is a state that never changes. M is a network that exports of the usual toolboxes resemble: float32 throughout,
with the input limits of the drive in the controller.
"""

from __future__ import annotations

import warnings

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor

from ctxval import Experiment, Task, TaskSpace, Validation, controllers, distances, models
from ctxval._util.arrays import Array
from ctxval.core.labels import Labels
from ctxval.systems import Simulated
from ctxval.systems.functions import rk4

DT, HORIZON = 0.1, 30
TROLLEY, ROPE, GRAVITY, DRAG = 2.0, 1.0, 9.81, 0.6
"""kg, m, m/s^2, N s/m."""
FORCE = 6.0
"""Limit of the drive, N."""
LOW, HIGH = np.array([-3.0, -3.0, -0.9, -3.0, 0.2]), np.array([3.0, 3.0, 0.9, 3.0, 2.0])
"""The states from which M is learned: position, speed, sway, sway rate and load."""


def derivative(x: Array, u: Array) -> Array:
    """Return the derivative of position, speed, sway, sway rate and load; u is the force on the trolley in N."""
    speed, sway, rate, load = (x[..., k] for k in range(1, 5))
    sine, cosine, push = np.sin(sway), np.cos(sway), u[..., 0] - DRAG * speed
    total = TROLLEY + load * sine**2
    faster = (push + load * sine * (ROPE * rate**2 + GRAVITY * cosine)) / total
    turned = -(push * cosine + load * ROPE * rate**2 * sine * cosine + (TROLLEY + load) * GRAVITY * sine)
    return np.stack([speed, faster, rate, turned / (ROPE * total), np.zeros_like(load)], axis=-1)


SYSTEM = Simulated(rk4(derivative, DT), vectorized=True)


def network(seed: int) -> bytes:
    """Return M as an ONNX file: ``x + scale tanh(...)``, in single precision."""
    rng = np.random.default_rng(seed)
    x, u = rng.uniform(LOW, HIGH, (1500, 5)), rng.uniform(-FORCE, FORCE, (1500, 1))
    pairs = np.concatenate([x, u], axis=1)
    change = (SYSTEM.model.step(x, u) - x)[:, :4]
    shift, scale, size = pairs.mean(axis=0), pairs.std(axis=0), change.std(axis=0)
    learned = MLPRegressor(
        hidden_layer_sizes=(16, 16), activation="tanh", solver="lbfgs", max_iter=150, random_state=seed
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a rough network is what is wanted
        learned.fit((pairs - shift) / scale, change / size)
    (W1, W2, W3), (b1, b2, b3) = learned.coefs_, learned.intercepts_
    constants = {
        "W1": W1 / scale[:, None],
        "b1": b1 - (shift / scale) @ W1,
        "W2": W2,
        "b2": b2,
        "W3": np.pad(W3 * size, ((0, 0), (0, 1))),
        "b3": np.append(b3 * size, 0.0),
        "keep": np.eye(6)[:, :5],
    }
    nodes = [
        helper.make_node("Gemm", ["z", "W1", "b1"], ["a"]),
        helper.make_node("Tanh", ["a"], ["b"]),
        helper.make_node("Gemm", ["b", "W2", "b2"], ["c"]),
        helper.make_node("Tanh", ["c"], ["d"]),
        helper.make_node("Gemm", ["d", "W3", "b3"], ["change"]),
        helper.make_node("MatMul", ["z", "keep"], ["x"]),
        helper.make_node("Add", ["x", "change"], ["x_next"]),
    ]
    value, kind = helper.make_tensor_value_info, TensorProto.FLOAT
    tensors = [numpy_helper.from_array(array.astype(np.float32), name) for name, array in constants.items()]
    graph = helper.make_graph(nodes, "crane", [value("z", kind, ["N", 6])], [value("x_next", kind, ["N", 5])], tensors)
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(made)
    return bytes(made.SerializeToString())


def experiment(seed: int) -> Experiment:
    """Return the crane that carries a load to a goal."""

    def task(p: object) -> Task:
        zero = np.zeros_like(p.load)  # type: ignore[attr-defined]
        start = np.stack([zero, zero, zero, zero, p.load], axis=-1)  # type: ignore[attr-defined]
        goal = np.stack([p.goal, zero, zero, zero, p.load], axis=-1)  # type: ignore[attr-defined]
        return Task(start, goal=goal, horizon=HORIZON, dt=DT)

    validation = Validation(
        space=TaskSpace(goal=(-2.0, 2.0, "m"), load=(0.3, 1.8, "kg")),
        task=task,
        system=SYSTEM,
        model=models.Onnx(network(seed)),
        synthesizer=controllers.ILQR(
            [1.0, 0.1, 2.0, 0.1, 0.0], [0.01], [20.0, 2.0, 20.0, 2.0, 0.0], limits=FORCE, iterations=30
        ),
        distance=distances.MaximumDeviation(components=(0,)),
        labels=Labels(
            ("position [m]", "speed [m/s]", "sway [rad]", "sway rate [rad/s]", "load [kg]"), ("force [N]",), "m"
        ),
    )
    return Experiment("crane", validation, budget=20)
