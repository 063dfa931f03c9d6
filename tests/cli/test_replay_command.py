"""``ctxval replay``, as users call it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

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
states = ["x0", "x1"]
inputs = ["u0"]
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
    assert "4 recordings, 320 steps of 0.05 s (16 s)" in result.stdout
    for text in ("error of the prediction", "one-step residual on held-out recordings", "affine function of state"):
        assert text in result.stdout


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
    assert any("inputs act -0.1 s after they are logged" in note for note in late["data"]["notes"])


def test_the_column_of_the_times_is_named(invoke: Invoke) -> None:
    text = Path("logs/0.csv").read_text().replace("t,", "clock,", 1)
    Path("other.csv").write_text(text)
    assert "has no column of times" in refusal(invoke("other.csv", *LINEAR))
    assert report(invoke("other.csv", *LINEAR, "--time", "clock", "--json"))["data"]["steps"] == 80


def test_a_mapping_is_a_toml_file(invoke: Invoke) -> None:
    write_mat(Path("run.mat"), run(), version="7.3")
    Path("map.toml").write_text(
        'time = "log.time"\n[states]\nposition = "log.state[0]"\nspeed = { path = "log.state[1]", unit = "m/s" }\n'
        '[inputs]\nforce = "force"\n'
    )
    found = report(invoke("run.mat", *LINEAR, "--mapping", "map.toml", "--json"))
    assert found["data"]["states"] == {"position": "", "speed": "m/s"}
    assert "cannot be combined" in refusal(invoke("run.mat", *LINEAR, "--mapping", "map.toml", "--state", "log.state"))


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
    for text in ("largest predicted distances, which no execution has tested", "executions that would tell most"):
        assert text in result.stdout


def test_splits_are_printed(invoke: Invoke) -> None:
    write_mcap_json(Path("run.mcap"), run(), lost=(20, 30))
    result = invoke("run.mcap", *LINEAR, *FIELDS)
    assert result.exit_code == 0
    assert "split: run.mcap, 0.95 s: position has no sample for 0.1 s" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("logs",), "a model is needed: give --model, or --experiment"),
        (("absent", *LINEAR), "there is no file absent"),
        (
            ("logs", "--model", "Linaer"),
            "a model must be a file that ends in .onnx, .npz, .xml or .toml, a result of mujoco.sysid",
        ),
        (("logs", "--model", "absent.npz"), "absent.npz cannot be read as a model (an NPZ file of ctxval, or one with"),
        (("logs", "--model", "absent.toml"), "there is no experiment file absent.toml"),
        (("logs", "--model", "absent:model"), "no module named 'absent'"),
        (("logs", *LINEAR, "--steps", "1,two"), "--steps must be positive integers with commas between them"),
        (
            ("logs", *LINEAR, "--steps", "0"),
            "between them, such as 1,10,50, got '0'",
        ),
        (("logs", *LINEAR, "--dt", "-1"), "dt must be a positive number"),
        (("logs", *LINEAR, "--delay", "nan"), "delay must be a finite number"),
        (("logs", *LINEAR, "--state", "x=x9"), "has no field 'x9'; it has t, x0, x1, u0"),
        (("logs", *LINEAR, "--state", "="), "each state and input must be given once, as NAME=FIELD"),
        (("logs", *LINEAR, "--input", "u=u0"), "--input needs --state"),
        (("logs", *LINEAR, "--mapping", "absent.toml"), "absent.toml cannot be read"),
        (
            ("logs", "--experiment", "pendulum"),
            "the tasks have steps of 0.02 s and the recordings have steps of 0.05 s",
        ),
    ],
)
def test_what_cannot_be_used_is_said_in_one_sentence(arguments: tuple[str, ...], message: str, invoke: Invoke) -> None:
    assert message in refusal(invoke(*arguments))


def test_a_model_of_other_dimensions_is_said_in_one_sentence(invoke: Invoke) -> None:
    result = invoke("logs", "--model", "Linear", "--option", "A=[[1.0]]", "--option", "B=[[1.0]]")
    assert result.exit_code == 3
    assert "the model cannot predict a step of the recordings, which have 2 states and 1 inputs" in result.stderr


@pytest.mark.slow
def test_names_in_a_log_steer_no_terminal(invoke: Invoke) -> None:
    Path("odd.csv").write_text("t,\x1b[31mred,u0\n0,1,2\n0.1,1,2\n0.2,1,2\n")
    result = invoke("odd.csv", "--model", "Linear", "--option", "A=[[1.0]]", "--option", "B=[[1.0]]", "--state", "\x1b")
    assert "\x1b" not in result.stdout + result.stderr


def test_a_replay_is_also_a_page(invoke: Invoke, tmp_path: Path) -> None:
    Path("runs").mkdir()
    for seed in range(3):
        run(60, seed).to_csv(f"runs/run{seed}.csv")
    done = invoke("runs", *LINEAR, "--html", "out/page.html", "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["report"] == "out/page.html"
    assert "Recordings replayed on Linear" in Path("out/page.html").read_text()
    printed = invoke("runs", *LINEAR, "--html", "out/page.html")
    assert "report: out/page.html" in printed.output
    refused = invoke("runs", *LINEAR, "--html", "runs")
    assert refused.exit_code == 2
    assert "--html must be a file that ends in .html, got 'runs'" in refused.output
