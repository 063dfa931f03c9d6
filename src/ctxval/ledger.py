"""The ledger of a campaign: search, validation and store together; it opens trials and closes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from ctxval.arrays import Array
from ctxval.describe import describe
from ctxval.errors import CtxvalError, DistanceError, InputError, StoreAccessError
from ctxval.prediction import predict_distance
from ctxval.recording import kept_beside, known_distance, require_one_result, require_recording, same_run
from ctxval.searches import GPUCB, Prediction, Search
from ctxval.store import Store
from ctxval.trajectory import Trajectory
from ctxval.trial import Origin, State, Trial
from ctxval.validation import START, Plan, Validation

_AUDIT = 0x6175
"""Marks the randomness of an audit's draws; searches mark streams of theirs with small numbers."""


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
        self.store.identify(
            {
                "name": name,
                "seed": self.seed,
                "search": describe(self.search),
                "validation": validation.describe(),
            }
        )
        self._replay()

    def _replay(self) -> None:
        """Bring the search to where the stored trials left it."""
        self.search.reset(self.validation.space.dimension, self.seed)
        self._trials = self.store.trials()
        told = _as_told(self._trials)
        if told:
            self.search.tell(np.array([trial.unit_point for trial in told]), [_value(trial) for trial in told])
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
    def executions(self) -> int:
        """How many executions of S have ended, well or badly."""
        return sum(trial.executed for trial in self._trials)

    def trajectories(self, trial: Trial) -> tuple[Trajectory | None, Trajectory | None]:
        """Return the trajectories of the model and of the system in a trial; None where there is none."""
        return self.store.trajectory(trial.number, "model"), self.store.trajectory(trial.number, "system")

    # By hand

    def ask(self, parameters: Mapping[str, Any] | None = None, *, draw: bool = False, wait: float = 0.0) -> OpenTrial:
        """Open the next trial: the search's choice, the task with these parameters, or an independent uniform draw.

        Args:
            parameters: of a task that you chose yourself.
            draw: for an audit.
            wait: seconds to wait for another process that is asking.

        Raises:
            InputError: the parameters are not of the task space.
            StoreAccessError: another process is running the store.
            ModelError, DesignError: no controller could be designed and run on the model; the trial is stored as
                failed and costs no execution.
        """
        with self.store.sole_writer(wait):
            self._refresh()
            if parameters is not None:
                return self._open((self._unit_point(parameters), "manual"), attempts=0)
            return self._open((self._draw(), "iid") if draw else None, attempts=0)

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

    def _draw(self) -> Array:
        # Apart from the search's own randomness, which is that of [seed, number].
        rng = np.random.default_rng(np.random.SeedSequence([self.seed, len(self._trials), _AUDIT]))
        return rng.random(self.validation.space.dimension)

    def _refresh(self) -> None:
        """Learn what other processes have stored meanwhile."""
        own = (len(self._trials), sum(trial.state == "open" for trial in self._trials))
        if self.store.signature() != own:
            self._replay()

    def _open(self, given: tuple[Array, Origin] | None, attempts: int) -> OpenTrial:
        """Store a new trial ahead of its execution; one that is about to be executed counts as its first attempt."""
        try:
            return self._store_next(given, attempts)
        except BaseException:
            # Whatever stopped it, the search must know the stored trials and no other.
            self._replay()
            raise

    def _store_next(self, given: tuple[Array, Origin] | None, attempts: int) -> OpenTrial:
        note = None
        if given is None:
            unit_point, origin = self._suggestion(), self._origin()
            note = self.search.note() if hasattr(self.search, "note") else None
        else:
            unit_point, origin = given
            self.search.tell(unit_point[None], [np.nan])
        names = self.validation.space.describe_point(self.validation.space.from_unit(unit_point))
        trial = Trial(len(self._trials), origin, "open", unit_point, names, attempts, note=note)
        try:
            plan = self._plan(trial)
        except CtxvalError as error:
            self.store.record_failed_plan(replace(trial, state="failed", failure=text_of(error), attempts=0))
            raise
        self.store.open_trial(trial, plan.model_trajectory)
        self._trials.append(trial)
        return OpenTrial(trial, plan)

    def tell(
        self,
        opened: OpenTrial | int,
        trajectory: Trajectory | None = None,
        *,
        distance: float | None = None,
        failed: str | None = None,
        start_tolerance: float = START,
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
        if failed is not None:
            return self._close(trial, failure=text_of(failed))
        if distance is not None:
            return self._close(trial, distance=known_distance(distance))
        plan = opened.plan if isinstance(opened, OpenTrial) else self._plan(trial)
        require_recording(plan, trajectory, start_tolerance)
        assert trajectory is not None
        return self._measure(OpenTrial(trial, plan), trajectory, None)

    def add(
        self,
        parameters: Mapping[str, Any],
        trajectory: Trajectory | None = None,
        *,
        distance: float | None = None,
        failed: str | None = None,
        start_tolerance: float = START,
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
        if trajectory is not None and failed is None:
            distance = self.validation.measure(plan, trajectory)
        with self.store.sole_writer(wait):
            self._refresh()
            if any(same_run(trial, unit_point, distance, failed) for trial in self._trials):
                return None
            state: State = "failed" if distance is None else "completed"
            names = self.validation.space.describe_point(plan.parameters.points)
            trial = Trial(
                *(len(self._trials), "manual", state, unit_point, names, 0, True, distance),
                None if failed is None else text_of(failed),
            )
            self.store.record_known(trial, plan.model_trajectory, trajectory)
            self._trials.append(trial)
            self.search.tell(unit_point[None], [np.nan if distance is None else distance])
        return trial

    def known(
        self,
        parameters: Mapping[str, Any],
        trajectory: Trajectory | None = None,
        *,
        distance: float | None = None,
        failed: str | None = None,
        tolerance: float = START,
    ) -> tuple[Array, Plan]:
        """Check an execution as :meth:`add` does; return its point of the unit cube and its plan."""
        require_one_result(trajectory, distance, failed)
        unit_point = self._unit_point(parameters)
        plan = self.validation.plan(self.validation.space.from_unit(unit_point))
        if trajectory is not None:
            require_recording(plan, trajectory, tolerance)
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
        self.store.begin_attempt(begun)
        self._trials[trial.number] = begun
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
        try:
            distance = self.validation.measure(opened.plan, trajectory)
        except DistanceError as error:
            self._close(opened.trial, trajectory, failure=text_of(error), seconds=seconds)
            raise
        return self._close(opened.trial, trajectory, distance=distance, seconds=seconds)

    def _close(
        self,
        trial: Trial,
        trajectory: Trajectory | None = None,
        *,
        distance: float | None = None,
        failure: str | None = None,
        seconds: float | None = None,
        executed: bool = True,
    ) -> Trial:
        ended = replace(
            trial,
            state="completed" if failure is None else "failed",
            executed=executed,
            distance=distance,
            failure=failure,
            seconds=seconds,
        )
        try:
            self.store.close_trial(ended, trajectory)
        except StoreAccessError as error:
            self._rescue(ended, trajectory, error)
        self._trials[trial.number] = ended
        if distance is not None:
            self.search.tell(trial.unit_point[None], [distance])
        return ended

    def _rescue(self, trial: Trial, trajectory: Trajectory | None, error: StoreAccessError) -> NoReturn:
        """Keep an execution that was paid for where its store takes no more."""
        if trajectory is None:
            raise error
        path = kept_beside(trajectory, trial.number, self.store.path)
        if path is not None:
            raise StoreAccessError(
                f"{error} The execution of trial {trial.number} is kept in {path}: once the store can be written "
                f"again, say `ctxval tell STORE {trial.number} --npz {path}` before anything else."
            ) from error
        raise StoreAccessError(f"{error} The execution of trial {trial.number} could not be kept either.") from error


def _as_told(trials: list[Trial]) -> list[Trial]:
    """Return the trials as a search keeps them: of a point that waits for its value there is one."""
    told: list[Trial] = []
    waiting: dict[bytes, int] = {}
    for trial in trials:
        key = trial.unit_point.tobytes()
        if key in waiting:
            slot = waiting[key]
            told[slot] = replace(trial, note=told[slot].note)
        else:
            slot = waiting[key] = len(told)
            told.append(trial)
        if trial.distance is not None:
            del waiting[key]
    return told


def _value(trial: Trial) -> float:
    return np.nan if trial.distance is None else trial.distance


def text_of(reason: object) -> str:
    """Return a reason as text that every file can hold; a serial line may have put anything into it."""
    return str(reason).encode("utf-8", "backslashreplace").decode()
