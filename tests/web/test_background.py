"""Background processes: jobs, their stages, their failures, and their end."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from typing import Any

import pytest

from ctxval._util.progress import Progress, advance, stage
from ctxval.errors import CampaignError, InputError
from ctxval.web.service import BackgroundProcess

pytestmark = pytest.mark.slow

WAIT = 120
"""Seconds to wait for a process."""


def open_nothing() -> Any:
    return "opened"


def refuse() -> Any:
    raise InputError("there is no such experiment.")


def own_process(served: Any, *arguments: Any) -> tuple[Any, ...]:
    with stage("working", 2):
        advance(1)
    return served, os.getpid(), *arguments


def fail(served: Any) -> None:
    raise KeyboardInterrupt


def die(served: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def wait(served: Any) -> None:
    with stage("waiting"):
        time.sleep(60)


@pytest.fixture
def stages() -> list[Progress]:
    return []


@pytest.fixture
def process(stages: list[Progress]) -> Iterator[BackgroundProcess]:
    made = BackgroundProcess(open_nothing, stages.append)
    yield made
    made.close()


def test_jobs_run_one_after_the_other_in_one_other_process(process: BackgroundProcess, stages: list[Progress]) -> None:
    first, second = (process.submit(own_process, number) for number in (1, 2))
    served, child, number = first.result(WAIT)
    assert (served, number) == ("opened", 1)
    assert child != os.getpid()
    assert second.result(WAIT) == ("opened", child, 2)
    assert [each.stage for each in stages[:2]] == ["loading the experiment", "working"]


def test_a_job_that_fails_is_an_error_and_the_next_one_runs(process: BackgroundProcess) -> None:
    with pytest.raises(CampaignError, match="KeyboardInterrupt"):
        process.submit(fail).result(WAIT)
    assert process.submit(own_process).result(WAIT)[0] == "opened"


def test_a_process_that_dies_is_an_error_and_is_started_again(process: BackgroundProcess) -> None:
    before = process.submit(own_process).result(WAIT)[1]
    with pytest.raises(CampaignError, match=r"ended with the status -9\. Try again\."):
        process.submit(die).result(WAIT)
    assert process.submit(own_process).result(WAIT)[1] != before


def test_a_campaign_that_cannot_be_opened_is_an_error_of_the_job() -> None:
    process = BackgroundProcess(refuse, lambda stage: None)
    with pytest.raises(CampaignError, match=r"there is no such experiment\."):
        process.submit(own_process).result(WAIT)
    process.close()


def test_closing_ends_the_process_at_once(process: BackgroundProcess, stages: list[Progress]) -> None:
    child = process.submit(own_process).result(WAIT)[1]
    waiting = process.submit(wait)
    while "waiting" not in [each.stage for each in stages]:
        time.sleep(0.01)
    process.close()
    assert waiting.exception(10) is not None
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)
