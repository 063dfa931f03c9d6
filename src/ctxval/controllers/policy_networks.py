"""Networks of policies from files: ONNX, arrays of numpy, TorchScript and Stable-Baselines3."""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import re
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ctxval._util.arrays import Array, rows_of
from ctxval._util.checked import require_known
from ctxval._util.files import Archive, read_bytes
from ctxval._util.onnx_network import OnnxNetwork
from ctxval._util.refusals import require_extra, reworded
from ctxval._util.representation import ShortRepr
from ctxval.errors import InputError, ModelError, ShapeError


class PolicyNetwork(Protocol):
    """A network of a policy: rows of observations, and of its states if it is recurrent, to actions and new states."""

    widths: tuple[int | None, ...]  #: numbers of values of the observation and of each state; None if it is not known
    width: int | None  #: number of actions

    def outputs(self, *inputs: Array) -> list[Array]:
        """Return actions and new states, each ``(..., k)``."""

    def describe(self) -> dict[str, Any]:
        """Return what identifies the network in a store."""


def read_network(path: str | Path) -> PolicyNetwork:
    """Read the network of a policy by the ending of its file.

    An ``.onnx`` may have recurrent states (:class:`ctxval.controllers.OnnxPolicy`). An ``.npz`` has weights ``W0``,
    ``b0``, ``W1``, ... of ``W x + b`` and texts ``activation`` and ``final``, names of :data:`ACTIVATIONS`. A ``.pt``
    is TorchScript, and ``.zip`` a model that Stable-Baselines3 saved; both need torch (extra ``torch``). TorchScript is
    a program, so read only files that you trust. All other files hold no code that is run.
    """
    readers: dict[str, Callable[[Path], PolicyNetwork]] = {
        ".onnx": lambda file: OnnxNetwork(file, recurrent=True),
        ".npz": _of_numpy,
        ".pt": TorchScript,
        ".pth": TorchScript,
        ".jit": TorchScript,
        ".zip": _of_stable_baselines,
    }
    ending = Path(path).suffix.lower()
    if ending not in readers:
        raise InputError(f"the network of a policy must be a file {', '.join(readers)}, got {str(path)!r}.")
    return readers[ending](Path(path))


ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "none": lambda x: x,
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
    "leaky_relu": lambda x: np.where(x > 0, x, 0.01 * x),
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0.0))),
    "silu": lambda x: x / (1.0 + np.exp(-x)),
    "softsign": lambda x: x / (1.0 + np.abs(x)),
}


class Perceptron(ShortRepr):
    """A network of dense layers in double precision: ``W x + b``, and an activation after each layer but the last.

    Args:
        layers: weights ``(outputs, inputs)`` and biases ``(outputs,)`` of each layer.
        activation, final: names of :data:`ACTIVATIONS`; the latter is that of the last layer.
    """

    def __init__(self, layers: list[tuple[Array, Array]], activation: str = "tanh", final: str = "none") -> None:
        require_known("activation", (activation, final), ACTIVATIONS)
        sizes = [(*weights.shape, *biases.shape) for weights, biases in layers]
        fits = all(len(size) == 3 and size[0] == size[2] for size in sizes)
        if not sizes or not fits or any(one[0] != after[1] for one, after in itertools.pairwise(sizes)):
            raise ShapeError(f"layers need weights (outputs, inputs) and biases (outputs,) that fit, got {sizes}.")
        self.layers, self.activation, self.final = layers, activation, final
        self.widths: tuple[int | None, ...] = (layers[0][0].shape[1],)
        self.width: int | None = layers[-1][0].shape[0]

    def outputs(self, *inputs: Array) -> list[Array]:
        (x,) = inputs
        if x.shape[-1] != self.widths[0]:
            raise ShapeError(f"the network takes {self.widths[0]} numbers, got {x.shape[-1]}.")
        with np.errstate(over="ignore"):
            for k, (weights, biases) in enumerate(self.layers):
                name = self.final if k == len(self.layers) - 1 else self.activation
                x = ACTIVATIONS[name](x @ weights.T + biases)
        return [x]

    def describe(self) -> dict[str, Any]:
        digest = hashlib.sha256()
        for weights, biases in self.layers:
            digest.update(weights.tobytes() + biases.tobytes())
        return {"weights": digest.hexdigest()[:16], "activation": self.activation, "final": self.final}


def _of_numpy(path: Path) -> Perceptron:
    with reworded(f"the network {path} cannot be read", InputError):
        arrays = Archive(read_bytes(path))
        layers = list[tuple[Array, Array]]()
        while (name := f"W{len(layers)}") in arrays.names:
            weights, bias = arrays.numbers(name), f"b{len(layers)}"
            layers.append((weights, arrays.numbers(bias) if bias in arrays.names else np.zeros(len(weights))))
        texts = {name: arrays.text(name) for name in ("activation", "final") if name in arrays.names}
        return Perceptron(layers, **texts)


def _torch() -> Any:
    return require_extra("torch", "torch", "policies as TorchScript or of Stable-Baselines3 need")


_STATES = ("hidden_state", "cell_state")  # buffers in which exported recurrent policies keep their memory


class TorchScript(ShortRepr):
    """A policy that was exported as TorchScript, on one thread.

    The states of a recurrent policy are its buffers ``hidden_state`` and ``cell_state`` of shape ``(L, 1, k)``, as
    exporters of legged robots write them. Each row is then computed alone.
    """

    def __init__(self, source: Path | bytes) -> None:
        torch = _torch()
        self._contents = source if isinstance(source, bytes) else read_bytes(source, most=2**34)
        with reworded("the file cannot be read as TorchScript", Exception), warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # torch deprecates what its users still export
            self._module = torch.jit.load(io.BytesIO(self._contents), map_location="cpu").eval()
        buffers = dict(self._module.named_buffers())
        self._buffers = [buffers[name] for name in _STATES if name in buffers]
        self.widths: tuple[int | None, ...] = (None, *(buffer.numel() for buffer in self._buffers))
        self.width: int | None = None
        kinds = [each.dtype for each in self._module.parameters() if each.is_floating_point()]
        self._kind = kinds[0] if kinds else torch.float32

    def outputs(self, *inputs: Array) -> list[Array]:
        torch, batch = _torch(), np.broadcast_shapes(*(array.shape[:-1] for array in inputs))
        rows = [rows_of(np.broadcast_to(array, (*batch, array.shape[-1]))) for array in inputs]
        chunks = range(len(rows[0])) if self._buffers else [slice(None)]
        collected, threads = list[list[Array]](), torch.get_num_threads()
        torch.set_num_threads(1)  # the last bits depend on the number of threads
        try:
            with torch.no_grad(), reworded("the network cannot be evaluated", Exception, to=ModelError):
                for chunk in chunks:
                    observed, *states = (row[np.atleast_1d(np.arange(len(row))[chunk])] for row in rows)
                    for buffer, state in zip(self._buffers, states, strict=True):
                        buffer.copy_(torch.tensor(state, dtype=buffer.dtype).reshape(buffer.shape))
                    action = self._module(torch.tensor(observed, dtype=self._kind)).reshape(len(observed), -1)
                    new = (buffer.reshape(1, -1) for buffer in self._buffers)
                    collected.append([each.numpy().astype(np.float64) for each in (action, *new)])
        finally:
            torch.set_num_threads(threads)
        return [np.concatenate(parts).reshape(*batch, -1) for parts in zip(*collected, strict=True)]

    def describe(self) -> dict[str, Any]:
        return {"torchscript": hashlib.sha256(self._contents).hexdigest()[:16]}

    def __reduce__(self) -> tuple[Any, ...]:
        return TorchScript, (self._contents,)


_ACTORS = (  # prefixes of the layers of the actor and of its last layer, and the final activation
    ("mlp_extractor.policy_net", "action_net", "none"),  # PPO, A2C
    ("actor.latent_pi", "actor.mu", "tanh"),  # SAC
    ("actor.mu", "", "tanh"),  # TD3, DDPG
)
_ACTIVATION = re.compile(r"activation\.(\w+)")


def _of_stable_baselines(path: Path) -> Perceptron:
    """Return the actor of a model that Stable-Baselines3 saved; nothing in the file is unpickled but its tensors."""
    torch = _torch()
    with reworded(f"{path} cannot be read as a model of Stable-Baselines3", Exception):
        with zipfile.ZipFile(io.BytesIO(read_bytes(path, most=2**34))) as archive:
            weights = torch.load(io.BytesIO(archive.read("policy.pth")), map_location="cpu", weights_only=True)
            settings = json.loads(archive.read("data"))
        arrays = {name: np.asarray(weight.numpy(), dtype=np.float64) for name, weight in weights.items()}
    for hidden, last, final in _ACTORS:
        layers = [name for name in arrays if re.fullmatch(rf"{re.escape(hidden)}\.\d+\.weight", name)]
        layers += [f"{last}.weight"] * (f"{last}.weight" in arrays)
        if not layers or (last and f"{last}.weight" not in arrays):
            continue
        kwargs = settings.get("policy_kwargs")
        stated = _ACTIVATION.search(str(kwargs.get("activation_fn", ""))) if isinstance(kwargs, dict) else None
        usual = "Tanh" if final == "none" else "ReLU"
        name = (stated[1] if stated else usual).lower().replace("leakyrelu", "leaky_relu")
        pairs = [(arrays[layer], arrays[layer.removesuffix("weight") + "bias"]) for layer in layers]
        return Perceptron(pairs, activation=name, final=final)
    known = ", ".join(sorted(arrays))[:200]
    raise InputError(f"{path} has no actor of dense layers as PPO, A2C, SAC, TD3 and DDPG have: {known}.")
