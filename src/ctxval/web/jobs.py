"""The jobs of the background processes: choosing a task, writing its files, judging, and drawing."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctxval._util.texts import reason_of
from ctxval.campaign.by_hand import write_files
from ctxval.campaign.choices import OpenTrial
from ctxval.campaign.telling import parameters_of_trial
from ctxval.certificates import Certificate, Verdict
from ctxval.certificates import judge as judge_trials
from ctxval.certificates.bounds import with_error
from ctxval.core.labels import labels_of
from ctxval.errors import InputError
from ctxval.plot import overview, worst_trajectories
from ctxval.web.background import Stage, TellStage
from ctxval.web.served import ServedCampaign

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WAIT = 60.0
"""Seconds to wait for another process that chooses a task or runs the store."""

Files = dict[str, bytes]
"""The files of a trial by name."""


@dataclass(frozen=True)
class TaskRequest:
    """What the operator asks for: by default, the task that the search chooses.

    Attributes:
        parameters: the parameters of a task that the operator chooses.
        again: the number of an earlier trial whose task is executed again.
        because: what was changed since that trial.
        draw: whether the task is an independent draw, for an audit.
        trials: the number of trials that the operator has seen; None to skip the check.
        decides: whether the task is the one that is expected to decide the verdict soonest.
    """

    parameters: Mapping[str, Any] | None = None
    again: int | None = None
    because: str | None = None
    draw: bool = False
    trials: int | None = None
    decides: bool = False


@dataclass(frozen=True, eq=False)
class Judgement:
    """A verdict and its certificate as texts.

    Attributes:
        answer: validated, falsified, undecided; empty if there is no threshold.
        reason: why, in one sentence.
        rests_on: what a validation rests on, in one sentence; None if there is none.
        bound: the upper bound with its confidence; None if there is none.
        withdrawn: why the bound is withdrawn; None if it is not.
        statement: what the certificate states; None if there is none.
        assumptions: what the certificate assumes.
    """

    answer: str
    reason: str
    rests_on: str | None = None
    bound: str | None = None
    withdrawn: str | None = None
    statement: str | None = None
    assumptions: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures of the campaign as SVG.

    Attributes:
        images: the pictures by name.
        missing: why a picture is missing, by name.
    """

    images: dict[str, bytes] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)


def warm_up(served: ServedCampaign, tell: TellStage) -> None:
    """Do nothing: the experiment is loaded now, and the first choice need not wait for it."""


def choose(served: ServedCampaign, tell: TellStage, request: TaskRequest) -> tuple[int, Files] | None:
    """Open the next trial; return its number and its files. None: the verdict is reached or the budget is spent."""
    tell(Stage("choosing a task"))
    opened = _ask(served, request)
    return None if opened is None else (opened.number, _files(served, opened))


def _ask(served: ServedCampaign, request: TaskRequest) -> OpenTrial | None:
    campaign = served.campaign
    with campaign.store.sole_writer(_WAIT):
        campaign.refresh()
        if request.trials is not None and request.trials != len(campaign.trials):
            raise InputError(
                f"another task was opened since this page was loaded, as trial {len(campaign.trials) - 1}. If you need "
                "one more task, ask again."
            )
        if request.decides:
            if served.threshold is None:
                raise InputError(
                    "there is no threshold, so no task decides a verdict: start the server with --threshold."
                )
            return campaign.ask_for_verdict(served.threshold, served.budget, certificate=served.certificate)
        parameters = request.parameters
        if request.again is not None:
            parameters = parameters_of_trial(campaign, request.again)
        return campaign.ask(parameters, draw=request.draw, because=request.because)


def files_of(served: ServedCampaign, tell: TellStage, number: int) -> Files:
    """Return the files of an open trial."""
    tell(Stage(f"preparing the files of trial {number}"))
    return _files(served, served.campaign.reopen(number))


def _files(served: ServedCampaign, opened: OpenTrial) -> Files:
    with tempfile.TemporaryDirectory() as folder:
        names = write_files(Path(folder) / "trial", served.experiment, opened)
        return {name: (Path(folder) / "trial" / name).read_bytes() for name in names}


def judge(served: ServedCampaign, tell: TellStage) -> Judgement | None:
    """Return the verdict on the trials that have ended; None if there is no threshold.

    A certificate refuses open trials, because somebody may have left open what failed. At a rig a trial is nearly
    always open, so the page judges the others, and says which ones do not count.
    """
    if served.threshold is None:
        return None
    tell(Stage("computing the verdict"))
    served.campaign.refresh()
    ended = [trial for trial in served.campaign.trials if trial.state != "open"]
    verdict = judge_trials(ended, served.threshold, served.certificate, served.campaign.provenance)
    return judgement_of(verdict, verdict.certificate, served.experiment.units)


def judgement_of(verdict: Verdict | None, certificate: Certificate | None, units: str) -> Judgement:
    """Return a verdict, or a certificate without one, as texts."""
    answer, reason, rests_on = ("", "", None) if verdict is None else (verdict.answer, verdict.reason, verdict.rests_on)
    if certificate is None:
        return Judgement(answer, reason, rests_on)
    bound = f"{with_error(certificate.upper_bound, certificate.error)} {units}".rstrip()
    return Judgement(
        answer,
        reason,
        rests_on,
        f"{bound}, with confidence {certificate.confidence:g}",
        certificate.doubt,
        certificate.statement,
        certificate.assumptions,
    )


def draw(served: ServedCampaign, tell: TellStage) -> Pictures:
    """Return the pictures of the present trials."""
    tell(Stage("drawing the pictures"))
    served.campaign.refresh()
    return pictures_of(served)


def pictures_of(served: ServedCampaign) -> Pictures:
    """Return the pictures of the trials that the campaign knows."""
    pictures = Pictures()
    if served.campaign.completed:
        _draw(pictures, "distance", lambda: _distance_picture(served))
        _draw(pictures, "worst", lambda: _worst_picture(served))
    return pictures


def _draw(pictures: Pictures, name: str, make: Callable[[], Figure]) -> None:
    import matplotlib

    # Names of parameters may contain a $, which is not mathematics; a stated id makes equal pictures equal files.
    try:
        with matplotlib.rc_context({"text.parse_math": False, "svg.hashsalt": "ctxval"}):
            content = io.BytesIO()
            make().savefig(content, format="svg", metadata={"Date": None})
    except Exception as error:  # a picture must not hide the verdict
        pictures.missing[name] = reason_of(error)
    else:
        pictures.images[name] = content.getvalue()


def _distance_picture(served: ServedCampaign) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = overview(served.campaign, units=served.experiment.units, ax=figure.add_subplot())
    if served.threshold is not None:
        axes.axhline(served.threshold, color="#000000", linestyle="-.", linewidth=1.4, label="threshold")
        axes.legend(loc="best", fontsize=8, framealpha=0.9)
    return figure


def _worst_picture(served: ServedCampaign) -> Figure:
    campaign = served.campaign
    assert campaign.worst is not None  # it is drawn only if a distance is known
    model, _ = campaign.trajectories(campaign.worst)
    if model is None:
        raise InputError(f"the trajectories of trial {campaign.worst.number} are not in the store.")
    states, inputs = served.experiment.names(model.states.shape[-1], model.inputs.shape[-1])
    return worst_trajectories(campaign, states=labels_of(states), inputs=labels_of(inputs))
