"""The floors and the walls of docs/architecture.md, held against the imports that the source has."""

from __future__ import annotations

import ast
import functools
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from source_counts import branches, counts_of_tests, numeric_constants, sentence_assertions

SOURCE = Path(__file__).parents[1] / "src" / "ctxval"
ARCHITECTURE = Path(__file__).parents[1] / "docs" / "architecture.md"

NUMBERS_ONLY = ("gp", "searches", "certificates")
CONTROL = {
    f"core.{name}"
    for name in (
        "task",
        "trajectory",
        "model",
        "controller",
        "system",
        "rollout",
        "distance",
        "validation",
        "experiment",
    )
}
SENTENCES = 80
"""Assertions on wording: texts have their snapshots, everything else asserts names, values and codes."""
CONSTANTS = 120  # numbers in capitals that are no settings: tolerances of rounding, formats, layouts; never more
BRANCHES = 20  # conditions on a suite, outputs or a quantile: task spaces, outputs and targets answer in their place
READ_ONLY = ("report",)
EXECUTING = {"execute", "run", "ask", "tell", "outcome", "distances", "plan"}


@functools.cache
def modules() -> dict[str, Path]:
    return {
        ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__"): path
        for path in SOURCE.rglob("*.py")
        if path != SOURCE / "__init__.py"
    }


@functools.cache
def imports_of(path: Path, *, loaded: bool = False) -> set[str]:
    """Return the ctxval modules that a file imports; with ``loaded``, those that are loaded with it."""
    known, tree = modules(), ast.parse(path.read_text())
    found: set[str] = set()
    for node in tree.body if loaded else ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "ctxval":
            inside = node.module.removeprefix("ctxval").lstrip(".")
            for alias in node.names:
                longer = f"{inside}.{alias.name}".lstrip(".")
                found.add(longer if longer in known else inside)
    return found


@functools.cache
def floors() -> dict[str, int]:
    """Read the table of floors: rows ``| number | module, module |``."""
    table: dict[str, int] = {}
    for line in ARCHITECTURE.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if len(cells) == 3 and cells[0].isdigit():
            for name in cells[1].replace("`", "").split(","):
                table[name.strip()] = int(cells[0])
    return table


def room(module: str) -> str:
    """Return the folder at the top of the package, or the file, that a module belongs to."""
    return module.split(".")[0]


MODULES = sorted(modules())
CASES = [name for name in MODULES if name.startswith("paper.cases.")]


def test_the_floor_table_names_every_folder_and_no_other() -> None:
    assert set(floors()) == {room(name) for name in MODULES}


def test_a_folder_imports_only_from_lower_floors() -> None:
    table = floors()
    for module in MODULES:
        for imported in () if module in CASES else imports_of(modules()[module]):
            # The public face hands out what the rooms up to the campaign have.
            own, other = room(module), room(imported) or "campaign"
            assert own == other or table[other] < table[own], f"{module} imports {imported}"


def test_no_file_imports_itself_through_others() -> None:
    graph = {name: imports_of(path, loaded=True) & {*MODULES} - {name} for name, path in modules().items()}
    assert len(tuple(TopologicalSorter(graph).static_order())) >= len(graph)  # a CycleError names a circle


@pytest.mark.parametrize("module", [name for name in MODULES if room(name) in NUMBERS_ONLY])
def test_gaussian_processes_searches_and_certificates_know_numbers_alone(module: str) -> None:
    assert not imports_of(modules()[module]) & CONTROL


@pytest.mark.parametrize("module", [name for name in MODULES if name.startswith(READ_ONLY)])
def test_pictures_and_reports_never_execute(module: str) -> None:
    tree = ast.parse(modules()[module].read_text())
    called = {n.func.attr for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute)}
    assert not called & EXECUTING


@pytest.mark.parametrize("module", CASES)
def test_cases_use_the_public_interface_alone(module: str) -> None:
    public = {"", "errors", "models", "systems", "controllers", "distances", "searches", "paper.cases"}
    for imported in imports_of(modules()[module]):
        assert imported in public or imported.startswith("paper.cases."), f"{module} imports {imported}"


@pytest.mark.slow
def test_importing_ctxval_loads_nothing_heavy_and_the_commands_nothing_slow() -> None:
    heavy = ["matplotlib", "plotly", "scipy.stats", "gymnasium", "mujoco", "sklearn", "torch", "cmaes", "rich", "typer"]
    heavy += ["fmpy", "onnxruntime", "onnx", "casadi", "control", "pyarrow", "h5py", "mcap", "rosbags"]
    code = (
        "import sys, ctxval; from ctxval import cases, controllers, data, distances, models, searches, systems; "
        f"print([m for m in {heavy} if m in sys.modules])"
    )
    slow = ["matplotlib", "scipy.stats", "mujoco", "sklearn", "torch"]
    code += (
        "; import importlib; from ctxval.cli.commands import MODULES; "
        "[importlib.import_module(module) for module in MODULES.values()]; "
        f"print([m for m in {slow} if m in sys.modules])"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.split() == ["[]", "[]"]


def loaded_by(code: str) -> set[str]:
    """Return the modules that a fresh interpreter has loaded after it has run a statement."""
    code += "; import sys; print(*sys.modules, file=sys.stderr)"
    return {*subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stderr.split()}


def test_importing_ctxval_alone_loads_nothing_else() -> None:
    loaded = loaded_by("import ctxval")
    assert not loaded & {"numpy", "scipy", "typer", "rich", "starlette", "pydantic", "jinja2"}
    assert {name for name in loaded if name.startswith("ctxval.")} == {"ctxval._util", "ctxval._util.version"}


def test_the_help_loads_no_command_and_nothing_that_computes() -> None:
    loaded = loaded_by("from ctxval.cli import app; app(['--help'], standalone_mode=False)")
    assert not loaded & {"numpy", "scipy", "starlette", "pydantic", "jinja2"}
    ours = {name.removeprefix("ctxval.") for name in loaded if name.startswith("ctxval.")}
    assert {room(name) for name in ours} == {"_util", "cli"}
    assert {name for name in ours if room(name) == "cli"} == {"cli", "cli.commands"}


def test_tasks_validations_and_stores_are_there_without_the_parts_of_scipy() -> None:
    loaded = loaded_by("from ctxval import Experiment, Store, Task, TaskSpace, Trajectory, Validation")
    assert not loaded & {"scipy.linalg", "scipy.optimize", "scipy.spatial", "scipy.special"}


def test_numbers_that_decide_are_settings() -> None:
    assert sum(len(numeric_constants(path.read_text())) for path in SOURCE.rglob("*.py")) <= CONSTANTS


def test_task_spaces_outputs_and_targets_answer_in_the_place_of_branches() -> None:
    assert sum(branches(list(ast.walk(ast.parse(path.read_text())))) for path in SOURCE.rglob("*.py")) <= BRANCHES
    text = "if self._suite is None and not outputs:\n    x = [y for y in z if d.get('quantile')] or details['quantile']"
    assert branches(list(ast.walk(ast.parse(text)))) == 4


def test_tests_assert_facts_and_hardly_any_sentence() -> None:
    assert counts_of_tests(Path(__file__).parent)["assertions on sentences"] <= SENTENCES


def test_a_sentence_counts_wherever_a_test_compares_it_and_names_do_not() -> None:
    text = """
@pytest.mark.parametrize(("x", "words"), [(1, "it has no end"), (2, "a.csv: x[0]")])
def test(x, words):
    assert words in str(x)
    assert "two words" in f("not an operand of it")
    with pytest.raises(ValueError, match="must be a number"):
        refuses(InputError, "dt", -0.1, "the step of time")
    assert x == "--option of a.toml", "what is wrong with it"
"""
    assert [line for line, _ in sentence_assertions(text)] == [2, 6, 7]


def test_numbers_tuples_and_arrays_are_constants_and_fields_of_settings_are_not() -> None:
    text = """
import numpy as np
A = -1.0
B: float = 2 * 3**2
_C, _D = 1, (0.5, [2])
E = np.linspace(0.0, 1.0, 21)
F = "text"
G = True
H = Settings(3)
class Settings:
    I = 4
"""
    assert numeric_constants(text) == ["A", "B", "_C", "_D", "E"]
