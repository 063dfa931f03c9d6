"""The pytest plugin: with ``pytest --ctxval``, a test that asks for the fixture ``nightly`` is a campaign.

Its store is in pytest's cache, so the next run continues it. pytest imports this module always, and the rest of the
package only with the option.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from ctxval.pytest_plugin.nightly import Nightly


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the plugin."""
    group = parser.getgroup("ctxval", "validation of learned models")
    group.addoption("--ctxval", action="store_true", help="Run the tests that execute systems; otherwise skip them.")
    group.addoption(
        "--ctxval-budget",
        type=int,
        metavar="N",
        help="Largest number of executions that each test makes in this run (default: those that it has left).",
    )
    group.addoption(
        "--ctxval-undecided",
        choices=("skip", "xfail", "fail"),
        default="skip",
        help="Outcome of a test that is undecided (default: skip).",
    )
    group.addoption(
        "--ctxval-task",
        metavar="JSON",
        help="Execute only this task, such as '{\"goal\": 1.5}', once for each selected test; nothing is stored.",
    )


@pytest.fixture
def nightly(request: pytest.FixtureRequest) -> Nightly:
    """The campaigns of a test: ``nightly.validate(...)`` and ``nightly.not_worse(...)``."""
    if not request.config.getoption("ctxval"):
        pytest.skip("it executes a system: give --ctxval")
    from ctxval.pytest_plugin.nightly import Nightly  # imported here: most runs of pytest need nothing of it

    return Nightly(request)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print one line for each campaign, from whichever process ran it."""
    reports = [report for reports in terminalreporter.stats.values() for report in reports]
    ended = [report for report in reports if getattr(report, "when", "") == "call"]
    lines = [value for report in ended for name, value in report.user_properties if name == "ctxval"]
    if lines:
        terminalreporter.section("ctxval")
        for line in lines:
            terminalreporter.line(line)
