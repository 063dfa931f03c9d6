"""The manual is built without a warning, no link in it is broken, and it has every public name."""

from __future__ import annotations

import importlib
import runpy
import shutil
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
from matplotlib import pyplot

import ctxval
from browser import accessibility_findings

ROOT = Path(__file__).parents[1]
GALLERY = sorted((ROOT / "examples" / "gallery").glob("plot_*.py"))
LONG = (
    "plot_1_pendulum",
    "plot_1_pendulum_noisy",
    "plot_2_arm",
    "plot_3_dubins",
    "plot_4_linear",
    "plot_6_aspect1",
    "plot_6_comparison",
    "plot_6_refine",
    "plot_7_replay",
    "plot_8_fit",
)
"""Scripts that only `make docs` and `make thorough` run."""
NEEDS = {"plot_2_arm": "mujoco", "plot_7_replay": "mcap", "plot_8_fit": "onnx"}
BUILT = ("_build", "api", "auto_examples", "__pycache__")


class Page(HTMLParser):
    """The links, the anchors and the loaded files of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.loaded: list[str] = []
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attrs if value}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        elif tag in ("script", "img", "source", "iframe") and "src" in given:
            self.loaded.append(given["src"])
        elif tag == "link" and given.get("rel") in ("stylesheet", "preload", "icon"):
            self.loaded.append(given["href"])


@pytest.mark.slow
@pytest.mark.thorough
def test_the_manual_is_built_without_a_warning_and_is_complete(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """`make docs` runs it on the pages that it has built."""
    built = request.config.getoption("--manual")
    if built is None:
        for module in ("sphinx", "myst_parser", "furo", "sphinx_gallery", "sphinx_copybutton"):
            pytest.importorskip(module)
    manual = Path(built).resolve() if built else build(tmp_path)
    pages = {path: Page(path) for path in sorted(manual.rglob("*.html"))}
    assert not list(broken_links(pages))
    assert not [one for page in pages.values() for one in page.loaded if urlsplit(one).scheme not in ("", "data")]
    assert not list(names_without_description(manual, pages))
    assert not list(pages_left_out(manual))


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.parametrize("page", ["index", "how-to/decide", "reference/api/ctxval.distances", "search"])
def test_a_page_of_the_manual_is_accessible(page: str, browser: Any, request: pytest.FixtureRequest) -> None:
    built = request.config.getoption("--manual")
    if built is None:
        pytest.skip("`make docs` runs it on the pages that it has built")
    opened = browser.new_page()
    opened.goto((Path(built).resolve() / f"{page}.html").as_uri())
    assert accessibility_findings(opened) == []


def build(folder: Path) -> Path:
    """Build the manual from a copy, without running its gallery, and return the folder of the pages."""
    for name in ("docs", "examples"):  # a build writes into them
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns(*BUILT))
    for name in ("src", "tests", "benchmarks", "CONTRIBUTING.md", "CHANGELOG.md", "README.md"):
        (folder / name).symlink_to(ROOT / name)
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-D", "plot_gallery=0", "-b", "html"]
    done = subprocess.run([*command, "docs", "built"], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "built"


def broken_links(pages: dict[Path, Page]) -> Iterator[str]:
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            anchors = pages[target].anchors if target in pages else set()
            lost = bool(parts.fragment) and target.suffix == ".html" and unquote(parts.fragment) not in anchors
            if not parts.scheme and (lost or not target.is_file()):
                yield f"{path.name}: {link}"


def names_without_description(manual: Path, pages: dict[Path, Page]) -> Iterator[str]:
    anchors = set().union(*(page.anchors for page in pages.values()))
    for module in ("ctxval", *(f"ctxval.{module}" for module in ctxval._MODULES.values())):
        assert (manual / "reference" / "api" / f"{module}.html").exists()
        described = {name.rpartition(".")[2] for name in anchors if name.startswith("ctxval.")}
        yield from (name for name in getattr(importlib.import_module(module), "__all__", ()) if name not in described)


def pages_left_out(manual: Path) -> Iterator[Path]:
    for path in (ROOT / "docs").rglob("*.md"):
        page = (manual / path.relative_to(ROOT / "docs")).with_suffix(".html")
        if not set(path.relative_to(ROOT).parts) & set(BUILT) and not page.exists():
            yield path


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:FigureCanvasAgg:UserWarning")
@pytest.mark.parametrize(
    "script",
    [
        pytest.param(script, id=script.stem, marks=pytest.mark.thorough if script.stem in LONG else ())
        for script in GALLERY
    ],
)
def test_a_script_of_the_gallery_runs(
    script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The whole searches are run by `make docs`."""
    pytest.importorskip(NEEDS.get(script.stem, "ctxval"))
    monkeypatch.chdir(tmp_path)
    pyplot.switch_backend("agg")
    try:
        runpy.run_path(str(script), run_name="__main__")
    finally:
        pyplot.close("all")
    assert capsys.readouterr().out
    assert not list(tmp_path.iterdir())


def test_the_gallery_has_every_case() -> None:
    from ctxval import cases

    text = "".join(script.read_text() for script in GALLERY)
    assert all(f'by_name("{name}"' in text for name in cases.NAMES)


def test_the_picture_of_the_readme_is_small() -> None:
    assert "docs/pictures/robot.png" in (ROOT / "README.md").read_text()
    for name in ("report.png", "robot.png"):
        assert (ROOT / "docs" / "pictures" / name).stat().st_size < 200_000
