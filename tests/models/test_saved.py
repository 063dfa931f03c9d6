"""Models in NPZ files are read back bit for bit, with the data that they were learned from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import Transitions, models
from ctxval.cli.config.parts import part
from ctxval.errors import InputError
from facts import refuses

RNG = np.random.default_rng(0)
X, U = RNG.normal(size=(60, 2)), RNG.normal(size=(60, 1))
DATA = Transitions(X, U, np.stack([X[:, 0] + 0.1 * X[:, 1], np.sin(X[:, 1]) + 0.1 * U[:, 0]], axis=-1))
SAVED: list[Any] = [
    models.Linear.fit(DATA),
    models.Linear([[1.0]], [[2.0]], [3.0]),
    models.GaussianProcessModel.fit(DATA, 30),
    models.FeedforwardReLU.fit(DATA, (4, 3), restarts=1, iterations=20),
]


@pytest.mark.parametrize("model", SAVED, ids=lambda model: type(model).__name__)
def test_a_model_is_read_back_bit_for_bit(model: Any, tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    models.write_model(path, model)
    read: Any = models.read_model(path)
    assert type(read) is type(model)
    n = 2 if model.data is not None else 1
    np.testing.assert_array_equal(read.step(X[:, :n], U), model.step(X[:, :n], U))
    if model.data is None:
        assert read.data is None
    else:
        np.testing.assert_array_equal(read.data.x_next, DATA.x_next)


def test_an_experiment_file_names_a_saved_model(tmp_path: Path) -> None:
    models.write_model(tmp_path / "model.npz", SAVED[0])
    made = part("model", {"type": "Saved", "source": "model.npz"}, tmp_path)
    np.testing.assert_array_equal(made.A, SAVED[0].A)


def test_two_matrices_are_a_linear_model(tmp_path: Path) -> None:
    np.savez(tmp_path / "model.npz", A=[[1, 2], [3, 4]], B=[[5], [6]])
    read = models.read_model(tmp_path / "model.npz")
    assert isinstance(read, models.Linear)
    assert (read.A.tolist(), read.c.tolist(), read.data) == ([[1, 2], [3, 4]], [0, 0], None)


@pytest.mark.parametrize(
    ("content", "facts"),
    [
        ({}, ("A", "model.npz")),
        ({"A": [[1.0, 2.0]], "B": [[1.0]]}, ("A", "B")),
        ({"A": [[1.0]], "B": [[np.nan]]}, ("B", "model.npz")),
        ({"about": "{}"}, ("format", "ctxval model", 1)),
        ({"about": "[]"}, ("format", "ctxval model", 1)),
        ({"about": "no json"}, ("model.npz", 1)),
        ({"about": {"kind": "Pickle"}}, ("kind", "FeedforwardReLU", "Pickle")),
        ({"about": {"kind": "FeedforwardReLU"}}, ("shift_in", "model.npz")),
        ({"about": {"kind": "GaussianProcessModel"}, "shift_in": [1.0]}, ("scale_in", "model.npz")),
        ({"A": np.array([{}])}, ("model.npz",)),
    ],
)
def test_a_file_that_is_no_model_is_refused(content: dict[str, Any], facts: tuple[object, ...], tmp_path: Path) -> None:
    if isinstance(content.get("about"), dict):
        content = content | {"about": json.dumps({"format": "ctxval model", "version": 1} | content["about"])}
    np.savez(tmp_path / "model.npz", **content)
    with refuses(InputError, *facts):
        models.read_model(tmp_path / "model.npz")


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    with refuses(InputError, "Function"):
        models.write_model(tmp_path / "a.npz", models.Function(lambda x, u: x))  # type: ignore[arg-type]
    with refuses(InputError, "a.npz"):
        models.write_model(tmp_path / "absent" / "a.npz", SAVED[0])
    with refuses(InputError, "a.npz"):
        models.write_transitions(tmp_path / "a.npz", None)
