"""Networks from ONNX files, for models and policies."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, rows_of
from ctxval._util.files import read_bytes
from ctxval._util.refusals import require_extra, reworded
from ctxval._util.representation import ShortRepr
from ctxval.errors import InputError, ModelError, ShapeError

_TYPES: dict[str, type[np.float32] | type[np.float64]] = {"tensor(float)": np.float32, "tensor(double)": np.float64}

Width = int | None  # number of values in one row; None if the file leaves it open


class OnnxNetwork(ShortRepr):
    """A network that maps rows of numbers to rows of numbers, on one thread; an ONNX file holds no code.

    Its inputs and its output have one row for each task, shapes ``(N, k)``. If the file fixes N to 1, or the shapes are
    ``(k,)``, the network is called row by row. Its widths are the numbers of values in a row of each input and of the
    output, None if the file leaves them open; its precision is its relative rounding.

    A recurrent network has states: all inputs after the first, and the new states as its last outputs in the same
    order. They may also have the shape ``(L, N, k)``, as those of L layers; a row then has ``L k`` values.
    """

    def __init__(self, source: str | Path | bytes, recurrent: bool = False) -> None:
        contents = [source] if isinstance(source, bytes) else []
        if not isinstance(source, bytes):
            path, weights = Path(source), Path(f"{source}.data")  # PyTorch may write weights into a second file
            with reworded(f"the ONNX file {path} cannot be read", InputError):
                # The largest size refuses endless files, not large networks.
                contents = [read_bytes(file, most=2**34) for file in (path, weights) if file == path or file.exists()]
        # A single file goes to other processes as its bytes. Weights in a second file are found only by the path.
        self._source: bytes | str = contents[0] if len(contents) == 1 else str(Path(str(source)).absolute())
        self._digest = hashlib.sha256(b"".join(contents)).hexdigest()[:16]
        onnxruntime = require_extra("onnxruntime", "onnx", "ONNX networks need")
        options = onnxruntime.SessionOptions()
        # Small networks are slower on many threads, and their last bits depend on the number of threads.
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        with reworded("the file cannot be read as an ONNX network", Exception):
            self._session = onnxruntime.InferenceSession(self._source, options, providers=["CPUExecutionProvider"])
        self._recurrent = recurrent
        given, returned = self._session.get_inputs(), self._session.get_outputs()
        self.names = tuple(node.name for node in given)
        states = len(given) - 1 if recurrent else 0
        if states >= len(returned):
            got = f"the inputs {', '.join(self.names)} and the outputs {', '.join(node.name for node in returned)}"
            raise InputError(f"the network must return a new state for each input after the first, got {got}.")
        self._inputs = [_port(node, recurrent and i > 0) for i, node in enumerate(given)]
        self._outputs = [_port(returned[0])]
        self._outputs += [_port(node, True) for node in returned[len(returned) - states :]]
        for old, new in zip(self._inputs[1:], self._outputs[1:], strict=False):
            if None in (old.width, new.width) or old.width != new.width or old.layers != new.layers:
                pair = f"{old.name!r} has {old.width} and {new.name!r} has {new.width}"
                raise InputError(f"a state and the new state must have the same number of values, got {pair}.")
        self.widths: tuple[Width, ...] = tuple(port.width for port in self._inputs)
        self.width: Width = self._outputs[0].width
        ports = [*self._inputs, *self._outputs]
        self._looped = any(port.flat or port.count is not None for port in ports)
        fixed = {port.count for port in ports if port.count is not None}
        if fixed - {1}:
            raise InputError(f"the network must take any number of rows or one row, got {max(fixed)} rows.")
        self.precision = max(float(np.finfo(port.kind).eps) for port in ports)

    @property
    def notes(self) -> dict[str, str]:
        """The texts that the file keeps beside the network, by their names."""
        return dict(self._session.get_modelmeta().custom_metadata_map)

    def describe(self) -> dict[str, Any]:
        return {"onnx": self._digest}

    def __call__(self, *inputs: Array) -> Array:
        """Return the first output ``(..., l)`` of the network for one array ``(..., k)`` for each of its inputs."""
        return self.outputs(*inputs)[0]

    def outputs(self, *inputs: Array) -> list[Array]:
        """Return the first output ``(..., l)`` and the new states of a recurrent network, each ``(..., k)``."""
        if len(inputs) != len(self.widths):
            raise ShapeError(f"the network has {len(self.widths)} inputs, {', '.join(self.names)}, got {len(inputs)}.")
        for name, width, array in zip(self.names, self.widths, inputs, strict=True):
            if width not in (None, array.shape[-1]):
                raise ShapeError(f"the network's input {name!r} takes {width} numbers, got {array.shape[-1]}.")
        batch = np.broadcast_shapes(*(array.shape[:-1] for array in inputs))
        rows = [rows_of(np.broadcast_to(array, (*batch, array.shape[-1]))) for array in inputs]
        count = len(rows[0])
        if not self._looped:
            outputs = self._run(rows)
        else:
            each = [self._run([row[i : i + 1] for row in rows]) for i in range(count)]
            outputs = [np.array([row[k].reshape(-1) for row in each]) for k in range(len(self._outputs))]
        for output in outputs:
            if output.ndim != 2 or len(output) != count:
                raise ShapeError(f"the network must return one row for each of {count} rows, got shape {output.shape}.")
        return [output.reshape(*batch, -1) for output in outputs]

    def _run(self, rows: list[Array]) -> list[Array]:
        feeds = {port.name: port.fed(row) for port, row in zip(self._inputs, rows, strict=True)}
        # The exceptions of onnxruntime have no base class of their own.
        with reworded("the network cannot be evaluated", Exception, to=ModelError):
            outputs = self._session.run([port.name for port in self._outputs], feeds)
        return [port.read(output) for port, output in zip(self._outputs, outputs, strict=True)]

    def __reduce__(self) -> tuple[Any, ...]:
        return OnnxNetwork, (self._source, self._recurrent)


@dataclass(frozen=True)
class _Port:
    """An input or output: one flat row, rows, or the rows of L layers; counts and widths are None if they are open."""

    name: str
    kind: type[np.float32] | type[np.float64]
    flat: bool
    layers: int | None
    count: int | None
    width: Width

    def fed(self, rows: Array) -> Array:
        """Return rows ``(N, k)`` in the shape of the port."""
        shaped = rows.reshape(-1) if self.flat else rows
        if self.layers is not None:
            shaped = np.moveaxis(rows.reshape(len(rows), self.layers, -1), 1, 0)
        return np.ascontiguousarray(shaped, dtype=self.kind)

    def read(self, values: Any) -> Array:
        """Return what the network returned as rows ``(N, k)``."""
        array = np.asarray(values, dtype=np.float64)
        if self.layers is None or array.ndim != 3:
            return array
        return np.moveaxis(array, 0, 1).reshape(array.shape[1], -1)


def _port(node: Any, layered: bool = False) -> _Port:
    """Return an input or output of a network; a layered one may have the shape ``(L, N, k)``."""
    shape = node.shape if isinstance(node.shape, list) else []
    sizes = [size if isinstance(size, int) else None for size in shape]
    layers = sizes[0] if layered and len(sizes) == 3 else None
    if node.type not in _TYPES or (len(sizes) not in (1, 2) and layers is None):
        wanted = "(N, k), (k,) or (L, N, k) with a fixed L" if layered else "(N, k) or (k,)"
        got = f"{node.type} of shape {node.shape}"
        raise InputError(f"the network's {node.name!r} must be real numbers {wanted}, got {got}.")
    *count, width = sizes if layers is None else sizes[1:]
    if layers is not None and width is not None:
        width *= layers
    return _Port(node.name, _TYPES[node.type], not count, layers, count[0] if count else None, width)
