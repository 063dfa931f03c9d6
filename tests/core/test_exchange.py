"""Controllers and tasks survive being files; other files do not get in."""

from __future__ import annotations

import contextlib
import io
import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctxval import Task, controllers
from ctxval.core.controller import AffineFeedback, Limits
from ctxval.core.exchange import read_controller, read_task, write_controller, write_task
from ctxval.errors import CtxvalError, InputError, ShapeError
from ctxval.models import Linear
from facts import assert_names, refuses

KINDS = ["json", "npz"]
MODEL = Linear([[1.0, 0.1], [-0.2, 0.9]], [[0.0], [0.1]], [0.01, 0.0])
TASK = Task([np.pi, -1e-300], goal=[1 / 3, 0.0], horizon=12, dt=0.02)
PARTS = ("gains", "inputs", "states")


def designed(limits: Limits | None = None) -> AffineFeedback:
    feedback = controllers.LQR([1.0, 0.1], [0.01]).design(TASK, MODEL)
    return AffineFeedback(feedback.gains, feedback.inputs, feedback.states, limits)


def assert_same(one: AffineFeedback, other: AffineFeedback) -> None:
    for name in PARTS:
        assert np.ascontiguousarray(getattr(one, name)).tobytes() == getattr(other, name).tobytes()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("limits", [None, Limits.of(2.5, 1), Limits.of([[-1 / 3, np.inf]], 1)])
def test_a_controller_comes_back_bit_for_bit(kind: str, limits: Limits | None, tmp_path: Path) -> None:
    path, controller = tmp_path / f"controller.{kind}", designed(limits)
    write_controller(path, controller, dt=TASK.dt, states={"angle": "rad", "rate": "rad/s"}, inputs={"torque": "N m"})
    found = read_controller(path)
    assert_same(controller, found.controller)
    assert found.dt == TASK.dt
    assert found.states == {"angle": "rad", "rate": "rad/s"}
    assert found.inputs == {"torque": "N m"}
    for x in np.random.default_rng(0).normal(scale=10, size=(5, 2)):
        np.testing.assert_array_equal(found.controller(3, x), controller(3, x))
    assert (found.controller.limits is None) == (limits is None)
    if limits is not None and found.controller.limits is not None:
        np.testing.assert_array_equal(found.controller.limits.low, limits.low)
        np.testing.assert_array_equal(found.controller.limits.high, limits.high)


@pytest.mark.parametrize("kind", KINDS)
@given(
    gains=arrays(np.float64, (4, 2, 3), elements=st.floats(allow_nan=False, allow_infinity=False)),
    inputs=arrays(np.float64, (4, 2), elements=st.floats(allow_nan=False, allow_infinity=False)),
)
def test_any_finite_numbers_come_back(kind: str, gains: Any, inputs: Any, tmp_path_factory: Any) -> None:
    path = tmp_path_factory.mktemp("any") / f"controller.{kind}"
    controller = AffineFeedback(gains, inputs, np.zeros((4, 3)))
    write_controller(path, controller, dt=0.1)
    assert_same(controller, read_controller(path).controller)


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_says_by_itself_what_is_in_it(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"controller.{kind}"
    write_controller(path, designed(Limits.of(2.0, 1)), dt=TASK.dt)
    if kind == "json":
        content = json.loads(path.read_text())
    else:
        with np.load(path, allow_pickle=False) as arrays_:
            content = {**json.loads(str(arrays_["about"])), **arrays_}
    assert_names(content["law"], "low", "high")
    assert content["state_names"] == ["x0", "x1"]
    x, t = np.array([0.3, -0.2]), 5
    law = np.array(content["inputs"])[t] + np.array(content["gains"])[t] @ (x - np.array(content["states"])[t])
    np.testing.assert_allclose(np.clip(law, content["low"], content["high"]), designed(Limits.of(2.0, 1))(t, x))


def test_json_is_json_also_with_infinite_limits(tmp_path: Path) -> None:
    path = tmp_path / "controller.json"
    write_controller(path, designed(Limits.of([(-np.inf, 1.0)], 1)), dt=0.1)

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    assert json.loads(path.read_text(), parse_constant=refuse)["low"] == [None]


def test_a_task_comes_back_bit_for_bit(tmp_path: Path) -> None:
    path = tmp_path / "task.json"
    write_task(path, TASK, states={"angle": "rad", "rate": "rad/s"})
    found = read_task(path)
    assert (found.horizon, found.dt) == (TASK.horizon, TASK.dt)
    assert found.initial_state.tobytes() == TASK.initial_state.tobytes()
    assert found.reference.tobytes() == np.ascontiguousarray(TASK.reference).tobytes()
    assert json.loads(path.read_text())["state_units"] == ["rad", "rad/s"]
    assert found.environment == {}


def test_the_environment_of_a_task_comes_back_bit_for_bit(tmp_path: Path) -> None:
    path = tmp_path / "task.json"
    write_task(path, Task([0.0, 1.0], horizon=2, dt=0.1, environment={"obstacle": [0.1, 1 / 3, 2.0]}))
    assert read_task(path).environment["obstacle"].tolist() == [0.1, 1 / 3, 2.0]
    path.write_text(path.read_text().replace("[0.1,", "[null,"))
    with refuses(InputError, "obstacle", "environment"):
        read_task(path)


# What cannot be written


def test_only_affine_feedback_of_one_task_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / "controller.json"
    with refuses(InputError, "LQR"):
        write_controller(path, lambda t, x: x, dt=0.1)
    batch = controllers.LQR([1.0, 0.1], [0.01]).design(Task(np.zeros((3, 2)), horizon=4, dt=0.1), MODEL)
    with refuses(ShapeError, "controller", (4, 1, 2)):
        write_controller(path, batch, dt=0.1)
    write_controller(path, batch[1], dt=0.1)
    with refuses(ShapeError, "task"):
        write_task(path, Task(np.zeros((3, 2)), horizon=4, dt=0.1))


def test_what_is_written_must_make_sense(tmp_path: Path) -> None:
    controller = designed()
    with refuses(ShapeError, 2, "angle"):
        write_controller(tmp_path / "c.json", controller, dt=0.1, states={"angle": "rad"})
    with refuses(InputError, "dt", 0):
        write_controller(tmp_path / "c.json", controller, dt=0)
    with refuses(InputError, "file", "c.pkl"):
        write_controller(tmp_path / "c.pkl", controller, dt=0.1)
    with refuses(InputError, "c.json"):
        write_controller(tmp_path / "none" / "c.json", controller, dt=0.1)
    broken = AffineFeedback(controller.gains * np.nan, controller.inputs, controller.states)
    with refuses(InputError, "gains"):
        write_controller(tmp_path / "c.npz", broken, dt=0.1)


# Hostile files


def content() -> dict[str, Any]:
    named = {"state_names": ["a", "b"], "state_units": ["", ""], "input_names": ["u"], "input_units": [""]}
    numbers = {"gains": [[[1.0, 2.0]]] * 3, "inputs": [[0.0]] * 3, "states": [[0.0, 0.0]] * 3}
    return {"format": "ctxval controller", "version": 1, "dt": 0.1, "horizon": 3, **named, **numbers}


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        ({"format": "something else"}, ("format", "ctxval controller", "something else")),
        ({"version": 99}, ("version", 1, 99)),
        ({"gains": None}, ("gains", "controller.json")),
        ({"gains": [[["a", "b"]]] * 3}, ("gains", "controller.json")),
        ({"gains": [[[1.0, float("nan")]]] * 3}, ("gains", "controller.json")),
        ({"gains": [[[1.0, 10**400]]] * 3}, ("controller.json",)),
        ({"gains": [1.0]}, ("gains", (1,))),
        ({"inputs": [[0.0]] * 2}, ((3, 1, 2), (2, 1), (3, 2))),
        ({"horizon": 10**9}, ("horizon", 3, 1000000000)),
        ({"dt": "0.1"}, ("dt", "controller.json")),
        ({"dt": -1}, ("dt", "controller.json")),
        ({"low": [1.0], "high": [-1.0]}, ("low", "high")),
        ({"low": [1.0]}, ("KeyError", "controller.json")),
        ({"low": 3, "high": 4}, ("controller.json",)),
        ({"state_names": ["a", "a"]}, (2, "controller.json")),
        ({"state_names": [["a"], {}]}, (2, "controller.json")),
        ({"state_names": 7}, ("controller.json",)),
    ],
)
def test_a_made_up_controller_is_refused(change: dict[str, Any], facts: tuple[object, ...], tmp_path: Path) -> None:
    path = tmp_path / "controller.json"
    path.write_text(json.dumps(content()))
    read_controller(path)
    path.write_text(json.dumps(content() | change))
    with refuses(InputError, *facts):
        read_controller(path)


class Trap:
    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (Path("sprung"),))


def test_nothing_in_a_file_is_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path("controller.npz")
    with path.open("wb") as file:
        np.savez(file, allow_pickle=True, about=np.array(json.dumps(content())), gains=np.array([Trap()], dtype=object))
    with refuses(InputError, "controller.npz"):
        read_controller(path)
    path.write_bytes(pickle.dumps(Trap()))
    with refuses(InputError, "controller.npz"):
        read_controller(path)
    assert not Path("sprung").exists()


def test_damaged_and_foreign_files_are_refused(tmp_path: Path) -> None:
    huge = io.BytesIO()
    np.lib.format.write_array_header_2_0(huge, {"descr": "<f8", "fortran_order": False, "shape": (10**15,)})
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w") as archive:
        archive.writestr("about.npy", huge.getvalue())
    deep = b"[" * 100_000
    for name, data in {
        "a.npz": bomb.getvalue(),
        "b.json": deep,
        "c.json": b"\xff\xfe",
        "d.json": b"3",
        "e.npz": b"",
    }.items():
        (tmp_path / name).write_bytes(data)
        with refuses(InputError, name):
            read_controller(tmp_path / name)
    with refuses(InputError, "missing.json"):
        read_controller(tmp_path / "missing.json")
    with refuses(InputError, "d.json"):
        read_task(tmp_path / "d.json")


@pytest.mark.parametrize("kind", KINDS)
def test_no_damage_gives_anything_but_an_error_of_ours(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"controller.{kind}"
    write_controller(path, designed(Limits.of(2.0, 1)), dt=0.1)
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(150):
        broken = bytearray(whole)
        for position in rng.integers(len(whole), size=3):
            broken[position] = rng.integers(256)
        path.write_bytes(bytes(broken[: rng.integers(1, len(whole) + 1)] if rng.random() < 0.3 else broken))
        with contextlib.suppress(CtxvalError):
            read_controller(path)


def test_an_archive_that_unpacks_to_much_is_refused_before_it_does(tmp_path: Path) -> None:
    path = tmp_path / "controller.npz"
    write_controller(path, designed(), dt=0.1)
    with np.load(path, allow_pickle=False) as whole:
        content = dict(whole)
    header = np.lib.format.header_data_from_array_1_0(np.zeros(1)) | {"shape": (2**40, 1, 1)}
    huge = io.BytesIO()
    np.lib.format.write_array_header_1_0(huge, header)
    np.savez(path, **{name: array for name, array in content.items() if name != "gains"})
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("gains.npy", huge.getvalue())
    with refuses(InputError, "gains", "controller.npz"):
        read_controller(path)


@pytest.mark.parametrize("kind", KINDS)
def test_a_fifo_is_no_file(kind: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / f"controller.{kind}")
    with refuses(InputError, "FIFO"):
        read_controller(tmp_path / f"controller.{kind}")


@pytest.mark.parametrize("content", ["[1, 2]", "3", '"text"', "null"])
def test_json_that_is_no_object_is_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "task.json").write_text(content)
    with refuses(InputError, "task.json"):
        read_task(tmp_path / "task.json")
