"""What is given away: the source distribution has the code, its tests and its texts, and no results or pictures."""

from __future__ import annotations

import re
import tarfile
from pathlib import Path, PurePosixPath

import pytest

from ctxval import __version__

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Build the source distribution and return the paths of its files."""
    sdist = pytest.importorskip("hatchling.builders.sdist", reason="hatchling is not installed")
    (built,) = sdist.SdistBuilder(str(ROOT)).build(directory=str(tmp_path_factory.mktemp("dist")))
    with tarfile.open(built) as archive:
        return sorted(name.partition("/")[2] for name in archive.getnames())


def test_the_source_distribution_has_code_tests_examples_and_texts(files: list[str]) -> None:
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "src").rglob("*.py")}
    examples = {path.relative_to(ROOT).as_posix() for path in (ROOT / "examples").glob("*.py")}
    assert modules | examples <= set(files)
    for needed in ("README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "pyproject.toml"):
        assert needed in files
    assert {"tests/conftest.py", "tests/data/test_mapping.py", "docs/theory.md"} <= set(files)


def test_the_source_distribution_has_no_results_and_no_pictures(files: list[str]) -> None:
    assert {PurePosixPath(file).parts[0] for file in files} <= {
        *("src", "tests", "docs", "examples", "pyproject.toml", "PKG-INFO", ".gitignore"),
        *("README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md"),
    }
    assert {PurePosixPath(file).suffix for file in files if file.startswith("docs/")} == {".md"}
    assert not [file for file in files if PurePosixPath(file).suffix in (".jsonl", ".csv", ".png")]


def test_every_text_names_the_version_of_the_source() -> None:
    metadata = pytest.importorskip("hatchling.metadata.core").ProjectMetadata
    manager = pytest.importorskip("hatchling.plugin.manager").PluginManager()
    assert metadata(str(ROOT), manager).version == __version__
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text()
    released = re.findall(r"^## ([\d.]+) \((\d{4}-\d\d-\d\d)\)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert released[0][0] == __version__
    assert f"\ndate-released: {released[0][1]}\n" in (ROOT / "CITATION.cff").read_text()
