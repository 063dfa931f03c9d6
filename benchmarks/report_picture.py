"""``docs/pictures/report.png``: two parts of a real report, in the Chromium of this computer. Needs playwright."""

from __future__ import annotations

import io
import shutil
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from ctxval import Campaign, cases, report

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "report.png"
WIDTH, HEIGHT = 720, 860
LARGEST = 200_000
"""Bytes; the README is read over slow lines too."""


def write_report(folder: Path) -> Path:
    """Write the report of a campaign on the running example, and return its path."""
    experiment = cases.by_name("pendulum", seed=0)
    campaign = Campaign(experiment.validation, seed=0, name="pendulum", store=folder / "pendulum.sqlite")
    campaign.run(budget=12, threshold=0.5)
    return report.write(campaign, folder / "report.html", threshold=0.5)


def photograph(page: Path, picture: Path) -> None:
    """Write the verdict and the distances of a report side by side as a PNG, in light colours."""
    program = next(found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name)))
    with sync_playwright() as running:
        browser = running.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
        tab = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
        tab.goto(page.as_uri())
        parts = [seen_from(tab, "Verdict"), seen_from(tab, "Distance over the tasks")]
        browser.close()
    both = Image.new("RGB", (2 * WIDTH, HEIGHT))
    for k, part in enumerate(parts):
        both.paste(part, (k * WIDTH, 0))
    both.quantize(128).save(picture, optimize=True)
    if picture.stat().st_size > LARGEST:
        raise SystemExit(f"{picture} has {picture.stat().st_size} bytes, more than {LARGEST}.")


def seen_from(tab: Page, title: str) -> Image.Image:
    """Return what is seen if the page is scrolled to a heading."""
    heading = tab.get_by_role("heading", name=title, exact=True)
    heading.evaluate("element => element.scrollIntoView()")
    return Image.open(io.BytesIO(tab.screenshot()))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        photograph(write_report(Path(folder)), PICTURE)
