"""The operator's page in a real Chromium: what people at a rig do with it."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from browser import accessibility_findings
from ctxval.campaign.storage.store import Store
from ctxval.core.trial import Trial
from facts import assert_names
from rig_cli import SMALL
from rig_page import ctxval, new_store, record, serving

pytestmark = pytest.mark.slow

WAIT = 60_000
"""Milliseconds to wait for a choice or a verdict."""


def stored(folder: Path) -> list[Trial]:
    store = Store.existing(folder / "a.sqlite")
    try:
        return store.trials()
    finally:
        store.close()


class Operator:
    """A person with a browser of their own.

    Attributes:
        page: the page of playwright.
        errors: what the browser's console said, and the requests to anywhere else.
    """

    def __init__(self, browser: Any, folder: Path, address: str, **options: Any) -> None:
        self.context = browser.new_context(**options)
        self.folder = folder
        self.errors: list[str] = []
        self.page = self.context.new_page()
        self.page.on("console", lambda said: self.errors.append(said.text) if said.type in ("error", "warning") else 0)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: request.url.startswith(address.partition("?")[0]) or self.note(request))
        self.page.goto(address)

    def note(self, request: Any) -> None:
        self.errors.append(f"a request to {request.url}")

    def choose(self) -> int:
        """Choose the next task; return the number of its trial."""
        seen = self.page.locator("section.open").count()
        self.page.get_by_role("button", name=re.compile("Choose")).click()
        return self.opened(seen)

    def draw(self) -> int:
        """Ask for an independent draw; return the number of its trial."""
        self.page.get_by_text("Other ways to choose a task").click()
        self.page.get_by_role("button", name="Draw a task").click()
        return self.opened()

    def opened(self, before: int = 0) -> int:
        """Wait for one more open trial with its files; return its number."""
        last = self.page.locator("section.open").nth(before)
        last.locator(".files").wait_for(timeout=WAIT)
        return int(last.get_attribute("id").removeprefix("trial-"))

    def files(self, number: int) -> Path:
        """Download the task and the controller of a trial."""
        folder = self.folder / f"download-{number}"
        folder.mkdir(exist_ok=True)
        for name in ("task.json", "controller.json"):
            with self.page.expect_download() as download:
                self.trial(number).get_by_role("link", name=name).click()
            assert download.value.suggested_filename == f"trial-{number}-{name}"
            download.value.save_as(folder / name)
        return folder

    def trial(self, number: int) -> Any:
        return self.page.locator(f"#trial-{number}")

    def upload(self, number: int, recording: Path) -> None:
        """Report a recording, and wait for the answer."""
        with self.page.expect_file_chooser() as chooser:
            self.trial(number).get_by_label(f"Recording of trial {number}").click()
        chooser.value.set_files(recording)
        with self.page.expect_navigation():
            self.trial(number).get_by_role("button", name="Check and store the recording").click()

    def message(self) -> str:
        return str(self.page.locator("#message").inner_text())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    new_store(tmp_path)
    return tmp_path


@pytest.fixture
def address(folder: Path) -> Iterator[str]:
    with serving(folder) as server:
        yield server.address


def test_a_whole_campaign_by_hand_of_two_operators(browser: Any, folder: Path, address: str) -> None:
    first = Operator(browser, folder, address, accept_downloads=True)
    second = Operator(browser, folder, address, accept_downloads=True)
    number = first.opened()
    assert number == 0
    assert first.page.locator("button:visible").all_inner_texts() == ["Check and store the recording"]
    recording = record(first.files(number), folder / "run.csv")
    second.opened()
    loses_and_doubles_nothing(first, second, recording)
    for number in (1, 2, 3):
        if number > 1:
            assert (first.choose() if number < 3 else first.draw()) == number
        first.upload(number, record(first.files(number), folder / f"run{number}.csv"))
        assert_names(first.message(), number, "m")
        first.page.locator("#verdict .work").wait_for(state="detached", timeout=WAIT)
    assert first.page.locator(".answer").inner_text() == "validated against 2 m"
    assert "95 % probability" in first.page.locator("#verdict").inner_text()
    first.page.locator("#choosing .done")
    assert first.page.locator("#choosing .problem").count() == 0
    assert first.page.locator("#space svg.chart").count() > 0
    assert first.page.locator("#interval svg.chart").count() == 1
    assert first.page.locator("#worst svg.chart").count() > 0
    assert first.page.locator("#trials tbody tr").count() == 4
    assert accessibility_findings(first.page) == []
    assert first.errors == []
    assert [trial.state for trial in stored(folder)] == ["completed"] * 4


@pytest.mark.thorough
def test_a_falsification_on_a_phone(browser: Any, folder: Path, address: str) -> None:
    for number, distance in enumerate(("0.02", "0.03", "0.04", "0.03", "3")):
        ctxval("tell", "a.sqlite", str(number), "--distance", distance, folder=folder)
        ctxval("ask", "a.sqlite", "--explore", folder=folder)
    phone = Operator(browser, folder, address, viewport={"width": 400, "height": 800}, color_scheme="dark")
    phone.opened()
    phone.page.locator(".answer").get_by_text("falsified").wait_for(timeout=WAIT)
    fits_and_is_accessible(phone)


def loses_and_doubles_nothing(first: Operator, second: Operator, recording: Path) -> None:
    """Check what both see who report one trial, and what one sees who fills a form while the other one chooses."""
    number = 0
    with second.page.expect_file_chooser() as chooser:
        second.trial(number).get_by_label(f"Recording of trial {number}").click()
    chooser.value.set_files(recording)
    first.upload(number, recording)
    assert_names(first.message(), 0)
    told = second.trial(number).get_by_role("alert")
    told.wait_for(timeout=WAIT)
    assert_names(told.inner_text(), "trial")
    with second.page.expect_navigation():
        second.trial(number).get_by_role("button", name="Check and store the recording").click()
    assert_names(second.message(), "stored", "trial", 0)
    assert second.page.locator("section.open").count() == 0

    second.page.get_by_text("Other ways to choose a task").click()
    second.page.get_by_label("goal [m], from 0.5 to 2").fill("1.25")
    assert first.choose() == 1
    second.trial(1).wait_for(timeout=WAIT)
    assert second.page.get_by_label("goal [m], from 0.5 to 2").input_value() == "1.25"
    assert [(trial.state, trial.executed) for trial in stored(first.folder)] == [("completed", True), ("open", False)]


def fits_and_is_accessible(one: Operator) -> None:
    """Check the dark page of a small screen, with everything unfolded."""
    for summary in one.page.locator("summary").all():
        summary.click()
    assert accessibility_findings(one.page) == []
    assert one.page.evaluate("document.documentElement.scrollWidth") <= 400
    small = one.page.locator("button:visible, .files a:visible").evaluate_all(
        "all => all.filter((one) => one.getBoundingClientRect().height < 40).map((one) => one.innerText)"
    )
    assert small == []
    assert one.errors == []


@pytest.mark.thorough
def test_a_wrong_file_is_refused_in_place_and_the_right_one_taken(browser: Any, folder: Path, address: str) -> None:
    one = Operator(browser, folder, address, accept_downloads=True)
    number = one.opened()
    files = one.files(number)
    one.upload(number, record(files, folder / "short.csv", steps=7))
    problem = one.trial(number).get_by_role("alert")
    assert_names(problem.inner_text(), "stored", "trajectory", 21, 20)
    one.page.locator("[data-focus]:focus").wait_for()
    assert one.page.title().startswith("Error: ")
    described = one.trial(number).locator("input[type=file]").get_attribute("aria-describedby")
    assert problem.get_attribute("id") in described
    assert accessibility_findings(one.page) == []
    assert stored(folder)[0].state == "open"
    large = folder / "large.csv"
    with large.open("wb") as file:
        file.truncate(65 * 2**20)
    one.trial(number).locator("input[type=file]").set_input_files(large)
    one.trial(number).get_by_role("button", name="Check and store").click()
    assert_names(one.trial(number).get_by_role("alert").inner_text(), "large", 64, "MiB")
    one.upload(number, record(files, folder / "run.csv"))
    assert_names(one.message(), 0)
    assert [re.findall(r"\d+", said) for said in one.errors] == [["422"]]


@pytest.mark.thorough
def test_a_reload_midway_loses_nothing(browser: Any, tmp_path: Path) -> None:
    new_store(tmp_path, "my_rig:slow")
    with serving(tmp_path) as server:
        one = Operator(browser, tmp_path, server.address)
        one.opened()
        one.page.get_by_text("Other ways to choose a task").click()
        one.page.get_by_role("button", name="Choose another task").click()
        one.page.locator("#choosing progress").wait_for()
        one.page.reload()
        assert one.page.locator("#choosing progress").count() == 1
        one.trial(0).get_by_text("It failed, or there is no recording").click()
        one.trial(0).get_by_label("Reason").fill("the motor cut")
        one.trial(1).wait_for(timeout=WAIT)
        one.trial(0).get_by_label("Reason").input_value()
        assert_names(one.page.locator("#news").inner_text(), 1, "open")
        one.trial(0).get_by_label("Reason").press("Enter")
        one.page.get_by_text("Trial 0 failed: the motor cut.").wait_for()
        one.page.wait_for_url(server.address)
        one.page.reload()
        assert one.message() == ""
        one.page.get_by_text("Other ways to choose a task").click()
        # The page shows the choice as soon as it has begun, and a kill before the answer would leave no page at all.
        with one.page.expect_navigation():
            one.page.get_by_role("button", name="Choose another task").click()
        one.page.locator("#choosing progress").wait_for()
        server.process.kill()
        server.process.wait()
    assert [trial.state for trial in stored(tmp_path)][:2] == ["failed", "open"]
    one.page.get_by_text("There is no connection to the server.").wait_for(timeout=WAIT)
    one.trial(1).get_by_text("It failed, or there is no recording").click()
    one.trial(1).get_by_label("Reason").fill("the power failed")
    # Read before the new server is up, because the page may replace it as soon as it is connected.
    before = one.page.locator("#trial-1 input[name=token]").first.get_attribute("value")
    with serving(tmp_path, port=server.port):
        one.page.locator("#connection", has_not_text="There is no connection").wait_for(state="attached", timeout=WAIT)
        one.page.wait_for_function(
            "before => document.querySelector('#trial-1 input[name=token]').value !== before", arg=before
        )
        one.trial(1).get_by_label("Reason").press("Enter")
        one.page.get_by_text("Trial 1 failed: the power failed.").wait_for()
        assert one.page.locator("#trials tbody tr").count() == len(stored(tmp_path))


@pytest.mark.thorough
def test_hostile_names_are_text(browser: Any, tmp_path: Path) -> None:
    new_store(tmp_path, "my_rig:hostile")
    with serving(tmp_path) as server:
        one = Operator(browser, tmp_path, server.address)
        dialogs: list[str] = []
        one.page.on("dialog", lambda dialog: (dialogs.append(dialog.message), dialog.dismiss()))
        one.opened()
        one.trial(0).get_by_text("It failed, or there is no recording").click()
        one.trial(0).get_by_label("Distance in").fill("0.1")
        one.trial(0).get_by_label("Distance in").press("Enter")
        one.page.locator("#space svg.chart").first.wait_for(timeout=WAIT)
        ctxval("ask", "a.sqlite", folder=tmp_path)
        ctxval("tell", "a.sqlite", "1", "--failed", "<img src=x onerror=alert(2)>\x1b[2J\u202e", folder=tmp_path)
        one.page.locator("#trials tr.failed").wait_for(timeout=WAIT)
        text = one.page.locator("body").inner_text()
        assert "<script>document.title='run'</script><img src=x onerror=alert(1)>" in text
        assert "{{7*7}}" in text
        assert r"<img src=x onerror=alert(2)>\x1b[2J\u202e" in text
        assert one.page.title() != "run"
        assert dialogs == []
        assert one.page.locator("img[src=x]").count() == 0
        assert accessibility_findings(one.page) == []
        assert one.errors == []


@pytest.mark.thorough
def test_everything_works_without_javascript(browser: Any, folder: Path, address: str) -> None:
    one = Operator(browser, folder, address, java_script_enabled=False, accept_downloads=True)
    for number in range(2):
        while one.page.locator(f"#trial-{number} .files").count() == 0:
            one.page.wait_for_timeout(300)
            one.page.goto(address)
        one.upload(number, record(one.files(number), folder / "run.csv"))
        assert_names(one.message(), number)
        one.page.get_by_role("button", name="Choose the next task").click()
    assert [trial.state for trial in stored(folder)][:2] == ["completed"] * 2


@pytest.mark.thorough
def test_the_keyboard_reaches_everything_in_order(browser: Any, folder: Path, address: str) -> None:
    one = Operator(browser, folder, address)
    one.opened()
    reached = []
    for _ in range(12):
        one.page.keyboard.press("Tab")
        reached.append(one.page.evaluate("document.activeElement.innerText || document.activeElement.name"))
    assert reached == [
        *("To the next task", "Trial 0", "Other ways to choose a task"),
        *("task.json", "controller.json", "controller.npz", "model.csv", "all files (zip)"),
        *("file", "If the execution was stopped, or the recording does not match", "Check and store the recording"),
        "It failed, or there is no recording",
    ]
    one.page.keyboard.press("Enter")
    one.page.keyboard.press("Tab")
    one.page.keyboard.type("the cable broke")
    one.page.keyboard.press("Enter")
    one.page.get_by_text("Trial 0 failed: the cable broke.").wait_for()


@pytest.mark.thorough
def test_the_entrance_is_accessible_and_the_token_leaves_the_address(browser: Any, folder: Path) -> None:
    with serving(folder, "--host", "0.0.0.0", "--allow-host", "localhost") as server:
        bare = f"http://127.0.0.1:{server.port}/"
        one = Operator(browser, folder, bare)
        assert accessibility_findings(one.page) == []
        one.page.get_by_label("Token").fill("a wrong token of many letters")
        one.page.get_by_role("button", name="Open the page").click()
        assert_names(one.page.get_by_role("alert").inner_text(), "token", "server")
        token = server.address.partition("?token=")[2]
        one.page.get_by_label("Token").fill(token)
        one.page.get_by_role("button", name="Open the page").click()
        one.opened()
        two = Operator(browser, folder, f"{bare}?token={token}")
        two.opened()
        assert two.page.url == bare


@pytest.mark.thorough
def test_a_run_is_shown_as_it_goes_and_takes_nothing(browser: Any, tmp_path: Path) -> None:
    case = ("linear", "--option", "dim=1", "--seed", "1")
    command = [*SMALL, "run", *case, "--threshold", "90", "--tests", "0", "--live"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    address = next(found[0] for line in process.stdout if (found := re.search(r"http://127\.0\.0\.1:\d+/", line)))
    one = Operator(browser, tmp_path, address, viewport={"width": 400, "height": 800})
    one.page.locator("#trials tbody tr").first.wait_for(timeout=WAIT)
    assert one.page.locator("form, button, input").count() == 0
    refused = one.page.request.post(f"{address}choose", headers={"Origin": address.rstrip("/")})
    assert refused.status == 404
    one.page.locator("#next .done").wait_for(timeout=4 * WAIT)
    assert ".report.html" in one.page.locator("#next").inner_text()
    assert one.page.locator(".answer").inner_text() == "validated against 90"
    assert one.page.evaluate("document.documentElement.scrollWidth") <= 400
    assert accessibility_findings(one.page) == []
    output, _ = process.communicate(timeout=120)
    assert (process.returncode, "VALIDATED" in output) == (0, True), output
