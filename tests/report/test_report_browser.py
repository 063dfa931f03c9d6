"""Reports in a real browser: no error, no connection, accessible, and the trials can be looked at."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rig_pages import hostile_store, pendulum, plane

from browser import accessibility_findings
from ctxval import Campaign, Store, cases, searches
from ctxval.certificates import CertificateOptions, DistanceBound
from ctxval.report import ReportContext, context_of_campaign, context_of_store, write_page
from facts import assert_names
from rig_thorough import more

LARGEST = 1_500_000
"""Bytes of a report."""

FIRST = ".answer .word, .answer .sentence, .picture svg.chart:not(.scale), .first h3 + p"
"""The verdict, its sentence, its picture and what to do next."""

LOWEST = f"Math.max(...[...document.querySelectorAll('{FIRST}')].map((one) => one.getBoundingClientRect().bottom))"

POINT_AT_THE_END = """(chart) => {
  const box = chart.getBoundingClientRect();
  chart.dispatchEvent(new PointerEvent("pointermove", { clientX: box.right - 1, clientY: box.top + 1 }));
}"""

pytestmark = pytest.mark.slow


def case(name: str, executions: int) -> ReportContext:
    experiment = cases.by_name(name)
    campaign = Campaign(experiment.validation, search=searches.Random(), seed=0, name=experiment.name).run(executions)
    options = CertificateOptions(DistanceBound())
    return context_of_campaign(campaign, threshold=experiment.threshold, certificate=options)


def arm() -> ReportContext:
    pytest.importorskip("mujoco")
    return case("arm", 4)


def by_hand(tmp_path: Path) -> ReportContext:
    """Return the context of a store without its experiment, as somebody else gets it."""
    campaign = pendulum(tmp_path / "hand.sqlite", 3)
    opened = campaign.ask({"goal": 0.5})
    campaign.tell(opened, failed="the motor <b>cut</b> out")
    campaign.tell(campaign.ask({"goal": -0.5}), distance=0.1)
    campaign.ask({"goal": 1.0})
    return context_of_store(Store.existing(tmp_path / "hand.sqlite"), 0.5)


REPORTS: dict[str, Callable[[Path], ReportContext]] = {
    "pendulum": lambda folder: case("pendulum", 8),
    "many parameters": lambda folder: context_of_campaign(plane(8), threshold=0.1),
    "arm": lambda folder: arm(),
    "by hand": by_hand,
    "hostile": lambda folder: context_of_store(hostile_store(folder / "hostile.sqlite"), 1.0),
    "plane": lambda folder: context_of_campaign(plane(), threshold=0.1),
}


class Opened:
    """A page with what it printed and what it asked for."""

    def __init__(self, browser: Any, path: Path, **options: Any) -> None:
        self.context = browser.new_context(**options)
        self.page = self.context.new_page()
        self.said: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path.as_uri())

    def unfold(self, which: str = "section > details") -> None:
        """Unfold what is folded: by default the sections, but not what is folded in them."""
        self.page.evaluate(f"document.querySelectorAll('{which}').forEach((one) => {{ one.open = true; }})")

    def require_quiet(self, path: Path) -> None:
        """Check that there was no message, and no request but for the page and its own images."""
        assert self.said == []
        assert [url for url in self.asked if not url.startswith("data:")] == [path.as_uri()]

    def violations(self, unfold: bool) -> list[str]:
        """Return what axe-core finds, also in what is folded if ``unfold`` is True."""
        if unfold:
            self.unfold("details")
        return accessibility_findings(self.page)


@pytest.mark.parametrize("name", ["pendulum", *more("hostile", "by hand", "many parameters", "arm", "plane")])
def test_a_report_is_quiet_small_and_accessible(name: str, browser: Any, tmp_path: Path) -> None:
    path = write_page(REPORTS[name](tmp_path), tmp_path / "report.html")
    assert path.stat().st_size < LARGEST
    phone = {"viewport": {"width": 400, "height": 800}}
    dark = [{"color_scheme": "dark"}] if name == "pendulum" else []
    for options in ({"viewport": {"width": 1280, "height": 800}}, *dark, phone):
        opened = Opened(browser, path, **options)
        assert opened.page.locator(FIRST).count() == 4
        assert opened.page.evaluate(LOWEST) <= (1600 if options is phone else 800)
        opened.unfold()
        if opened.page.locator("button[data-trial]").count():
            opened.page.locator("button[data-trial]").first.click()
            assert opened.page.locator("#trial svg.chart").count() > 0
        if options is not phone:
            assert opened.violations(unfold=name in ("pendulum", "hostile")) == []
        opened.require_quiet(path)
        assert opened.page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        assert opened.page.title().startswith("Validation of")
        opened.context.close()


@pytest.fixture(scope="module")
def swing(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Opened, ReportContext]]:
    context = context_of_campaign(pendulum(), threshold=0.2, certificate=CertificateOptions(DistanceBound()))
    path = write_page(context, tmp_path_factory.mktemp("swing") / "report.html")
    opened = Opened(browser, path)
    opened.unfold()
    yield opened, context
    opened.context.close()


def test_a_click_on_a_trial_shows_its_trajectories(swing: tuple[Opened, ReportContext]) -> None:
    opened, context = swing
    number = context.worst_first[2].number
    opened.page.click(f"button[data-trial='{number}']")
    panel = opened.page.locator("#trial")
    assert panel.locator("h3").inner_text() == f"Trial {number}"
    titles = panel.locator("figcaption").all_inner_texts()
    assert_names(titles, number)
    assert len(titles) == 6  # two states and one input, each with its error
    names = panel.locator("figure").first.locator(".legend li").all_inner_texts()
    assert {"system S", "model M", "corrected model"} <= set(names)
    assert opened.page.locator("tr[aria-current]").count() == 1
    assert opened.page.evaluate("document.activeElement.textContent") == f"Trial {number}"


def test_the_lines_on_the_page_are_those_of_the_store(swing: tuple[Opened, ReportContext]) -> None:
    opened, context = swing
    number = context.worst_first[0].number
    opened.page.click(f"button[data-trial='{number}']")
    chart = opened.page.locator("#trial figure").first
    chart.locator("svg").first.evaluate(POINT_AT_THE_END)
    said = chart.locator(".readout").inner_text().replace("\u2212", "-")
    recording = context.recordings[number]
    end = float(recording.system.states[-1, 0])
    shown = float(said.split("system S ")[1].split(",")[0])
    assert shown == pytest.approx(end, rel=1e-3, abs=1e-3)


def test_a_trial_is_shown_by_the_keyboard(swing: tuple[Opened, ReportContext]) -> None:
    opened, context = swing
    number = context.worst_first[1].number
    opened.page.locator(f"button[data-trial='{number}']").focus()
    opened.page.keyboard.press("Enter")
    assert opened.page.locator("#trial h3").inner_text() == f"Trial {number}"


def test_the_table_is_sorted_by_numbers(swing: tuple[Opened, ReportContext]) -> None:
    opened, context = swing
    header = opened.page.locator("#trials thead th", has_text="distance")
    for direction in ("ascending", "descending"):
        header.locator("button").click()
        assert header.get_attribute("aria-sort") == direction
        rows = opened.page.locator("#trials tbody tr td:nth-child(2)")
        values = [float(one) for one in rows.evaluate_all("cells => cells.map((one) => one.dataset.value)")]
        assert values == sorted(values, reverse=direction == "descending")
        assert len(values) == len(context.trials)


def test_print_unfolds_and_hides_what_cannot_be_clicked(swing: tuple[Opened, ReportContext], tmp_path: Path) -> None:
    opened, _ = swing
    opened.page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert opened.page.locator("details:not([open])").count() == 0
    opened.page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert opened.page.locator("details:not([open])").count() > 0
    opened.page.emulate_media(media="print")
    assert not opened.page.locator(".trial-panel").is_visible()
    opened.page.emulate_media(media="screen")
    assert len(opened.page.pdf(path=tmp_path / "report.pdf")) > 10_000


def test_a_hostile_store_does_not_script_the_page(browser: Any, tmp_path: Path) -> None:
    context = context_of_store(hostile_store(tmp_path / "hostile.sqlite"), 1.0)
    path = write_page(context, tmp_path / "report.html")
    opened = Opened(browser, path)
    opened.unfold()
    opened.page.locator("button[data-trial]").last.click()
    assert opened.page.title().startswith("Validation of </script>")
    assert opened.page.locator("img").count() == 0
    assert opened.page.locator("script").count() == 2
    opened.require_quiet(path)
    opened.context.close()


def test_the_policy_refuses_a_script_that_gets_into_the_page(browser: Any, tmp_path: Path) -> None:
    class Careless:
        title = "Careless"

        def render(self, context: ReportContext) -> Any:
            from markupsafe import Markup

            return Markup("<script>document.title = 'hacked'</script><img src='https://example.org/x.png'>")

    context = replace(context_of_campaign(pendulum(executions=2)), name="guarded")
    path = write_page(context, tmp_path / "report.html", [Careless()])
    opened = Opened(browser, path)
    assert_names(opened.page.title(), "guarded")
    assert any("Content Security Policy" in message for message in opened.said)
    opened.context.close()
