"""``ctxval replay``, as users call it."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from facts import assert_names
from rig_cli import Invoke, calling, report
from rig_logs import DT, run, write_lerobot, write_mat, write_mcap_json

LINEAR = ("--model", "Linear", "--option", f"A=[[1.0, {DT}], [0.0, 1.0]]", "--option", f"B=[[0.0], [{DT}]]")
FIELDS = ("--state", "position=/state.cart.position", "--state", "speed=/state.cart.speed", "--input", "/command.force")

EXPERIMENT = f"""
name = "cart"
units = "m"
[space]
goal = [0.5, 2.0, "m"]
[task]
initial_state = [0.0, 0.0]
goal = ["goal", 0.0]
horizon = 30
dt = {DT}
[states]
position = "m"
speed = "m/s"
[inputs]
force = "N"
[system]
type = "Manual"
states = {{ position = "m", speed = "m/s" }}
inputs = {{ force = "N" }}
dt = {DT}
[model]
type = "Linear"
A = [[1.0, {DT}], [0.0, 1.0]]
B = [[0.0], [{DT}]]
[synthesizer]
type = "LQR"
Q = [10.0, 1.0]
R = [0.1]
[distance]
type = "MaximumDeviation"
components = [0]
[recordings]
dt = {DT}
states = {{ x0 = "x0", x1 = "x1" }}
inputs = {{ u0 = "u0" }}
"""


@pytest.fixture
def invoke(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Invoke:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.delitem(sys.modules, "my_model", raising=False)
    Path("logs").mkdir()
    for seed in range(4):
        run(80, seed).to_csv(f"logs/{seed}.csv")

    return calling("replay")


def refusal(result: Result) -> str:
    assert result.exit_code == 2, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    return " ".join(result.stderr.split())


def test_a_folder_of_logs_and_a_model_are_enough(invoke: Invoke) -> None:
    result = invoke("logs", *LINEAR)
    assert result.exit_code == 0, result.stderr
    assert_names(result.stdout, 4, 320, 0.05)
    for facts in ((), (), ()):
        assert_names(result.stdout, *facts)


def test_the_result_is_one_json_object(invoke: Invoke) -> None:
    found = report(invoke("logs", *LINEAR, "--json"))
    assert set(found) == {"data", "errors", "regions", "residuals", "suggestions", "faults", "tasks", "insights"}
    assert found["data"]["recordings"] == 4
    assert [one["steps"] for one in found["errors"]] == [1, 1, 5, 5, 20, 20]
    assert found["errors"][1]["relative"] == pytest.approx(found["errors"][1]["rms"] / found["errors"][1]["change"])
    assert found["tasks"] is None


def test_options_name_fields_steps_and_timing(invoke: Invoke) -> None:
    write_mcap_json(Path("run.mcap"), run())
    found = report(invoke("run.mcap", *LINEAR, *FIELDS, "--steps", "1,3", "--json"))
    assert (list(found["data"]["states"]), list(found["data"]["inputs"])) == (["position", "speed"], ["/command.force"])
    assert {one["steps"] for one in found["errors"]} == {1, 3}
    late = report(invoke("run.mcap", *LINEAR, *FIELDS, "--delay", "-0.1", "--dt", "0.05", "--json"))
    assert late["suggestions"][0]["kind"] == "delay"
    assert late["suggestions"][0]["value"] == pytest.approx(0.1)
    assert_names(late["data"]["notes"], -0.1)


def test_the_column_of_the_times_is_named(invoke: Invoke) -> None:
    text = Path("logs/0.csv").read_text().replace("t,", "clock,", 1)
    Path("other.csv").write_text(text)
    refusal(invoke("other.csv", *LINEAR))
    assert report(invoke("other.csv", *LINEAR, "--time", "clock", "--json"))["data"]["steps"] == 80


def test_a_mapping_is_a_toml_file(invoke: Invoke) -> None:
    write_mat(Path("run.mat"), run(), version="7.3")
    Path("map.toml").write_text(
        'time = "log.time"\n[states]\nposition = "log.state[0]"\nspeed = { path = "log.state[1]", unit = "m/s" }\n'
        '[inputs]\nforce = "force"\n'
    )
    found = report(invoke("run.mat", *LINEAR, "--mapping", "map.toml", "--json"))
    assert found["data"]["states"] == {"position": "", "speed": "m/s"}
    refusal(invoke("run.mat", *LINEAR, "--mapping", "map.toml", "--state", "log.state"))


@pytest.mark.thorough
def test_a_lerobot_data_set_needs_no_mapping(invoke: Invoke) -> None:
    write_lerobot(Path("set"), [run(seed=seed) for seed in range(3)])
    found = report(invoke("set", *LINEAR, "--json"))
    assert list(found["data"]["states"]) == ["position", "speed"]
    assert found["residuals"][1]["explained"] > 0.9


@pytest.mark.slow
@pytest.mark.thorough
def test_a_model_is_a_file_a_reference_or_that_of_an_experiment(invoke: Invoke) -> None:
    A, B = np.array([[1.0, DT], [0.0, 1.0]]), np.array([[0.0], [DT]])
    np.savez("model.npz", A=A, B=B)
    Path("my_model.py").write_text(f"from ctxval import models\nmodel = models.Linear({A.tolist()}, {B.tolist()})\n")
    Path("cart.toml").write_text(EXPERIMENT)
    expected = report(invoke("logs/0.csv", *LINEAR, "--json"))["errors"]
    for model in ("model.npz", "my_model:model", "cart.toml"):
        assert report(invoke("logs/0.csv", "--model", model, "--json"))["errors"] == expected, model


@pytest.mark.thorough
def test_a_model_is_an_onnx_file_with_options(invoke: Invoke) -> None:
    pytest.importorskip("onnxruntime")
    onnx = pytest.importorskip("onnx")
    weights = np.array([[0.0, 0.0], [DT, 0.0], [0.0, DT]], dtype=np.float32)
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("MatMul", ["z", "w"], ["y"])],
        "step",
        [onnx.helper.make_tensor_value_info("z", onnx.TensorProto.FLOAT, ["N", 3])],
        [onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, ["N", 2])],
        [onnx.numpy_helper.from_array(weights, "w")],
    )
    made = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=9)
    onnx.save(made, "model.onnx")
    found = report(invoke("logs", "--model", "model.onnx", "--option", "increments=true", "--json"))
    expected = report(invoke("logs", *LINEAR, "--json"))
    np.testing.assert_allclose(
        [one["rms"] for one in found["errors"]], [one["rms"] for one in expected["errors"]], atol=1e-5
    )


@pytest.mark.slow
@pytest.mark.thorough
def test_an_experiment_predicts_its_worst_tasks_and_names_the_states(invoke: Invoke) -> None:
    Path("cart.toml").write_text(EXPERIMENT)
    found = report(invoke("logs", "--experiment", "cart.toml", "--executions", "3", "--seed", "1", "--json"))
    assert found["data"]["states"] == {"position": "m", "speed": "m/s"}
    assert len(found["tasks"]["executions"]) == 3
    assert found["tasks"]["worst"][0]["parameters"]["goal"] == pytest.approx(2.0, abs=0.05)
    result = invoke("logs", "--experiment", "cart.toml", "--executions", "1")
    for facts in ((), ("executions",)):
        assert_names(result.stdout, *facts)


def test_splits_are_printed(invoke: Invoke) -> None:
    write_mcap_json(Path("run.mcap"), run(), lost=(20, 30))
    result = invoke("run.mcap", *LINEAR, *FIELDS)
    assert result.exit_code == 0
    assert_names(result.stderr, "run.mcap", 0.95, 0.1)


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        (("logs",), ("--model", "--experiment")),
        (("absent", *LINEAR), ("absent",)),
        (
            ("logs", "--model", "Linaer"),
            ("model", "mujoco.sysid"),
        ),
        (("logs", "--model", "absent.npz"), ("absent.npz", "model")),
        (("logs", "--model", "absent.toml"), ("absent.toml",)),
        (("logs", "--model", "absent:model"), ("absent",)),
        (("logs", *LINEAR, "--steps", "1,two"), ("--steps",)),
        (
            ("logs", *LINEAR, "--steps", "0"),
            (1, "0", 0),
        ),
        (("logs", *LINEAR, "--dt", "-1"), ("dt",)),
        (("logs", *LINEAR, "--delay", "nan"), ("delay",)),
        (("logs", *LINEAR, "--state", "x=x9"), ("x9",)),
        (("logs", *LINEAR, "--state", "="), ("input", "NAME", "FIELD")),
        (("logs", *LINEAR, "--input", "u=u0"), ("--input", "--state")),
        (("logs", *LINEAR, "--mapping", "absent.toml"), ("absent.toml",)),
        (
            ("logs", "--experiment", "pendulum"),
            (0.02, 0.05),
        ),
    ],
)
def test_what_cannot_be_used_is_said_in_one_sentence(
    arguments: tuple[str, ...], facts: tuple[object, ...], invoke: Invoke
) -> None:
    assert_names(refusal(invoke(*arguments)), *facts)


def test_a_model_of_other_dimensions_is_said_in_one_sentence(invoke: Invoke) -> None:
    result = invoke("logs", "--model", "Linear", "--option", "A=[[1.0]]", "--option", "B=[[1.0]]")
    assert result.exit_code == 3
    assert_names(result.stderr, 2, 1)


@pytest.mark.slow
def test_names_in_a_log_steer_no_terminal(invoke: Invoke) -> None:
    Path("odd.csv").write_text("t,\x1b[31mred,u0\n0,1,2\n0.1,1,2\n0.2,1,2\n")
    result = invoke("odd.csv", "--model", "Linear", "--option", "A=[[1.0]]", "--option", "B=[[1.0]]", "--state", "\x1b")
    assert "\x1b" not in result.stdout + result.stderr
