from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ctxval.paper.reproduce import jobs
from ctxval.paper.reproduce.jobs import AUTO, libraries, measured_with, provenance, source_digest
from facts import assert_names


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return a folder that stands for the package, with one module in each folder of a search."""
    for folder in AUTO:
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "one.py").write_text('"""Text."""\n\nGAIN = 1.0\n')
    monkeypatch.setattr(jobs, "_PACKAGE", tmp_path)
    source_digest.cache_clear()
    yield tmp_path
    source_digest.cache_clear()


@pytest.mark.parametrize(
    ("file", "text", "same"),
    [
        ("gp/one.py", '"""Other words."""\n\nGAIN = 1.0  # 1/m\n', True),
        ("gp/one.py", "GAIN = 2.0\n", False),
        ("searches/two.py", "GAIN = 1.0\n", False),
        ("learning/one.py", "GAIN = 2.0\n", True),
    ],
)
def test_a_digest_covers_what_searches_and_processes_compute(package: Path, file: str, text: str, same: bool) -> None:
    before = source_digest("gp", "searches")
    (package / file).write_text(text)
    source_digest.cache_clear()
    assert (source_digest("gp", "searches") == before) == same


def test_results_measured_with_other_sources_are_counted(package: Path) -> None:
    old, unnamed = provenance(), {"distance": 1.0}
    assert_names(measured_with([old, old]), "gp", 2, libraries())
    (package / "gp" / "one.py").write_text("GAIN = 2.0\n")
    source_digest.cache_clear()
    said = measured_with([old, provenance(), unnamed, {**old, "libraries": "numpy 1.0"}])
    assert_names(said, "gp", 1, 2)
    assert said.endswith(f"Libraries: {libraries()}; numpy 1.0.")


def test_libraries_name_numpy_and_the_kernel_of_the_linear_algebra() -> None:
    assert f"numpy {np.__version__}" in libraries()
    assert "scipy" in libraries()
    assert len(libraries().split(", ")) > 3
