"""Background processes: jobs, their stages, their failures, and their end."""

from __future__ import annotations

import functools
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ctxval._util.progress import Progress, advance, stage
from ctxval.errors import CampaignError, InputError
from ctxval.web.service import BackgroundProcess
from facts import assert_names, refuses

pytestmark = pytest.mark.slow

WAIT = 120
"""Seconds to wait for a process."""


def open_if_it_exists(path: Path) -> Any:
    if not path.exists():
        raise InputError("there is no such experiment.")
    return "opened"


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
def process(stages: list[Progress], tmp_path: Path) -> Iterator[BackgroundProcess]:
    made = BackgroundProcess(functools.partial(open_if_it_exists, tmp_path / "campaign"), stages.append)
    yield made
    made.close()


def test_jobs_run_in_one_other_process_that_survives_their_errors_and_is_started_again_if_it_dies(
    process: BackgroundProcess, stages: list[Progress], tmp_path: Path
) -> None:
    with refuses(CampaignError):
        process.submit(own_process).result(WAIT)
    (tmp_path / "campaign").touch()
    stages.clear()
    first, second = (process.submit(own_process, number) for number in (1, 2))
    served, child, number = first.result(WAIT)
    assert (served, number) == ("opened", 1)
    assert child != os.getpid()
    assert second.result(WAIT) == ("opened", child, 2)
    assert_names([each.stage for each in stages[:2]], "working")

    with refuses(CampaignError, "KeyboardInterrupt"):
        process.submit(fail).result(WAIT)
    assert process.submit(own_process).result(WAIT) == ("opened", child)

    with refuses(CampaignError, -9):
        process.submit(die).result(WAIT)
    again = process.submit(own_process).result(WAIT)[1]
    assert again != child

    waiting = process.submit(wait)
    while "waiting" not in [each.stage for each in stages]:
        time.sleep(0.01)
    process.close()
    assert waiting.exception(10) is not None
    with pytest.raises(ProcessLookupError):
        os.kill(again, 0)
