"""The ledger of a campaign: search, validation and store together; it opens trials and closes them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.describe import differences
from ctxval._util.representation import call, lines
from ctxval._util.texts import text_of
from ctxval.campaign.identity import description_of, identify, with_distance
from ctxval.campaign.independent_draws import IndependentDraws
from ctxval.campaign.recordings import (
    as_told,
    known_distance,
    measured_again,
    outcome_of,
    require_one_result,
    rescued,
    same_run,
    told_value,
)
from ctxval.certificates import PLANNED
from ctxval.core.distance import Distance
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Change, Origin, State, Trial
from ctxval.core.validation import Plan, Validation
from ctxval.errors import CtxvalError, DistanceError, InputError, StoreAccessError, StoreError
from ctxval.learning.prediction import predict_distance
from ctxval.searches import GPUCB, Prediction, Search
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


class Ledger:
    """Trials of one experiment, opened by a search's choice and closed with what happened.

    Args and errors are those of :class:`ctxval.Campaign`.
    """

    def __init__(
        self,
        validation: Validation,
        *,
        search: Search | None = None,
        store: Store | str | Path | None = None,
        seed: int = 0,
        name: str = "",
        accept_change: str | None = None,
        remeasure: bool = False,
    ) -> None:
        if not isinstance(validation, Validation):
            raise InputError(f"validation must be a Validation, got {validation!r}.")
        if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
            raise InputError(f"seed must be an integer >= 0, got {seed!r}.")
        self.validation = validation
        self.search: Search = GPUCB() if search is None else search
        if not isinstance(self.search, Search):
            raise InputError(f"search must have reset, ask and tell, got {search!r}.")
        self.seed = int(seed)
        self.name = name
        self.store = store if isinstance(store, Store) else Store(store)
        self._described = description_of(validation, self.search, self.seed, name)
        identify(self.store, validation, self._described, accept_change, remeasure)
        self._draws = IndependentDraws(self.store, validation, self.seed)
        self._executing: set[int] = set()
        self._planned: int | None = None
        self._replay()
        if remeasure:
            self.remeasure()

    def _replay(self) -> None:
        """Bring the search to where the stored trials left it."""
        self._trials = self.store.trials()
        self._changes = self.store.signature()[2]
        iid = getattr(self.search, "iid", False)
        seed = self._draws.search_seed(self._trials) if iid else self.seed
        self.search.reset(self.validation.space.dimension, seed)
        told = as_told(self._trials)
        if told:
            self.search.tell(np.array([trial.unit_point for trial in told]), [told_value(trial) for trial in told])
            if hasattr(self.search, "remember"):
                self.search.remember([trial.note for trial in told])

    # What is known

    @property
    def trials(self) -> tuple[Trial, ...]:
        """All trials in the order of asking."""
        return tuple(self._trials)

    @property
    def completed(self) -> list[Trial]:
        """The trials with a distance."""
        return [trial for trial in self._trials if trial.state == "completed"]

    @property
    def failed(self) -> list[Trial]:
        """The trials that failed."""
        return [trial for trial in self._trials if trial.state == "failed"]

    @property
    def unmeasured(self) -> list[Trial]:
        """The trials that were executed but have no distance, because it could not be measured."""
        return [trial for trial in self._trials if trial.state == "unmeasured"]

    @property
    def executions(self) -> int:
        """How many executions of S have ended, well or badly."""
        return sum(trial.executed for trial in self._trials)

    def trajectories(self, trial: Trial) -> tuple[Trajectory | None, Trajectory | None]:
        """Return the trajectories of the model and of the system in a trial; None where there is none."""
        return self.store.trajectory(trial.number, "model"), self.store.trajectory(trial.number, "system")

    # By hand

    def ask(
        self,
        parameters: Mapping[str, Any] | None = None,
        *,
        draw: bool = False,
        because: str | None = None,
        wait: float = 0.0,
    ) -> OpenTrial:
        """Open the next trial: the search's choice, the task with these parameters, or an independent uniform draw.

        Args:
            parameters: of a task that you chose yourself.
            draw: for an audit.
            because: what was changed on the system since the task of these parameters was executed before.
            wait: seconds to wait for another process that is asking.

        Raises:
            InputError: the parameters are not of the task space.
            StoreAccessError: another process is running the store.
            ModelError, DesignError: no controller could be designed and run on the model; the trial is stored as
                failed and costs no execution.
        """
        if because is not None and (parameters is None or not because.strip()):
            raise InputError('a reason such as "fuse replaced" is given for a task that was executed before.')
        with self.store.sole_writer(wait):
            self._refresh()
            self._planned = None
            if parameters is not None:
                return self._open((self._unit_point(parameters), "manual"), attempts=0, because=because)
            return self._open((self._draws.point(self._trials), "iid") if draw else None, attempts=0)

    def reopen(self, number: int) -> OpenTrial:
        """Return an open trial again, with its task and controller.

        Raises:
            InputError: there is no such trial, or it is not open.
        """
        self._refresh()
        trial = self._open_trial(number)
        return OpenTrial(trial, self._plan(trial))

    def _unit_point(self, parameters: Mapping[str, Any]) -> Array:
        return self.validation.space.to_unit(self.validation.space.point(parameters))

    def _refresh(self) -> None:
        """Learn what other processes have stored meanwhile."""
        own = (len(self._trials), sum(trial.state == "open" for trial in self._trials), self._changes)
        stored = self.store.signature()
        if stored[2] != self._changes:
            identify(self.store, self.validation, self._described, None, False)
        if stored != own:
            self._replay()

    def _open(self, given: tuple[Array, Origin] | None, attempts: int, because: str | None = None) -> OpenTrial:
        """Store a new trial ahead of its execution; one that is about to be executed counts as its first attempt."""
        try:
            return self._store_next(given, attempts, because)
        except BaseException:
            # Whatever stopped it, the search must know the stored trials and no other.
            self._replay()
            raise

    def _store_next(self, given: tuple[Array, Origin] | None, attempts: int, because: str | None) -> OpenTrial:
        note = None
        if given is None:
            unit_point, origin = self._suggestion(), self._origin()
            note = self.search.note() if hasattr(self.search, "note") else None
        else:
            unit_point, origin = given
            self.search.tell(unit_point[None], [np.nan])
        if origin == "iid" and self._planned is not None:
            note = {**(note or {}), PLANNED: self._planned}
        names = self.validation.space.describe_point(self.validation.space.from_unit(unit_point))
        trial = Trial(len(self._trials), origin, "open", unit_point, names, attempts, note=note, because=because)
        try:
            plan = self._plan(trial)
        except CtxvalError as error:
            failed = replace(trial, state="failed", failure=text_of(error), attempts=0)
            self.store.record_failed_plan(failed, changes=self._changes)
            raise
        self.store.open_trial(trial, plan.model_trajectory, changes=self._changes)
        self._trials.append(trial)
        if attempts:
            self._executing.add(trial.number)
        return OpenTrial(trial, plan)

    def tell(
        self,
        opened: OpenTrial | int,
        trajectory: Trajectory | None = None,
        *,
        distance: float | None = None,
        failed: str | None = None,
        start_tolerance: float | None = None,
    ) -> Trial:
        """Record how an open trial, or the one of this number, ended: its trajectory, its distance, or why it failed.

        Raises:
            InputError: not exactly one of them is given, the trial is not open, or the trajectory is of another task.
            ExecutionError: the trajectory is not a whole execution of the trial's task; the trial stays open.
        """
        self._refresh()
        trial = self._open_trial(opened.number if isinstance(opened, OpenTrial) else int(opened))
        if isinstance(opened, OpenTrial) and not np.array_equal(opened.trial.unit_point, trial.unit_point):
            raise InputError(f"this open trial {opened.number} is of another campaign.")
        require_one_result(trajectory, distance, failed)
        with self._not_executing(trial):
            trial = self._open_trial(trial.number)
            if failed is not None:
                return self._close(trial, failure=text_of(failed))
            if distance is not None:
                return self._close(trial, distance=known_distance(distance))
            plan = opened.plan if isinstance(opened, OpenTrial) else self._plan(trial)
            self.validation.require(plan, trajectory, start_tolerance)
            assert trajectory is not None
            return self._measure(OpenTrial(trial, plan), trajectory, None)

    @contextmanager
    def _not_executing(self, trial: Trial) -> Iterator[None]:
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
            self._refresh()
            yield

    def add(
        self,
        parameters: Mapping[str, Any],
        trajectory: Trajectory | None = None,
        *,
        distance: float | None = None,
        failed: str | None = None,
        start_tolerance: float | None = None,
        wait: float = 0.0,
    ) -> Trial | None:
        """Record an execution that was made before, with the origin manual; None where it is in the store already.

        It counts as an execution.

        Raises:
            InputError, ExecutionError: as :meth:`tell` does; nothing is stored then.
            ModelError, DesignError, DistanceError: the task cannot be validated; nothing is stored.
        """
        unit_point, plan = self.known(
            parameters, trajectory, distance=distance, failed=failed, tolerance=start_tolerance
        )
        with self.store.sole_writer(wait):
            self._refresh()
            measured, unusable = (distance, None) if trajectory is None else self._measured(plan, trajectory)
            failure = unusable if failed is None else text_of(failed)
            if any(same_run(trial, unit_point, measured, failure) for trial in self._trials):
                return None
            state: State = "failed" if failed is not None else "unmeasured" if measured is None else "completed"
            names = self.validation.space.describe_point(plan.parameters.points)
            trial = Trial(
                *(len(self._trials), "manual", state, unit_point, names, 0, True, measured, failure),
            )
            self.store.record_known(trial, plan.model_trajectory, trajectory, changes=self._changes)
            self._trials.append(trial)
            self.search.tell(unit_point[None], [np.nan if measured is None else measured])
        return trial

    def known(
        self,
        parameters: Mapping[str, Any],
        trajectory: Trajectory | None = None,
        *,
        distance: float | None = None,
        failed: str | None = None,
        tolerance: float | None = None,
    ) -> tuple[Array, Plan]:
        """Check an execution as :meth:`add` does; return its point of the unit cube and its plan."""
        require_one_result(trajectory, distance, failed)
        unit_point = self._unit_point(parameters)
        plan = self.validation.plan(self.validation.space.from_unit(unit_point))
        if trajectory is not None:
            self.validation.require(plan, trajectory, tolerance)
        if distance is not None:
            known_distance(distance)
        return unit_point, plan

    def _open_trial(self, number: int) -> Trial:
        if not 0 <= number < len(self._trials):
            raise InputError(f"there is no trial {number}; the campaign has {len(self._trials)}.")
        if self._trials[number].state != "open":
            raise InputError(f"trial {number} is {self._trials[number].state}, so nothing more can be told of it.")
        return self._trials[number]

    # What running and telling share

    def _reopen(self, trial: Trial) -> OpenTrial:
        """Plan an interrupted trial again and count one more attempt."""
        try:
            plan = self._plan(trial)
        except CtxvalError as error:
            self._close(trial, failure=text_of(error), executed=False)
            raise
        return OpenTrial(self._begin_again(trial), plan)

    def _begin_again(self, trial: Trial) -> Trial:
        begun = replace(trial, attempts=trial.attempts + 1)
        self.store.begin_attempt(begun, changes=self._changes)
        self._trials[trial.number] = begun
        self._executing.add(trial.number)
        return begun

    def _plan(self, trial: Trial) -> Plan:
        return self.validation.plan(self.validation.space.from_unit(trial.unit_point))

    def _suggestion(self) -> Array:
        if hasattr(self.search, "use_prediction"):
            self.search.use_prediction(self._prediction())
        point: Array = np.asarray(self.search.ask(1), dtype=np.float64)
        if point.shape != (1, self.validation.space.dimension) or not ((point >= 0) & (point <= 1)).all():
            raise InputError(
                f"a search must return points of the unit cube, shape (1, {self.validation.space.dimension}), "
                f"got {point.tolist()}."
            )
        return np.asarray(point[0])

    def _prediction(self) -> Prediction | None:
        """Return the distance that the trajectories executed so far predict."""
        executed = [
            (trial.unit_point, trajectory)
            for trial in self.completed
            if (trajectory := self.store.trajectory(trial.number, "system")) is not None
        ]
        return predict_distance(self.validation, executed)

    def _origin(self) -> Origin:
        if getattr(self.search, "iid", False):
            return "iid"
        return "initial" if len(self._trials) < getattr(self.search, "initial", 0) else "acquisition"

    def _measure(self, opened: OpenTrial, trajectory: Trajectory, seconds: float | None) -> Trial:
        """Store an execution with its distance, or as unmeasured.

        Raises:
            DistanceError: the distance gave nothing usable; the execution is stored all the same.
        """
        distance, unusable = self._measured(opened.plan, trajectory)
        ended = self._close(opened.trial, trajectory, distance=distance, unusable=unusable, seconds=seconds)
        if unusable is not None:
            raise DistanceError(
                f"{unusable} The execution of trial {ended.number} is stored: once the distance is mended, "
                "`ctxval remeasure STORE` measures it, without another execution."
            )
        return ended

    def _measured(self, plan: Plan, trajectory: Trajectory) -> tuple[float | None, str | None]:
        """Return the distance, or why it could not be measured."""
        try:
            return self.validation.measure(plan, trajectory), None
        except DistanceError as error:
            return None, text_of(error)

    def _close(
        self,
        trial: Trial,
        trajectory: Trajectory | None = None,
        *,
        distance: float | None = None,
        failure: str | None = None,
        unusable: str | None = None,
        seconds: float | None = None,
        executed: bool = True,
    ) -> Trial:
        ended = replace(
            trial,
            state="failed" if failure is not None else "completed" if unusable is None else "unmeasured",
            executed=executed,
            distance=distance,
            failure=failure if unusable is None else unusable,
            seconds=seconds,
        )
        try:
            self.store.close_trial(ended, trajectory, changes=self._changes)
        except (StoreError, InputError) as error:
            raise rescued(ended, trajectory, self.store.path, error) from error
        self._executing.discard(trial.number)
        self._trials[trial.number] = ended
        if distance is not None:
            self.search.tell(trial.unit_point[None], [distance])
        return ended

    # Measuring again

    def remeasure(self, distance: Distance | None = None) -> list[Trial]:
        """Measure the distance of every stored execution anew, without an execution; return the trials that changed.

        The values of before stay in the store's history. A distance that was told without a trajectory cannot be
        measured anew: if the definition has changed, its trial has no distance from then on.

        Args:
            distance: the distance from now on; the one of the validation if it is not given.

        Raises:
            DistanceError: the distance of a trial that had one cannot be measured any more; nothing is changed.
            StoreAccessError: another process is running the store.
        """
        before = self.validation, self._described
        if distance is not None:
            self.validation = self.validation.with_distance(distance)
            self._described = with_distance(self._described, distance)
        try:
            with self.store.sole_writer():
                while (changed := self._remeasured()) is None:
                    pass  # somebody has told of a trial meanwhile
        except BaseException:
            self.validation, self._described = before
            raise
        self._replay()
        return changed

    def _remeasured(self) -> list[Trial] | None:
        """Store what is measured anew; return the trials that changed, None if the store has changed meanwhile."""
        seen = self.store.signature()
        self._replay()
        differing = differences(self.store.description(), self._described)
        other = any(path.startswith("validation.distance") for path, _ in differing)
        changed = measured_again(self.validation, self._trials, self.trajectories, redefined=other)
        if not changed and not other:
            return changed
        old = {str(trial.number): outcome_of(self._trials[trial.number]) for trial in changed}
        change = Change("remeasured", "the distance has changed" if other else "asked for", {"before": old})
        return changed if self.store.remeasure(changed, self._described, change, seen) else None
