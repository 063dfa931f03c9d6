"""Learned models of other toolboxes: networks from ONNX files, and torch modules."""

from __future__ import annotations

import contextlib
import hashlib
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, rows_of
from ctxval._util.onnx_network import OnnxNetwork
from ctxval._util.refusals import require_extra, reworded
from ctxval._util.registry import part
from ctxval.core.model import central_differences, paired
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError, ModelError, ShapeError
from ctxval.models.saved import names_in


@part(files=("source",))
class Onnx:
    """A network from an ONNX file as a model; any toolbox may have written the file, and nothing in it is run as code.

    The network takes the state and the input as two inputs in this order, or as one input with the state first. Its
    Jacobian is taken by central differences that suit its precision; in single precision about three digits are
    correct.

    Args:
        source: the file, or its bytes.
        increments: whether the network returns ``x_next - x`` instead of ``x_next``.
        data: the transitions that the network was learned from, if they are known.

    Raises:
        InputError: if the network does not take (x, u).
    """

    def __init__(
        self, source: str | Path | bytes, *, increments: bool = False, data: Transitions | None = None
    ) -> None:
        self.network, self.increments, self.data = OnnxNetwork(source), increments, data
        with reworded("the ONNX file", InputError):
            named = names_in(self.network.notes["ctxval"]) if "ctxval" in self.network.notes else {}
        self.states, self.inputs = named.get("states", {}), named.get("inputs", {})
        if len(self.network.widths) not in (1, 2):
            names = ", ".join(self.network.names)
            raise InputError(f"a model must take (x, u) as one or two inputs, but the network has {names}.")

    def step(self, x: Array, u: Array) -> Array:
        pair = (x, u) if len(self.network.widths) == 2 else (np.concatenate(paired(x, u), axis=-1),)
        output = self.network(*pair)
        if output.shape[-1] != x.shape[-1]:
            got = f"{x.shape[-1]}, got {output.shape[-1]}"
            raise ShapeError(f"the network must return as many states as it takes, {got}.")
        return x + output if self.increments else output

    def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
        return central_differences(self.step, *paired(x, u), self.network.precision)

    def describe(self) -> dict[str, Any]:
        return {**self.network.describe(), "increments": self.increments}


@part()
class Torch:
    """A torch module as a model, with the exact Jacobian of its automatic differentiation.

    The module maps a batch of states ``(N, n)`` and inputs ``(N, m)`` to ``(N, n)``. It is called with both if its
    ``forward`` has two required arguments, and otherwise with one tensor ``(N, n + m)``, the state first. It is used in
    evaluation mode, on the device and in the precision of its parameters, on one thread. Rows may not depend on each
    other.

    Args:
        module: a ``torch.nn.Module`` or a function of tensors.
        increments: whether the module returns ``x_next - x`` instead of ``x_next``.
        data: the transitions that the module was learned from, if they are known.

    Raises:
        InputError: if the module does not take (x, u).
    """

    def __init__(self, module: Any, *, increments: bool = False, data: Transitions | None = None) -> None:
        torch = _torch()
        self.module, self.increments, self.data = module, increments, data
        forward = inspect.signature(getattr(module, "forward", module))
        required = [each for each in forward.parameters.values() if each.default is each.empty]
        if not 1 <= len(required) <= 2 or any(each.kind is each.VAR_KEYWORD for each in required):
            raise InputError(f"the module must take (x, u) as one or two tensors, but it takes {forward}.")
        self._separate = len(required) == 2
        weights = [*module.parameters(), *module.buffers()] if isinstance(module, torch.nn.Module) else []
        real = [weight for weight in weights if weight.is_floating_point()]
        self._kind = {"dtype": real[0].dtype, "device": real[0].device} if real else {"dtype": torch.float64}

    def step(self, x: Array, u: Array) -> Array:
        torch = _torch()
        states, inputs = paired(x, u)
        with self._evaluated(), torch.no_grad():
            output = self._next(self._tensor(rows_of(states)), self._tensor(rows_of(inputs)))
        values = _floats(output)
        if values.shape != rows_of(states).shape:
            wanted = f"{rows_of(states).shape}, a next state for each state"
            raise ShapeError(f"the module must return the shape {wanted}, got {values.shape}.")
        return values.reshape(states.shape)

    def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
        torch = _torch()
        states, inputs = paired(x, u)

        def of_one(x: Any, u: Any) -> Any:
            return self._next(x[None], u[None])[0]

        with self._evaluated():
            rows = self._tensor(rows_of(states)), self._tensor(rows_of(inputs))
            A, B = torch.func.vmap(torch.func.jacrev(of_one, argnums=(0, 1)))(*rows)
        return _floats(A).reshape(*states.shape, -1), _floats(B).reshape(*states.shape, -1)

    def describe(self) -> dict[str, Any]:
        digest = hashlib.sha256()
        for name, weight in getattr(self.module, "state_dict", dict)().items():
            digest.update(name.encode() + weight.detach().cpu().numpy().tobytes())
        return {"module": type(self.module), "weights": digest.hexdigest()[:16], "increments": self.increments}

    def _next(self, x: Any, u: Any) -> Any:
        torch = _torch()
        output = self.module(x, u) if self._separate else self.module(torch.cat([x, u], dim=-1))
        return x + output if self.increments else output

    def _tensor(self, rows: Array) -> Any:
        return _torch().tensor(np.array(rows), **self._kind)

    @contextlib.contextmanager
    def _evaluated(self) -> Iterator[None]:
        # Training mode would mix rows by batch normalisation; the last bits depend on the number of threads.
        torch = _torch()
        training, threads = getattr(self.module, "training", False), torch.get_num_threads()
        torch.set_num_threads(1)
        if training:
            self.module.eval()
        try:
            with reworded("the module cannot be evaluated", RuntimeError, to=ModelError):
                yield
        finally:
            torch.set_num_threads(threads)
            if training:
                self.module.train()


def _torch() -> Any:
    return require_extra("torch", "torch", "torch modules need")


def _floats(tensor: Any) -> Array:
    return np.asarray(tensor.detach().cpu().numpy(), dtype=np.float64)
