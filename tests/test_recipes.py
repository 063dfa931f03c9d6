"""The recipes of CONTRIBUTING.md, followed to the letter in a copy of the tree."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from ctxval import cases, certificates, controllers, distances, models, searches, systems

ROOT = Path(__file__).parents[1]
GUIDE = (ROOT / "CONTRIBUTING.md").read_text()
LINES = 40
FILES = 2
"""Files of the package that a recipe touches; its test comes on top."""


@dataclass(frozen=True)
class Recipe:
    """One recipe: its blocks of code by file, and how an experiment file names the part."""

    part: str
    module: str
    source: str
    export: str
    line: str
    test: str
    check: str
    toml: dict[str, Any]


def recipes() -> dict[str, Recipe]:
    found = {}
    for part, text in re.findall(r"^### An? (\w+)\n(.*?)(?=^##|\Z)", GUIDE, re.DOTALL | re.MULTILINE):
        blocks = re.findall(r"`((?:src|tests)/[\w/]+\.py)`:\n\n```python\n(.*?)```", text, re.DOTALL)
        (toml,) = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
        found[part] = Recipe(part, *(each for block in blocks for each in block), tomllib.loads(toml))
    return found


RECIPES = recipes()

WHOLE: dict[str, Any] = {
    "space": {"goal": [0.5, 2.0, "m"]},
    "task": {"initial_state": [0.0, 0.0], "goal": ["goal", 0.0], "horizon": 20, "dt": 0.1},
    "system": {"type": "Manual", "states": {"position": "m", "speed": "m/s"}, "inputs": {"force": "N"}, "dt": 0.1},
    "model": {"type": "Linear", "A": [[1.0, 0.1], [0.0, 1.0]], "B": [[0.0], [0.1]]},
    "synthesizer": {"type": "LQR", "Q": [10.0, 1.0], "R": [0.1]},
}
"""An experiment file, of which a recipe replaces a table."""

MY_RIG = """
import numpy as np

def step(x, u):
    return np.stack([x[..., 0] + 0.1 * x[..., 1], x[..., 1] + 0.1 * u[..., 0]], axis=-1)
"""

COPIED = ("src", "benchmarks", "docs", "tests", "pyproject.toml", "README.md", "CONTRIBUTING.md", "CHANGELOG.md")
TESTS = (
    "tests/test_architecture.py",
    "tests/test_public.py",
    "tests/_util/test_registry.py",
    "tests/benchmarks/test_parts_page.py",
    "tests/test_documents.py::test_the_glossary_explains_what_certificates_and_trials_say",
    "tests/test_testing.py::test_every_search_conforms[halving]",
    "tests/core/test_plan.py::test_every_distance_takes_states_by_name",
    *(
        f"tests/certificates/test_base.py::{name}"
        for name in (
            "test_more_confidence_never_gives_a_lower_bound_or_a_smaller_volume[lipschitz]",
            "test_every_kind_has_its_name_on_its_certificate[lipschitz]",
            "test_the_kinds_of_this_package_are_listed_by_name",
            "test_which_kinds_have_a_use_for_an_option_follows_from_their_fields",
        )
    ),
)
"""Tests that hold any part against what all parts must be."""
NOT_OF_PARTS = (
    "not (load or loads or without_the_parts or all_brings or new_process or importing_ctxval"
    " or installed_package or entry_point or makes_no_experiment or damaged_metadata or never_replaced)"
)
"""Leaves out tests of what processes load, and of what is installed."""


def not_needed(folder: str, names: list[str]) -> set[str]:
    """Return what of a folder is left out of the copy: results, pictures, and what `make docs` has written."""
    written = ("results", "_build", "api", "auto_examples")
    return {name for name in names if name in written or name.endswith((".json", ".png", ".sqlite"))}


def run(tree: Path, *command: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a Python module in the copy."""
    environment = {**os.environ, "PYTHONPATH": str(tree / "src"), "OMP_NUM_THREADS": "1", "NO_COLOR": "1"}
    return subprocess.run(
        [sys.executable, "-m", *command], cwd=cwd or tree, env=environment, capture_output=True, text=True
    )


def exported(text: str, line: str) -> str:
    """Return an ``__init__.py`` with an import and its name in ``__all__``."""
    text = text.replace("\nfrom ctxval.", f"\n{line}from ctxval.", 1)
    return text.replace("__all__ = [", f'__all__ = ["{line.split()[-1]}", ', 1)


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the tree in which all recipes were followed, but for `make parts`."""
    copy = tmp_path_factory.mktemp("clone")
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, copy / name, ignore=not_needed)
        else:
            shutil.copy2(source, copy / name)
    for recipe in RECIPES.values():
        for path, content in ((recipe.module, recipe.source), (recipe.test, recipe.check)):
            assert not (copy / path).exists(), f"{path} exists already; the recipe needs another example."
            (copy / path).write_text(content)
        package = copy / recipe.export
        package.write_text(exported(package.read_text(), recipe.line))
    touched = [path for recipe in RECIPES.values() for path in (recipe.module, recipe.export, recipe.test)]
    for command in (("check", "--no-cache", "--fix"), ("format", "--no-cache")):
        done = run(copy, "ruff", *command, *touched)
        assert done.returncode == 0, done.stdout + done.stderr
    return copy


def test_there_is_a_recipe_for_each_of_these() -> None:
    assert set(RECIPES) == {"search", "distance", "synthesizer", "system", "certificate"}


@pytest.mark.parametrize("part", RECIPES)
def test_a_recipe_is_short(part: str) -> None:
    recipe = RECIPES[part]
    written = [line for block in (recipe.source, recipe.line, recipe.check) for line in block.splitlines()]
    assert len(recipe.source.splitlines()) < LINES
    assert len([line for line in written if line.strip()]) < LINES
    assert len({recipe.module, recipe.export}) <= FILES
    assert recipe.module.startswith("src/ctxval/")
    assert Path(recipe.test).parts[1:-1] == Path(recipe.module).parts[2:-1]  # tests mirror the source


@pytest.mark.thorough
def test_what_the_recipes_give_passes_make_check(tree: Path) -> None:
    for recipe in RECIPES.values():  # it is formatted and in order as it is written in the guide
        assert (tree / recipe.module).read_text() == recipe.source
        assert (tree / recipe.test).read_text() == recipe.check
    touched = [path for recipe in RECIPES.values() for path in (recipe.module, recipe.export, recipe.test)]
    if (ROOT / ".mypy_cache").exists():  # what `make check` knows of the files that no recipe touches
        shutil.copytree(ROOT / ".mypy_cache", tree / ".mypy_cache")
    types = ("mypy", *{path for path in touched if path.startswith("src/")})
    for command in (
        ("ruff", "check", "--no-cache", *touched),
        ("ruff", "format", "--no-cache", "--check", *touched),
        types,
    ):
        done = run(tree, *command)
        assert done.returncode == 0, done.stdout + done.stderr


PARTS = "benchmarks/parts_page.py"
CHECK_ALL = """
import json, runpy, sys
from typer.testing import CliRunner
from ctxval.cli import app
from ctxval.cli.config import check

check._cost = lambda validation, plans: iter(())  # what a suggestion costs takes longest to measure
runpy.run_path(sys.argv[1], run_name="__main__")
calls = {part: CliRunner().invoke(app, ["check", f"{part}.toml", "--json"]) for part in sys.argv[2:]}
print(json.dumps({part: [done.exit_code, done.stdout, done.stderr] for part, done in calls.items()}))
"""


def checked(tree: Path, folder: Path) -> dict[str, tuple[int, str, str]]:
    """Follow `make parts`; return exit status, output and errors of `ctxval check` for the file of each recipe."""
    (folder / "my_rig.py").write_text(MY_RIG)
    (folder / "check_all.py").write_text(CHECK_ALL)
    for part, recipe in RECIPES.items():
        content = {**WHOLE, **recipe.toml}
        (folder / f"{part}.toml").write_text("".join(f"{key} = {written(value)}\n" for key, value in content.items()))
    done = run(tree, "check_all", str(tree / PARTS), *RECIPES, cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    found: dict[str, tuple[int, str, str]] = json.loads(done.stdout)
    return found


@pytest.mark.slow
def test_parts_are_found_in_experiment_files_and_in_the_page(tree: Path, tmp_path: Path) -> None:
    """One test, because each process of the suite that ran a part of it would make a copy of the tree."""
    said_of = checked(tree, tmp_path)
    for part, recipe in RECIPES.items():
        status, said, problems = said_of[part]
        assert status == 0, said + problems
        assert json.loads(said)["ok"]
        table = recipe.toml[part]
        name = table.get("type") or table.get("name") or table["kind"]
        assert f"| `{name}` |" in (tree / "docs" / "parts.md").read_text()
        assert f"| `{name}` |" not in (ROOT / "docs" / "parts.md").read_text()
    own = [recipe.test for recipe in RECIPES.values()]
    done = run(tree, "pytest", "-q", "-p", "no:cacheprovider", *own)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.thorough
def test_parts_pass_the_tests_of_all_parts(tree: Path, tmp_path: Path) -> None:
    checked(tree, tmp_path)
    done = run(tree, "pytest", "-q", "-p", "no:cacheprovider", "-k", NOT_OF_PARTS, *TESTS)
    assert done.returncode == 0, done.stdout + done.stderr


def written(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {written(item)}" for key, item in value.items()) + " }"
    return json.dumps(value)


def test_the_groups_of_entry_points_are_those_of_the_registries() -> None:
    named = set(re.findall(r"`(ctxval\.[a-z]+)`", GUIDE.partition("The groups are")[2].partition("The rules")[0]))
    registries = [each.REGISTRY for each in (systems, models, controllers, distances, searches, cases)]
    assert named == {registry.group for registry in (*registries, certificates.KINDS)}
    (text,) = re.findall(r"```toml\n(\[project\.entry-points.*?)```", GUIDE, re.DOTALL)
    assert set(tomllib.loads(text)["project"]["entry-points"]) <= named
