"""Experiment files: the whole in one, written by init, looked at by check."""

from __future__ import annotations

import io
import json
import sys
import tomllib
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

import ctxval
from conftest import make_validation, make_validation_without_inputs
from ctxval import Experiment, Store, Task, TaskSpace, Trajectory, Validation, controllers, distances, systems
from ctxval.cli import app
from ctxval.cli.config.check import check_experiment
from ctxval.cli.config.parts import TaskTable, part, recorded
from ctxval.cli.config.settings import ExperimentSettings, read_settings
from ctxval.core.experiment import UnitsWarning
from ctxval.errors import CtxvalError, ExecutionError, InputError
from facts import assert_names, is_named, refuses, warns
from faulty_rig import FaultyRig
from rig_thorough import more


@pytest.fixture
def invoke(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    """Run the command line in a folder with the file that init writes."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    sys.modules.pop("experiment_system", None)

    def run(*arguments: str) -> Result:
        return CliRunner().invoke(app, list(arguments))

    assert run("init").exit_code == 0
    yield run
    sys.modules.pop("experiment_system", None)


def changed(*changes: tuple[str, str]) -> str:
    """Write the file of init with some of its text replaced."""
    text = Path("experiment.toml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    Path("e.toml").write_text(text)
    return "e.toml"


def sentence(result: Result) -> str:
    assert result.exit_code == 2, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    return result.stderr.replace("\n", " ")


@pytest.mark.slow
@pytest.mark.parametrize("draws", ["few", pytest.param("all", marks=[pytest.mark.in_full, pytest.mark.thorough])])
def test_the_file_of_init_reaches_a_verdict_as_it_is(invoke: Any, draws: str) -> None:
    result = invoke("run", "experiment.toml", "--no-report", "--json")
    assert result.exit_code == 0, result.stderr
    report = json.loads(result.stdout)
    assert (report["case"], report["search"], report["units"]) == ("cart", "auto", "m")
    assert report["verdict"] == "validated"
    assert 4 <= report["executions"] <= 20
    assert report["worst"]["distance"] > 0.01
    again = json.loads(invoke("run", "experiment.toml", "--no-report", "--json").stdout)
    assert again == report


def test_the_file_of_init_passes_its_check(invoke: Any, request: pytest.FixtureRequest) -> None:
    result = invoke("check", "experiment.toml", "--execute", "--json")
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert report["ok"]
    assert {finding["state"] for finding in report["findings"]} == {"ok"}
    request.getfixturevalue("without_costs")
    assert_names(invoke("check", "experiment.toml", "--execute").stdout, "ok")
    assert not Path("runs").exists()


def test_a_file_is_an_experiment_in_python_too(invoke: Any) -> None:
    experiment = ctxval.load_experiment(Path("experiment.toml"))
    assert (experiment.name, experiment.units, experiment.validation.space.names) == (
        "cart",
        "m",
        ("goal", "start_speed"),
    )
    assert experiment.validation.distances(np.array([[1.0, 0.1]]))[0] > 0
    assert ctxval.load_experiment("linear", seed=1, dim=2).validation.space.dimension == 4
    with refuses(InputError, "none.toml"):
        ctxval.load_experiment("none.toml")


def test_init_overwrites_nothing(invoke: Any) -> None:
    before = Path("experiment.toml").read_bytes()
    assert "experiment.toml already exists" in sentence(invoke("init"))
    assert "must" not in invoke("init", "other.toml").stderr
    assert_names(invoke("init", "my rig.toml").stdout, "my rig.toml")
    assert "ends in .toml" in sentence(invoke("init", "other.ini"))
    sentence(invoke("init", "/proc/none/other.toml"))
    assert Path("experiment.toml").read_bytes() == before


def rig_of(invoke: Any, *changes: tuple[str, str]) -> Any:
    """Return the validation of a short task on the program that `ctxval init --hardware` writes, with changes in it."""
    invoke("init", "cart.toml", "--hardware")
    for name in ("experiment.toml", "cart.toml"):
        Path(name).write_text(
            Path(name).read_text().replace("horizon = 60", "horizon = 4").replace("dt = 0.05 ", "dt = 0.2 ")
        )
    program = Path("cart_rig.py")
    for old, new in changes:
        assert old in program.read_text()
        program.write_text(program.read_text().replace(old, new))
    return ctxval.load_experiment(Path("cart.toml")).validation


@pytest.mark.slow
def test_init_for_hardware_executes_the_program_that_it_writes(invoke: Any) -> None:
    rig = rig_of(invoke)
    simulated = ctxval.load_experiment(Path("experiment.toml")).validation
    assert isinstance(rig.system, systems.Subprocess)
    point = np.array([0.4, 0.7])
    # Measured times differ from those of the task, and states are interpolated.
    np.testing.assert_allclose(rig.distances(point[None]), simulated.distances(point[None]), rtol=0.3)


@pytest.mark.slow  # a rig keeps real time
@pytest.mark.parametrize(
    ("old", "new", "facts", "steps"),
    [
        ("> 10.0", "> 0.06", (2, 1), 1),
        ("= self.state\n", "= self.state\n        time.sleep(0.5)\n", (0.2, 1), 0),
        ("= self.state\n", "= self.state\n        time.sleep(60 * (position > 0.06))\n", (2.5,), 2),
    ],
)
def test_a_rig_stops_after_every_failure_and_keeps_its_steps(
    invoke: Any, old: str, new: str, facts: tuple[object, ...], steps: int
) -> None:
    stops = ('and Ctrl-C."""\n', 'and Ctrl-C."""\n        Path("stopped").touch()\n')
    rig = rig_of(invoke, (old, new), stops)
    rig.system.timeout = 2.5
    plan = rig.plan(np.array([0.4, 0.7]))
    if steps:
        trajectory = rig.system.execute(plan.controller, plan.task)
        assert_names(trajectory.ended, *facts)
        assert trajectory.horizon >= steps
        with refuses(ExecutionError, *facts):
            rig.execute(plan)
    else:
        with refuses(ExecutionError, *facts):
            rig.system.execute(plan.controller, plan.task)
    assert Path("stopped").exists()


def test_a_described_experiment_can_be_asked_by_hand(invoke: Any) -> None:
    manual = (
        'type = "Simulated"\nstep = { ref = "experiment_system:step" }',
        'type = "Manual"\nstates = { position = "m", speed = "m/s" }\ninputs = { force = "N" }\ndt = 0.05',
    )
    target = changed(manual, ("dt = 0.05               # time step in seconds\n", "\n"))
    asked = json.loads(invoke("ask", target, "--store", "a.sqlite", "--json").stdout)
    assert asked["trial"] == 0
    assert invoke("tell", "a.sqlite", "0", "--distance", "0.1").exit_code == 0
    assert Store("a.sqlite").trials()[0].distance == 0.1
    invoke("check", target, "--execute")


@pytest.mark.parametrize(
    ("old", "new", "facts"),
    [
        ('type = "Simulated"', 'type = "Simulatd"', ("Simulatd", "Simulated")),
        ('type = "LQR"', 'type = "LQG"', ("LQG",)),
        ("R = [0.1]", "RR = [0.1]", ("R",)),
        ("R = [0.1]", 'R = "much"', ("R",)),
        ("R = [0.1]", "R = [-0.1]", ("R",)),
        ("R = [0.1]", "", ("LQR", "TypeError")),
        ("A = [[1.0, 0.05], [0.0, 1.0]]", "A = [[1.0]]", ("A", "B")),
        ('goal = ["goal", 0.0]', 'goal = ["gaol", 0.0]', ("goal",)),
        ('goal = ["goal", 0.0]', "goal = 3", ("goal",)),
        ('goal = ["goal", 0.0]', "goal = [0.0, 0.0]\nenvironment = 3", ("environment",)),
        (
            'goal = ["goal", 0.0]',
            "goal = [0.0, 0.0]\nenvironment = { o = 3 }",
            ("environment",),
        ),
        ('goal = ["goal", 0.0]', "goal = [1.0]", ("goal", "task", 2)),
        ('goal = ["goal", 0.0]', 'goal = ["goal[1]", 0.0]', ()),
        ("horizon = 60            # number of time steps", "", ("horizon",)),
        ("horizon = 60", "horizonn = 60", ("horizon",)),
        ("horizon = 60", "horizon = -1", ("horizon",)),
        ("goal = [0.5, 3.0", "goal = [3.0, 0.5", ()),
        ("threshold = 0.5", "threshold = true", ("threshold",)),
        ('goal = [0.5, 3.0, "m"]', "goal = 3", ("space.goal",)),
        ("experiment_system:step", "nowhere:step", ()),
        ("[system] ", "[sistem] ", ("sistem", "system")),
        (
            "[certificate]",
            "[certificate]\nresolutoin = 1",
            ("resolutoin", "resolution"),
        ),
        (
            'kind = "auto"',
            'kind = "audit"\nresolution = 0.3',
            ("resolution", "kind", "auto"),
        ),
        ("components = [0]", "componets = [0]", ("components",)),
        ('type = "auto"', 'type = "gp-ucb"\nbeta = "two"', ("gp-ucb", "beta")),
        ('type = "auto"', 'type = "gp-ucb"\ninitial = 2.5', ("gp-ucb", "initial")),
        ('type = "auto"', 'type = "gp-ucb"\ninitial = true', ("gp-ucb", "initial")),
        ('type = "auto"', 'type = "gp-ucb"\nkernel = "matern"', ("gp-ucb", "kernel")),
        ('type = "auto"', 'type = "gp-ucb"\nnoise = 3', ("gp-ucb", "noise")),
        ('kind = "auto"', 'kind = "posteriour"', ("posterior",)),
        ('name = "cart"', 'name = "cart"\nexperiment = "pendulum"', ()),
        ('name = "cart"', 'name = "cart"\n[options]\nx = 1\n[other]', ()),
    ],
)
def test_what_is_wrong_in_a_file_is_named_before_anything_is_executed(
    invoke: Any, old: str, new: str, facts: tuple[object, ...]
) -> None:
    for command in ("check", "run"):
        assert_names(sentence(invoke(command, changed((old, new)))), *facts)
    assert not Path("runs").exists()


@pytest.mark.parametrize("options", ["settings = 3", "pendulum = 3", "settings = { dt = 0.1 }"])
def test_options_of_a_case_are_plain_values(invoke: Any, options: str) -> None:
    Path("e.toml").write_text(f'experiment = "pendulum"\n[options]\n{options}')
    assert "case 'pendulum'" in sentence(invoke("run", "e.toml"))
    Path("e.toml").write_text('experiment = "linear"\n[options]\ndim = "three"')
    assert "dim" in sentence(invoke("run", "e.toml"))


def test_what_the_certificate_of_the_file_would_ignore_is_refused(invoke: Any) -> None:
    target = changed(('kind = "auto"', 'kind = "scenario"'))
    sentence(invoke("run", target, "--resolution", "1"))
    assert not Path("runs").exists()


@pytest.mark.parametrize("target", ["experiment = 'pendulum'", "name = 'cart'"])
def test_the_file_says_the_largest_horizon_that_is_planned(invoke: Any, target: str) -> None:
    text = target if "pendulum" in target else Path("experiment.toml").read_text()
    for longest in (3, 10**7):
        Path("e.toml").write_text(f"longest = {longest}\n{text}")
        assert read_settings("e.toml", {}).load().validation.longest == longest
    for wrong in ("0", "2.5", "true", "'3'", str(2**60)):
        Path("e.toml").write_text(f"longest = {wrong}\n{text}")
        assert "longest" in sentence(invoke("run", "e.toml"))
    Path("e.toml").write_text(f"longest = 3\n{text}")
    assert_names(sentence(invoke("run", "e.toml")), 3, "longest")
    Path("e.toml").write_text(f"start_tolerance = 0.5\n{text}")
    assert read_settings("e.toml", {}).load().validation.start_tolerance == 0.5
    Path("e.toml").write_text(f"start_tolerance = -1\n{text}")
    assert "start_tolerance" in sentence(invoke("run", "e.toml"))


@pytest.mark.slow
def test_the_certificate_of_the_file_is_what_run_and_certify_judge_by(invoke: Any) -> None:
    scenario = ('kind = "auto"', 'kind = "scenario"\nvolume = 0.5')
    target = changed(scenario, ('type = "auto"', 'type = "random"'))
    run = json.loads(invoke("run", target, "--no-report", "--json").stdout)
    assert (run["verdict"], run["certificate"]["kind"]) == ("validated", "scenario")
    certified = json.loads(invoke("certify", run["store"], "--threshold", "0.5", "--json").stdout)
    assert (certified["kind"], certified["verdict"]) == ("scenario", "validated")
    sentence(invoke("run", target, "--decide"))
    adaptive = changed(scenario, ('type = "auto"', 'type = "gp-ucb"'))
    refused = json.loads(invoke("run", adaptive, "--store", "b.sqlite", "--no-report", "--json").stdout)
    assert refused["verdict"] == "undecided"


# Tasks and data without code


def test_a_task_table_serves_one_task_and_a_batch() -> None:
    space = TaskSpace(goal=(0, 2), offsets=([-1, -1], [1, 1]))
    table = TaskTable((0.5, "-goal"), ("goal", "offsets[1]"), 4, 0.1)
    points = space.iid(5, np.random.default_rng(0))
    batch = table(space.parameters(points))
    np.testing.assert_array_equal(batch.initial_state, np.stack([np.full(5, 0.5), -points[:, 0]], axis=1))
    np.testing.assert_array_equal(batch.goal, points[:, [0, 2]])
    np.testing.assert_array_equal(table(space.parameters(points[3])).goal, batch.goal[3])
    placed = TaskTable((0.5,), None, 4, 0.1, {"obstacle": ["offsets[0]", 2.0]})(space.parameters(points))
    np.testing.assert_array_equal(placed.environment["obstacle"], np.stack([points[:, 1], np.full(5, 2.0)], axis=1))


def test_a_model_is_learned_from_recorded_files(invoke: Any) -> None:
    rng = np.random.default_rng(0)
    x = np.zeros((31, 2))
    u = rng.normal(size=(30, 1))
    for t in range(30):
        x[t + 1] = [x[t, 0] + 0.05 * x[t, 1], 0.9 * x[t, 1] + 0.05 * u[t, 0] + 0.01 * rng.normal()]
    trajectory = Trajectory(np.arange(31) * 0.05, x, u)
    trajectory.to_csv("run1.csv")
    Path("run2.npz").write_bytes(trajectory.to_npz())
    steps = trajectory.transitions()
    np.savez("steps.npz", x=steps.x, u=steps.u, x_next=steps.x_next)
    assert len(recorded({"logs": ["run1.csv", "run2.npz", "steps.npz"]})) == 90
    rows = zip(x.tolist(), [*u[:, 0].tolist(), 0.0], strict=True)
    matrices = "A = [[1.0, 0.05], [0.0, 1.0]]\nB = [[0.0], [0.05]]\n"
    settings = read_settings(changed((matrices, 'data = { logs = ["run1.csv", "run2.npz"] }\n')), {})
    model = settings.load().validation.model
    np.testing.assert_allclose(model.A[0], [1, 0.05], atol=1e-9)  # type: ignore[attr-defined]
    # Columns with the names of the experiment's states and inputs, one of them in another unit.
    named = ["t,position [mm],speed,force", *(f"{0.05 * k},{1e3 * p},{v},{f}" for k, ((p, v), f) in enumerate(rows))]
    Path("named.csv").write_text("\n".join(named))
    names = {"states": {"position": "m", "speed": "m/s"}, "inputs": {"force": "N"}}
    np.testing.assert_allclose(recorded({"logs": ["named.csv"]}, None, names).x, steps.x, atol=1e-12)
    with refuses(InputError, "named.csv", "observation.state"):
        recorded({"logs": ["named.csv"]})
    for data in ("none.csv", "experiment_system.py", ["x.npz"], [], 3):
        with pytest.raises(InputError):
            recorded(data)
    Path("ms.csv").write_text(
        "\n".join(["t,position,speed,force", *(f"{50 * k},{p},{v},0" for k, (p, v) in enumerate(x))])
    )
    with refuses(InputError, 50, "ms.csv"):
        recorded({"logs": ["ms.csv"]}, None, names)


# Any bytes


@given(st.text(max_size=60))
def test_no_text_gives_anything_but_an_error_of_ours(text: str) -> None:
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return
    with pytest.raises((CtxvalError, ValueError)):
        ExperimentSettings.model_validate({**content, "unknown": 1})


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
WHOLE: dict[str, Any] = {
    "space": {"goal": [0.0, 1.0]},
    "task": {"initial_state": [0.0], "goal": ["goal"], "horizon": 3, "dt": 0.1},
    "system": {"type": "Manual", "states": {"x": "m"}, "inputs": {"u": "N"}, "dt": 0.1},
    "model": {"type": "Linear", "A": [[1.0]], "B": [[1.0]]},
    "synthesizer": {"type": "LQR", "Q": [1.0], "R": [1.0]},
    "distance": {"type": "FinalState"},
    "search": {"type": "gp-ucb", "beta": 1.0},
    "certificate": {"kind": "posterior"},
}


@given(st.data())
def test_no_value_anywhere_gives_anything_but_an_error_of_ours(data: st.DataObject) -> None:
    table = data.draw(st.sampled_from(list(WHOLE)))
    key = data.draw(st.sampled_from([None, *WHOLE[table]]))
    value = data.draw(PLAIN)
    content = {**WHOLE, table: value if key is None else {**WHOLE[table], key: value}}
    try:
        settings = ExperimentSettings.model_validate(content)
    except ValueError:
        return
    try:
        settings.search.build()
        settings.load().validation.describe()
    except CtxvalError:
        return


# What a check finds


def findings(validation: Any, execute: bool = False, **names: Any) -> dict[str, tuple[str, str]]:
    """Return the worst finding of each check."""
    order = ("ok", "skipped", "noted", "failed")
    found = check_experiment(Experiment("x", validation, **names), execute=execute)
    ordered = sorted(found, key=lambda finding: order.index(finding.state))
    return {finding.check: (finding.state, finding.text) for finding in ordered}


@pytest.fixture(scope="module")
def plain() -> dict[str, tuple[str, str]]:
    """The findings of an experiment without a fault, and without names."""
    return findings(make_validation())


@pytest.mark.usefixtures("without_costs")
@pytest.mark.parametrize(("iterations", "state"), [(1, "noted"), (100, "ok")])
def test_a_check_counts_the_designs_that_did_not_converge(
    iterations: int, state: str, plain: dict[str, tuple[str, str]]
) -> None:
    validation = make_validation()
    hasty = controllers.ILQR([1.0, 0.1], [1e-2], [10.0, 1.0], iterations=iterations, limits=0.5)
    validation = Validation(**{**vars(validation), "synthesizer": hasty})
    found = {one.check: one for one in check_experiment(Experiment("x", validation))}["convergence of the designs"]
    assert found.state == state
    assert_names(found.text, 11)
    assert "convergence of the designs" not in plain


def test_a_check_executes_nothing_unless_told(request: pytest.FixtureRequest) -> None:
    rig = FaultyRig(make_validation().system, dict.fromkeys(range(9), "raise"))
    validation = make_validation(system=rig, horizon=5)
    assert findings(validation)["execution"][0] == "skipped"
    assert rig._executions == 0
    request.getfixturevalue("without_costs")
    assert findings(validation, execute=True)["execution"][0] == "failed"


@pytest.mark.usefixtures("without_costs")
def test_noise_is_measured() -> None:
    rng = np.random.default_rng(0)
    plain = make_validation()

    class Noisy:
        def execute(self, controller: Any, task: Task) -> Trajectory:
            whole = plain.system.execute(controller, task)
            return Trajectory(whole.times, whole.states + 1e-9 * rng.normal(size=whole.states.shape), whole.inputs)

    state, text = findings(make_validation(system=Noisy(), horizon=5), execute=True)["execution"]
    assert state == "noted"
    assert_names(text, "system")


@pytest.mark.usefixtures("without_costs")
def test_states_in_another_unit_are_noted() -> None:
    plain = make_validation()

    class InMillimetres:
        def execute(self, controller: Any, task: Task) -> Trajectory:
            whole = plain.system.execute(controller, task)
            start = whole.states[0]
            return Trajectory(whole.times, start + 1e3 * (whole.states - start), whole.inputs)

    found = check_experiment(Experiment("x", make_validation(system=InMillimetres(), horizon=5)), execute=True)
    texts = [finding.text for finding in found if finding.state == "noted"]
    assert_names(texts, "system")


@pytest.mark.usefixtures("without_costs")
@pytest.mark.parametrize(("moved", "state", "fact"), [(10.0, "failed", "start_tolerance"), (0.002, "noted", 0.002)])
def test_a_start_is_refused_if_campaigns_refuse_it(moved: float, state: str, fact: object) -> None:
    """The first record of a sensor with noise is not the initial state of the task."""
    plain = make_validation()

    class Elsewhere:
        def execute(self, controller: Any, task: Task) -> Trajectory:
            whole = plain.system.execute(controller, task)
            return Trajectory(whole.times, whole.states + moved, whole.inputs)

    checked = check_experiment(Experiment("x", make_validation(system=Elsewhere(), horizon=5)), execute=True)
    of_execution = {(each.state, each.text) for each in checked if each.check == "execution"}
    assert any(each == state and is_named(text, fact) for each, text in of_execution), of_execution


@pytest.mark.usefixtures("without_costs")
def test_a_model_whose_batches_differ_is_found() -> None:
    plain = make_validation()

    class Sloppy:
        def step(self, x: Any, u: Any) -> Any:
            return plain.model.step(x, u) + (0.1 if np.ndim(x) > 1 and len(x) == 7 else 0.0)

    assert findings(make_validation(model=Sloppy(), horizon=5))["model"][0] == "failed"


@pytest.mark.parametrize("batched", [True, *more(False)])
def test_a_system_without_inputs_has_none_to_name(batched: bool) -> None:
    validation = make_validation_without_inputs(batched)
    validation.task = lambda p: Task(np.stack([p.a, p.b], axis=-1), goal=[0.0, 0.0], horizon=5, dt=0.1)
    found = check_experiment(Experiment("x", validation), execute=True)
    assert ("names", "ok", "inputs: none") in [(one.check, one.state, one.text) for one in found]
    assert not [one for one in found if one.state == "failed"]


@pytest.mark.usefixtures("without_costs")
def test_dimensions_names_and_units_are_held_against_each_other(plain: dict[str, tuple[str, str]]) -> None:
    validation = make_validation(system=systems.Manual(states={"a": "m"}, inputs={"u": "N"}, dt=0.01), horizon=5)
    found = findings(validation, states=("angle",), inputs=("torque",))
    assert found["system"][0] == "failed"
    assert_names(found["names"], "failed", 2, 1, "angle")
    assert plain["names"][0] == "noted"


@pytest.mark.usefixtures("without_costs")
def test_a_check_notes_a_distance_that_adds_different_units_and_how_to_weight_them() -> None:
    with warns(UnitsWarning, "rad", "rad/s"):
        experiment = Experiment("x", make_validation(horizon=5), states=("angle [rad]", "rate [rad/s]"))
    found = [finding for finding in check_experiment(experiment) if finding.check == "distance"]
    assert found[0].state == "noted"
    assert_names(found[0].text, "scales=[...]")


@pytest.mark.usefixtures("without_costs")
def test_a_controller_that_fails_on_the_model_itself_is_noted() -> None:
    state, _ = findings(make_validation(horizon=3))["controller on the model"]
    assert state == "noted"


def test_a_part_that_breaks_is_a_finding_and_no_traceback() -> None:
    validation = make_validation(distance=lambda a, b, task: 1 / 0, horizon=5)
    assert findings(validation)["distance"][0] == "failed"
    elsewhere = findings(make_validation(distance=distances.FinalState(components=[7]), horizon=5))
    assert elsewhere["tasks"][0] == "ok"
    assert_names(elsewhere["distance"], "failed", "distance", "ShapeError", "components")
    broken = make_validation(model=lambda x, u: x * float("nan"))
    assert findings(broken)["tasks"][0] == "failed"


@pytest.mark.parametrize(
    ("limits", "low", "high"),
    [
        ("2.0", [-2, -2], [2, 2]),
        ("[[0.0, 8.0], [-inf, 8.0]]", [0, -np.inf], [8, 8]),
    ],
)
def test_limits_are_written_in_a_file_as_in_python(limits: str, low: list[float], high: list[float]) -> None:
    table = tomllib.loads(f'type = "LQR"\nQ = [1.0]\nR = [1.0, 1.0]\nlimits = {limits}')
    made = part("synthesizer", table)
    assert (made.limits.low.tolist(), made.limits.high.tolist()) == (low, high)


@pytest.mark.parametrize("kind", ["LQR", "ILQR", "StationaryLQR"])
def test_a_flat_list_of_limits_in_a_file_is_refused(kind: str) -> None:
    with refuses(InputError, [1.0, 8.0], "limits"):
        part("synthesizer", {"type": kind, "Q": [1.0], "R": [1.0, 1.0], "limits": [1.0, 8.0]})


def test_recorded_data_is_read_with_bounds(tmp_path: Path) -> None:
    path = tmp_path / "steps.npz"
    np.savez(path, x=np.zeros((3, 2)), u=np.zeros((3, 1)), x_next=np.ones((3, 2)))
    assert recorded({"logs": [str(path)]}).x_next.tolist() == [[1, 1]] * 3
    header = np.lib.format.header_data_from_array_1_0(np.zeros(1)) | {"shape": (2**40, 2)}
    huge = io.BytesIO()
    np.lib.format.write_array_header_1_0(huge, header)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x_next.npy", huge.getvalue())
        archive.writestr("x.npy", huge.getvalue())
    with refuses(InputError, "steps.npz", "x"):
        recorded({"logs": [str(path)]})


def test_a_model_is_learned_from_logs_with_a_mapping(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    from rig_logs import DT, run, write_mcap_json

    write_mcap_json(tmp_path / "run.mcap", run())
    states = {"position": "/state.cart.position", "speed": "/state.cart.speed"}
    mapping = {"states": states, "inputs": {"force": "/command.force"}}
    model = part("model", {"type": "Linear", "data": {"logs": ["run.mcap"], **mapping}}, tmp_path)
    np.testing.assert_allclose(model.A, [[1, DT], [0, 1 - 0.3 * DT]], atol=1e-9)
    assert len(model.data) == 60
    with refuses(InputError, "data", "logs"):
        part("model", {"type": "Linear", "data": mapping}, tmp_path)
    with refuses(InputError, "run.mcap", "observation.state"):
        part("model", {"type": "Linear", "data": {"logs": ["run.mcap"]}}, tmp_path)
    with refuses(InputError, "logs", "run.mcap"):
        part("model", {"type": "Linear", "data": ["run.mcap"]}, tmp_path)


COMPARABLE = "components = [0, 1]\nweights = [1.0, 2.0]\nscales = [0.1, 0.5]\nangles = [0]\n"
DISTANCES = {
    **{f"{name} {norm}": f'type = "{name}"\nnorm = {norm}\n{COMPARABLE}'
       for name in ("FinalState", "GoalError", "MaximumDeviation", "MeanDeviation", "WholeTrajectory", "TrackingError")
       for norm in (1, 2, "inf")},
    "relative": f'type = "RelativeDeviation"\nnorm = inf\nleast = [0.1, 0.2]\n{COMPARABLE}',
    "times": f'type = "AtTimes"\ntimes = [0.1, 0.3]\n{COMPARABLE}',
    "crossing": f'type = "AtCrossing"\nstate = 0\nlevel = 0.2\ndirection = "up"\ncrossings = 2\n{COMPARABLE}',
    "time": 'type = "CrossingTime"\nstate = 0\nlevel = 0.2\nangle = true\n',
    "average": f'type = "TrackingError"\nover = "mean"\n{COMPARABLE}',
}  # fmt: skip


@pytest.mark.parametrize("name", DISTANCES)
def test_every_distance_is_written_in_a_file_as_in_python(name: str) -> None:
    table = tomllib.loads(DISTANCES[name])
    made = part("distance", dict(table))
    in_python = getattr(distances, table.pop("type"))(**table)
    found = make_validation(distance=made).outcome([0.5])
    assert found.distance == make_validation(distance=in_python).outcome([0.5]).distance
    assert np.isfinite(found.distance)
    if "weights" in table and name != "relative":
        assert made.added_units(["rad", "rad/s"]) == ()
        del table["weights"], table["scales"]
        assert getattr(distances, type(made).__name__)(**table).added_units(["rad", "rad/s"]) == ("rad", "rad/s")


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("cart", "cart-auto-seed0.sqlite"),
        ("Kran 起重机", "Kran 起重机-auto-seed0.sqlite"),
        ("../../etc/cart", "..-..-etc-cart-auto-seed0.sqlite"),
        ("a\\b\nc\0", "a-b-c--auto-seed0.sqlite"),
    ],
)
def test_no_name_leaves_the_folder_of_the_stores(name: str, file: str) -> None:
    assert read_settings("pendulum", {}).store_path(name) == Path("runs") / file


@pytest.mark.parametrize(
    ("table", "entry"),
    [
        ("distance", {"type": "FinalState", "components": [5]}),
        ("distance", {"type": "FinalState", "angles": [7]}),
        ("distance", {"type": "AtTimes", "times": [99.0]}),
        ("distance", {"type": "FinalState", "components": ["speed"]}),
        ("distance", {"type": "AtCrossing", "crossings": 0}),
        ("certificate", {"kind": "sampling-discarding", "discard": -1}),
        ("certificate", {"kind": "sampling-discarding"}),
        ("search", {"name": "gp-ucb", "beta": -1.0}),
        ("search", {"name": "cma-es", "population": 0}),
        ("synthesizer", {"type": "ILQR", "Q": [1.0], "R": [1.0], "iterations": 0}),
        ("space", {"goal": [1.0, 0.0]}),
        ("task", {"initial_state": [0.0], "goal": ["goal"], "horizon": 0, "dt": 0.1}),
        ("system", {"type": "Manual", "states": {"time": "s"}, "inputs": {"u": "N"}, "dt": 0.1}),
    ],
    ids=repr,
)
def test_a_wrong_option_is_refused_before_an_execution_is_spent(table: str, entry: dict[str, Any]) -> None:
    counted: list[int] = []

    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        counted.append(1)
        return x + u

    def run() -> None:
        settings = ExperimentSettings.model_validate({**WHOLE, table: entry, "budget": 5, "threshold": 1.0})
        experiment = settings.load()
        chosen = settings.certificate_options
        chosen.kind.require_usable(chosen.confidence, 5)
        validation = Validation(**{**vars(experiment.validation), "system": systems.Simulated(step)})
        settings.campaign(replace(experiment, validation=validation), Store()).run(5)

    with pytest.raises((ValueError, CtxvalError)):
        run()
    assert not counted


def test_a_file_names_the_states_that_are_compared() -> None:
    entry = {"type": "FinalState", "components": ["x"], "angles": ["x"]}
    experiment = ExperimentSettings.model_validate({**WHOLE, "distance": entry}).load()
    assert experiment.validation.distance == distances.FinalState(components=(0,), angles=(0,))


def test_a_wrong_file_that_was_told_is_replaced(invoke: Any) -> None:
    target = changed(
        (
            'type = "Simulated"\nstep = { ref = "experiment_system:step" }',
            'type = "Manual"\nstates = { position = "m", speed = "m/s" }\ninputs = { force = "N" }\ndt = 0.05',
        ),
        ("dt = 0.05               # time step in seconds\n", "\n"),
    )
    assert invoke("ask", target, "--store", "a.sqlite").exit_code == 0
    refused = invoke("tell", "a.sqlite", "0", "--distance", "0.2", "--replace", "typing error")
    assert refused.exit_code == 2
    assert invoke("tell", "a.sqlite", "0", "--distance", "0.1").exit_code == 0
    assert invoke("tell", "a.sqlite", "0", "--distance", "0.2").exit_code == 2
    assert invoke("tell", "a.sqlite", "0", "--distance", "0.2", "--replace", "typing error").exit_code == 0
    store = Store("a.sqlite")
    assert store.trials()[0].distance == 0.2
    assert [change.why for change in store.history()] == ["typing error"]


OUTPUTS = """
outputs = {outputs}
space = {{ goal = [-1.0, 1.0] }}
task = {{ initial_state = [0.2, 0.0], goal = ["goal"], horizon = 12, dt = 0.05 }}
system = {{ type = "angles:rig" }}
model = {{ type = "angles:model" }}
synthesizer = {{ {synthesizer} }}
distance = {{ type = "MaximumDeviation" }}
[states]
angle = "rad"
"""


PID = 'type = "PID", kp = 3.0, ki = 1.0, kd = 1.0'
FILTERED = (
    'type = "OutputFeedback", synthesizer = { type = "LQR", Q = [20.0, 1.0], R = [0.1] }, outputs = [0], '
    "process = 0.01, measurement = 0.002"
)


@pytest.mark.parametrize(
    ("outputs", "synthesizer"), [*more(("[0]", PID), ("[0]", FILTERED)), ('{ ref = "angles:angle" }', PID)]
)
def test_outputs_are_indices_or_a_function_of_a_module(outputs: str, synthesizer: str, invoke: Any) -> None:
    sys.modules.pop("angles", None)
    Path("angles.py").write_text(
        "from rig_outputs import Swing as model, swing_validation\n\nrig = swing_validation().system\n\n\n"
        "def angle(x):\n    return x[..., :1]\n"
    )
    Path("e.toml").write_text(OUTPUTS.format(outputs=outputs, synthesizer=synthesizer))
    findings = invoke("check", "e.toml").stdout
    assert_names(findings, 1, "outputs", 2)
    assert "failed" not in findings
    result = invoke("run", "e.toml", "--budget", "2", "--explore", "--no-report", "--store", "runs/e.sqlite")
    assert result.exit_code == 0, result.stderr
    (first, *_) = Store("runs/e.sqlite").trials()
    assert first.state == "completed"
    assert first.distance > 0


def test_outputs_of_a_named_experiment_are_its_own(invoke: Any) -> None:
    Path("e.toml").write_text('experiment = "pendulum"\noutputs = [0]\n')
    assert "both 'experiment' and 'outputs'" in sentence(invoke("run", "e.toml"))


def test_a_share_of_the_tasks_is_an_option_of_the_certificate_that_the_command_line_overrides() -> None:
    settings = ExperimentSettings.model_validate({"experiment": "pendulum", "certificate": {"share": 0.99}})
    assert settings.certificate_options.left_out == pytest.approx(0.01)
    assert settings.certified_as({"share": 0.9}).certificate_options.kind.share == 0.9
    assert settings.certified_as({"share": 1.0}).certificate_options.left_out == 0
    assert not settings.explores
    for table in ({"share": 0.4}, {"kind": "posterior", "share": 0.99}):
        with pytest.raises((ValueError, CtxvalError)):
            ExperimentSettings.model_validate({"experiment": "pendulum", "certificate": table})
