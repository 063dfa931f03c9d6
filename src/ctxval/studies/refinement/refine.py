"""``refine``: learn a model again from the executions that falsified it, and validate it, until it is validated."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval._util.checked import PositiveFloat, PositiveInt, TimeLimit, checked
from ctxval._util.progress import progress_shown, stage
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.history import at_points, executed_trials
from ctxval.certificates import CertificateOptions
from ctxval.certificates.verdict import Verdict, counterexample
from ctxval.core.model import Model, Step, linearize
from ctxval.core.plan import gives_inputs
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError, InputError
from ctxval.learning.extended import estimates_by_loops_on_model, with_states_of_model
from ctxval.learning.recorded import closed_loops_on_model
from ctxval.learning.state_estimates import States
from ctxval.models import Corrected, Linear, Refined, read_refined, write_model
from ctxval.models.corrected import before_refinement
from ctxval.models.saved import is_savable, read_note
from ctxval.studies.refinement.held_out import Records, measure_residual
from ctxval.studies.refinement.methods import Learned, Method, method_of
from ctxval.studies.refinement.rounds import Refinement, Round, SameControllers


@checked
def refine(
    campaign: Campaign,
    threshold: PositiveFloat,
    budget: PositiveInt,
    *,
    method: str | Method | Callable[[Transitions], Model | Step] = "residual",
    certificate: CertificateOptions | None = None,
    on_trial: Callable[[Trial], None] | None = None,
    open_round: Callable[[Validation, Path, Path, CertificateOptions], Campaign] | None = None,
    thinking: TimeLimit | None = None,
    progress: bool | None = None,
    **execution: Any,
) -> Refinement:
    """Learn a model again from executions and validate it, round by round, until it is validated or the budget ends.

    A round ends as soon as its model is falsified; the next model learns from the executions of all rounds. Each model
    has a store of its own next to that of the campaign, such as ``cart.round-1.sqlite``, and a file such as
    ``cart.round-1.npz``. If these files exist, the refinement is resumed, with the same choices as without an
    interruption.

    An execution counts for one model only, that on which its controller was designed. The k-th refined model is judged
    with confidence ``1 - alpha / (k (k + 1))``, so that all of them together are wrong with probability at most alpha.

    If the validation has outputs, models learn from the states of M, which are estimated along the executions.

    Args:
        campaign: the campaign of the first model. It is run until it is decided, if it is not yet.
        threshold: tau, in the units of the distance.
        budget: largest total number of executions of all rounds, including those of the campaign.
        method: ``residual``, ``linear``, ``network`` or ``gaussian-process``; a method of ``ctxval.refinement``; or a
            function ``fit(data) -> model`` that always returns the same model for the same data.
        certificate: the kind and options of the certificates, with the confidence ``1 - alpha``; ``auto`` by default.
        on_trial: called with each trial that has ended.
        open_round: makes the campaign of a round from its validation, its store, the file of its model and its options,
            if the store and the model are files; by default, it is like the given campaign.
        thinking: seconds of CPU for each choice and verdict, as in :meth:`ctxval.Campaign.run`; a model is learned
            whole.
        progress: whether to show the progress on standard error; None to show it at a terminal and in a notebook.
        execution: ``workers``, ``executor`` and ``timeout`` of :meth:`ctxval.Campaign.run`.

    Raises:
        InputError: if the budget does not exceed the executions of the campaign, if the method is unknown, or if the
            executions teach no model.
    """
    if budget < campaign.executions:
        raise InputError(
            f"the campaign has {campaign.executions} executions already, and the budget of {budget} is a total: give "
            "more."
        )
    chosen, options = method_of(method, seed=campaign.seed), certificate or CertificateOptions()
    execution |= {"on_trial": on_trial, "progress": progress, "thinking": thinking}
    with progress_shown(progress):
        return _Loop(campaign, float(threshold), budget, chosen, options, open_round, execution).run()


@dataclass(eq=False)
class _Loop:
    """The rounds so far. Everything but the executions is a function of the stores, so an interrupted loop resumes."""

    first: Campaign
    threshold: float
    budget: int
    method: Method
    options: CertificateOptions
    open_round: Callable[[Validation, Path, Path, CertificateOptions], Campaign] | None
    execution: dict[str, Any]

    def __post_init__(self) -> None:
        self.rounds = list[Round]()
        # The model that is corrected or replaced; of a model that was refined before, the one before.
        self._base = before_refinement(self.first.validation.model)
        self._of_states = with_states_of_model(self.first.validation)
        self._last: tuple[int, Learned] | None = None

    @property
    def spent(self) -> int:
        """The number of executions of all rounds."""
        return sum(item.executions for item in self.rounds)

    def run(self) -> Refinement:
        """Run the rounds until one is validated, or nothing more can be done."""
        verdict = self._judged(self.first, self.options)
        self.rounds.append(Round(0, "given", self.first, verdict, self.options.confidence))
        ended = self._why_ended()
        while ended is None:
            ended = self._next_round() or self._why_ended()
        units, confidence = self.first.validation.labels.units, self.options.confidence
        refinement = Refinement(tuple(self.rounds), self.threshold, confidence, self.budget, ended, units=units)
        last = self.rounds[-1]
        if not last.number:
            return refinement
        with stage("measuring the residual"):
            try:
                learned = self._learned(last.number)
            except CtxvalError:  # the file of the model is there, but its executions are not
                return refinement
            before = len(self._executed(self.rounds[:-1]))
            executed = self._with_states(self.rounds, judged=before)[before:]
            errors = learned.errors.with_executions(last.model, self._base, executed)
        n = errors.errors.shape[1]
        states, inputs = self._of_states.names(n, errors.pairs.shape[1] - n)
        rms = zip(errors.rms_before.tolist(), errors.rms.tolist(), strict=True)
        residual, accuracy = measure_residual(errors, states, inputs), dict(zip(states, rms, strict=False))
        return replace(refinement, residual=residual, accuracy=accuracy, parameters=learned.parameters)

    def _judged(self, campaign: Campaign, options: CertificateOptions) -> Verdict:
        """Execute tasks of a campaign until it is decided or the budget ends; people execute theirs themselves."""
        falsified = counterexample(campaign.trials, self.threshold) is not None
        left = self.budget - self.spent
        if not falsified and not getattr(campaign.validation.system, "manual", False) and left >= 1:
            campaign.run(left, self.threshold, certificate=options, **self.execution)
        return campaign.verdict(self.threshold, certificate=options, thinking=self.execution["thinking"])

    def _why_ended(self) -> str | None:
        """Return why there is no further round; None if there is one."""
        last = self.rounds[-1]
        if last.verdict.answer == "validated":
            return f"{f'the model of round {last.number}' if last.number else 'the given model'} is validated"
        if last.verdict.answer == "undecided":
            if getattr(last.campaign.validation.system, "manual", False):
                return (
                    f"people execute the tasks of this system: get them with `ctxval ask {last.store}`, tell their "
                    "results, and refine again"
                )
            return f"the verdict on the model of round {last.number} is undecided after {self.spent} executions"
        return f"the budget of {self.budget} executions is spent" if self.spent >= self.budget else None

    def _next_round(self) -> str | None:
        """Run one more round; return why there is none."""
        number = len(self.rounds)
        confidence = confidence_of_round(self.options.confidence, number)
        options = replace(self.options, confidence=confidence)
        file = self._beside(number, ".npz")
        if file is not None and file.exists():
            note = read_note(file)
            if note.get("method") != self.method.name:
                raise InputError(
                    f"{file} was learned by the method {note.get('method')!r}: give this method, or move the files of "
                    "the rounds away."
                )
            stored, notes = read_refined(file, self._base), tuple(map(str, note.get("notes", [])))
            model = Refined(stored, stored.data or self._records(number).transitions, self._base)
        else:
            try:
                model, notes, file = self._learned_model(number, file)
            except InputError as error:
                if number == 1:
                    raise
                return f"no better model can be learned: {str(error).removesuffix('.')}"
        validation = self.first.validation.with_parts(model=model)
        same = same_controllers(validation, self._executed(self.rounds))
        if same.worst is not None and same.worst > self.threshold:
            return (
                f"the model that round {number} would learn has the distance {same.worst:.4g} on a task that it has "
                "learned from, with the controller that was executed: another method is needed"
            )
        store, first = self._beside(number, ".sqlite"), self.first
        if self.open_round is not None and store is not None and file is not None:
            campaign = self.open_round(validation, store, file, options)
        else:
            search = copy.deepcopy(first.search)
            campaign = Campaign(validation, search=search, store=store, seed=first.seed, name=first.name)
        verdict, name = self._judged(campaign, options), self.method.name
        self.rounds.append(Round(number, name, campaign, verdict, confidence, len(model.data), file, notes, same))
        return None

    def _learned_model(self, number: int, file: Path | None) -> tuple[Refined, tuple[str, ...], Path | None]:
        """Return the model of a round, learned from the executions before, with its notes; write its file."""
        with stage("learning the model again"):
            data = self._records(number).transitions
            learned = self._learned(number)
            refined, of_design = with_best_jacobian(self.first.validation, Refined(learned.model, data, self._base))
        notes = learned.notes if of_design is None else (*learned.notes, of_design)
        if file is None or not is_savable(refined):
            return refined, notes, None
        write_model(file, refined, {"method": self.method.name, "notes": list(notes)})
        # What a resumed refinement reads is what this one uses, to the last bit.
        return Refined(read_refined(file, self._base), refined.data, self._base), notes, file

    def _executed(self, rounds: list[Round]) -> list[tuple[Trial, Trajectory]]:
        return [each for item in rounds for each in executed_trials(item.campaign.store, item.campaign.trials)]

    def _learned(self, number: int) -> Learned:
        """Return what the rounds before a number teach; the result needs it after the round, too."""
        if self._last is None or self._last[0] != number:
            self._last = number, self.method.learn(self._base, self._records(number))
        return self._last[1]

    def _records(self, before: int) -> Records:
        return Records.of(self.first.validation.model, self._with_states(self.rounds[:before]))

    def _with_states(self, rounds: list[Round], judged: int | None = None) -> list[Trajectory]:
        """Return executions; with states of M, estimated as the first ``judged`` choose, if outputs are recorded."""
        executed = at_points(self._executed(rounds))
        judged = len(executed) if judged is None else judged
        estimated = None if self._estimates is None else self._estimates.of(executed, judged)
        if estimated is None:
            raise InputError(
                "the states of the model cannot be estimated from the recorded outputs: its closed loops, or its "
                "derivatives along the executions, are not finite."
            )
        return estimated

    @functools.cached_property
    def _estimates(self) -> States | None:
        return estimates_by_loops_on_model(self.first.validation)

    def _beside(self, number: int, suffix: str) -> Path | None:
        store = self.first.store.path
        return None if store is None else store.with_name(f"{store.stem}.round-{number}{suffix}")


def confidence_of_round(confidence: float, number: int) -> float:
    """Return the confidence with which the k-th refined model is judged; the shares of all k sum up to alpha."""
    return 1 - (1 - confidence) / (number * (number + 1))


# Which Jacobian controllers are designed with, and whose controllers on executed tasks have not changed


def with_best_jacobian(validation: Validation, refined: Refined) -> tuple[Refined, str | None]:
    """Return a refined model with the Jacobian whose controllers complete the tasks best on the refined model itself.

    A synthesizer that linearises once, such as LQR, needs a linear model that is good on the whole task. If M is
    linear, it is such a model, and the Jacobian of a nonlinear M' at one point may be none. It is used only if random
    tasks have a clearly smaller cost on M' with it. Nothing is executed.
    """
    model = refined.model
    if not (isinstance(model, Corrected) and isinstance(model.model, Linear)):
        return refined, None
    if not _linearises_once(validation, model.model):
        return refined, None
    other = Corrected(model.model, model.correction, linearised="model", data=model.data)
    kept = Refined(other, refined.data, refined.before)
    costs = [_typical_cost(validation.with_parts(model=either)) for either in (refined, kept)]
    if costs[0] <= 0.95 * costs[1]:  # clearly
        return refined, None
    return kept, (
        "controllers are designed with the Jacobian of the model before, and the prediction is corrected: the "
        "synthesizer linearises once, and the tasks are not completed clearly better on the refined model with its own "
        f"Jacobian (their cost is {costs[0]:.3g} with it, and {costs[1]:.3g} without)"
    )


def _linearises_once(validation: Validation, model: Linear) -> bool:
    """Return whether the design of one controller asks for the Jacobian of M at one or two points."""

    class Counted:
        points = 0

        def step(self, x: Array, u: Array) -> Array:
            return model.step(x, u)

        def jacobian(self, x: Array, u: Array) -> tuple[Array, Array]:
            batch = x.shape[:-1]
            self.points += int(np.prod(batch))
            A, B = linearize(model, x, u)
            return np.broadcast_to(A, (*batch, *A.shape[-2:])), np.broadcast_to(B, (*batch, *B.shape[-2:]))

    counted = Counted()
    with suppress(CtxvalError):
        validation.with_parts(model=counted).plan(validation.space.from_unit(np.full(validation.space.dimension, 0.5)))
        return 1 <= counted.points <= 2
    return False


def _typical_cost(validation: Validation) -> float:
    """Return the median cost of random tasks on a model; infinity if their controllers cannot be designed."""
    space, rng = validation.space, np.random.default_rng(0)
    # Users' tasks, synthesizers and costs may raise anything, on tasks that may never be executed.
    with suppress(Exception), single_threaded():
        loops = closed_loops_on_model(validation)
        if loops is None or loops.states.ndim == 2:  # designs cannot be made in a batch
            plans = map(validation.plan, space.from_unit(rng.random((8, space.dimension))))
            return float(np.median([_cost(validation, plan.task, plan.model_trajectory) for plan in plans]))
        points = space.from_unit(rng.random((len(loops.states), space.dimension)))
        costs = _cost(validation, validation.task_at(space.parameters(points)), loops)
        return float(np.median(costs)) if np.isfinite(costs).all() else np.inf
    return np.inf


def _cost(validation: Validation, task: Task, loops: Trajectory) -> Array:
    """Return the cost of closed loops: that of the synthesizer, or else the squared deviation from the reference."""
    deviations = np.moveaxis(loops.states - task.reference, -2, 0)
    value = getattr(getattr(validation.synthesizer, "cost", None), "value", None)
    if callable(value):
        return np.asarray(value(deviations, np.moveaxis(loops.inputs, -2, 0)))
    sizes = np.maximum(np.abs(loops.states).reshape(-1, loops.states.shape[-1]).std(axis=0), 1e-12)
    return np.asarray(((deviations / sizes) ** 2).sum(axis=(0, -1)))


def same_controllers(validation: Validation, executed: Sequence[tuple[Trial, Trajectory]]) -> SameControllers:
    """Return on how many executed tasks the controllers of a refined model are those that were executed."""
    distances, recent = list[float](), executed[-32:]
    for trial, recorded in recent:
        with suppress(Exception):  # users' parts may raise anything: what cannot be compared differs
            plan = validation.plan(validation.space.from_unit(trial.unit_point))
            if gives_inputs(plan, recorded, 1e-6):  # a share of the largest magnitude of each input
                distances.append(validation.accept(plan, recorded))
    return SameControllers(len(recent), len(distances), max(distances, default=None))
