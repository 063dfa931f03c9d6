"""Which tasks are safe on S, from a campaign whose distance is the margin of unsafe tasks.

``d_a`` is the largest deviation of the states that a specification looks at, and ``d_b`` the largest robustness rho_M
of a task that M satisfies and S violates (Ghosh et al. 2019, arXiv 1902.10320). Every task with a larger rho_M than
``d_b`` is safe, and ``d_b`` is at most ``d_a``.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ctxval._util.checked import PositiveInt, checked
from ctxval._util.progress import progress_shown, stage
from ctxval._util.representation import ShortRepr, call
from ctxval._util.texts import parted
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.history import at_points, executed_trials
from ctxval.certificates import Certificate, CertificateOptions, Dynamics
from ctxval.certificates.bounds import ERRORS, rank_of
from ctxval.certificates.dynamics import draws_for
from ctxval.certificates.verdict import Answer, Verdict
from ctxval.core.distance import selected
from ctxval.core.experiment import Experiment
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.distances import MaximumDeviation, UnsafeMargin
from ctxval.errors import CertificateError, InputError
from ctxval.learning import DynamicsStudy
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.specs import ReachAvoid
from ctxval.studies.safety.draws import on_model, spec_distance

TASKS = 4000  #: number of tasks on M that the shares are of; of designs that are made one by one, a tenth of it


@dataclass(frozen=True)
class UnsafeTask(ShortRepr):
    """An executed task that M satisfies and S violates."""

    trial: int  #: the number of its trial
    parameters: dict[str, Any]  #: the task
    on_model: float  #: the robustness of both trajectories
    on_system: float


@dataclass(frozen=True, eq=False)
class SafetyReport(ShortRepr):
    """Which tasks are safe on S."""

    spec: Any  #: the specification
    margin: float | None  #: the robustness of M that was asked for; None if it was to be found
    answer: Answer | None  #: whether every task with a larger one is safe; None if no margin was asked for
    reason: str | None  #: why
    d_a: float  #: the largest executed deviation of the states that the specification looks at
    d_a_bound: float | None  #: by the learned dynamics, whose prediction of it was not tested; None if not known
    d_b: float  #: the largest executed rho_M of a task that S violates; 0 if there is none
    d_b_bound: float | None  #: the certified bound; None if there is none
    counterexamples: tuple[UnsafeTask, ...]  #: executed tasks that M satisfies and S violates, the largest rho_M first
    certificate: Certificate | None  #: the certificate of the bound; None if there is none
    doubt: str | None  #: why there is no bound; None if there is one
    tasks: int  #: number of drawn tasks, on M alone, that the shares are of
    share_satisfied: float  #: the share of the tasks that M satisfies
    share_certified: float | None  #: the share whose rho_M exceeds the bound of d_b; None if there is none
    share_by_deviation: float | None  #: the same for the bound of d_a; None also if an execution failed
    #: the specification whose sets to avoid have grown, and whose set to reach has shrunk, by the bound; None if there
    #: is no bound, no sets, or nothing left of the set to reach
    tightened: ReachAvoid | None
    between: float  #: how far S moved at most between two recorded times, in the states that the specification looks at
    executions: int  #: the number of executions of S
    confidence: float  #: the confidence of the certificate
    units: str  #: the unit of all distances

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain values."""
        plain = {name: value for name, value in vars(self).items() if name not in ("spec", "certificate", "tightened")}
        return {
            **plain,
            "spec": repr(self.spec),
            "counterexamples": [asdict(task) for task in self.counterexamples],
            "certificate": self.certificate and self.certificate.to_json(),
            "avoid": None if self.tightened is None else [repr(avoided) for avoided in self.tightened.avoid],
            "reach": None if self.tightened is None or self.tightened.reach is None else repr(self.tightened.reach),
        }

    @property
    def statement(self) -> str:
        """What follows for the tasks, in one sentence."""
        unit = f" {self.units}".rstrip()
        if self.d_b_bound is None:
            return f"no margin is certified: {self.doubt}."
        often = "" if self.certificate is None else self.certificate.target.often
        return (
            f"With {100 * self.confidence:g} % confidence, every task that M satisfies with a robustness above "
            f"{self.d_b_bound:.4g}{unit} is safe on S at its recorded times{often}: "
            f"{100 * (self.share_certified or 0):.1f} % of the tasks, and M satisfies "
            f"{100 * self.share_satisfied:.1f} %."
        )

    def __repr__(self) -> str:
        return call(self, self.answer, d_a=self.d_a, d_b=self.d_b, bound=self.d_b_bound, executions=self.executions)


def judged_by(experiment: Experiment, distance: UnsafeMargin) -> Experiment:
    """Return an experiment whose distance is the margin of unsafe tasks, and whose threshold is that margin.

    The unit is that of the states that the specification looks at, if they have one.
    """
    given = experiment.validation.with_parts(distance=distance)
    labels = [parted(label)[1] for label in experiment.states]
    components = getattr(spec_distance(given).spec, "components", None)
    places = range(len(labels)) if components is None else [i for i in components if isinstance(i, int)]
    units, *others = {labels[i] for i in places if -len(labels) <= i < len(labels)} or {""}
    units = "" if others else units
    validation = given.with_parts(labels=replace(given.labels, units=units))
    return replace(experiment, validation=validation, threshold=distance.margin, truth=None, units=units)


def require_safe_tasks(validation: Validation) -> float:
    """Return the share of drawn tasks that M satisfies with the margin.

    Raises:
        InputError: if no drawn task is safe on the model.
    """
    distance, planner, space = spec_distance(validation), LoopPlanner(validation), validation.space
    plan = validation.plan(0.5 * (space.low + space.high))
    distance.spec.robustness(plan.model_trajectory, plan.task)  # refuses sets of other dimensions
    unit = space.candidates(space.unit_draws(512, np.random.default_rng([0, 1])))
    least = distance.margin or 0.0
    share = float((on_model(planner, distance.spec, unit[: 512 if planner.batched else 100]) > least).mean())
    if not share:
        what = f"with a margin of {least:g}" if least else "at all"
        raise InputError(
            f"no drawn task satisfies the specification on the model {what}, so there is nothing to certify: check "
            "the sets, their places and the states that the specification looks at."
        )
    return share


@checked
def assess(
    campaign: Campaign,
    certificate: CertificateOptions | None = None,
    *,
    tasks: PositiveInt = TASKS,
    progress: bool | None = None,
) -> SafetyReport:
    """Return which tasks are safe on S, from the trials of a campaign. S is not executed.

    Args:
        campaign: a campaign whose distance is a :class:`ctxval.distances.UnsafeMargin`.
        certificate: the kind and options of the certificate; that of learned dynamics by default.
        tasks: number of tasks on M that the shares are of.
        progress: whether to show the progress on standard error; None to show it at a terminal and in a notebook.

    Raises:
        InputError: if no drawn task is safe on the model.
    """
    validation, options = campaign.validation, certificate or CertificateOptions(Dynamics())
    distance, space = spec_distance(validation), validation.space
    spec, deviation = distance.spec, MaximumDeviation(2, getattr(distance.spec, "components", None))
    with progress_shown(progress):
        runs = executed_trials(campaign.store, campaign.trials)
        executed = [_compared(campaign, trial, system, deviation) for trial, system in runs]
        d_a = max((deviated for _, deviated, _ in executed), default=0.0)
        verdict, certified, bound, doubt = _bound(campaign, distance.margin, options)
        # `ctxval run` would execute tasks of the experiment's own distance.
        reasons = (None if verdict is None else verdict.reason, doubt)
        reason, doubt = (each and each.replace("`ctxval run`", "`ctxval safe`") for each in reasons)
        with stage("predicting the largest deviation", unit="closed loops"):
            predicted = _deviation_bound(campaign, runs, deviation, options.confidence)
        planner, unit = LoopPlanner(validation), space.members
        if unit is None:
            count = tasks if planner.batched else max(tasks // 10, 1)
            unit = space.unit_draws(count, np.random.default_rng([campaign.seed, 2]))
        with stage("running tasks on the model", len(unit), "tasks"):
            rho = on_model(planner, spec, unit)
    if not (rho > 0).any():
        raise InputError(f"none of {len(unit)} drawn tasks satisfies the specification on the model.")
    d_a_bound = None if predicted is None else max(predicted, d_a)
    violated = (task for task, *_ in executed if task.on_system <= 0 < task.on_model)
    unsafe = sorted(violated, key=lambda task: -task.on_model)
    known = None if campaign.failed else d_a_bound  # a failed execution has deviations that nobody knows
    tightened = None
    if bound is not None and isinstance(spec, ReachAvoid):
        with suppress(InputError):  # nothing is left of a set
            tightened = spec.tightened(bound)
    return SafetyReport(
        spec=spec,
        margin=distance.margin,
        answer=None if verdict is None else verdict.answer,
        reason=reason,
        d_a=d_a,
        d_a_bound=d_a_bound,
        d_b=unsafe[0].on_model if unsafe else 0.0,
        d_b_bound=bound,
        counterexamples=tuple(unsafe),
        certificate=certified,
        doubt=doubt,
        tasks=len(unit),
        share_satisfied=float((rho > 0).mean()),
        share_certified=None if bound is None else float((rho > bound).mean()),
        share_by_deviation=None if known is None else float((rho > known).mean()),
        tightened=tightened,
        between=max((moved for *_, moved in executed), default=0.0),
        executions=campaign.executions,
        confidence=options.confidence,
        units=validation.labels.units,
    )


def _compared(
    campaign: Campaign, trial: Trial, system: Trajectory, deviation: MaximumDeviation
) -> tuple[UnsafeTask, float, float]:
    """Return the robustness of both trajectories, how far they deviate, and how far S moved in a step at most."""
    validation, spec = campaign.validation, spec_distance(campaign.validation).spec
    parameters = validation.space.parameters(validation.space.from_unit(trial.unit_point))
    task, model = validation.task_at(parameters), campaign.store.trajectory(trial.number, "model")
    if model is None:
        model = validation.plan(validation.space.from_unit(trial.unit_point)).model_trajectory
    of_model, of_system = (float(spec.robustness(run, task)) for run in (model, system))
    moved = np.linalg.norm(np.diff(selected(system.states, deviation.components), axis=0), axis=-1).max()
    compared = UnsafeTask(trial.number, trial.parameters, of_model, of_system)
    return compared, float(deviation(model, system, task)), float(moved)


def _bound(
    campaign: Campaign, margin: float | None, options: CertificateOptions
) -> tuple[Verdict | None, Certificate | None, float | None, str | None]:
    """Return the verdict on a margin, if there is one, the certificate, and the bound on d_b or why there is none."""
    untested = None
    if not campaign.failed and not (campaign.worst is not None and campaign.worst.distance):
        untested = (
            "no executed task came near a violation, so that no prediction of one was tested; ask for a margin, or "
            "draw tasks with an audit"
        )
    if margin is not None:
        verdict = campaign.verdict(margin, certificate=options)
        if verdict.answer == "validated":
            return verdict, verdict.certificate, margin, None
        return verdict, verdict.certificate, None, untested or verdict.reason.removesuffix(".")
    try:
        certified = campaign.certify(certificate=options)
    except CertificateError as error:
        return None, None, None, untested or str(error).removesuffix(".")
    if certified.bound is None:
        return None, certified, None, untested or certified.doubt or "the certificate leaves out a share of the tasks"
    # Share of a bound on d_b by which a search may end below its largest value, which lies on a ridge: in the
    # study of ``docs/how-to/safety.md``, it ended by up to 0.2 % below.
    searched = max(certified.details.get("disagreement") or 0.0, 0.01)
    return None, certified, (1 + searched) * (certified.bound + ERRORS * certified.error), None


def _deviation_bound(
    campaign: Campaign, runs: list[tuple[Trial, Trajectory]], deviation: MaximumDeviation, confidence: float
) -> float | None:
    """Return the bound that learned dynamics give on the largest deviation; None if they give none."""
    validation = campaign.validation.with_parts(distance=deviation)
    with suppress(Exception):  # users' parts, at states that no execution has reached
        learned = DynamicsStudy(validation, campaign.seed).learn(at_points(runs))
        if learned is not None:
            maxima = learned.worst_case_of(draws_for(confidence)).maxima
            bound = float(np.sort(maxima)[min(rank_of(confidence, len(maxima)), len(maxima)) - 1])
            return bound if np.isfinite(bound) else None
    return None
