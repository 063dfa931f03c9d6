"""``ctxval envelope`` and ``ctxval run --envelope``: what they refuse, and an envelope that is not stated."""

from __future__ import annotations

from pathlib import Path

import pytest

from facts import assert_names
from rig_cli import calling, report

pytestmark = pytest.mark.slow


def test_without_a_threshold_there_is_no_envelope(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("aimless_pendulum.py").write_text(
        "from dataclasses import replace\nfrom ctxval import cases\n"
        "experiment = replace(cases.by_name('pendulum'), threshold=None)\n"
    )
    refused = calling("run")("aimless_pendulum:experiment", "--budget", "2", "--store", "p.sqlite", "--envelope")
    assert refused.exit_code == 2
    assert "--envelope needs --threshold" in refused.output
    assert not Path("p.sqlite").exists()
    assert calling("run")("aimless_pendulum:experiment", "--budget", "1", "--store", "p.sqlite").exit_code == 0
    refused = calling("envelope")("p.sqlite")
    assert refused.exit_code == 2
    assert_names(refused.output, "envelope", "--threshold")


@pytest.mark.thorough
def test_one_that_is_not_stated_says_why_and_writes_no_function(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    calling("run")("pendulum", "--budget", "1", "--store", "p.sqlite")
    stated = report(calling("envelope")("p.sqlite", "--threshold", "0.3", "--out", "trusted.py", "--json"))
    assert_names(stated["words"], "envelope", "stated", stated["doubt"])
    assert stated["share"] == 0
    assert stated["file"] is None
    assert not Path("trusted.py").exists()
    shown = calling("envelope")("p.sqlite", "--threshold", "0.3", "--out", "trusted.py").stdout
    assert_names(" ".join(shown.split()), "trusted.py")


@pytest.mark.thorough  # 15 s
def test_what_an_envelope_assumes_is_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    ran = calling("run")("pendulum", "--threshold", "0.3", "--budget", "16", "--seed", "7", "--envelope", "--no-report")
    assert ran.exit_code == 1
