"""Registries: built-in parts, and those of packages that are really installed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ctxval import cases, controllers, distances, models, part, searches, systems
from ctxval._util.registry import Registry, construct, declaration_of
from ctxval.errors import InputError, UnknownNameError
from facts import refuses
from rig_packages import install

REGISTRIES: list[Registry] = [each.REGISTRY for each in (systems, models, controllers, distances, searches, cases)]


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of installed packages, with one that adds parts."""
    monkeypatch.delitem(sys.modules, "their_parts", raising=False)
    monkeypatch.syspath_prepend(str(install(tmp_path / "site")))
    return tmp_path / "site"


@pytest.mark.parametrize("registry", REGISTRIES, ids=lambda registry: registry.kind)
def test_built_in_parts_are_found_and_have_the_method_of_their_kind(registry: Registry) -> None:
    assert registry.built_in
    assert list(registry) == list(registry.built_in)
    assert len(registry) == len(registry.built_in)
    for name in registry.built_in:
        assert name in registry
        assert registry[name] is registry.find(name)
        assert registry.summary(name)
    assert registry.get("nothing") is None
    with refuses(UnknownNameError, "nothing", registry.kind):
        registry.find("nothing")


NOT_BY_NAME = {
    "BaseSearch",
    "Corrected",
    "FeedforwardReLU",
    "IncrementScaling",
    "Refined",
    "SequentialSearch",
}
"""What has the method of its kind and cannot be made from a file: of arrays, of another search, or abstract."""


@pytest.mark.parametrize("package", [systems, models, controllers, distances, searches])
def test_what_a_package_exports_is_found_by_name(package: Any) -> None:
    known = {package.REGISTRY.find(name) for name in package.REGISTRY.built_in}
    for name in package.__all__:
        found = getattr(package, name)
        is_part = isinstance(found, type) and any(callable(vars(b).get(package.REGISTRY.method)) for b in found.__mro__)
        is_protocol = getattr(found, "_is_protocol", False)
        if is_part and not is_protocol and name not in NOT_BY_NAME | {"AffineFeedback", "BoundPolicy"}:
            assert found in known, f"{name} has the method of a {package.REGISTRY.kind} but is not declared by @part"


def test_a_part_is_made_by_name() -> None:
    assert distances.by_name("FinalState", norm=2) == distances.FinalState(2)
    assert isinstance(models.by_name("Linear", A=[[1.0]], B=[[1.0]]), models.Linear)
    assert isinstance(controllers.by_name("LQR", Q=[1.0], R=[1.0]), controllers.LQR)
    assert isinstance(systems.by_name("Simulated", step=lambda x, u: x), systems.Simulated)
    with refuses(UnknownNameError, "FinalState", "nrm"):
        distances.by_name("FinalState", nrm=2)
    with refuses(InputError, "TypeError", "Linear.__init__"):
        models.by_name("Linear", A=[[1.0]])


def test_a_declaration_is_of_one_class_alone() -> None:
    @part("mine", files=("path",))
    class Mine:
        pass

    class Derived(Mine):
        pass

    declared = declaration_of(Mine)
    assert declared is not None
    assert (declared.name, declared.files) == ("mine", ("path",))
    assert declaration_of(Derived) is None
    assert declaration_of([]) is None


def test_a_class_that_takes_any_argument_is_given_it() -> None:
    assert construct("it", lambda **options: options, {"a": 1}) == {"a": 1}


# Parts of installed packages


def test_parts_of_an_installed_package_are_found_by_name(site: Path) -> None:
    assert distances.REGISTRY.installed == ("Gone", "Nothing", "Number", "Speed")
    assert "Speed" in distances.REGISTRY
    assert list(distances.REGISTRY) == [*distances.REGISTRY.built_in, *distances.REGISTRY.installed]
    assert len(distances.REGISTRY) == len(distances.REGISTRY.built_in) + 4
    assert not (site / "imported.txt").exists()  # names alone import nothing
    made: Any = distances.by_name("Speed", weight=2.0)
    assert made.weight == 2.0
    distances.REGISTRY.summary("Speed")
    search = searches.by_name("corners")
    search.reset(2, 0)
    assert set(search.ask(1)[0]) <= {0.0, 1.0}
    assert cases.by_name("swing", 1, size=2).name == "pendulum"


def test_a_built_in_part_is_never_replaced(site: Path) -> None:
    assert distances.by_name("FinalState") == distances.FinalState()
    assert type(searches.by_name("auto")) is searches.Auto
    assert not (site / "imported.txt").exists()


def test_a_package_that_quits_while_it_is_loaded_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entry_points = "[ctxval.distances]\nQuits = their_script:main\n"
    monkeypatch.syspath_prepend(str(install(tmp_path / "site", entry_points=entry_points)))
    (tmp_path / "site" / "their_script.py").write_text("raise SystemExit('this is a program')")
    with refuses(InputError, "their_script:main", "SystemExit"):
        distances.by_name("Quits")


@pytest.mark.parametrize(
    ("name", "facts"),
    [
        (
            "Gone",
            ("no_such_module:Gone",),
        ),
        ("Nothing", ("their_parts:Nothing",)),
        ("Number", ("math:pi", "Number")),
        ("Sped", ("Sped", "Speed")),
    ],
)
def test_what_is_wrong_with_an_entry_point_is_one_sentence(site: Path, name: str, facts: tuple[object, ...]) -> None:
    with refuses((InputError, UnknownNameError), *facts) as refused:
        distances.by_name(name)
    assert "\n" not in str(refused.value)
    assert distances.by_name("FinalState") == distances.FinalState()


def test_a_case_that_makes_no_experiment_is_refused(site: Path) -> None:
    with refuses(InputError, "odd", "int"):
        cases.by_name("odd")
    with refuses(UnknownNameError, "swing", "sise", "size"):
        cases.by_name("swing", sise=2)


def test_two_packages_with_one_name_are_both_named(site: Path) -> None:
    install(site, "other-parts", "[ctxval.distances]\nSpeed = their_parts:Speed\n")
    with refuses(InputError, "Speed"):
        distances.by_name("Speed")


def test_damaged_metadata_breaks_no_built_in_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path)
    (next(tmp_path.glob("*.dist-info")) / "entry_points.txt").write_bytes(b"[ctxval.distances]\n\xff\xfe = x:y\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert distances.by_name("FinalState") == distances.FinalState()
    assert "FinalState" in list(distances.REGISTRY)
    assert "Speed" not in distances.REGISTRY
    with refuses(InputError, "utf-8", 19):
        distances.by_name("Speed")


@pytest.mark.slow
def test_an_installed_package_is_found_by_a_new_process(site: Path) -> None:
    code = (
        "import ctxval, sys; assert 'their_parts' not in sys.modules; "
        "print(ctxval.distances.by_name('Speed').weight, *ctxval.paper.cases.REGISTRY)"
    )
    environment = {"PYTHONPATH": f"{site}:{Path(distances.__file__).parents[2]}", "OMP_NUM_THREADS": "1"}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["1.0", *cases.NAMES, "odd", "swing"]
