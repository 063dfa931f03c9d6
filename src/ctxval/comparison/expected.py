"""Which candidate has the smaller expected distance: the same independent tasks for all, one after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ctxval._util.arrays import Array
from ctxval.campaign.choices import Choice
from ctxval.certificates.difference import MeanDifference, PairedDifferences, mean_difference
from ctxval.comparison.candidates import Candidate, TrialNote
from ctxval.comparison.executions import Executions
from ctxval.comparison.predictions import Predictions
from ctxval.core.trial import Trial

_DRAWS = 0x6472  # identifies the random stream of the tasks of a comparison; it is none of the streams of trials


@dataclass(eq=False)
class MeanQuestion:
    """Decides which candidates have the smaller expected distance, and executes the draws for it.

    Each task is drawn from the distribution of tasks and executed with every candidate that is in an undecided pair.
    Before its draw, the distance of each candidate is predicted from all executions so far.
    """

    executions: Executions
    predictions: Mapping[str, Predictions]
    confidence: float
    seed: int
    most: float | None = None

    @property
    def candidates(self) -> Sequence[Candidate]:
        """All candidates."""
        return self.executions.candidates

    def point(self, draw: int) -> Array:
        """Return an independent draw from the distribution of tasks, a point of the unit cube ``(d,)``.

        It depends on all models, so that a model that is learned again with the draws is not judged by them.
        """
        models = [candidate.recorder.draws.of_model() for candidate in self.candidates]
        rng = np.random.default_rng([self.seed, draw, _DRAWS, *models])
        space = self.candidates[0].campaign.validation.space
        return np.asarray(space.rounded(space.unit_draws(1, rng)[0]))

    def draws_of(self, candidate: Candidate) -> dict[int, tuple[Trial, TrialNote]]:
        """Return the trials of the draws that have ended, by the number of the draw."""
        noted = ((trial, TrialNote.of(trial)) for trial in candidate.trials if trial.state != "open")
        return {note.draw: (trial, note) for trial, note in noted if note is not None and note.draw is not None}

    def difference(self, a: Candidate, b: Candidate) -> MeanDifference:
        """Return the expected distance of a candidate minus that of another one."""
        count = len(self.candidates)
        error_of_pair = (1 - self.confidence) / (count * (count - 1) / 2)
        return mean_difference(self.differences(a, b), error_of_pair)

    def differences(self, a: Candidate, b: Candidate) -> PairedDifferences:
        """Return the differences at the draws that both have, up to the first one without a usable distance."""
        first, second = self.draws_of(a), self.draws_of(b)
        values, predicted = [], []
        for draw in sorted(first.keys() & second.keys()):
            pair = [self._known(*draws[draw]) for draws in (first, second)]
            if pair[0] is None or pair[1] is None:
                break
            values.append(pair[0][0] - pair[1][0])
            predicted.append(pair[0][1] - pair[1][1])
        return PairedDifferences(np.array(values), np.array(predicted), self.most)

    def _known(self, trial: Trial, note: TrialNote) -> tuple[float, float] | None:
        """Return the distance of a draw, and its prediction minus its mean; None if there is no distance."""
        if trial.distance is None and (self.most is None or trial.state != "failed"):
            return None
        distance = trial.distance if trial.distance is not None else self.most or 0.0
        centred = 0.0 if note.predicted is None or note.centre is None else note.predicted - note.centre
        return distance, centred

    def lost(self, a: Candidate, b: Candidate) -> str | None:
        """Return why the difference of a pair cannot be known any more; None if it can."""
        for candidate in (a, b):
            for trial, note in self.draws_of(candidate).values():
                if self._known(trial, note) is None:
                    return (
                        f"trial {trial.number} of {candidate.name} has no distance, so the expected distance is not "
                        "known; with a stated largest possible distance, a failure would count as that"
                    )
        return None

    @property
    def undecided(self) -> list[tuple[Candidate, Candidate]]:
        """The pairs that are not decided and can still be."""
        pairs = combinations(self.candidates, 2)
        return [(a, b) for a, b in pairs if not self.difference(a, b).sign and self.lost(a, b) is None]

    def step(self, left: int) -> bool:
        """Execute the next draw with one candidate; return False if there is nothing to execute."""
        active = [candidate for candidate in self.candidates if any(candidate in pair for pair in self.undecided)]
        if not active:
            return False
        draw = self._next_draw()
        point = self.point(draw)
        waiting = [candidate for candidate in active if draw not in self.draws_of(candidate)]
        if not waiting:
            draw += 1
            point, waiting = self.point(draw), active
        if len(waiting) == len(active) and left < self._usual_cost(len(active)):
            return False
        candidate = waiting[0]
        note = self.note_of(candidate, TrialNote(self.executions.steps, "mean", draw), point)
        self.executions.execute(candidate, Choice(point, "iid"), note, predicts=False)
        return True

    def _usual_cost(self, active: int) -> int:
        """Return the number of executions that the last draw took; that of all candidates if there was none."""
        last = self._next_draw()
        notes = [self.draws_of(candidate)[last][1] for candidate in self.candidates if last in self.draws_of(candidate)]
        return min(active, sum(note.shared is None for note in notes) or active)

    def _next_draw(self) -> int:
        """Return the number of the last draw that was begun; 0 if there was none."""
        return max((draw for candidate in self.candidates for draw in self.draws_of(candidate)), default=0)

    def note_of(self, candidate: Candidate, note: TrialNote, point: Array) -> TrialNote:
        """Return the note of a draw for a candidate, with the prediction from all executions of other tasks."""
        known = [(trial.unit_point, trajectory) for trial, trajectory in self.executions.history(without=point)]
        prediction = self.predictions[candidate.name].of_draw(known, point, note.draw or 0, self.most)
        value, centre = (None, None) if prediction is None else prediction
        return TrialNote(note.step, "mean", note.draw, value, centre)
