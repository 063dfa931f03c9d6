"""What the page serves: a campaign, and what the page shows of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval.campaign.campaign import Campaign
from ctxval.campaign.interval_search import require_decisive
from ctxval.certificates import CertificateOptions
from ctxval.core.experiment import Experiment
from ctxval.core.labels import labels_of
from ctxval.core.trial import Trial
from ctxval.errors import InputError


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The trials of the store at one moment: the open ones with their tasks by number, and the number of executions."""

    signature: tuple[int, int, int]
    trials: tuple[Trial, ...]
    tasks: dict[int, dict[str, Any]]
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


@dataclass(frozen=True, eq=False)
class ServedCampaign:
    """A campaign with what the page needs besides it; only the thread that opened the campaign may use it."""

    experiment: Experiment
    campaign: Campaign
    threshold: float | None
    certificate: CertificateOptions
    budget: int

    @property
    def store_name(self) -> str:
        """The name of the file of the store."""
        path = self.campaign.store.path
        return "a store in memory" if path is None else path.name

    @property
    def decides(self) -> bool:
        """Whether executions can be chosen that decide the verdict."""
        try:
            require_decisive(self.certificate)
        except InputError:
            return False
        return self.threshold is not None

    def snapshot(self, tasks: dict[int, dict[str, Any]] | None = None, changes: int = 0) -> Snapshot:
        """Return the trials that the campaign knows; the last number of the signature counts changes of results."""
        trials = self.campaign.trials
        signature = (len(trials), sum(trial.state == "open" for trial in trials), changes)
        executions = sum(trial.executed for trial in trials)
        return Snapshot(signature, trials, tasks or {}, executions, self.campaign.worst)

    def read(self) -> Snapshot:
        """Read the trials in the store, with what people must know of the open tasks before they execute them."""
        self.campaign.refresh()
        # The trials were read after this process's last change, so their counts are those of the signature.
        tasks = {trial.number: self._task(trial) for trial in self.campaign.trials if trial.state == "open"}
        return self.snapshot(tasks, self.campaign.store.signature()[2])

    def _task(self, trial: Trial) -> dict[str, Any]:
        validation = self.campaign.validation
        task = validation.task(validation.space.parameters(validation.space.point(trial.parameters)))
        start = np.atleast_1d(task.initial_state).tolist()
        states, _ = self.experiment.names(len(start), 0)
        return {"start": list(zip(labels_of(states), start, strict=True)), "horizon": task.horizon, "dt": task.dt}


OpenCampaign = Callable[[], ServedCampaign]
"""A function that opens the campaign in the thread or the process in which it is called."""
