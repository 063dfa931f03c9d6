"""The campaign of the server itself, in one thread: reading its state, and recording results."""

from __future__ import annotations

import asyncio
import concurrent.futures as cf
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from ctxval._util.texts import reason_of
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.interval_search import require_decisive
from ctxval.campaign.telling import ToldResult, tell_result
from ctxval.certificates import CertificateOptions
from ctxval.core.labels import labels_of
from ctxval.core.space import TaskSpace
from ctxval.core.task import Task
from ctxval.core.trial import Trial
from ctxval.errors import CampaignError, CtxvalError, DistanceError, InputError
from ctxval.web.served import OpenCampaign, ServedCampaign

Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class Description:
    """What does not change while a campaign is served.

    Attributes:
        name: the name of the experiment.
        store: the name of the file of the store.
        space: the task space.
        units: the units of the distance.
        threshold: tau; None if there is none.
        budget: the number of executions that are planned.
        decides: whether executions can be chosen that decide the verdict.
        live: whether a command executes the tasks, so that the page only shows them.
    """

    name: str
    store: str
    space: TaskSpace
    units: str
    threshold: float | None
    budget: int
    decides: bool
    live: bool = False


@dataclass(frozen=True, eq=False)
class OpenTask:
    """What an operator must know of an open trial before its execution.

    Attributes:
        start: the initial state, with names and units.
        horizon: the number of steps.
        dt: the length of a step, seconds.
    """

    start: tuple[tuple[str, float], ...]
    horizon: int
    dt: float


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The trials of the store at one moment.

    Attributes:
        signature: identifies the state of the store.
        trials: all trials in the order of asking.
        tasks: the tasks of the open trials, by the number of the trial.
        executions: the number of executions that have ended.
        worst: the trial with the largest distance; None if no distance is known.
    """

    signature: tuple[int, int, int]
    trials: tuple[Trial, ...]
    tasks: dict[int, OpenTask]
    executions: int
    worst: Trial | None

    @property
    def ended(self) -> tuple[int, int]:
        """Identifies the trials that have ended, which are those that a verdict is about."""
        total, waiting, changes = self.signature
        return total - waiting, changes

    @property
    def waiting(self) -> list[Trial]:
        """The open trials, which people execute, or which a program is executing."""
        return [trial for trial in self.trials if trial.state == "open"]


def description_of(served: ServedCampaign, *, live: bool = False) -> Description:
    """Return what does not change while a campaign is served."""
    campaign, experiment = served.campaign, served.experiment
    path = campaign.store.path
    return Description(
        experiment.name,
        "a store in memory" if path is None else path.name,
        campaign.validation.space,
        experiment.units,
        served.threshold,
        served.budget,
        served.threshold is not None and _can_decide(served.certificate),
        live,
    )


def _can_decide(certificate: CertificateOptions) -> bool:
    try:
        require_decisive(certificate)
    except InputError:
        return False
    return True


def snapshot_of(campaign: Campaign, tasks: Mapping[int, OpenTask], changes: int = 0) -> Snapshot:
    """Return the trials of a campaign at present."""
    trials = campaign.trials
    signature = (len(trials), sum(trial.state == "open" for trial in trials), changes)
    return Snapshot(signature, trials, dict(tasks), sum(trial.executed for trial in trials), campaign.worst)


class Desk:
    """The only user of the server's own campaign: everything runs in its thread, one thing at a time.

    Nothing here takes long. Choosing, judging and drawing are jobs of background processes.

    Args:
        open_campaign: opens the campaign; it is called in the thread.

    Raises:
        CtxvalError: if the campaign cannot be opened.
    """

    def __init__(self, open_campaign: OpenCampaign) -> None:
        self._thread = cf.ThreadPoolExecutor(1, "campaign")
        self._closed = False
        try:
            self._served: ServedCampaign = self._thread.submit(open_campaign).result()
            self.description = self._thread.submit(description_of, self._served).result()
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

    async def tell(self, number: int, told: ToldResult) -> Trial:
        """Check and store the result of an open trial; return the trial, which may be unmeasured."""
        return await self._in_thread(lambda: self._tell(number, told))

    def close(self) -> None:
        """Close the store after the present work; a second call does nothing."""
        if not self._closed:
            self._closed = True
            self._thread.submit(lambda: self._served.campaign.store.close()).result()
            self._thread.shutdown()

    async def _in_thread(self, function: Callable[[], Result]) -> Result:
        return await asyncio.get_running_loop().run_in_executor(self._thread, _guarded(function))

    # In the thread of the campaign

    def _snapshot(self) -> Snapshot:
        campaign = self._served.campaign
        campaign.refresh()
        # The trials were read after this process's last change, so their counts are those of the signature.
        tasks = {trial.number: self._task(trial) for trial in campaign.trials if trial.state == "open"}
        return snapshot_of(campaign, tasks, campaign.store.signature()[2])

    def _task(self, trial: Trial) -> OpenTask:
        validation = self._served.campaign.validation
        task: Task = validation.task(validation.space.parameters(validation.space.point(trial.parameters)))
        start = np.atleast_1d(task.initial_state)
        states, _ = self._served.experiment.names(start.size, 0)
        return OpenTask(tuple(zip(labels_of(states), start.tolist(), strict=True)), task.horizon, task.dt)

    def _tell(self, number: int, told: ToldResult) -> Trial:
        campaign = self._served.campaign
        try:
            return tell_result(campaign, self._served.experiment, number, told)
        except DistanceError:
            ended = campaign.trials[number]
            if ended.state != "unmeasured":
                raise
            return ended


def _guarded(function: Callable[[], Result]) -> Callable[[], Result]:
    """Return a function that raises errors of ctxval alone, also if users' code raises anything else."""

    def guarded() -> Result:
        try:
            return function()
        except CtxvalError:
            raise
        except Exception as error:
            raise CampaignError(f"{reason_of(error)}.") from error

    return guarded


def recording_in(folder: str, name: str) -> Path:
    """Return the path for an uploaded recording: its own name without anything that is not plain."""
    base = name.replace("\\", "/").rpartition("/")[2]
    plain = "".join(letter if letter.isalnum() or letter in "._- " else "_" for letter in base)[-80:].lstrip(".")
    return Path(folder) / (plain or "recording.csv")
