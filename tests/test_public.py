"""The public face: complete, sorted, documented."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

import ctxval
from ctxval import errors
from facts import assert_names, refuses

ROOT = Path(__file__).parents[1]
PACKAGES = ["", *(f".{module}" for module in ctxval._MODULES.values())]
COMPLETE = [".paper.cases", ".certificates", ".controllers", ".distances", ".models", ".searches", ".specs", ".systems"]


@pytest.mark.parametrize("package", PACKAGES)
def test_all_is_sorted_and_importable(package: str) -> None:
    module = importlib.import_module(f"ctxval{package}")
    names = list(getattr(module, "__all__", ()))
    # Capitals first, as the linter sorts; `__all__` names nothing that is not there.
    assert names == sorted(names, key=lambda name: (not name.isupper(), not name[0].isupper(), name))
    assert all(hasattr(module, name) for name in names)


@pytest.mark.parametrize("package", ["", *COMPLETE])
def test_all_is_complete(package: str) -> None:
    module = importlib.import_module(f"ctxval{package}")
    public = {
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and (getattr(value, "__module__", None) or "").startswith("ctxval")
    }
    assert public - {"Registry", "construct", "InputError", "UnknownNameError", "Experiment"} <= set(module.__all__)


@pytest.mark.slow
def test_the_part_packages_are_usable_after_importing_ctxval_alone() -> None:
    code = (
        "import sys, ctxval; "
        "light = [name for name, m in ctxval._MODULES.items() if f'ctxval.{m}' not in sys.modules]; "
        "assert set(ctxval._MODULES) <= set(dir(ctxval)); "
        "[getattr(ctxval, name) for name in dir(ctxval)]; "
        "print(ctxval.controllers.LQR.__name__, ctxval.testing.check_search.__name__, *light)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert said[:2] == ["LQR", "check_search"]
    assert {"cases", "controllers", "distances", "systems", "testing"} <= set(said)
    with refuses(AttributeError, "ctxval", "nothing"):
        _ = ctxval.nothing  # type: ignore[attr-defined]


def test_a_type_checker_sees_the_same_names() -> None:
    tree = ast.parse((ROOT / "src" / "ctxval" / "__init__.py").read_text())
    guarded = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    imported = {
        (alias.name, alias.asname): each.module.removeprefix("ctxval").lstrip(".")  # type: ignore[attr-defined]
        for node in guarded
        for each in node.body
        for alias in each.names  # type: ignore[attr-defined]
    }
    modules = {name: f"{module}.{name}".lstrip(".") for (name, asname), module in imported.items() if asname}
    assert modules == ctxval._MODULES
    assert {name: module for (name, asname), module in imported.items() if not asname} == ctxval._LAZY
    assert list(ctxval._LAZY) == ctxval.__all__


def test_the_exceptions_that_public_functions_raise_themselves_are_documented() -> None:
    """What they call may raise more; a constructor documents its own in the docstring of the class."""
    missing = set()
    for package in PACKAGES:
        module = importlib.import_module(f"ctxval{package}")
        for name in getattr(module, "__all__", ()):
            value = inspect.unwrap(getattr(module, name)) if callable(getattr(module, name)) else None
            if not getattr(value, "__module__", "").startswith("ctxval"):
                continue
            if inspect.isfunction(value):
                missing |= {(name, each) for each in raised_in(value) - documented(value.__doc__)}
            for method in vars(value).values() if inspect.isclass(value) else ():
                function = inspect.unwrap(getattr(method, "fget", None) or getattr(method, "__func__", method))
                if inspect.isfunction(function):
                    made = function.__name__ in ("__init__", "__post_init__", "__call__")
                    text = value.__doc__ if made else function.__doc__  # without one, it is that of its contract
                    written = inspect.getsourcefile(function) == inspect.getsourcefile(value)  # not by `dataclass`
                    if written and text and (made or not function.__name__.startswith("_")):
                        missing |= {(function.__qualname__, each) for each in raised_in(function) - documented(text)}
    assert not missing


def raised_in(function: Callable[..., object]) -> set[str]:
    """Return the names of the package's exceptions that the body of a function raises itself."""
    pending: list[ast.AST] = list(ast.parse(textwrap.dedent(inspect.getsource(function))).body[0].body)  # type: ignore[attr-defined]
    found = set()
    while pending:
        node = pending.pop()
        if isinstance(node, ast.FunctionDef | ast.Lambda | ast.ClassDef):
            continue
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and isinstance(node.exc.func, ast.Name):
            found.add(node.exc.func.id)
        pending += ast.iter_child_nodes(node)
    return {name for name in found if hasattr(errors, name)}


def documented(text: str | None) -> set[str]:
    return set(re.findall(r"\b[A-Z]\w*Error\b", (text or "").partition("Raises:")[2]))


@pytest.mark.parametrize("name", list(ctxval.__all__))
def test_everything_public_has_a_docstring(name: str) -> None:
    assert (getattr(ctxval, name).__doc__ or "").strip()


def arrays_without_shapes(name: str) -> list[str]:
    """Return the public functions and methods that take or return arrays, and whose docstrings have no shape."""
    made = getattr(ctxval, name) if name in ctxval.__all__ else None
    places = [(name, made)] if made is not None else [*vars(importlib.import_module(f"ctxval.{name}")).items()]
    without = []
    for label, public in places:
        where = getattr(public, "__module__", None) or ""
        ours = where.startswith(f"ctxval.{name}" if made is None else "ctxval") and not label.startswith("_")
        methods = vars(public).items() if ours and isinstance(public, type) else [(label, public)] if ours else []
        for method, function in methods:
            plain = inspect.unwrap(getattr(function, "__func__", None) or getattr(function, "fget", None) or function)
            if method.startswith("_") or not inspect.isfunction(plain) or not plain.__doc__:
                continue  # contracts document what has no docstring of its own
            texts = plain.__doc__ + (public.__doc__ or "")
            if re.search("Array", str(plain.__annotations__)) and not re.search(r"``[^`]*\(|``[SNd]``|shape", texts):
                without.append(f"{label}.{method}")
    return without


@pytest.mark.parametrize("name", [*ctxval.__all__, *(name for name in ctxval._MODULES if name != "cases")])
def test_docstrings_of_arrays_have_shapes(name: str) -> None:
    assert not arrays_without_shapes(ctxval._MODULES.get(name, name))


def test_every_error_is_drawn_in_the_tree_and_derives_from_one_base() -> None:
    classes = [v for v in vars(errors).values() if isinstance(v, type) and issubclass(v, Exception)]
    for error in classes:
        assert issubclass(error, errors.CtxvalError)
        assert error.__name__ in (errors.__doc__ or "")


def test_unknown_names_come_with_the_nearest_one() -> None:
    error = errors.UnknownNameError.among("search", "gp_ucb", ["random", "gp-ucb"])
    assert_names(str(error), "gp-ucb")
    assert "known: gp-ucb, random" in str(errors.UnknownNameError.among("search", "xyz", ["random", "gp-ucb"]))


def extras() -> dict[str, list[str]]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    found: dict[str, list[str]] = project["optional-dependencies"]
    return found


def test_every_extra_that_is_named_exists() -> None:
    files = [*(ROOT / "src").rglob("*.py"), *ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), ROOT / "pyproject.toml"]
    named = {
        extra.strip()
        for file in files
        for listed in re.findall(r"ctxval\[([a-z0-9, -]+)\]", file.read_text())
        for extra in listed.split(",")
    }
    assert {"mujoco", "fmu", "onnx", "all"} <= named
    assert named <= set(extras())


def test_all_brings_every_extra_and_each_is_used() -> None:
    given = extras()
    brought = {extra for each in given["all"] for extra in re.findall(r"[a-z]+", re.findall(r"\[(.*)\]", each)[0])}
    # Robots are two others, and torch is too large to come along.
    assert brought == set(given) - {"all", "test", "docs", "dev", "robots", "torch"}
    source = "".join(file.read_text() for file in (ROOT / "src").rglob("*.py"))
    imported = {
        "scikit-learn": "sklearn",
        "pyyaml": "yaml",
        "dask": "distributed",
        "python-multipart": "python_multipart",
    }
    for extra in brought:
        names = [re.split(r"[\[><=]", requirement)[0] for requirement in given[extra]]
        for name in names:
            assert re.search(rf"\b{imported.get(name, name)}\b", source), f"{extra} brings {name}, which nothing uses"
