"""The campaign behind the page, and the jobs of the background processes: choosing, writing files, judging, drawing."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from ctxval._util.progress import stage
from ctxval._util.texts import reason_of
from ctxval.campaign.by_hand import parameters_of_trial, write_files
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.choices import OpenTrial
from ctxval.campaign.interval_search import require_decisive
from ctxval.certificates import CertificateOptions, Verdict
from ctxval.certificates import judge as judge_trials
from ctxval.core.experiment import Experiment
from ctxval.core.labels import labels_of
from ctxval.core.trial import Trials
from ctxval.errors import InputError
from ctxval.report import Axis, Chart, ReportContext, paragraph
from ctxval.report.charts import small_charts
from ctxval.report.sections.distances import over_tasks
from ctxval.report.sections.trials import signals_of

Files = dict[str, bytes]  #: the files of a trial by name

Pictures = dict[str, str]  #: pictures by name, as HTML


class Interval(NamedTuple):
    """What is known of the largest distance after some executions; the bound is None if there is none."""

    executions: int
    low: float
    high: float | None


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The trials of the store at one moment, the number of its changes, and the tasks of the open trials by number."""

    trials: Trials
    changes: int = 0
    tasks: dict[int, dict[str, Any]] = field(default_factory=dict)

    @property
    def signature(self) -> tuple[int, int, int]:
        """That of the store, which shows whether it has changed."""
        return len(self.trials), len(self.trials.open), self.changes

    @property
    def ended(self) -> tuple[int, int]:
        """Identifies the trials that have ended, which are those that a verdict is about."""
        return len(self.trials.ended), self.changes


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
        path = self.campaign.store.path
        return "a store in memory" if path is None else path.name

    @property
    def decides(self) -> bool:
        with suppress(InputError):
            require_decisive(self.certificate)
            return self.threshold is not None
        return False

    def read(self) -> Snapshot:
        """Read the trials in the store, with what people must know of the open tasks before they execute them."""
        self.campaign.refresh()
        validation, tasks = self.campaign.validation, dict[int, dict[str, Any]]()
        for trial in self.campaign.trials.open:
            task = validation.task_at(validation.space.parameters(validation.space.point(trial.parameters)))
            start = np.atleast_1d(validation.recorded_task(task).initial_state).tolist()
            labels = labels_of(self.experiment.names(len(start), 0)[0])
            starts = list(zip(labels, start, strict=True))
            tasks[trial.number] = {"start": starts, "horizon": task.horizon, "dt": task.dt}
        # The trials were read after this process's last change, so their counts are those of the signature.
        return Snapshot(self.campaign.trials, self.campaign.store.signature()[2], tasks)


OpenCampaign = Callable[[], ServedCampaign]
"""A function that opens the campaign in the thread or the process in which it is called."""


@dataclass(frozen=True)
class TaskRequest:
    """What the operator asks for: by default, the task that the search chooses."""

    parameters: Mapping[str, Any] | None = None
    #: the number of an earlier trial whose task is executed again, ``because`` something was changed
    again: int | None = None
    because: str | None = None
    draw: bool = False  #: whether the task is an independent draw, for an audit
    trials: int | None = None  #: the number of trials that the operator has seen; None to skip the check
    decides: bool = False  #: whether the task is the one that is expected to decide the verdict soonest

    def require_current(self, trials: int) -> None:
        """Refuse a request if another task was opened since the operator looked."""
        if self.trials is not None and self.trials != trials:
            raise InputError(
                f"another task was opened since this page was loaded, as trial {trials - 1}. If you need one more "
                "task, ask again."
            )


def warm_up(served: ServedCampaign) -> None:
    """Do nothing: the experiment is loaded now, and the first choice need not wait for it."""


def choose(served: ServedCampaign, request: TaskRequest) -> tuple[int, Files] | None:
    """Open the next trial; return its number and its files. None: the verdict is reached or the budget is spent."""
    campaign = served.campaign
    with stage("choosing a task"), campaign.store.sole_writer(60.0):
        campaign.refresh()
        request.require_current(len(campaign.trials))
        if request.decides:
            if served.threshold is None:
                raise InputError(
                    "there is no threshold, so no task decides a verdict: start the server with --threshold."
                )
            opened = campaign.ask_for_verdict(served.threshold, served.budget, certificate=served.certificate)
        else:
            again = request.again
            parameters = request.parameters if again is None else parameters_of_trial(campaign, again)
            opened = campaign.ask(parameters, draw=request.draw, because=request.because)
    return None if opened is None else (opened.number, _files(served, opened))


def files_of(served: ServedCampaign, number: int) -> Files:
    with stage(f"preparing the files of trial {number}"):
        return _files(served, served.campaign.reopen(number))


def _files(served: ServedCampaign, opened: OpenTrial) -> Files:
    with tempfile.TemporaryDirectory() as folder:
        names = write_files(Path(folder) / "trial", served.experiment, opened)
        return {name: (Path(folder) / "trial" / name).read_bytes() for name in names}


def judge(served: ServedCampaign) -> Verdict | None:
    """Return the verdict on the trials that have ended; None if there is no threshold.

    At a rig a trial is nearly always open, which a certificate refuses, so the page says which trials do not count.
    """
    if served.threshold is None:
        return None
    with stage("computing the verdict"):
        served.campaign.refresh()
        ended, options = served.campaign.trials.ended, served.certificate
        known = served.campaign.provenance_for(options, served.threshold, ended)
        return judge_trials(ended, served.threshold, options, known)


def draw(served: ServedCampaign) -> Pictures:
    with stage("drawing the pictures"):
        served.campaign.refresh()
        return pictures_of(served)


def pictures_of(served: ServedCampaign) -> Pictures:
    campaign, tau = served.campaign, served.threshold
    context = ReportContext(
        campaign.name,
        campaign.validation.space,
        campaign.trials,
        campaign.store,
        None if tau is None else Verdict("undecided", tau, ""),
        labels=campaign.validation.labels,
    )

    def of_worst() -> Markup | None:
        worst = context.worst_tasks(1, recorded=True)
        return small_charts(signals_of(context, worst[0].number)) if worst else None

    pictures: Pictures = {}
    for name, drawing in {"tasks": lambda: over_tasks(context), "worst": of_worst}.items():
        try:
            drawn = drawing()
        except Exception as error:  # a picture must not hide the verdict
            drawn = paragraph(f"There is no picture: {reason_of(error)}.")
        if drawn is not None:
            pictures[name] = str(Markup(drawn))
    return pictures


def interval_chart(history: Sequence[Interval], threshold: float | None, units: str) -> Markup:
    """Return how the interval of the largest distance closes, with the executions; empty with fewer than two."""
    known = [each for each in history if np.isfinite(each.low)]
    if len(known) < 2:
        return Markup()
    counts, low = np.array([each.executions for each in known]), np.array([each.low for each in known])
    high = np.array([np.nan if each.high is None else each.high for each in known])
    most = 3 * max(low.max(), threshold or 0.0)
    label = f"largest distance [{units}]" if units else "largest distance"
    near = threshold if threshold is not None and threshold <= 3 * np.nanmax([*low, *high]) else 0.0
    y = Axis.over(label, low, np.minimum(high, most), near, zero=True)
    chart = Chart("The interval of the largest distance", Axis("executions", counts[0], counts[-1], whole=True), y)
    chart.line(counts, np.minimum(high, 1.02 * y.high), "bound", "bound on it")
    chart.line(np.repeat(counts, 2)[1:], np.repeat(low, 2)[:-1], "best", "executed")
    return chart.limit(threshold, "threshold", "threshold").render()
