"""The floors and the walls of docs/architecture.md, held against the imports that the source has."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "ctxval"
ARCHITECTURE = Path(__file__).parents[1] / "docs" / "architecture.md"

NUMBERS_ONLY = ("kernels", "gp", "hyperposterior", "paths", "surrogate", "acquisition", "searches", "certificates")
CONTROL = ("task", "trajectory", "model", "controller", "system", "rollout", "distance", "validation", "campaign")
READ_ONLY = ("plot", "report")
EXECUTING = {"execute", "run", "ask", "tell", "outcome", "distances", "plan"}


def modules() -> dict[str, Path]:
    return {
        ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__"): path
        for path in SOURCE.rglob("*.py")
        if path != SOURCE / "__init__.py"
    }


def imports_of(path: Path) -> set[str]:
    """Return the ctxval modules that a file imports when it is loaded or later; typing-only imports count too."""
    known = modules()
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "ctxval":
            inside = node.module.removeprefix("ctxval").lstrip(".")
            for alias in node.names:
                longer = f"{inside}.{alias.name}".lstrip(".")
                found.add(longer if longer in known else inside)
    return found


def floors() -> dict[str, int]:
    """Read the table of floors: rows ``| number | module, module |``."""
    table: dict[str, int] = {}
    for line in ARCHITECTURE.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if len(cells) == 3 and cells[0].isdigit():
            for name in cells[1].replace("`", "").split(","):
                table[name.strip()] = int(cells[0])
    return table


def floor_of(module: str) -> int:
    table = floors()
    while module not in table and "." in module:
        module = module.rpartition(".")[0]
    assert module in table, f"{module} has no floor in docs/architecture.md"
    return table[module]


PUBLIC = sorted(name for name in modules() if not name.startswith("cases"))


@pytest.mark.parametrize("module", PUBLIC)
def test_a_module_imports_only_from_lower_floors(module: str) -> None:
    for imported in imports_of(modules()[module]):
        same_room = module.split(".")[0] == imported.split(".")[0]
        assert same_room or floor_of(imported) < floor_of(module), f"{module} imports {imported}"


@pytest.mark.parametrize(
    "module", [name for name in PUBLIC if name.split(".")[0] in ("models", "systems", "controllers")]
)
def test_leaves_do_not_import_other_leaves(module: str) -> None:
    rooms = {"models", "systems", "controllers"} - {module.split(".")[0]}
    assert not {name for name in imports_of(modules()[module]) if name.split(".")[0] in rooms}


@pytest.mark.parametrize("module", [name for name in PUBLIC if name.split(".")[0] in NUMBERS_ONLY])
def test_searches_know_numbers_and_never_control(module: str) -> None:
    assert not imports_of(modules()[module]) & set(CONTROL)


@pytest.mark.parametrize("module", [name for name in PUBLIC if name.split(".")[0] in READ_ONLY])
def test_pictures_and_reports_never_execute(module: str) -> None:
    tree = ast.parse(modules()[module].read_text())
    called = {n.func.attr for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute)}
    assert not called & EXECUTING


@pytest.mark.parametrize("module", sorted(name for name in modules() if name.startswith("cases.")))
def test_cases_use_the_public_interface_alone(module: str) -> None:
    public = {"", "arrays", "errors", "open_loop", "models", "systems", "controllers", "distances", "searches", "cases"}
    for imported in imports_of(modules()[module]):
        assert imported in public or imported.startswith("cases."), f"{module} imports {imported}"


def test_importing_ctxval_loads_nothing_heavy() -> None:
    heavy = ["matplotlib", "plotly", "scipy.stats", "gymnasium", "mujoco", "sklearn", "torch", "cmaes", "rich", "typer"]
    heavy += ["fmpy", "onnxruntime", "onnx", "casadi", "control"]
    code = (
        "import sys, ctxval; from ctxval import cases, controllers, distances, models, searches, systems; "
        f"print([m for m in {heavy} if m in sys.modules])"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "[]"
