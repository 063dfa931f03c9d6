"""Hostile input through the command line: a seeded sample of what `make attack` inflicts, and what its cage notices."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import attack  # noqa: E402
import reliability  # noqa: E402
from hostile import cage  # noqa: E402
from hostile.cage import Case, carry_out  # noqa: E402

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="inputs are tried in forks")

EACH = {"damaged": 45, "crafted": 40, "crafted-own": 20, "coded": 20, "no-store": 20, "told": 25, "imported": 20}
EACH |= {"data": 3, "toml": 6, "systems": 3, "arguments": 6}


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    attack._warm()
    return attack.prepare(tmp_path_factory.mktemp("attack") / "base")


@pytest.mark.slow
@pytest.mark.parametrize("family", attack.FAMILIES)
def test_hostile_input_ends_in_a_sentence(family: str, base: Path) -> None:
    for number in range(EACH[family]):
        # Other inputs than those of the large run.
        outcome = attack.inflict(family, number, 1, base)
        assert not outcome.wrong, f"{family} {number}: {outcome}"


def test_an_input_follows_from_its_number(base: Path, tmp_path: Path) -> None:
    cases = []
    for name in ("one", "two"):
        folder = tmp_path / name
        folder.mkdir()
        case = attack.case_of("told", 3, 0, folder, base)
        cases.append((case.arguments, sorted((f.name, f.read_bytes()) for f in folder.glob("run.*"))))
    assert cases[0] == cases[1]


def ran(monkeypatch: pytest.MonkeyPatch, folder: Path, act: Callable[[], object], **case: Any) -> tuple[str, ...]:
    monkeypatch.setattr("ctxval.cli.main", act)
    (folder / "f").mkdir()
    return carry_out(Case(("--json",), **case), folder / "f").wrong


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "wrong"),
    [
        ("1 / 0", "traceback"),
        ("raise KeyboardInterrupt", "traceback"),
        ("sys.exit(7)", "status"),
        ("os.kill(os.getpid(), 9)", "status"),
        ("print('\\x1b[2J')", "escape"),
        ("print('x' * 10**6)", "flood"),
        ("print('{')", "no JSON"),
        ("sys.exit(2)", "silent"),
        ("os.system('true')", "code"),
        ("open('PWNED', 'w').close()", "code"),
        ("open('../else', 'w').close()", "wrote elsewhere"),
        ("x = bytearray(800 * 2**20); x[::4096] = b'1' * len(x[::4096])", "memory"),
    ],
)
def test_the_cage_notices(code: str, wrong: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert wrong in ran(monkeypatch, tmp_path, lambda: exec(code, {"os": os, "sys": sys}))


@pytest.mark.slow
def test_what_never_ends_is_ended(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cage, "CPU", 1)

    def spin() -> None:
        while True:
            pass

    assert ran(monkeypatch, tmp_path, spin) == ("hang",)


def test_what_ends_well_is_let_be(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert ran(monkeypatch, tmp_path, lambda: print(json.dumps({"a": "ä"}))) == ()


@pytest.mark.slow
def test_the_attack_goes_on_where_it_was(base: Path) -> None:
    none: dict[str, Any] = {}
    first, _ = attack.attack(60, 1, base, workers=1, done=none, apart=10**6, only=["told"])
    assert first["told"]["inputs"] == 8
    again, _ = attack.attack(120, 1, base, workers=1, done=first, apart=10**6, only=["told"])
    assert again["told"]["inputs"] == 17


def test_the_page_is_what_the_stored_counts_give() -> None:
    assert reliability.page() == reliability.PAGE.read_text()


@pytest.mark.slow
def test_an_interpreter_of_its_own_says_the_same(base: Path, tmp_path: Path) -> None:
    (tmp_path / "f").mkdir()
    shutil.copy(base / "a.sqlite", tmp_path / "f" / "a.sqlite")
    case = Case(("status", "a.sqlite", "--json"))
    assert attack._apart(case, tmp_path / "f").status == carry_out(case, tmp_path / "f").status == 0
