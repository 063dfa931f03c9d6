"""Reports: their size, the CPU seconds to write them, and the time until Chromium shows them and their first trial.

The verdicts are those of the posterior bound, so that the seconds are those of the report. Opening is measured in the
browser (from the start of the navigation to the end of its load event), and beside it stands the load of the machine:
with more processes than cores each waits for the others.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from ctxval import Campaign, cases, searches
from ctxval.certificates import CertificateOptions, DistanceBound
from ctxval.report import context_of_campaign, write_page

EXECUTIONS = {"pendulum": 25, "dubins": 100, "arm": 50}
LARGEST = 1_500_000
"""Bytes of a report."""

ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]
_LOAD = "(() => { const e = performance.getEntriesByType('navigation')[0]; return e.loadEventEnd - e.startTime; })()"
_CLICK = (
    "(() => { const t = performance.now(); document.querySelector('button[data-trial]').click(); "
    "return performance.now() - t; })()"
)


def write(name: str, folder: Path) -> tuple[Path, float]:
    """Return the report of a case, and the CPU seconds that it took without the campaign and its verdict."""
    experiment = cases.by_name(name)
    campaign = Campaign(experiment.validation, search=searches.Random(), seed=0, name=name).run(EXECUTIONS[name])
    verdict = campaign.verdict(experiment.threshold or 1.0, certificate=CertificateOptions(DistanceBound()))
    started = time.process_time()
    path = write_page(context_of_campaign(campaign, verdict), folder / f"{name}.html")
    return path, time.process_time() - started


def opened(browser: Any, path: Path) -> tuple[float, float]:
    """Return the seconds until the page is loaded, and until a trial is shown after a click; medians of five."""
    times = []
    for _ in range(5):
        page = browser.new_page()
        page.goto(path.as_uri())
        times.append((page.evaluate(_LOAD) / 1e3, page.evaluate(_CLICK) / 1e3))
        page.close()
    loads, clicks = (sorted(column)[2] for column in zip(*times, strict=True))
    return loads, clicks


def main() -> None:
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        sys.exit("there is no Chromium: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=ARGUMENTS)
        print(f"{'case':10} {'bytes':>10} {'CPU s':>7} {'open s':>7} {'click s':>8} {'load':>6}")
        for name in EXECUTIONS:
            path, seconds = write(name, Path(folder))
            load, click = opened(browser, path)
            size = path.stat().st_size
            print(f"{name:10} {size:>10,} {seconds:>7.2f} {load:>7.2f} {click:>8.3f} {os.getloadavg()[0]:>6.1f}")
            assert size < LARGEST, f"the report of {name} has {size} bytes"
        browser.close()


if __name__ == "__main__":
    main()
