from __future__ import annotations

import importlib
import itertools
import logging
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from ctxval._util.code_digest import module_digest, source_digest
from ctxval._util.describe import describe, first_difference
from rig_thorough import more

BEFORE = '''
import numpy as np

GAIN = 2.0
UNUSED = 1.0

def scaled(x):
    return GAIN * x

def distance(model, system, task):
    """Return how far they are apart."""
    gaps = [scaled(abs(a - b)) for a, b in zip(model, system)]
    return np.sum(gaps) + f"{len(gaps)}".count("3")

class Rig:
    """A rig."""

    limit = GAIN

    def execute(self, controller, task):
        """Move."""
        return scaled(controller + task)

low, high = (lambda x: x - GAIN), (lambda x: x + GAIN)
'''

_numbers = itertools.count()


@pytest.fixture
def written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """Return a function that writes a module, under a new name each time, and imports it."""
    monkeypatch.syspath_prepend(tmp_path)

    def module(source: str) -> ModuleType:
        name = f"written_{next(_numbers)}"
        (tmp_path / f"{name}.py").write_text(source)
        importlib.invalidate_caches()
        return importlib.import_module(name)

    return module


def difference(before: ModuleType, after: ModuleType, name: str) -> str | None:
    one, other = (getattr(module, name) for module in (before, after))
    if isinstance(one, type):
        one, other = one(), other()
    return first_difference(describe(one), describe(other))


@pytest.mark.parametrize("name", ["distance", "Rig", "low", "high"])
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("", ""),
        ('"""Return how far they are apart."""', '"""Return\n    how far\n    they are apart, indented."""'),
        ('"""Move."""', '"""Move the rig."""'),
        ("UNUSED = 1.0", "UNUSED = 3.0"),
        ("def distance(model, system, task):", "def distance(model: list, system: list, task) -> float:  # a comment"),
        ("import numpy as np", "import numpy as np\n\n\n# far below"),
    ],
)
def test_edits_that_compute_the_same_are_no_difference(
    written: Callable[[str], ModuleType], old: str, new: str, name: str
) -> None:
    assert old in BEFORE
    assert difference(written(BEFORE), written(BEFORE.replace(old, new)), name) is None


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("distance", "abs(a - b)", "abs(a + b)"),
        ("distance", "GAIN = 2.0", "GAIN = 3.0"),
        ("distance", "GAIN * x", "GAIN / x"),
        ("distance", "np.sum", "np.max"),
        ("Rig", "controller + task", "controller - task"),
        ("Rig", "limit = GAIN", "limit = -GAIN"),
        ("Rig", "GAIN = 2.0", "GAIN = 3.0"),
        ("low", "x - GAIN", "x * GAIN"),
    ],
)
def test_edits_that_compute_something_else_are_noticed(
    written: Callable[[str], ModuleType], name: str, old: str, new: str
) -> None:
    found = difference(written(BEFORE), written(BEFORE.replace(old, new)), name)
    assert found is not None
    assert "source" in found


def test_definitions_in_other_modules_are_reached(written: Callable[[str], ModuleType]) -> None:
    def using(gain: float) -> list[Any]:
        helper = written(f"GAIN = {gain}\n\ndef scaled(x): return GAIN * x\n").__name__
        sources = (
            f"from {helper} import scaled as s\ndef f(x): return s(x)\n",
            f"from {helper} import GAIN as g\ndef f(x): return g * x\n",
            f"import {helper} as h\ndef f(x): return h.GAIN * x\n",
            f"import {helper} as h\nTABLE = {{'s': h.scaled}}\ndef f(x): return TABLE['s'](x)\n",
        )
        return [source_digest(written(source).f) for source in sources]

    assert all(before != after for before, after in zip(using(2.0), using(3.0), strict=True))
    assert using(2.0)[0] == using(2.0)[0]


def test_values_that_change_are_no_difference(
    written: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch
) -> None:
    source = """
import os, sys
TOKEN, ARGUMENTS = os.environ.get("TOKEN"), sys.argv

class Rig:
    def __init__(self):
        self.password = TOKEN
    def execute(self, controller, task):
        return (TOKEN, ARGUMENTS, os.environ.get("TOKEN"), self.password, (lambda: TOKEN)())
"""
    found = []
    for token in ("first", "second"):
        monkeypatch.setenv("TOKEN", token)
        monkeypatch.setattr(sys, "argv", [token])
        found.append(describe(written(source).Rig()))
    assert found[0] == found[1]
    assert "first" not in str(found)


DEEP = """
import functools
import logging
import threading
from dataclasses import dataclass

LOG = logging.getLogger("rig")
LOCK = threading.Lock()
TABLE = {"a": {"b": {"c": {"d": {"e": 9.0}}}}}
G = 9.0


def f5(x): return 9.25 * x
def f4(x): return f5(x)
def f3(x): return f4(x)
def f2(x): return f3(x)
def f1(x): return f2(x)


@functools.lru_cache
def cached(x): return 9.5 * x


def wrap(function):
    @functools.wraps(function)
    def wrapper(*arguments):
        return function(*arguments)
    return wrapper


class Rig:
    @wrap
    def execute(self, x):
        LOG.info("x")
        with LOCK:
            return G * x


def step(x):
    return f1(x) + cached(x) + TABLE["a"]["b"]["c"]["d"]["e"]
"""


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("step", "9.25", "8.0"),
        ("step", "9.5", "8.0"),
        ("step", '"e": 9.0', '"e": 8.0'),
        ("Rig", "G = 9.0", "G = 8.0"),
    ],
)
def test_what_lies_deep_is_noticed(written: Callable[[str], ModuleType], name: str, old: str, new: str) -> None:
    assert old in DEEP
    assert difference(written(DEEP), written(DEEP.replace(old, new)), name) is not None
    assert difference(written(DEEP), written(DEEP), name) is None


def test_loggers_and_locks_are_tools_and_no_values(written: Callable[[str], ModuleType]) -> None:
    module = written(DEEP)
    before = describe(module.Rig())
    logging.getLogger("another one")
    module.LOG.setLevel(logging.ERROR)
    assert first_difference(before, describe(module.Rig())) is None


def test_functions_that_call_each_other_have_a_digest(written: Callable[[str], ModuleType]) -> None:
    source = "\n".join(f"def f{i}(x): return {' + '.join(f'f{j}(x)' for j in range(30))}" for i in range(30))
    assert source_digest(written(source).f0) is not None


def test_a_function_without_source_is_known_by_its_constants() -> None:
    def made(text: str) -> Any:
        space: dict[str, Any] = {}
        exec(text, space)
        return space["f"]

    one, other = made("def f(x): return 2.0 * x"), made("def f(x): return 3.0 * x")
    assert first_difference(describe(one), describe(one)) is None
    assert first_difference(describe(one), describe(other)) is not None


@pytest.mark.parametrize("version", ["3.12", *more("3.13"), "3.14"])
def test_another_version_of_python_gives_the_same_digest(tmp_path: Path, version: str) -> None:
    python = python_of(version)
    if python is None:
        pytest.skip(f"there is no Python {version} here")
    (tmp_path / "written.py").write_text(BEFORE.replace("import numpy as np", "import math as np"))
    file = sys.modules["ctxval._util.code_digest"].__file__
    code = (
        "import importlib.util, sys; sys.path.insert(0, '.')\n"
        f"spec = importlib.util.spec_from_file_location('ctxval._util.code_digest', {file!r})\n"
        "module = importlib.util.module_from_spec(spec); sys.modules[spec.name] = module\n"
        "spec.loader.exec_module(module); import written\n"
        "print([module.source_digest(x) for x in (written.distance, written.Rig, written.low, written.high)])"
    )
    prints = [
        subprocess.run([one, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=True).stdout
        for one in (sys.executable, python)
    ]
    assert "None" not in prints[0]
    assert prints[0] == prints[1]


def python_of(version: str) -> str | None:
    """Return a Python of this version that runs."""
    beside = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    for found in (shutil.which(f"python{version}"), *map(str, beside)):
        if found is not None and subprocess.run([found, "-c", ""], capture_output=True).returncode == 0:
            return found
    return None


MODULE = """
'''A case.'''
from math import sin

GAIN = 2.0
'''Of the controller.'''

def distance(a: float, b: float) -> float:
    return GAIN * sin(a - b)
"""


@pytest.mark.parametrize(
    ("before", "after", "same"),
    [
        ("A case.", "The case.", True),
        ("Of the controller.", "Dimensionless.", True),
        ("from math import sin", "from numpy import cos, sin", True),
        ("a: float, b: float", "a, b", True),
        ("-> float", "-> object", True),
        ("GAIN * sin(a - b)", "(GAIN  # twice\n        * sin(a - b))", True),
        ("GAIN = 2.0", "GAIN = 3.0", False),
        ("a - b", "b - a", False),
        ("def distance", "def gap", False),
    ],
)
def test_a_module_is_what_it_computes(before: str, after: str, same: bool) -> None:
    assert MODULE.count(before) == 1
    assert (module_digest(MODULE.replace(before, after)) == module_digest(MODULE)) == same
