"""``docs/pictures/report.png``: the report of the README's command, in Chromium. Needs playwright."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "report.png"
WIDTH, HEIGHT = 1280, 800
LARGEST = 200_000
"""Bytes; the README is read over slow lines too."""


def photograph(page: Path, picture: Path) -> None:
    """Write the first screen of a report as a PNG, in light colours."""
    program = next(found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name)))
    with sync_playwright() as running:
        browser = running.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
        tab = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
        tab.goto(page.as_uri())
        tab.screenshot(path=picture)
        browser.close()
    with Image.open(picture) as seen:
        seen.convert("RGB").quantize(128).save(picture, optimize=True)
    if picture.stat().st_size > LARGEST:
        raise SystemExit(f"{picture} has {picture.stat().st_size} bytes, more than {LARGEST}.")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "ctxval", "run", "pendulum"], cwd=folder, check=True)
        photograph(next(Path(folder).glob("runs/*.report.html")), PICTURE)
