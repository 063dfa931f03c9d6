"""What the documents tell a reader to do works."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from ctxval.config.settings import Settings
from ctxval.testing import check_search

ROOT = Path(__file__).parents[1]


def block(document: str, language: str, holding: str) -> str:
    blocks = re.findall(rf"```{language}\n(.*?)```", (ROOT / document).read_text(), re.DOTALL)
    return next(code for code in blocks if holding in code)


def test_the_python_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(block("README.md", "python", "Campaign"), names)
    campaign = names["campaign"]
    assert campaign.executions == 21  # type: ignore[attr-defined]


def test_the_experiment_file_of_the_readme_is_valid() -> None:
    settings = Settings.model_validate(tomllib.loads(block("README.md", "toml", "experiment")))
    assert settings.search.build().designs == 500  # type: ignore[attr-defined]


def test_the_search_of_the_contributing_guide_conforms() -> None:
    names: dict[str, object] = {}
    exec(block("CONTRIBUTING.md", "python", "class Halving"), names)
    check_search(names["Halving"]())  # type: ignore[operator]


@pytest.mark.parametrize(
    "document",
    ["README.md", "CONTRIBUTING.md", "docs/architecture.md", "docs/theory.md", "docs/search.md", "docs/security.md"],
)
def test_links_lead_somewhere(document: str) -> None:
    path = ROOT / document
    for target in re.findall(r"\]\(([^)#:]+)\)", path.read_text()):
        assert (path.parent / target).exists(), target
