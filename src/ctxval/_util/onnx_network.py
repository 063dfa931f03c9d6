"""A network from an ONNX file, for learned models and trained policies."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, rows_of
from ctxval._util.extras import require_extra
from ctxval._util.files import read_bytes
from ctxval._util.representation import ShortRepr
from ctxval.errors import InputError, ModelError, ShapeError

_TYPES: dict[str, type[np.float32] | type[np.float64]] = {"tensor(float)": np.float32, "tensor(double)": np.float64}

Width = int | None  # number of values in one row; None if the file leaves it open


class OnnxNetwork(ShortRepr):
    """A network that maps rows of numbers to rows of numbers, on one thread; an ONNX file holds no code.

    Its inputs and its output have one row for each task, shapes ``(N, k)``. If the file fixes N to 1, or the shapes are
    ``(k,)``, the network is called row by row. Its widths are the numbers of values in a row of each input and of the
    output, None if the file leaves them open; its precision is its relative rounding.
    """

    def __init__(self, source: str | Path | bytes) -> None:
        contents = [source] if isinstance(source, bytes) else _contents(Path(source))
        # A single file goes to other processes as its bytes. Weights in a second file are found only by the path.
        self._source: bytes | str = contents[0] if len(contents) == 1 else str(Path(str(source)).absolute())
        self._digest = hashlib.sha256(b"".join(contents)).hexdigest()[:16]
        self._session = _session(self._source)
        self.names = tuple(node.name for node in self._session.get_inputs())
        nodes = [*self._session.get_inputs(), self._session.get_outputs()[0]]
        rows = [_rows(node) for node in nodes]
        self._types = [_TYPES[node.type] for node in nodes[:-1]]
        self._flat = [row[0] for row in rows[:-1]]
        self.widths: tuple[Width, ...] = tuple(row[2] for row in rows[:-1])
        self.width: Width = rows[-1][2]
        self._looped = any(flat or count is not None for flat, count, _ in rows)
        fixed = {count for _, count, _ in rows if count is not None}
        if fixed - {1}:
            raise InputError(f"the network must take any number of rows or one row, got {max(fixed)} rows.")
        self.precision = max(float(np.finfo(_TYPES[node.type]).eps) for node in nodes)

    def describe(self) -> dict[str, Any]:
        return {"onnx": self._digest}

    def __call__(self, *inputs: Array) -> Array:
        """Return the first output ``(..., l)`` of the network for one array ``(..., k)`` for each of its inputs."""
        if len(inputs) != len(self.widths):
            raise ShapeError(f"the network has {len(self.widths)} inputs, {', '.join(self.names)}, got {len(inputs)}.")
        for name, width, array in zip(self.names, self.widths, inputs, strict=True):
            if width not in (None, array.shape[-1]):
                raise ShapeError(f"the network's input {name!r} takes {width} numbers, got {array.shape[-1]}.")
        batch = np.broadcast_shapes(*(array.shape[:-1] for array in inputs))
        rows = [rows_of(np.broadcast_to(array, (*batch, array.shape[-1]))) for array in inputs]
        count = len(rows[0])
        if not self._looped:
            output = self._run(rows)
        else:
            output = np.array([self._run([row[i : i + 1] for row in rows]).reshape(-1) for i in range(count)])
        if output.ndim != 2 or len(output) != count:
            raise ShapeError(f"the network must return one row for each of {count} rows, got shape {output.shape}.")
        return output.reshape(*batch, -1)

    def _run(self, rows: list[Array]) -> Array:
        feeds = {
            name: np.ascontiguousarray(row.reshape(-1) if flat else row, dtype=kind)
            for name, row, flat, kind in zip(self.names, rows, self._flat, self._types, strict=True)
        }
        try:
            return np.asarray(self._session.run(None, feeds)[0], dtype=np.float64)
        except Exception as error:  # onnxruntime's exceptions have no base class of their own
            raise ModelError(f"the network cannot be evaluated: {error}") from error

    def __reduce__(self) -> tuple[Any, ...]:
        return OnnxNetwork, (self._source,)


def _contents(path: Path) -> list[bytes]:
    """Return the bytes of the file, and of the file of weights that PyTorch may write beside it."""
    weights = path.with_name(f"{path.name}.data")
    try:
        # The largest size refuses endless files, not large networks.
        return [read_bytes(file, most=2**34) for file in (path, weights) if file == path or file.exists()]
    except InputError as error:
        raise InputError(f"the ONNX file {path} cannot be read: {error}.") from error


def _session(source: bytes | str) -> Any:
    onnxruntime = require_extra("onnxruntime", "onnx", "ONNX networks")
    options = onnxruntime.SessionOptions()
    # Small networks are slower on many threads, and their last bits depend on the number of threads.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise InputError(f"the file cannot be read as an ONNX network: {error}") from error


def _rows(node: Any) -> tuple[bool, Width, Width]:
    """Return whether an input or output is one flat row, and its numbers of rows and of values in a row, if fixed."""
    if node.type not in _TYPES or not isinstance(node.shape, list) or len(node.shape) not in (1, 2):
        got = f"{node.type} of shape {node.shape}"
        raise InputError(f"the network's {node.name!r} must be real numbers (N, k) or (k,), got {got}.")
    *count, width = (size if isinstance(size, int) else None for size in node.shape)
    return not count, count[0] if count else None, width
