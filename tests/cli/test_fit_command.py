"""``ctxval fit``, as users call it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import models
from ctxval.cli.config.parts import part
from ctxval.cli.config.settings import read_settings
from ctxval.cli.recordings import named_model
from ctxval.errors import InputError
from facts import assert_names, refuses
from rig_cli import Invoke, calling, report
from rig_logs import DT, run, write_mcap_json

STEP = f"""
import numpy as np

def step(x, u, theta):
    mass, friction = theta
    return np.array([x[0] + {DT} * x[1], x[1] + {DT} * (u[0] - friction * x[1]) / mass])
"""


@pytest.fixture
def invoke(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Invoke:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    for module in ("my_cart_step", "my_batch_step"):  # each test has a module of its own
        monkeypatch.delitem(sys.modules, module, raising=False)
    Path("logs").mkdir()
    for seed in range(4):
        run(80, seed).to_csv(f"logs/{seed}.csv")
    Path("my_cart_step.py").write_text(STEP)

    return calling("fit")


def test_a_linear_model_is_learned_and_written_with_its_data(invoke: Invoke) -> None:
    found = report(invoke("logs", "--kind", "linear", "--out", "model.npz", "--hold-out", "0.5", "--json"))
    assert found["files"] == ["model.npz"]
    assert (found["learned_from"]["recordings"], found["held_out"]["recordings"]) == (2, 2)
    assert found["fitted"][0]["errors"][0]["relative"] < 1e-10
    read: Any = models.read_model("model.npz")
    np.testing.assert_allclose(read.A, [[1, DT], [0, 1 - 0.3 * DT]], atol=1e-10)
    assert len(read.data) == 160


def test_what_the_file_of_the_model_needs_is_asked_for_before_anything_is_learned(
    invoke: Invoke, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    result = invoke("logs", "--kind", "linear", "--out", "model.onnx")
    assert result.exit_code == 2
    assert "ctxval[fit]" in result.stderr
    assert not result.stdout


def test_what_is_learned_is_printed(invoke: Invoke) -> None:
    result = invoke("logs", "--kind", "linear, gaussian-process", "--steps", "1,5", "--seed", "2")
    assert result.exit_code == 0, result.stderr
    assert_names(result.stdout, 240, 3, 80, 1)


@pytest.mark.slow
def test_a_network_is_written_as_onnx_with_its_data_beside_it(invoke: Invoke) -> None:
    pytest.importorskip("onnxruntime")
    found = report(invoke("logs", "--kind", "network", "--out", "model.onnx", "--json"))
    assert found["files"] == ["model.onnx", "model.data.npz"]
    model = part("model", {"type": "Onnx", "source": "model.onnx", "data": {"logs": ["model.data.npz"]}}, Path())
    assert len(model.data) == 240
    one = run(80, 0)
    np.testing.assert_allclose(model.step(one.states[:-1], one.inputs), one.states[1:], atol=0.05)


def test_parameters_of_a_function_are_estimated_with_their_intervals(invoke: Invoke) -> None:
    options = ("--step", "my_cart_step:step", "--parameter", "mass=[0.5, 2.0]", "--parameter", "friction=[0, 1]")
    found = report(invoke("logs", *options, "--out", "model.toml", "--json"))
    mass, friction = found["fitted"][0]["parameters"]
    assert mass["low"] <= mass["value"] <= mass["high"]
    assert mass["value"] == pytest.approx(1.0, rel=1e-6)
    assert friction["value"] == pytest.approx(0.3, rel=1e-6)
    assert named_model("model.toml", {}).theta == {"mass": mass["value"], "friction": friction["value"]}
    result = invoke("logs", *options)
    assert_names(result.stdout, "mass", 1, 0.95)


def test_fields_are_named_as_for_replay(invoke: Invoke) -> None:
    for seed in range(3):
        write_mcap_json(Path(f"{seed}.mcap"), run(60, seed))
    fields = ("--state", "p=/state.cart.position", "--state", "v=/state.cart.speed", "--input", "f=/command.force")
    files = ("0.mcap", "1.mcap", "2.mcap")
    found = report(invoke(*files, *fields, "--kind", "linear", "--dt", "0.05", "--delay", "0", "--json"))
    assert {one["state"] for one in found["fitted"][0]["errors"]} == {"p", "v"}
    Path("map.toml").write_text('[states]\nposition = "/state.cart.position"\n[inputs]\nforce = "/command.force"\n')
    result = invoke(*files, "--mapping", "map.toml", "--kind", "linear", "--json")
    assert result.exit_code == 1  # without the speed, the position cannot be predicted
    mapped = json.loads(result.stdout)
    assert mapped["fitted"][0]["errors"][0]["relative"] > 0.1
    Path("clock.csv").write_text(Path("logs/0.csv").read_text().replace("t,", "clock,", 1))
    assert report(invoke("clock.csv", "--time", "clock", "--kind", "linear", "--json"))["held_out"]["steps"] == 20


def test_recordings_that_determine_nothing_are_said_to(invoke: Invoke) -> None:
    Path("still.csv").write_text("t,x0,u0\n" + "".join(f"{k / 10},1,0\n" for k in range(20)))
    result = invoke("still.csv", "--kind", "linear")
    assert result.exit_code == 3
    assert_names(result.stderr, "linear")


@pytest.mark.slow
def test_batches_are_taken_if_they_are_promised(invoke: Invoke) -> None:
    Path("my_batch_step.py").write_text("def step(x, u, theta):\n    return x + theta[0] * u\n")
    options = ("--step", "my_batch_step:step", "--parameter", "gain=[0, 1]", "--vectorized", "--out", "a.toml")
    found = json.loads(invoke("logs", *options, "--json").stdout)["fitted"][0]
    assert found["kind"] == "parameters"
    assert found["useless"]  # a cart is no integrator of the force
    assert "vectorized = true" in Path("a.toml").read_text()


@pytest.mark.parametrize("content", ["<mujoco>", None])
def test_a_given_model_that_cannot_be_used_is_an_error(content: str | None, invoke: Invoke) -> None:
    pytest.importorskip("mujoco")
    slide = (
        f"<mujoco><option timestep='{DT}'/><worldbody><body><joint type='slide'/><geom size='1'/></body></worldbody>"
    )
    Path("given.xml").write_text(content or f"{slide}</mujoco>")
    result = invoke("logs", "--kind", "linear", "--given", "given.xml")
    assert result.exit_code in (2, 3), result.stdout + result.stderr
    assert_names(" ".join(result.stderr.split()), *(["MuJoCo"] if content else [2, 1, 0, "qpos", "qvel"]))
    assert not result.stdout


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        (("--kind", "linaer"), ("kind", "linaer", "linear")),
        (("--hold-out", "1"), ("out", 0, 1)),
        (("--kind", "linear", "--out", "logs"), ("model",)),
        (("--kind", "linear", "--out", "map.npz/a.npz"), ("map.npz", "a.npz")),
        (("--kind", "linear", "--out", "a.txt"), ("model", "a.txt")),
        (
            ("--kind", "linear", "--out", "a.toml"),
            (),
        ),
        (("--step", "my_cart_step:step"), ("--step", "--parameter")),
        (("--parameter", "a=[0, 1]"), ("--step", "--parameter")),
        (("--step", "my_cart_step:step", "--parameter", "mass"), ("--parameter", "NAME", "VALUE")),
        (("--step", "my_cart_step:step", "--parameter", "mass=1"), ("mass",)),
        (("--step", "os:getcwd", "--parameter", "mass=[0, 1]"), ("os", "getcwd")),
        (("--kind", "linear", "--steps", "x"), ("--steps",)),
        (("--kind", "linear", "--steps", "0,5"), ("--steps",)),
    ],
)
def test_what_cannot_be_used_is_said_in_one_sentence(
    arguments: tuple[str, ...], facts: tuple[object, ...], invoke: Invoke
) -> None:
    Path("map.npz").write_text("no folder")
    result = invoke("logs", *arguments)
    assert result.exit_code == 2, result.stdout + result.stderr
    assert_names(" ".join(result.stderr.split()), *facts)


def test_a_model_that_is_no_better_than_none_is_said_to_be_useless(invoke: Invoke) -> None:
    rng = np.random.default_rng(0)
    for number in range(4):  # each recording has dynamics of its own
        one = run(80, number, friction=(-30.0, 30.0, 25.0, -25.0)[number] * (1 + rng.uniform()), dt=0.01)
        one.to_csv(f"logs/{number}.csv")
    found = invoke("logs", "--kind", "linear", "--out", "model.npz")
    assert found.exit_code == 1
    said = " ".join(found.stderr.split())
    assert_names(said, "linear")
    again = invoke("logs", "--kind", "linear", "--json")
    assert again.exit_code == 1
    assert json.loads(again.stdout)["fitted"][0]["useless"]


@pytest.mark.parametrize("name", ["model.npz", "model.onnx", "model.toml"])
def test_a_model_file_holds_its_time_step(invoke: Invoke, name: str) -> None:
    options = ("--step", "my_cart_step:step", "--parameter", "mass=[0.5, 2]", "--parameter", "friction=[0, 1]")
    kind = options if name.endswith("toml") else ("--kind", "linear")
    assert invoke("logs", *kind, "--out", name).exit_code == 0
    source = {
        "model.npz": 'type = "Saved"\nsource = "model.npz"',
        "model.onnx": 'type = "Onnx"\nsource = "model.onnx"\ndata = { logs = ["model.data.npz"] }',
        "model.toml": Path(name).read_text().partition("[model]\n")[2] if name.endswith("toml") else "",
    }[name]
    for dt, agrees in ((DT, True), (2 * DT, False)):
        Path("cart.toml").write_text(EXPERIMENT.format(dt=dt, model=source))
        validation = read_settings("cart.toml", {}).load().validation
        if agrees:
            assert validation.plan([1.0]).task.dt == DT
            continue
        with refuses(InputError, 0.05, 0.1):
            validation.plan([1.0])


EXPERIMENT = """
[space]
goal = [0.5, 2.0]

[task]
initial_state = [0.0, 0.0]
goal = ["goal", 0.0]
horizon = 10
dt = {dt}

[system]
type = "Manual"
states = {{x0 = "", x1 = ""}}
inputs = {{u0 = ""}}
dt = {dt}

[model]
{model}

[synthesizer]
type = "LQR"
Q = [1.0, 1.0]
R = [0.1]
"""


def test_recorded_data_of_several_files_have_one_unit_and_one_time_step(invoke: Invoke) -> None:
    run(80, 5, dt=2 * DT).to_csv("slow.csv")
    np.savez("slow.npz", **{name: getattr(run(80, 5, dt=2 * DT), name) for name in ("times", "states", "inputs")})
    run(80, 6).to_csv("degrees.csv", states=["x0 [deg]", "x1"])
    table = {"type": "Linear", "data": {"logs": ["logs/0.csv", "logs/1.csv"]}}
    assert len(part("model", table).data) == 160
    assert len(part("model", {**table, "data": {"logs": ["logs/0.csv", "slow.csv"]}}).data) == 80 + 160
    for other, facts in (
        ("slow.npz", (0.05, 0.1)),
        ("degrees.csv", ("degrees.csv",)),
    ):
        with refuses(InputError, *facts):
            part("model", {**table, "data": {"logs": ["logs/0.csv", other]}})
