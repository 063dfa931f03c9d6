"""Networks of policies from files of numpy, TorchScript and Stable-Baselines3."""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval.controllers.policy_networks import Perceptron, read_network
from ctxval.errors import InputError, ShapeError, UnknownNameError
from facts import refuses

RNG = np.random.default_rng(0)
LAYERS = [(RNG.normal(size=(5, 3)), RNG.normal(size=5)), (RNG.normal(size=(2, 5)), RNG.normal(size=2))]
X = RNG.normal(size=(4, 6, 3))


def expected(x: Any = X, final: Any = lambda a: a) -> Any:
    (W0, b0), (W1, b1) = LAYERS
    return final(np.tanh(x @ W0.T + b0) @ W1.T + b1)


def test_arrays_of_numpy_are_a_network(tmp_path: Path) -> None:
    arrays = {
        f"{letter}{k}": array for k, layer in enumerate(LAYERS) for letter, array in zip("Wb", layer, strict=True)
    }
    np.savez(tmp_path / "a.npz", **arrays, activation=np.array("tanh"), final=np.array("tanh"))
    network = read_network(tmp_path / "a.npz")
    assert network.widths == (3,)
    assert network.width == 2
    assert network.outputs(X)[0] == pytest.approx(expected(final=np.tanh))
    np.savez(tmp_path / "linear.npz", W0=LAYERS[0][0])
    assert read_network(tmp_path / "linear.npz").outputs(X)[0] == pytest.approx(X @ LAYERS[0][0].T)
    assert network.describe() != Perceptron(LAYERS).describe()


def test_what_is_no_network_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", W0=np.zeros((2, 3)), W1=np.zeros((2, 3)))
    with refuses(InputError, "fit"):
        read_network(tmp_path / "a.npz")
    with refuses(InputError, ".onnx"):
        read_network(tmp_path / "a.h5")
    with refuses(UnknownNameError, "swish"):
        Perceptron(LAYERS, "swish")
    with refuses(ShapeError, "3 numbers"):
        Perceptron(LAYERS).outputs(np.zeros(2))


def modules() -> Any:
    return pytest.importorskip("torch", reason="torch is not installed: pip install 'ctxval[torch]'")


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_torchscript_is_a_network(tmp_path: Path) -> None:
    torch = modules()
    net = torch.nn.Sequential(torch.nn.Linear(3, 5), torch.nn.Tanh(), torch.nn.Linear(5, 2)).double()
    with torch.no_grad():
        for layer, (W, b) in zip((net[0], net[2]), LAYERS, strict=True):
            layer.weight[:], layer.bias[:] = torch.tensor(W), torch.tensor(b)
    torch.jit.script(net).save(str(tmp_path / "a.pt"))
    network = read_network(tmp_path / "a.pt")
    assert network.outputs(X)[0] == pytest.approx(expected())
    assert pickle.loads(pickle.dumps(network)).outputs(X[0])[0] == pytest.approx(expected(X[0]))


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_a_recurrent_torchscript_keeps_its_buffers_in_the_memory(tmp_path: Path) -> None:
    torch = modules()

    class Exported(torch.nn.Module):  # type: ignore[name-defined, misc]
        def __init__(self) -> None:
            super().__init__()
            self.memory = torch.nn.LSTM(3, 4)
            self.head = torch.nn.Linear(4, 2)
            self.register_buffer("hidden_state", torch.zeros(1, 1, 4))
            self.register_buffer("cell_state", torch.zeros(1, 1, 4))

        def forward(self, x):  # type: ignore[no-untyped-def]
            out, (h, c) = self.memory(x.unsqueeze(0), (self.hidden_state, self.cell_state))
            self.hidden_state[:] = h
            self.cell_state[:] = c
            return self.head(out.squeeze(0))

    torch.manual_seed(0)
    module = Exported()
    torch.jit.script(module).save(str(tmp_path / "a.pt"))
    network = read_network(tmp_path / "a.pt")
    assert network.widths == (None, 4, 4)
    states = [np.zeros((4, 4)), np.zeros((4, 4))]
    for k in range(3):
        output, *states = network.outputs(X[:, k], *states)
    with torch.no_grad():
        for k in range(3):
            alone = module(torch.tensor(X[2, k][None], dtype=torch.float32))
    assert output[2] == pytest.approx(alone.numpy()[0], abs=1e-6)


@pytest.mark.parametrize("kind", ["ppo", "sac", "td3"])
def test_models_of_stable_baselines_are_networks(tmp_path: Path, kind: str) -> None:
    torch = modules()
    hidden, last = {"ppo": ("mlp_extractor.policy_net.0", "action_net"), "sac": ("actor.latent_pi.0", "actor.mu"),
                    "td3": ("actor.mu.0", "actor.mu.2")}[kind]  # fmt: skip
    weights = {}
    for name, (W, b) in zip((hidden, last), LAYERS, strict=True):
        weights |= {f"{name}.weight": torch.tensor(W), f"{name}.bias": torch.tensor(b)}
    content = io.BytesIO()
    torch.save({**weights, "log_std": torch.zeros(2)}, content)
    activation = "<class 'torch.nn.modules.activation.Tanh'>"
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("policy.pth", content.getvalue())
        archive.writestr("data", json.dumps({"policy_kwargs": {":serialized:": "x", "activation_fn": activation}}))
    network = read_network(tmp_path / "a.zip")
    assert network.outputs(X)[0] == pytest.approx(expected(final=np.tanh if kind != "ppo" else lambda a: a))
