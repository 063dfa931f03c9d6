"""The campaign of the server itself, in one thread: reading its state, and recording results."""

from __future__ import annotations

import asyncio
import concurrent.futures as cf
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from ctxval._util.texts import reason_of
from ctxval.campaign.telling import ToldResult, tell_result
from ctxval.core.labels import labels_of
from ctxval.core.trial import Trial
from ctxval.errors import CampaignError, CtxvalError, DistanceError
from ctxval.web.served import OpenCampaign, OpenTask, Snapshot

Result = TypeVar("Result")


class Desk:
    """The only user of the server's own campaign: everything runs in its thread, one thing at a time.

    Nothing here takes long. Choosing, judging and drawing are jobs of background processes.
    """

    def __init__(self, open_campaign: OpenCampaign) -> None:
        self._thread = cf.ThreadPoolExecutor(1, "campaign")
        self._closed = False
        try:
            self._served = self._thread.submit(open_campaign).result()
            self.description = self._thread.submit(self._served.description).result()
            self.first = self._thread.submit(self._snapshot).result()
        except BaseException:
            self._thread.shutdown()
            raise

    async def snapshot(self) -> Snapshot:
        """Return the present state of the store."""
        return await self._in_thread(self._snapshot)

    async def signature(self) -> tuple[int, int, int]:
        """Return what identifies the present state of the store."""
        return await self._in_thread(lambda: self._served.campaign.store.signature())

    async def tell(self, number: int, result: ToldResult) -> Trial:
        """Check and store the result of an open trial; return the trial, which may be unmeasured."""
        return await self._in_thread(lambda: self._tell(number, result))

    def close(self) -> None:
        """Close the store after the present work; a second call does nothing."""
        if not self._closed:
            self._closed = True
            self._thread.submit(lambda: self._served.campaign.store.close()).result()
            self._thread.shutdown()

    async def _in_thread(self, function: Callable[[], Result]) -> Result:
        """Call a function in the thread; errors of users' code become errors of ctxval."""

        def guarded() -> Result:
            try:
                return function()
            except CtxvalError:
                raise
            except Exception as error:
                raise CampaignError(f"{reason_of(error)}.") from error

        return await asyncio.get_running_loop().run_in_executor(self._thread, guarded)

    # In the thread of the campaign

    def _snapshot(self) -> Snapshot:
        campaign = self._served.campaign
        campaign.refresh()
        # The trials were read after this process's last change, so their counts are those of the signature.
        tasks = {trial.number: self._task(trial) for trial in campaign.trials if trial.state == "open"}
        return self._served.snapshot(tasks, campaign.store.signature()[2])

    def _task(self, trial: Trial) -> OpenTask:
        validation = self._served.campaign.validation
        task = validation.task(validation.space.parameters(validation.space.point(trial.parameters)))
        start = np.atleast_1d(task.initial_state)
        states, _ = self._served.experiment.names(start.size, 0)
        return OpenTask(tuple(zip(labels_of(states), start.tolist(), strict=True)), task.horizon, task.dt)

    def _tell(self, number: int, result: ToldResult) -> Trial:
        campaign = self._served.campaign
        try:
            return tell_result(campaign, self._served.experiment, number, result)
        except DistanceError:
            trial = campaign.trials[number]
            if trial.state != "unmeasured":
                raise
            return trial


def recording_in(folder: str, name: str) -> Path:
    """Return the path for an uploaded recording: its own name without anything that is not plain."""
    base = name.replace("\\", "/").rpartition("/")[2]
    plain = "".join(letter if letter.isalnum() or letter in "._- " else "_" for letter in base)[-80:].lstrip(".")
    return Path(folder) / (plain or "recording.csv")
