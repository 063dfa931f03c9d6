"""The executions of a comparison: one at a time, and shared by all candidates whose controllers agree."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval.campaign.choices import Choice
from ctxval.campaign.execution import RetryPolicy, Schedule, execute_schedule
from ctxval.comparison.candidates import Candidate, TrialNote, is_shared
from ctxval.core.plan import Plan, gives_inputs
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.errors import CtxvalError, DistanceError

OnTrial = Callable[[str, Trial], None]
"""Called with the name of a candidate and each of its trials that has ended."""

NoteFor = Callable[[Candidate, Trial, TrialNote], TrialNote]
"""Returns the note of a shared trial, from the trial that was executed and its note."""


@dataclass(eq=False)
class Executions:
    """Executes tasks for candidates, and records each execution for all candidates whose controllers agree."""

    candidates: Sequence[Candidate]
    note_for: NoteFor
    on_trial: OnTrial | None = None
    kept: Callable[[], tuple[dict[str, Any], ...]] = tuple
    _examined: set[tuple[str, int, str]] = field(default_factory=set, init=False)
    _hidden: Array | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        for candidate in self.candidates:
            candidate.recorder.dynamics.elsewhere = partial(self.elsewhere, candidate)

    @property
    def count(self) -> int:
        """The number of executions of S that have ended; a shared execution counts once."""
        return sum(len(candidate.executed) for candidate in self.candidates)

    @property
    def steps(self) -> int:
        """The number of executions that this comparison has started."""
        notes = [TrialNote.of(trial) for candidate in self.candidates for trial in candidate.trials]
        return max((note.step + 1 for note in notes if note is not None), default=0)

    def history(self, without: Array | None = None) -> list[tuple[Trial, Trajectory]]:
        """Return all executions in the order in which they were made, each one once."""
        executed = [
            ((-1 if (note := TrialNote.of(trial)) is None else note.step, row, trial.number), trial, trajectory)
            for row, candidate in enumerate(self.candidates)
            for trial, trajectory in candidate.trajectories()
            if not is_shared(trial) and (without is None or not np.array_equal(trial.unit_point, without))
        ]
        return [(trial, trajectory) for _, trial, trajectory in sorted(executed, key=lambda row: row[0])]

    def execute(self, candidate: Candidate, choice: Choice, note: TrialNote, *, predicts: bool) -> None:
        """Execute one task, and record the execution for the others."""
        stored = replace(note, decided=self.kept()).to_note()
        whole = replace(choice, note={**(choice.note or {}), **stored}, planned_draws=0)
        self._run(candidate, whole, predicts)
        self.share()

    def resume(self) -> None:
        """End what was interrupted: repeat interrupted executions, and record those that are shared."""
        for candidate in self.candidates:
            candidate.campaign.refresh()
            if candidate.recorder.interrupted is not None:
                self._run(candidate, None, False)
        self.share()

    def _run(self, candidate: Candidate, choice: Choice | None, predicts: bool) -> None:
        waiting = [] if choice is None else [choice]
        schedule = Schedule(candidate.recorder, lambda: waiting.pop() if waiting else None, expected=None)
        with candidate.recorder.predicting(predicts), self.hiding(None if choice is None else choice.unit_point):
            execute_schedule(schedule, None, lambda trial: self._ended(candidate, trial), RetryPolicy())

    def _ended(self, candidate: Candidate, trial: Trial) -> None:
        if self.on_trial is not None:
            self.on_trial(candidate.name, trial)

    # Sharing

    def share(self) -> None:
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
                        self._share(candidate, trial, trajectory, note, other)

    def _share(
        self, candidate: Candidate, trial: Trial, trajectory: Trajectory, note: TrialNote, other: Candidate
    ) -> None:
        known = other.trial_at(trial.unit_point)
        if known is not None and (known.state != "open" or known.attempts):
            return
        try:
            plan = other.recorder.plan(trial)
        except CtxvalError:  # this candidate has no controller for the task
            return
        if not agrees(plan, trajectory):
            return
        with other.campaign.store.sole_writer(), self.hiding(trial.unit_point):
            if known is None:
                source = candidate.name, trial.number
                copied = replace(self.note_for(other, trial, note), shared=source, decided=self.kept()).to_note()
                choice = Choice(
                    trial.unit_point, trial.origin, planned_draws=0, note=copied, parameters=trial.parameters
                )
                with other.recorder.predicting(note.question == "worst"):
                    known = other.recorder.open(choice).trial
            try:
                ended = other.recorder.complete(known, other.recorder.validation.accept(plan, trajectory), trajectory)
            except DistanceError:  # it is stored as unmeasured
                return
        self._ended(other, ended)

    @contextmanager
    def hiding(self, point: Array | None) -> Iterator[None]:
        """Leave out the executions of a task from what predictions of its execution are learned from."""
        before, self._hidden = self._hidden, point
        try:
            yield
        finally:
            self._hidden = before

    def elsewhere(self, candidate: Candidate) -> list[Trajectory]:
        """Return the executions that are in no trial of a candidate."""
        known = {note.shared for trial in candidate.trials if (note := TrialNote.of(trial)) is not None and note.shared}
        return [
            trajectory
            for other in self.candidates
            if other is not candidate
            for trial, trajectory in other.trajectories()
            if not is_shared(trial)
            and (other.name, trial.number) not in known
            and (self._hidden is None or not np.array_equal(trial.unit_point, self._hidden))
        ]


def agrees(plan: Plan, trajectory: Trajectory) -> bool:
    """Return whether an execution is recorded for the candidate with this plan, too."""
    return gives_inputs(plan, trajectory, 1e-9)  # a share of the largest magnitude of each input
