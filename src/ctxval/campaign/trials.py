"""The trials of a campaign: opened before an execution, closed with its result, and passed on to the search."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.progress import advance, stage
from ctxval._util.texts import text_of
from ctxval.campaign.choices import Choice, Execution, OpenTrial
from ctxval.campaign.dynamics import CampaignDynamics
from ctxval.campaign.goals_of_model import GoalsOfModel
from ctxval.campaign.history import history_of
from ctxval.campaign.identity import described_plainly, identify, remeasure, with_distance
from ctxval.campaign.proposals import IndependentDraws, Proposals, remaining_tasks
from ctxval.campaign.storage.disks import error_with_fallback
from ctxval.campaign.storage.store import Store
from ctxval.core.controller import converged_of
from ctxval.core.distance import Distance
from ctxval.core.plan import Plan, require_repeatable, try_distance
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Origin, Trial, Trials
from ctxval.core.validation import Validation
from ctxval.errors import CertificateError, CtxvalError, DistanceError, InputError, StoreAccessError, StoreError
from ctxval.models import Refined
from ctxval.searches import BaseSearch, Search, SequentialSearch


class TrialRecorder:
    """Opens and closes the trials of one campaign; the search knows exactly the trials in the store.

    The store was checked to belong to the experiment, which the description identifies in the form that JSON returns;
    ``executing`` has the numbers of the trials that this process executes, and ``predicts`` tells whether executions
    are predicted, and the predictions stored, before they are made.
    """

    def __init__(
        self, validation: Validation, search: Search, store: Store, seed: int, description: dict[str, Any]
    ) -> None:
        self.validation, self.store, self.description = validation, store, description
        self.search = BaseSearch.of(search)
        self.draws = IndependentDraws(store, validation, seed)
        self.dynamics = CampaignDynamics(validation, store, seed, description)
        self.predicts = False
        self._goals_of_model = GoalsOfModel(validation)
        self._proposals = Proposals(validation, self.search, self.dynamics)
        self._seed = seed
        self._parts_tried = False
        self.executing: set[int] = set()
        self.replay()

    # Present state

    @property
    def trials(self) -> Trials:
        """All trials in the order of asking."""
        return Trials(self._trials)

    @property
    def interrupted(self) -> Trial | None:
        """The first trial whose execution was interrupted."""
        begun = (trial for trial in self.trials.open if trial.attempts)
        return next((trial for trial in begun if trial.number not in self.executing), None)

    @property
    def has_tasks(self) -> bool:
        """Whether there is a task that may be executed; each task of a suite is executed once."""
        remaining = remaining_tasks(self.validation, self._trials)
        return remaining is None or len(remaining) > 0

    def trial(self, number: int, *, ended: bool = False) -> Trial:
        """Return an open trial, or with ``ended`` one whose result a person has told; refuse other trials."""
        if not 0 <= number < len(self._trials):
            raise InputError(f"there is no trial {number}; the campaign has {len(self._trials)}.")
        trial = self._trials[number]
        if ended and not trial.told:
            raise InputError(f"trial {number} has no result that was told by a person, so none can be replaced.")
        if not ended and trial.state != "open":
            raise InputError(f"trial {number} is {trial.state}, so nothing more can be told of it.")
        return trial

    def plan(self, trial: Trial) -> Plan:
        """Return the plan of a trial, whose task knows how often it was executed before."""
        plan, before = self.validation.plan(self.validation.space.point(trial.parameters)), self._trials[: trial.number]
        earlier = sum(bool((other.unit_point == trial.unit_point).all()) for other in before)
        return replace(plan, task=plan.task.again(earlier)) if earlier else plan

    def draw(self) -> Array:
        """Return the next independent draw of a task, a point of the unit cube ``(d,)``."""
        if self.validation.space.members is not None:
            raise CertificateError("a suite of tasks has no independent draws: `ctxval run` executes each task once.")
        return self.draws.point(self._trials)

    # Consistency with the store

    def replay(self) -> None:
        """Read the trials from the store, reset the search and tell it all trials."""
        with self.store.snapshot():
            self._trials = self.store.trials()
            self._changes = self.store.signature()[2]
        # A refined model has learned from the tasks of the model before: the same initial tasks would not test it.
        seed = self._seed
        if self.search.iid or isinstance(self.validation.model, Refined):
            seed = int(np.random.SeedSequence([seed, self.draws.of_model()]).generate_state(1)[0])
        self.search.reset(self.validation.space.dimension, seed)
        history = history_of(self._trials)
        if history:
            self._tell_search(history)
            self.search.remember([trial.note.search for trial in history])

    def _tell_search(self, trials: Sequence[Trial]) -> None:
        known = Trials(trials)
        self.search.tell(known.points(self.validation.space.dimension), known.distances.tolist())

    def refresh(self) -> None:
        """Read the trials again if other processes have changed the store."""
        known = (len(self._trials), len(self.trials.open), self._changes)
        stored = self.store.signature()
        if stored[2] != self._changes:
            identify(self.store, self.validation, self.description, None, False)
        if stored != known:
            self.replay()

    def remeasure(self, distance: Distance | None = None) -> list[Trial]:
        """Recompute the distances of all stored executions, with another distance if one is given."""
        validation, description = self.validation, self.description
        if distance is not None:
            validation = validation.with_parts(distance=distance)
            description = with_distance(description, described_plainly(validation.distance))
        changed = remeasure(self.store, validation, description)
        self._redefine(validation, description)
        return changed

    def _redefine(self, validation: Validation, description: dict[str, Any]) -> None:
        self.validation, self.description, self._parts_tried = validation, description, False
        elsewhere = self.dynamics.extra_recordings
        self.dynamics = CampaignDynamics(validation, self.store, self._seed, description)
        self.dynamics.extra_recordings = elsewhere
        self._proposals = Proposals(validation, self.search, self.dynamics)
        self.replay()

    # Opening

    def open(self, choice: Choice) -> OpenTrial:
        """Store a new trial that people execute."""
        return self.open_all([choice], attempts=0)[0]

    def start_again(self, trial: Trial) -> OpenTrial:
        """Store that the execution of an interrupted trial starts again."""
        try:
            plan = self.plan(trial)
        except CtxvalError as error:
            self.close(trial, Execution(failed=text_of(error)), executed=False)
            raise
        return self.repeat(OpenTrial(trial, plan))

    def repeat(self, opened: OpenTrial) -> OpenTrial:
        """Store that another execution of an open trial starts."""
        begun = replace(opened.trial, attempts=opened.trial.attempts + 1)
        self.store.begin_attempt(begun, changes=self._changes)
        self._trials[begun.number] = begun
        self.executing.add(begun.number)
        return OpenTrial(begun, opened.plan)

    def open_all(self, choices: Iterable[Choice], attempts: int) -> list[OpenTrial]:
        """Store new trials in one transaction, with the number of attempts that start at once.

        Each choice is made when the trials before it are known. If a task cannot be planned, the trials end before it;
        if it is the first one, the error is raised.
        """
        opened, executing, unplanned = list[OpenTrial](), set(self.executing), False
        try:
            for choice in choices:
                trial = self._next_trial(choice, attempts)
                try:
                    plan = self.plan(trial)
                except CtxvalError as error:
                    if not opened:
                        failed = replace(trial, state="failed", failure=text_of(error), attempts=0)
                        self.store.add([(failed, None, None)], changes=self._changes)
                        raise
                    unplanned = True
                    break
                if not self._parts_tried:
                    require_repeatable(self.validation, plan)
                    try_distance(self.validation, plan)
                    self._parts_tried = True
                with suppress(InputError):  # an attribute of a user's controller with this name that is something else
                    if (converged := converged_of(plan.controller)) is not None:
                        trial = replace(trial, note=replace(trial.note, converged=bool(converged)))
                opened.append(OpenTrial(trial, plan))
                self._trials.append(trial)
                if attempts:
                    self.executing.add(trial.number)
            if opened and not opened[0].number and self.store.path is not None:
                self.draws.of_model()  # by which other stores of the same model are found
            new = [(each.trial, each.plan.model_trajectory, None) for each in opened]
            self.store.add(new, changes=self._changes)
        except BaseException:
            # After every error, the search must know exactly the stored trials.
            self.executing = executing
            self.replay()
            raise
        if unplanned:
            self.replay()
        for each in opened:
            self._goals_of_model.watch(each.plan)
        return opened

    def _next_trial(self, choice: Choice, attempts: int) -> Trial:
        """Return the trial of a choice, and tell the search that its point has no value yet."""
        space, trials = self.validation.space, self._trials
        if not self.has_tasks and choice.parameters is None:
            raise InputError("each task of the suite is executed, or is being executed; state one to execute it again.")
        if choice.unit_point is None:
            if self.search.iid and space.distribution is not None:
                # The points of such a search are uniform, and the tasks are not.
                choice = replace(choice, unit_point=self.draw(), origin="iid")
            elif self.search.iid and space.members is not None:
                choice = replace(choice, unit_point=self.draws.left(trials), origin="initial")
            elif (spread := self._proposals.spread(trials)) is not None:
                choice = replace(choice, unit_point=spread, origin="initial")
        if choice.unit_point is None:
            first = len(trials) < self.search.initial
            origin: Origin = "iid" if self.search.iid else "initial" if first else "acquisition"
            if not isinstance(self.search, SequentialSearch):
                self.replay()  # such a search may still know the point that it proposed, and not the rounded one
                trials = self._trials
            unit_point, note = self._proposals.next(trials, choice)
        else:
            origin = choice.origin
            unit_point, note = self._proposals.tested(choice, trials)
            self.search.tell(unit_point[None], [np.nan])
        if origin == "iid" and choice.planned_draws is not None:
            note = replace(note, draws=choice.planned_draws)
        if self.predicts:
            self.dynamics.thinking.measure(trials)
        if self.predicts and (predicted := self.dynamics.predict(trials, unit_point)) is not None:
            note = replace(note, prediction={**predicted.to_json(), "experiment": self.dynamics.experiment})
        if self.predicts:
            note = replace(note, **self.dynamics.noted(trials))
        key = unit_point.tobytes()
        same = (trial.parameters for trial in trials if trial.unit_point.tobytes() == key)
        parameters = choice.parameters or next(same, None) or space.describe_point(space.from_unit(unit_point))
        return Trial(
            *(len(trials), origin, "open", unit_point, dict(parameters), attempts), note=note, because=choice.because
        )

    # Closing

    def close(
        self, trial: Trial, execution: Execution, *, replacing: str | None = None, executed: bool = True
    ) -> Trial:
        """Store a measured execution of an open trial, or one ``replacing`` a result; return the final trial."""
        ended = execution.ended(trial, executed=executed)
        trajectory = execution.trajectory
        if replacing is not None:
            self.store.replace_result(self._trials[ended.number], ended, trajectory, replacing, changes=self._changes)
            self._redefine(self.validation, self.description)
        else:
            try:
                self.store.close_trials([(ended, trajectory)], changes=self._changes)
            except (StoreError, InputError) as error:
                raise error_with_fallback(ended, trajectory, self.store.path, error) from error
            self._closed([ended])
        if ended.state == "unmeasured":
            raise DistanceError(
                f"{ended.failure} The execution of trial {ended.number} is stored: correct the distance, and "
                "`ctxval remeasure STORE` computes it without another execution."
            )
        return ended

    def close_together(self, executions: Sequence[tuple[Trial, Execution]]) -> list[Trial]:
        """Store measured executions of open trials in one transaction; if an error is raised, none is stored."""
        ended = [(execution.ended(trial), execution.trajectory) for trial, execution in executions]
        self.store.close_trials(ended, changes=self._changes)
        return self._closed([trial for trial, _ in ended])

    def _closed(self, ended: list[Trial]) -> list[Trial]:
        for trial in ended:
            self.executing.discard(trial.number)
            self._trials[trial.number] = trial
            if trial.distance is not None:
                self.search.tell(np.array([trial.unit_point]), [trial.distance])
        return ended

    def add(self, executions: Sequence[tuple[Plan, Execution]], wait: float = 0.0) -> list[Trial | None]:
        """Store earlier executions in one transaction; return their trials, None if one is already in the store."""
        space = self.validation.space
        with self.store.sole_writer(wait), stage("importing", len(executions), "runs"):
            self.refresh()
            known = defaultdict[bytes, list[Trial]](list)
            for trial in self._trials:
                known[(trial.unit_point + 0.0).tobytes()].append(trial)
            trials = list[Trial | None]()
            new = list[tuple[Trial, Trajectory | None, Trajectory | None]]()
            for plan, execution in executions:
                point = plan.parameters.points
                same = known[(space.to_unit(point) + 0.0).tobytes()]
                if any(execution.is_that_of(trial) for trial in same):
                    trials.append(None)
                    continue
                number = len(self._trials) + len(new)
                opened = Trial(number, "manual", "open", space.to_unit(point), space.describe_point(point))
                trial = execution.ended(opened)
                same.append(trial)
                trials.append(trial)
                new.append((trial, plan.model_trajectory, execution.trajectory))
                advance(1)
            if added := [trial for trial, _, _ in new]:
                self.store.add(new, changes=self._changes)
                self._trials += added
                self._tell_search(added)
        return trials

    @contextmanager
    def predicting(self, predicts: bool, thinking: float | None = np.inf) -> Iterator[None]:
        """Predict the executions of the trials that are opened within this context, and store the predictions.

        A choice takes at most so many seconds of ``thinking``; None for the default.
        """
        before, self.predicts = self.predicts, predicts
        self._proposals.thinking = thinking if thinking is not None and np.isfinite(thinking) else None
        try:
            with self.dynamics.thinking.limited(thinking if predicts else np.inf):
                yield
        finally:
            self.predicts, self._proposals.thinking = before, None

    @contextmanager
    def not_executing(self, trial: Trial) -> Iterator[None]:
        """Refuse the result of a trial that a process is executing: that process records the result."""
        until = "its result cannot be recorded before the execution has ended."
        refusal = InputError(f"trial {trial.number} is being executed: {until}")
        if trial.number in self.executing:
            raise refusal
        if not trial.attempts:
            yield  # a person opened it, and no process executes it
            return
        with ExitStack() as stack:
            try:
                stack.enter_context(self.store.sole_writer())
            except StoreAccessError as error:
                raise refusal from error
            self.refresh()
            yield
