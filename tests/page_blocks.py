"""Writes the Python of the manual's pages to files, so that mypy finds the names in it that do not exist.

``python tests/page_blocks.py`` writes docs/_build/blocks; `make check` does it before it calls mypy.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"
BLOCKS = DOCS / "_build" / "blocks"
WRITTEN = ("contributing.md", "changelog.md", "_build", "api", "auto_examples")
"""Pages and folders that a build of the manual writes."""
PAGES = [
    DOCS.parent / "README.md",
    *sorted(path for path in DOCS.rglob("*.md") if not {*path.relative_to(DOCS).parts} & {*WRITTEN}),
]


def blocks(page: Path) -> list[tuple[str, str]]:
    """Return the languages and contents of a page's blocks."""
    return re.findall(r"^```(\w+)\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def python_files(page: Path) -> dict[str, str]:
    """Return the Python of a page by file: its modules, and ``page.py`` with all other blocks in their order."""
    files: dict[str, str] = {}
    for language, content in blocks(page):
        first, _, rest = content.partition("\n")
        if language == "python" and first.startswith("# file: "):
            files[first.removeprefix("# file: ")] = rest
        elif language == "python":
            files["page.py"] = files.get("page.py", "") + content
    return files


def main() -> None:
    """Write the files."""
    shutil.rmtree(BLOCKS, ignore_errors=True)
    for page in PAGES:
        folder = BLOCKS / re.sub(r"\W", "_", str(page.relative_to(DOCS.parent).with_suffix("")))
        files = python_files(page)
        modules = "|".join(Path(name).stem for name in files)
        for name, content in files.items():
            folder.mkdir(parents=True, exist_ok=True)
            # Several pages have modules of one name, and a page may give a name several values.
            content = re.sub(rf"^from (?=({modules}) import )", "from .", content, flags=re.MULTILINE)
            (folder / name).write_text("# mypy: allow-redefinition\n" + content)


if __name__ == "__main__":
    main()
