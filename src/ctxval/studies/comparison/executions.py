"""The executions of a comparison: one at a time, and shared by all candidates whose controllers agree."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from ctxval._util.arrays import Array
from ctxval.campaign.choices import Choice, Execution
from ctxval.campaign.execution import RetryPolicy, Schedule, execute_schedule
from ctxval.core.plan import Plan, gives_inputs
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.errors import CtxvalError, DistanceError
from ctxval.studies.comparison.candidates import Candidate, Decision, TrialNote, is_shared

OnTrial = Callable[[str, Trial], None]
"""Called with the name of a candidate and each of its trials that has ended."""


@dataclass(eq=False)
class Executions:
    """Executes tasks for candidates, and records each execution for all candidates whose controllers agree.

    Attributes:
        candidates: the candidates.
        most: a number that no distance can exceed; None if none is stated.
        on_trial: called with each trial that has ended.
        decided: the decisions on d* so far, by the names of the candidates; each new trial keeps them in its note.
    """

    candidates: Sequence[Candidate]
    most: float | None = None
    on_trial: OnTrial | None = None
    decided: dict[tuple[str, str], Decision] = field(default_factory=dict, init=False)
    _examined: set[tuple[str, int, str]] = field(default_factory=set, init=False)
    _hidden: Array | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        for candidate in self.candidates:
            candidate.recorder.dynamics.elsewhere = partial(self._elsewhere, candidate)
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

    def history(self, without: Array | None = None) -> list[tuple[Array, Trajectory]]:
        """Return all executed tasks in the order in which they were executed, each execution once."""
        executed = []
        for row, candidate in enumerate(self.candidates):
            for trial, trajectory in candidate.trajectories():
                note = TrialNote.of(trial)
                hidden = without is not None and np.array_equal(trial.unit_point, without)
                if not hidden and (note is None or note.shared is None):
                    order = (-1 if note is None else note.step, row, trial.number)
                    executed.append((order, trial.unit_point, trajectory))
        return [(point, trajectory) for _, point, trajectory in sorted(executed, key=lambda item: item[0])]

    def predicted(self, candidate: Candidate, note: TrialNote, point: Array) -> TrialNote:
        """Return the note of a draw with what the executions of all other tasks predict for a candidate."""
        prediction = candidate.of_draw(self.history(without=point), point, note.draw or 0, self.most)
        value, centre = (None, None) if prediction is None else prediction
        return TrialNote(note.step, "mean", note.draw, value, centre)

    def execute(self, candidate: Candidate, choice: Choice, note: TrialNote, *, predicts: bool) -> None:
        """Execute one task, and record the execution for the others."""
        stored = replace(note, decided=tuple(self.decided.values())).to_note()
        self._run(candidate, replace(choice, note={**(choice.note or {}), **stored}, planned_draws=0), predicts)
        self._share_all()

    def resume(self) -> None:
        """End what was interrupted: repeat interrupted executions, and record those that are shared."""
        for candidate in self.candidates:
            candidate.campaign.refresh()
            if candidate.recorder.interrupted is not None:
                self._run(candidate, None, False)
        self._share_all()

    def _run(self, candidate: Candidate, choice: Choice | None, predicts: bool) -> None:
        waiting = [] if choice is None else [choice]
        schedule = Schedule(candidate.recorder, lambda: waiting.pop() if waiting else None, expected=None)
        with candidate.recorder.predicting(predicts), self._hiding(None if choice is None else choice.unit_point):
            execute_schedule(schedule, None, lambda trial: self._ended(candidate, trial), RetryPolicy())

    def _ended(self, candidate: Candidate, trial: Trial) -> None:
        if self.on_trial is not None:
            self.on_trial(candidate.name, trial)

    def _share_all(self) -> None:
        """Record executions for the candidates that would have given the system the same inputs."""
        for candidate in self.candidates:
            for trial, trajectory in list(candidate.trajectories()):
                note = TrialNote.of(trial)
                if note is None or note.shared is not None:
                    continue
                for other in self.candidates:
                    key = (candidate.name, trial.number, other.name)
                    if other is not candidate and key not in self._examined:
                        self._examined.add(key)
                        self._share(trial, trajectory, replace(note, shared=key[:2]), other)

    def _share(self, trial: Trial, trajectory: Trajectory, note: TrialNote, other: Candidate) -> None:
        same = [known for known in other.trials if np.array_equal(known.unit_point, trial.unit_point)]
        copy = same[-1] if same else None
        if copy is not None and (copy.state != "open" or copy.attempts):
            return
        try:
            plan = other.recorder.plan(trial)
        except CtxvalError:  # this candidate has no controller for the task
            return
        if not agrees(plan, trajectory):
            return
        with other.campaign.store.sole_writer(), self._hiding(trial.unit_point):
            if copy is None:
                of_draw = note.question == "mean"
                made = self.predicted(other, note, trial.unit_point) if of_draw else replace(note, predicted=None)
                stored = replace(made, shared=note.shared, decided=tuple(self.decided.values())).to_note()
                choice = Choice(
                    trial.unit_point, trial.origin, planned_draws=0, note=stored, parameters=trial.parameters
                )
                with other.recorder.predicting(not of_draw):
                    copy = other.recorder.open(choice).trial
            try:
                ended = other.recorder.close(copy, Execution(trajectory).measured(other.recorder.validation, plan))
            except DistanceError:  # it is stored as unmeasured
                return
        self._ended(other, ended)

    @contextmanager
    def _hiding(self, point: Array | None) -> Iterator[None]:
        """Leave out the executions of a task from what predictions of its execution are learned from."""
        before, self._hidden = self._hidden, point
        try:
            yield
        finally:
            self._hidden = before

    def _elsewhere(self, candidate: Candidate) -> list[Trajectory]:
        """Return the executions that are in no trial of a candidate."""
        copied = {note.shared for _, note in candidate.noted}
        return [
            trajectory
            for other in self.candidates
            if other is not candidate
            for trial, trajectory in other.trajectories()
            if not is_shared(trial)
            and (other.name, trial.number) not in copied
            and (self._hidden is None or not np.array_equal(trial.unit_point, self._hidden))
        ]


def agrees(plan: Plan, trajectory: Trajectory) -> bool:
    """Return whether an execution is recorded for the candidate with this plan, too."""
    return gives_inputs(plan, trajectory, 1e-9)  # a share of the largest magnitude of each input
