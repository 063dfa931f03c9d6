"""The candidates of a comparison, which are campaigns on one system, their predictions, and their executions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from pydantic import TypeAdapter, ValidationError

from ctxval._util.arrays import Array
from ctxval._util.describe import describe, differences
from ctxval._util.progress import stage
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.choices import Choice, Execution
from ctxval.campaign.execution import ExecutionLoop
from ctxval.campaign.history import executed_trials
from ctxval.core.plan import gives_inputs
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.core.trial_note import TrialNote
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError, DistanceError, InputError
from ctxval.learning import DynamicsStudy
from ctxval.searches import Prediction

Question = Literal["worst", "mean"]

Executed = Sequence[tuple[Array, Trajectory]]  #: executed tasks, points ``(d,)`` of the unit cube, with trajectories
OnTrial = Callable[[str, Trial], None]  #: called with the name of a candidate and each of its trials that has ended


@dataclass(frozen=True)
class Decision:
    """A decision that one candidate has the smaller d*: its bound is at most an executed distance of the other one."""

    smaller: str
    larger: str
    bound: float
    distance: float
    certificate: str
    executions: int  #: the number of executions of all candidates, when it was decided


@dataclass(frozen=True)
class ComparisonNote:
    """What a comparison stores with a trial, before its execution."""

    step: int  #: the number of the execution among those of all candidates, from 0; a shared execution has one number
    question: Question
    draw: int | None = None  #: the number of the task among the independent draws; None if the task is no draw
    predicted: float | None = None  #: the distance that was predicted for a draw, and its mean over others
    centre: float | None = None
    shared: tuple[str, int] | None = None  #: the candidate and the trial that executed the task; None if this one did
    decided: tuple[Decision, ...] = ()  #: what had been decided about the largest distances

    def to_json(self) -> dict[str, Any]:
        """Return what the note of the trial has."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    @staticmethod
    def of(trial: Trial) -> ComparisonNote | None:
        """Return what a comparison stored with a trial; None if it stored nothing."""
        try:
            return _NOTES.validate_python(trial.note.comparison)
        except ValidationError:
            return None


_NOTES = TypeAdapter(ComparisonNote)


@dataclass(eq=False)
class Candidate:
    """One model, controller or distance, with its campaign. The executions of all candidates teach what it predicts."""

    name: str
    campaign: Campaign
    seed: int

    def __post_init__(self) -> None:
        validation = self.campaign.validation
        self.recorder = self.campaign.recorder
        self._space, self._study = validation.space, DynamicsStudy(validation, self.seed)
        self._batched = bool(getattr(validation.synthesizer, "batched", False))
        self._last: tuple[tuple[int, ...], Prediction | None] | None = None

    @property
    def noted(self) -> list[tuple[Trial, ComparisonNote]]:
        """The trials that a comparison has opened, with their notes."""
        return [(trial, note) for trial in self.recorder.trials if (note := ComparisonNote.of(trial)) is not None]

    @property
    def largest(self) -> float:
        """The largest executed distance; 0 if there is none."""
        return self.recorder.trials.largest

    def executed(self, *, shared: bool = False) -> list[Trial]:
        """Return the trials whose execution has ended, with or without success: its own, or those of others."""
        copied = {trial.number for trial, note in self.noted if note.shared is not None}
        return [trial for trial in self.recorder.trials if trial.executed and (trial.number in copied) == shared]

    def trajectories(self) -> list[tuple[Trial, ComparisonNote | None, Trajectory]]:
        """Return the completed trials that are its own, with their notes and trajectories; the store keeps these."""
        recorded = executed_trials(self.campaign.store, self.recorder.trials)
        noted = [(trial, ComparisonNote.of(trial), trajectory) for trial, trajectory in recorded]
        return [each for each in noted if each[1] is None or each[1].shared is None]

    def highest(self, executed: Executed) -> tuple[float, Array] | None:
        """Return the largest predicted distance and its task ``(d,)``; None if nothing can be predicted."""
        if (prediction := self._prediction(executed)) is None:
            return None
        # The number identifies a random stream, which is none of those of trials.
        rng, count = np.random.default_rng([self.seed, 0x706F]), 400 if self._batched else 48
        points = rng.random((count, self._space.dimension))
        snapped = rng.random(points.shape) < 0.5 * (np.arange(count) % 2)[:, None]  # maxima often lie at bounds
        points = self._space.candidates(np.where(snapped, np.round(points), points))
        with stage("predicting distances", len(points), "designs"):
            expected = prediction.expected(points)[0]
        best = int(np.argmax(np.where(np.isfinite(expected), expected, -np.inf)))
        return (float(expected[best]), points[best]) if np.isfinite(expected[best]) else None

    def of_draw(self, executed: Executed, point: Array, draw: int, most: float | None) -> tuple[float, float] | None:
        """Return the prediction of a draw and its mean over other tasks; None if nothing can be predicted."""
        if (prediction := self._prediction(executed)) is None:
            return None
        # The other tasks are new for each draw, so that the error of the mean has the expectation 0.
        rng = np.random.default_rng([self.seed, draw, 0x6365])
        others = self._space.unit_draws(200 if self._batched else 24, rng)
        with stage("predicting distances", len(others) + 1, "designs"):
            expected = prediction.expected(np.concatenate([others, point[None]]))[0]
        # Learned dynamics may diverge.
        limit = most if most is not None else (2.0 * self.largest if self.largest > 0 else np.inf)
        usual = 0.5 * limit if np.isfinite(limit) else 0.0
        values = np.clip(np.where(np.isfinite(expected), expected, usual), 0.0, limit)
        return float(values[-1]), float(values[:-1].mean())

    def _prediction(self, executed: Executed) -> Prediction | None:
        key = tuple(id(trajectory) for _, trajectory in executed)
        if self._last is None or self._last[0] != key:
            self._last = key, None
            with suppress(Exception):  # the user's parts, at states that no execution has reached
                self._last = key, self._study.prediction_of(self._study.learn(executed), executed)
        return self._last[1]


@dataclass(eq=False)
class Executions:
    """Executes tasks one at a time, and records each execution for all candidates whose controllers agree."""

    candidates: Sequence[Candidate]
    most: float | None  #: a number that no distance can exceed; None if none is stated
    on_trial: OnTrial
    #: the decisions on d* so far, by the names of the candidates; each new trial keeps them in its note
    decided: dict[tuple[str, str], Decision] = field(default_factory=dict, init=False)
    _examined: set[tuple[str, int, str]] = field(default_factory=set, init=False)
    _hidden: Array | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        for candidate in self.candidates:
            candidate.recorder.dynamics.extra_recordings = partial(self._elsewhere, candidate)
            for _, note in candidate.noted:
                self.decided |= {(decision.smaller, decision.larger): decision for decision in note.decided}

    @property
    def count(self) -> int:
        """The number of executions of S that have ended; a shared execution counts once."""
        return sum(len(candidate.executed()) for candidate in self.candidates)

    @property
    def steps(self) -> int:
        """The number of executions that this comparison has started."""
        return max((note.step + 1 for candidate in self.candidates for _, note in candidate.noted), default=0)

    def require_possible(self) -> None:
        """Check that no executed distance refutes the stated largest one, with which decisions would be false."""
        largest = max(candidate.largest for candidate in self.candidates)
        if self.most is not None and largest > self.most:
            raise InputError(f"largest_possible is {self.most:g}, but a distance of {largest:.6g} was executed.")

    def history(self, without: Array | None = None) -> list[tuple[Array, Trajectory]]:
        """Return all executed tasks but one in the order in which they were executed, each execution once."""
        executed = [
            ((-1 if note is None else note.step, row, trial.number), (trial.unit_point, trajectory))
            for row, candidate in enumerate(self.candidates)
            for trial, note, trajectory in candidate.trajectories()
            if without is None or not np.array_equal(trial.unit_point, without)
        ]
        return [item for _, item in sorted(executed, key=lambda pair: pair[0])]

    def predicted(self, candidate: Candidate, note: ComparisonNote, point: Array) -> ComparisonNote:
        """Return the note of a draw with what the executions of all other tasks predict for a candidate."""
        prediction = candidate.of_draw(self.history(without=point), point, note.draw or 0, self.most)
        return ComparisonNote(note.step, "mean", note.draw, *(prediction or ()))

    def execute(self, candidate: Candidate, choice: Choice, note: ComparisonNote, *, predicts: bool) -> None:
        """Execute one task, and record the execution for the others."""
        stored = replace(choice.note, comparison=self._stored(note))
        self._run(candidate, replace(choice, note=stored, planned_draws=0), predicts)
        self._share_all()

    def resume(self) -> None:
        """End what was interrupted: repeat interrupted executions, and record those that are shared."""
        for candidate in self.candidates:
            candidate.campaign.refresh()
            if candidate.recorder.interrupted is not None:
                self._run(candidate, None, False)
        self._share_all()

    def _stored(self, note: ComparisonNote) -> dict[str, Any]:
        return replace(note, decided=tuple(self.decided.values())).to_json()

    def _run(self, candidate: Candidate, choice: Choice | None, predicts: bool) -> None:
        waiting, on_trial = [] if choice is None else [choice], partial(self.on_trial, candidate.name)
        with candidate.recorder.predicting(predicts), self._hiding(None if choice is None else choice.unit_point):
            ExecutionLoop(candidate.recorder, lambda: waiting.pop() if waiting else None, on_trial=on_trial).run()

    def _share_all(self) -> None:
        """Record executions for the candidates that would have given the system the same inputs."""
        for candidate in self.candidates:
            for trial, note, trajectory in candidate.trajectories():
                for other in self.candidates:
                    key = (candidate.name, trial.number, other.name)
                    if note is not None and other is not candidate and key not in self._examined:
                        self._examined.add(key)
                        self._share(trial, trajectory, replace(note, shared=key[:2]), other)

    def _share(self, trial: Trial, trajectory: Trajectory, note: ComparisonNote, other: Candidate) -> None:
        known = reversed(other.recorder.trials)
        copy = next((each for each in known if np.array_equal(each.unit_point, trial.unit_point)), None)
        if copy is not None and (copy.state != "open" or copy.attempts):
            return
        try:
            plan = other.recorder.plan(trial)
        except CtxvalError:  # this candidate has no controller for the task
            return
        if not gives_inputs(plan, trajectory, 1e-9):
            return
        with other.campaign.store.sole_writer(), self._hiding(trial.unit_point):
            if copy is None:
                of_draw, parameters = note.question == "mean", trial.parameters
                made = self.predicted(other, note, trial.unit_point) if of_draw else replace(note, predicted=None)
                stored = TrialNote(comparison=self._stored(replace(made, shared=note.shared)))
                choice = Choice(trial.unit_point, trial.origin, planned_draws=0, note=stored, parameters=parameters)
                with other.recorder.predicting(not of_draw):
                    copy = other.recorder.open(choice).trial
            try:
                ended = other.recorder.close(copy, Execution(trajectory).measured(other.recorder.validation, plan))
            except DistanceError:  # it is stored as unmeasured
                return
        self.on_trial(other.name, ended)

    @contextmanager
    def _hiding(self, point: Array | None) -> Iterator[None]:
        """Leave out the executions of a task from what predictions of its execution are learned from."""
        before, self._hidden = self._hidden, point
        try:
            yield
        finally:
            self._hidden = before

    def _elsewhere(self, candidate: Candidate) -> list[Trajectory]:
        copied = {note.shared for _, note in candidate.noted}
        return [
            trajectory
            for other in self.candidates
            if other is not candidate
            for trial, _, trajectory in other.trajectories()
            if (other.name, trial.number) not in copied
            and (self._hidden is None or not np.array_equal(trial.unit_point, self._hidden))
        ]


def require_comparable(candidates: Mapping[str, Validation]) -> None:
    """Check that the candidates have the same system, the same tasks and distances of the same unit."""
    if len(candidates) < 2:
        raise InputError(f"a comparison needs at least two candidates, got {len(candidates)}.")
    if any(getattr(candidate.system, "manual", False) for candidate in candidates.values()):
        raise InputError("candidates cannot be compared on a system that people execute.")

    def described(validation: Validation) -> dict[str, Any]:
        space = validation.space
        probes = (space.low, 0.5 * (space.low + space.high), space.high)
        tasks = [describe(validation.task(space.parameters(point))) for point in probes]
        return {**validation.describe(), "tasks": tasks}

    (first, expected), *others = candidates.items()
    of_first = described(expected)
    for other, validation in others:
        of_other = described(validation)
        for part, what in (("space", "task spaces"), ("tasks", "tasks"), ("system", "systems")):
            unequal = next(differences(of_first[part], of_other[part], part), None)
            if unequal is not None:
                raise InputError(
                    f"{first} and {other} must have the same {what}, but {unequal[0]} differs: only models, "
                    "controllers and distances on one system can be compared."
                )
        if validation.labels.units != expected.labels.units:
            raise InputError(
                f"the distances of {first} and {other} must have the same unit, got "
                f"{expected.labels.units or 'none'!r} and {validation.labels.units or 'none'!r}."
            )
