"""No message, no page and no file that is written advises to weaken a bound so that it validates."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from ctxval.certificates import RESOLUTION, diagnose
from ctxval.cli import app
from ctxval.gp.hyperposterior import EXACT, Hyperparameters, condition

ROOT = Path(__file__).parents[1]

WEAKENS = re.compile(
    r"(larger|coarser|greater|bigger|higher|raise the|increase the) (resolution|volume|threshold)"
    r"|(smaller|lower|less|reduce the|decrease the) confidence"
    r"|state more\b|more than an eighth|--resolution (1\b|0\.[2-9])|--confidence 0\.[0-8]",
    re.IGNORECASE,
)


def strings(path: Path) -> list[str]:
    """Return the texts of a module that may be printed, those in parts joined."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.JoinedStr):
            parts = [part.value for part in node.values if isinstance(part, ast.Constant)]
            found.append("...".join(str(part) for part in parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.append(node.value)
    return found


def test_no_message_weakens_a_bound() -> None:
    for path in sorted((ROOT / "src").rglob("*.py")):
        assert not [text for text in strings(path) if WEAKENS.search(text)], path


@pytest.mark.parametrize(
    "path", [*sorted((ROOT / "docs" / "how-to").glob("*.md")), ROOT / "README.md"], ids=lambda path: path.stem
)
def test_no_page_weakens_a_bound(path: Path) -> None:
    assert not WEAKENS.search(" ".join(path.read_text().split()))


def test_a_bound_that_is_withdrawn_for_gaps_is_not_to_be_weakened() -> None:
    X, y = np.array([[0.1], [0.2], [0.3], [0.4]]), np.array([1.0, 2.0, 1.5, 1.2])
    known = Hyperparameters(2.5, np.array([-1.0]), float(np.log(EXACT)))
    doubt = diagnose([condition(known, X, y)], X).doubt
    assert doubt is not None
    assert not WEAKENS.search(doubt)


def test_the_files_of_init_state_nothing_weaker_than_usual(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(app, ["init"]).exit_code == 0
    for path in tmp_path.iterdir():
        text = path.read_text()
        assert not WEAKENS.search(text)
        assert all(float(value) <= RESOLUTION for value in re.findall(r"resolution = ([0-9.]+)", text))
        assert all(float(value) >= 0.95 for value in re.findall(r"confidence = ([0-9.]+)", text))
        assert "volume" not in text
