"""What the page serves: a campaign, and what the page shows of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ctxval.campaign.campaign import Campaign
from ctxval.campaign.interval_search import require_decisive
from ctxval.certificates import CertificateOptions
from ctxval.core.experiment import Experiment
from ctxval.core.space import TaskSpace
from ctxval.core.trial import Trial
from ctxval.errors import InputError


@dataclass(frozen=True, eq=False)
class ServedCampaign:
    """A campaign with what the page needs besides it; only the thread that opened the campaign may use it."""

    experiment: Experiment
    campaign: Campaign
    threshold: float | None
    certificate: CertificateOptions
    budget: int

    def description(self, *, live: bool = False) -> Description:
        """Return what does not change while the campaign is served."""
        store = self.campaign.store.path
        return Description(
            self.experiment.name,
            "a store in memory" if store is None else store.name,
            self.campaign.validation.space,
            self.experiment.units,
            self.threshold,
            self.budget,
            self.threshold is not None and self._decides(),
            live,
        )

    def _decides(self) -> bool:
        try:
            require_decisive(self.certificate)
        except InputError:
            return False
        return True

    def snapshot(self, tasks: dict[int, OpenTask], changes: int = 0) -> Snapshot:
        """Return the trials at present; the last number of the signature counts the changes of their results."""
        trials = self.campaign.trials
        signature = (len(trials), sum(trial.state == "open" for trial in trials), changes)
        executions = sum(trial.executed for trial in trials)
        return Snapshot(signature, trials, tasks, executions, self.campaign.worst)


OpenCampaign = Callable[[], ServedCampaign]
"""A function that opens the campaign in the thread or the process in which it is called."""


@dataclass(frozen=True, eq=False)
class Description:
    """What does not change while a campaign is served.

    Attributes:
        store: the name of the file of the store.
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
    live: bool


@dataclass(frozen=True, eq=False)
class OpenTask:
    """What an operator must know of an open trial before its execution: its start by name, its steps of dt seconds."""

    start: tuple[tuple[str, float], ...]
    horizon: int
    dt: float


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The trials of the store at one moment: the open ones with their tasks by number, and the number of executions."""

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
