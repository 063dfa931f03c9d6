"""The trials of a campaign: opened before an execution, closed with what happened, always known to the search."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import call, lines
from ctxval._util.texts import text_of
from ctxval.campaign.fallback import error_with_fallback
from ctxval.campaign.history import history_of, predict_from
from ctxval.campaign.identity import identify
from ctxval.campaign.independent_draws import IndependentDraws
from ctxval.campaign.known import KnownExecution, is_execution_of
from ctxval.certificates import PLANNED
from ctxval.core.plan import Measurement, Plan
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Origin, State, Trial
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError, DistanceError, InputError, StoreAccessError, StoreError
from ctxval.searches import BaseSearch, Search
from ctxval.storage.store import Store


@dataclass(frozen=True, eq=False)
class OpenTrial:
    """A trial to be executed, with all that an operator needs for it.

    Attributes:
        trial: what is stored.
        plan: its task, its controller and the model's trajectory.
    """

    trial: Trial
    plan: Plan

    @property
    def number(self) -> int:
        """The trial's number."""
        return self.trial.number

    def __repr__(self) -> str:
        parts = repr(self.plan).splitlines()[1:]
        return lines(call(self, self.number, origin=self.trial.origin), *(part.strip() for part in parts))


@dataclass(frozen=True, eq=False)
class Choice:
    """The task of a new trial.

    Attributes:
        unit_point: point of the unit cube, shape ``(d,)``; None if the search is to choose it.
        origin: why this point was chosen; if the search chooses it, it says so itself.
        because: what was changed on the system since the task was executed before.
        planned_draws: how many independent draws there are to be in all, stored with each of them; 0 if what they show
            ends them, None if it is not known.
    """

    unit_point: Array | None = None
    origin: Origin = "acquisition"
    because: str | None = None
    planned_draws: int | None = None


class TrialRecorder:
    """Opens and closes the trials of one campaign.

    It keeps three things in step: the store, the list of trials and the search, which is told each trial that the
    store has and no other.

    Args:
        validation: the map p -> d(p).
        search: chooses points of the unit cube.
        store: of the trials; it is known to be of this experiment.
        seed: of the search.
        description: of the experiment, as :func:`ctxval.campaign.identity.description_of` gives it.

    Attributes:
        validation, store, description: as above; :meth:`redefine` replaces validation and description.
        search: with the optional methods of :class:`ctxval.searches.BaseSearch`.
        draws: gives the points of an audit.
    """

    def __init__(
        self, validation: Validation, search: Search, store: Store, seed: int, description: dict[str, Any]
    ) -> None:
        self.validation = validation
        self.search = BaseSearch.of(search)
        self.store = store
        self.description = description
        self.draws = IndependentDraws(store, validation, seed)
        self._seed = seed
        self._executing: set[int] = set()
        self.replay()

    # What is known

    @property
    def trials(self) -> tuple[Trial, ...]:
        """All trials in the order of asking."""
        return tuple(self._trials)

    @property
    def executions(self) -> int:
        """How many executions of S have ended, well or badly."""
        return sum(trial.executed for trial in self._trials)

    @property
    def executing(self) -> int:
        """How many trials this process is executing."""
        return len(self._executing)

    @property
    def interrupted(self) -> Trial | None:
        """The first trial whose execution was started and never ended; None if there is none."""
        begun = (trial for trial in self._trials if trial.state == "open" and trial.attempts)
        return next((trial for trial in begun if trial.number not in self._executing), None)

    def open_trial(self, number: int) -> Trial:
        """Return the open trial of this number.

        Raises:
            InputError: there is no such trial, or it is not open.
        """
        if not 0 <= number < len(self._trials):
            raise InputError(f"there is no trial {number}; the campaign has {len(self._trials)}.")
        if self._trials[number].state != "open":
            raise InputError(f"trial {number} is {self._trials[number].state}, so nothing more can be told of it.")
        return self._trials[number]

    def plan(self, trial: Trial) -> Plan:
        """Return the plan of a trial, as :meth:`ctxval.Validation.plan` makes it."""
        return self.validation.plan(self.validation.space.from_unit(trial.unit_point))

    def draw(self) -> Array:
        """Return the next independent draw of an audit, a point of the unit cube ``(d,)``."""
        return self.draws.point(self._trials)

    # In step with the store

    def replay(self) -> None:
        """Read the trials from the store and tell them to the search from the beginning."""
        self._trials = self.store.trials()
        self._changes = self.store.signature()[2]
        seed = self.draws.search_seed(self._trials) if self.search.iid else self._seed
        self.search.reset(self.validation.space.dimension, seed)
        told = history_of(self._trials)
        if told:
            values = [np.nan if trial.distance is None else trial.distance for trial in told]
            self.search.tell(np.array([trial.unit_point for trial in told]), values)
            self.search.remember([trial.note for trial in told])

    def refresh(self) -> None:
        """Learn what other processes have stored meanwhile.

        Raises:
            StoreMismatchError: the store is of another experiment now.
        """
        own = (len(self._trials), sum(trial.state == "open" for trial in self._trials), self._changes)
        stored = self.store.signature()
        if stored[2] != self._changes:
            identify(self.store, self.validation, self.description, None, False)
        if stored != own:
            self.replay()

    def redefine(self, validation: Validation, description: dict[str, Any]) -> None:
        """Go on with another distance, once the store has its values."""
        self.validation, self.description = validation, description
        self.replay()

    # Opening

    def open(self, choice: Choice) -> OpenTrial:
        """Store a new trial that somebody else executes.

        Raises:
            ModelError, DesignError: the task cannot be planned; the trial is stored as failed.
        """
        return self._open(choice, attempts=0)

    def start(self, chosen: Choice | Trial) -> OpenTrial:
        """Store the beginning of an execution: the first one of a new trial, or another one of an interrupted trial.

        Raises:
            ModelError, DesignError: the task cannot be planned; the trial is stored as failed, without an execution.
        """
        if isinstance(chosen, Choice):
            return self._open(chosen, attempts=1)
        try:
            plan = self.plan(chosen)
        except CtxvalError as error:
            self.fail(chosen, error, executed=False)
            raise
        return self.repeat(OpenTrial(chosen, plan))

    def repeat(self, opened: OpenTrial) -> OpenTrial:
        """Store that one more execution of an open trial begins."""
        trial = opened.trial
        begun = replace(trial, attempts=trial.attempts + 1)
        self.store.begin_attempt(begun, changes=self._changes)
        self._trials[trial.number] = begun
        self._executing.add(trial.number)
        return OpenTrial(begun, opened.plan)

    def _open(self, choice: Choice, attempts: int) -> OpenTrial:
        try:
            return self._store_next(choice, attempts)
        except BaseException:
            # Whatever stopped it, the search must know the stored trials and no other.
            self.replay()
            raise

    def _store_next(self, choice: Choice, attempts: int) -> OpenTrial:
        trial = self._next_trial(choice, attempts)
        try:
            plan = self.plan(trial)
        except CtxvalError as error:
            failed = replace(trial, state="failed", failure=text_of(error), attempts=0)
            self.store.record_failed_plan(failed, changes=self._changes)
            raise
        self.store.open_trial(trial, plan.model_trajectory, changes=self._changes)
        self._trials.append(trial)
        if attempts:
            self._executing.add(trial.number)
        return OpenTrial(trial, plan)

    def _next_trial(self, choice: Choice, attempts: int) -> Trial:
        """Return the trial of a choice; its point is pending for the search from now on."""
        note = None
        if choice.unit_point is None:
            unit_point, origin = self._proposal(), self._origin()
            note = self.search.note()
        else:
            unit_point, origin = choice.unit_point, choice.origin
            self.search.tell(unit_point[None], [np.nan])
        if origin == "iid" and choice.planned_draws is not None:
            note = {**(note or {}), PLANNED: choice.planned_draws}
        parameters = self.validation.space.describe_point(self.validation.space.from_unit(unit_point))
        number = len(self._trials)
        return Trial(number, origin, "open", unit_point, parameters, attempts, note=note, because=choice.because)

    def _proposal(self) -> Array:
        """Return the search's next point ``(d,)``."""
        if self.search.uses_prediction:
            self.search.use_prediction(predict_from(self.validation, self.store, self._trials))
        point: Array = np.asarray(self.search.ask(1), dtype=np.float64)
        if point.shape != (1, self.validation.space.dimension) or not ((point >= 0) & (point <= 1)).all():
            raise InputError(
                f"a search must return points of the unit cube, shape (1, {self.validation.space.dimension}), "
                f"got {point.tolist()}."
            )
        return np.asarray(point[0])

    def _origin(self) -> Origin:
        if self.search.iid:
            return "iid"
        return "initial" if len(self._trials) < self.search.initial else "acquisition"

    # Closing

    def complete(
        self,
        trial: Trial,
        measurement: Measurement,
        trajectory: Trajectory | None = None,
        seconds: float | None = None,
    ) -> Trial:
        """Store an execution with its distance, or as unmeasured; return the trial as it has ended.

        Raises:
            DistanceError: the distance gave no usable number; the execution is stored all the same.
            StoreError, InputError: the store does not take it; the message says where it is kept instead.
        """
        ended = replace(
            trial,
            state="completed" if measurement.unusable is None else "unmeasured",
            executed=True,
            distance=measurement.distance,
            failure=measurement.unusable,
            seconds=seconds,
        )
        self._close(ended, trajectory)
        if measurement.unusable is not None:
            raise DistanceError(
                f"{measurement.unusable} The execution of trial {ended.number} is stored: once the distance is mended, "
                "`ctxval remeasure STORE` measures it, without another execution."
            )
        return ended

    def fail(self, trial: Trial, reason: object, *, seconds: float | None = None, executed: bool = True) -> Trial:
        """Store why a trial failed; return the trial as it has ended.

        Raises:
            StoreError, InputError: the store does not take it; the message says where it is kept instead.
        """
        ended = replace(trial, state="failed", executed=executed, failure=text_of(reason), seconds=seconds)
        self._close(ended, None)
        return ended

    def _close(self, ended: Trial, trajectory: Trajectory | None) -> None:
        try:
            self.store.close_trial(ended, trajectory, changes=self._changes)
        except (StoreError, InputError) as error:
            raise error_with_fallback(ended, trajectory, self.store.path, error) from error
        self._executing.discard(ended.number)
        self._trials[ended.number] = ended
        if ended.distance is not None:
            self.search.tell(ended.unit_point[None], [ended.distance])

    def abandon_executions(self) -> None:
        """Forget which trials this process was executing; those that have not ended are interrupted from now on."""
        self._executing.clear()

    def add(self, known: KnownExecution, wait: float = 0.0) -> Trial | None:
        """Store an execution that was made before; return None if the store has it already.

        Args:
            known: the execution.
            wait: seconds to wait for another process that is running the store.
        """
        with self.store.sole_writer(wait):
            self.refresh()
            if any(is_execution_of(trial, known) for trial in self._trials):
                return None
            state: State = "completed" if known.distance is not None else "unmeasured"
            trial = Trial(
                len(self._trials),
                "manual",
                state if known.failed is None else "failed",
                known.unit_point,
                self.validation.space.describe_point(known.plan.parameters.points),
                executed=True,
                distance=known.distance,
                failure=known.failure,
            )
            self.store.record_known(trial, known.plan.model_trajectory, known.trajectory, changes=self._changes)
            self._trials.append(trial)
            self.search.tell(known.unit_point[None], [np.nan if known.distance is None else known.distance])
        return trial

    @contextmanager
    def not_executing(self, trial: Trial) -> Iterator[None]:
        """Refuse what is told of a trial that is being executed: how that ends is recorded by who executes it.

        Raises:
            InputError: it is.
        """
        refusal = f"trial {trial.number} is being executed, and nothing can be told of it before that has ended."
        if trial.number in self._executing:
            raise InputError(refusal)
        if not trial.attempts:
            yield  # opened by hand, and nobody else executes it
            return
        with ExitStack() as stack:
            try:
                stack.enter_context(self.store.sole_writer())
            except StoreAccessError as error:
                raise InputError(refusal) from error
            self.refresh()
            yield
