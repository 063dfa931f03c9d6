"""What ``module:attr`` names: where it is sought, and what it must be before it is called."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from ctxval import Experiment, TaskSpace, distances, models, systems
from ctxval.cli import app
from ctxval.cli.config.parts import argument, part, recorded, task_function
from ctxval.cli.config.references import is_function, reference
from ctxval.cli.config.settings import ExperimentSettings, read_settings
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError
from facts import assert_names, refuses

PARTS = """
import functools
import numpy
from ctxval import distances, models, systems

calls = []

class Rig:
    def __init__(self, speed=1.0):
        calls.append("Rig")
        self.speed = speed
    def execute(self, controller, task):
        return None

class Model:
    def step(self, x, u):
        return x

class Other:
    def __init__(self, **options):
        calls.append("Other")

class Distance:
    def __call__(self, model_trajectory, system_trajectory, task):
        return 0.0

def distance(model_trajectory, system_trajectory, task):
    return 0.0

def scaled(scale):
    calls.append("scaled")
    return functools.partial(weighted, scale)

def weighted(scale, model_trajectory, system_trajectory, task):
    return scale

def step(x, u):
    return x

def steps(x, u, t):
    return x

def make_rig(speed=2.0):
    calls.append("make_rig")
    return Rig(speed)

def make_nothing(speed):
    calls.append("make_nothing")

def task(p):
    calls.append("task")

def experiment(seed, size=1):
    raise ZeroDivisionError("inside")

@functools.lru_cache
def cached(p):
    return None

rig, model, other, near = Rig(), Model(), Other(), Distance()
method = rig.execute
builtin = numpy.array
absolute = numpy.absolute
calls.clear()
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in a folder of its own, on a path and with modules of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name in ("parts_here", "helper_here", "step_here"):
        sys.modules.pop(name, None)
    (tmp_path / "parts_here.py").write_text(PARTS)
    return tmp_path


def calls() -> list[str]:
    return list(importlib.import_module("parts_here").calls)


# What it must be


@pytest.mark.parametrize(
    ("kind", "given", "expected"),
    [
        ("system", {"type": "parts_here:rig"}, "Rig"),
        ("system", {"type": "parts_here:Rig"}, "Rig"),
        ("system", {"type": "parts_here:Rig", "speed": 3.0}, "Rig"),
        ("system", {"type": "parts_here:make_rig"}, "Rig"),
        ("system", {"type": "parts_here:make_rig", "speed": 3.0}, "Rig"),
        ("model", {"type": "parts_here:model"}, "Model"),
        ("model", {"type": "parts_here:Model"}, "Model"),
        ("model", {"type": "parts_here:step"}, "function"),
        ("distance", {"type": "parts_here:distance"}, "function"),
        ("distance", {"type": "parts_here:near"}, "Distance"),
        ("distance", {"type": "parts_here:Distance"}, "Distance"),
        ("distance", {"type": "parts_here:scaled", "scale": 2.0}, "partial"),
    ],
)
def test_a_reference_names_a_part_or_what_makes_it(kind: str, given: Any, expected: str) -> None:
    assert type(part(kind, given)).__name__ == expected


@pytest.mark.parametrize(
    ("kind", "given", "facts"),
    [
        ("system", {"type": "parts_here:Other"}, ("system", "parts_here.Other")),
        ("system", {"type": "parts_here:Other", "args": "id > PWNED", "shell": True}, ()),
        ("system", {"type": "parts_here:other"}, ("parts_here.Other",)),
        ("system", {"type": "parts_here:model"}, ()),
        ("system", {"type": "parts_here:step"}, ("system", "step")),
        ("model", {"type": "parts_here:rig"}, ()),
        ("model", {"type": "parts_here:steps"}, ("model", "steps")),
        ("synthesizer", {"type": "parts_here:Rig"}, ()),
        ("distance", {"type": "parts_here:Rig"}, ("model_trajectory", "system_trajectory")),
        ("distance", {"type": "parts_here:builtin"}, ("builtin",)),
        ("distance", {"type": "parts_here:absolute"}, ("numpy.ufunc",)),
        ("distance", {"type": "parts_here:method"}, ("method",)),
        ("distance", {"type": "parts_here:step"}, ("model_trajectory", "system_trajectory")),
        ("system", {"type": "parts_here:rig", "speed": 1.0}, ()),
        ("system", {"type": "parts_here:method", "speed": 1.0}, ()),
    ],
)
def test_what_is_no_part_is_refused_before_it_is_called(kind: str, given: Any, facts: tuple[object, ...]) -> None:
    with pytest.raises(InputError) as refused:
        part(kind, given)
    assert_names(str(refused.value), *facts)
    assert calls() == []


def test_what_a_function_makes_must_be_a_part_too() -> None:
    with refuses(InputError, "system", "builtins.NoneType"):
        part("system", {"type": "parts_here:make_nothing", "speed": 1.0})


@pytest.mark.parametrize("name", ["subprocess:Popen", "os:getcwd", "builtins:exec", "webbrowser:open", "sys:exit"])
def test_pythons_own_library_has_no_parts(name: str) -> None:
    for kind in ("system", "model", "synthesizer", "distance"):
        for given in ({"type": name}, {"type": name, "args": "id > PWNED", "shell": True}):
            with refuses(InputError):
                part(kind, given)
    with refuses(InputError, name):
        argument({"ref": name})


def test_a_task_by_name_is_a_function_of_the_parameters() -> None:
    space = TaskSpace(goal=(0.0, 1.0))
    for name in ("task", "cached"):
        assert callable(task_function({"ref": f"parts_here:{name}"}, space, None))
    for name, facts in (
        ("step", ()),
        ("Rig", ("parts_here.Rig",)),
        ("builtin", ("builtin",)),
    ):
        with pytest.raises(InputError) as refused:
            task_function({"ref": f"parts_here:{name}"}, space, None)
        assert_names(str(refused.value), *facts)
    assert calls() == []


def test_functions_that_are_arguments_are_looked_at_too() -> None:
    for name in ("step", "model"):
        assert isinstance(
            part("system", {"type": "Simulated", "step": {"ref": f"parts_here:{name}"}}), systems.Simulated
        )
    for name, facts in (
        ("steps", ("step", "system", "Simulated", "x_next")),
        ("absolute", ("step", "system", "Simulated", "x_next")),
        ("builtin", ()),
        ("method", ()),
        ("numpy", ()),
    ):
        with pytest.raises(InputError) as refused:
            part("system", {"type": "Simulated", "step": {"ref": f"parts_here:{name}"}})
        assert_names(str(refused.value), *facts)
    with refuses(InputError, "policy", "synthesizer"):
        part("synthesizer", {"type": "Policy", "policy": {"ref": "parts_here:step"}})


def test_an_experiment_by_name_is_one_or_a_function_of_a_seed() -> None:
    for name, facts in (
        (
            "calls",
            (),
        ),
        ("Rig", ()),
        ("builtin", ()),
        ("steps", ("options",)),
        ("experiment", ("parts_here", "experiment", "ZeroDivisionError")),
    ):
        with pytest.raises(InputError) as refused:
            ExperimentSettings(experiment=f"parts_here:{name}").load()
        assert_names(str(refused.value), *facts)
    with refuses(InputError, "options", "length"):
        ExperimentSettings(experiment="parts_here:experiment", options={"length": 2}).load()
    assert calls() == []


@pytest.mark.parametrize("text", ["parts_here", ":rig", "parts_here:", "", "a b:c", "..:x", "parts_here:none", "1:\0"])
def test_a_text_that_names_nothing_is_a_sentence(text: str) -> None:
    with refuses(InputError, ""):
        reference(text)


def test_functions_are_recognised_below_decorators() -> None:
    assert is_function(distances.FinalState())
    assert is_function(lambda: None)
    assert not is_function(distances.FinalState)
    assert not is_function(print)
    assert not is_function(models.Linear([[1.0]], [[1.0]]).step)


# Where it is sought


def described(folder: Path, value: str, module: str = "step_here") -> Path:
    """Write an experiment file with a module and its data beside it."""
    folder.mkdir(exist_ok=True)
    (folder / f"{module}.py").write_text(f"def step(x, u):\n    return {value}\n")
    Trajectory([0, 0.1, 0.2, 0.3], [[0], [1], [3], [2]], [[1], [0], [1]]).to_csv(folder / "run.csv")
    (folder / "experiment.toml").write_text(
        'name = "x"\nspace = { goal = [0.0, 1.0] }\n'
        'task = { initial_state = [0.0], goal = ["goal"], horizon = 3, dt = 0.1 }\n'
        f'system = {{ type = "Simulated", step = {{ ref = "{module}:step" }} }}\n'
        'model = { type = "Linear", data = { logs = ["run.csv"] } }\n'
        'synthesizer = { type = "LQR", Q = [1.0], R = [1.0] }\n'
    )
    return folder / "experiment.toml"


def load(file: Path) -> Experiment:
    return read_settings(str(file), {}).load()


def step_of(experiment: Experiment) -> float:
    return float(experiment.validation.system.model.function(0.0, 0.0))  # type: ignore[attr-defined]


def test_what_a_file_names_is_sought_beside_it(here: Path) -> None:
    described(here / "one", "1.0")
    (here / "step_here.py").write_text("raise SystemExit('that of the current folder')")
    assert step_of(load(Path("one/experiment.toml"))) == 1.0
    assert sys.path[0] == str(here / "one")


@pytest.mark.usefixtures("without_costs")
def test_the_file_of_init_is_checked_from_another_folder(here: Path) -> None:
    (here / "folder").mkdir()
    sys.modules.pop("experiment_system", None)
    for command in (("init", "folder/experiment.toml"), ("check", "folder/experiment.toml")):
        result = CliRunner().invoke(app, list(command))
        assert result.exit_code == 0, result.stdout + result.stderr
    sys.modules.pop("experiment_system")


@pytest.mark.slow
@pytest.mark.thorough
def test_a_command_from_another_folder_finds_what_the_file_names(here: Path) -> None:
    described(here / "one", "x * 0.5")
    program = [sys.executable, "-m", "ctxval"]
    for arguments in (("run", "one/experiment.toml", "--budget", "1", "--store", "a.sqlite"), ("ask", "../a.sqlite")):
        cwd = here if arguments[0] == "run" else here / "one"
        result = subprocess.run([*program, *arguments], cwd=cwd, capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
    assert (here / "a.sqlite").exists()  # a store is where the command says


def test_modules_of_one_name_from_two_folders_are_not_mixed_up(here: Path) -> None:
    one, two = described(here / "one", "1.0"), described(here / "two", "2.0")
    assert step_of(load(one)) == 1.0
    with refuses(InputError, "step_here", "module"):
        load(two)
    assert step_of(load(one)) == 1.0
    (here / "two" / "step_here.py").unlink()
    with refuses(InputError, "step_here.py"):
        load(two)
    # nor is one found in the folder of the other
    sys.modules.pop("step_here")
    with refuses(InputError, "step_here", "module"):
        load(two)
    three = described(here / "three", "3.0", module="helper_here")
    assert step_of(load(three)) == 3.0


def test_modules_that_modules_import_are_not_mixed_up_either(here: Path) -> None:
    for folder, name in (("one", "step_here"), ("two", "parts_here")):
        (here / folder).mkdir()
        (here / folder / "helper_here.py").write_text(f"value = {folder!r}\n")
        (here / folder / f"{name}.py").write_text("from helper_here import value\n")
    assert reference("step_here:value", here / "one") == "one"
    with refuses(InputError, "helper_here", "parts_here"):
        reference("parts_here:value", here / "two")
    (here / "three").mkdir()
    (here / "three" / "parts_here.py").write_text("value = 'three'\n")
    assert reference("parts_here:value", here / "three") == "three"


def test_a_module_may_extend_the_path_of_modules(here: Path) -> None:
    (here / "lib").mkdir()
    (here / "lib" / "helper_here.py").write_text("value = 7\n")
    (here / "step_here.py").write_text(
        "import sys\nsys.path.insert(0, 'lib')\nfrom helper_here import value\nassert '' not in sys.path\n"
    )
    sys.path.insert(0, "")
    assert reference("step_here:value", here) == 7
    assert {"lib", "", str(here)} <= set(sys.path)


def test_a_module_called_like_one_of_python_is_found_where_it_is_meant(here: Path) -> None:
    (here / "this.py").write_text("value = 3\n")
    assert "this" in sys.stdlib_module_names
    assert reference("this:value", here) == 3
    sys.modules.pop("this")
    (here / "json.py").write_text("value = 3\n")
    with refuses(InputError, "json", "__init__.py"):
        reference("json:value", here)


def test_installed_modules_and_those_of_pythonpath_are_found(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert reference("numpy:ndarray", here / "nowhere").__name__ == "ndarray"
    (here / "helper_here.py").write_text("value = 7\n")
    sys.path.append(str(here))
    (here / "one").mkdir()
    with refuses(InputError, "helper_here", "file"):
        reference("helper_here:value", here / "one")
    monkeypatch.setenv("PYTHONPATH", str(here))
    assert reference("helper_here:value", here / "one") == 7


def test_files_are_sought_in_the_folder_unless_their_path_is_whole(here: Path) -> None:
    described(here / "one", "1.0")
    assert len(recorded({"logs": ["run.csv"]}, here / "one")) == 3
    assert len(recorded({"logs": [str(here / "one" / "run.csv")]}, here)) == 3
    with refuses(InputError, "run.csv"):
        recorded({"logs": ["run.csv"]}, here)
    for kind, table in (
        ("model", {"type": "Onnx", "source": "none.onnx"}),
        ("synthesizer", {"type": "OnnxPolicy", "source": "none.onnx"}),
        ("system", {"type": "MuJoCo", "mjcf": "none.xml"}),
        ("system", {"type": "FMU", "source": "none.fmu", "states": {"x": ""}, "inputs": {"u": ""}}),
    ):
        with pytest.raises(InputError) as refused:
            part(kind, table, here / "one")
        assert "one/none." in str(refused.value) or "pip install" in str(refused.value)


def test_where_to_seek_is_no_setting_of_a_file(here: Path) -> None:
    for key in ("folder", "file"):
        Path("a.toml").write_text(f'experiment = "pendulum"\n{key} = "/"\n')
        with refuses(InputError, "a.toml", "file", key):
            read_settings("a.toml", {})


def test_a_missing_file_says_how_to_begin(here: Path) -> None:
    with refuses(InputError, "a b.toml"):
        read_settings("a b.toml", {})
