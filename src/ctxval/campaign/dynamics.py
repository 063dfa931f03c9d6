"""What the trajectories of a campaign teach of the dynamics: predictions of executions, and evidence on d*."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import call
from ctxval.certificates.dynamics import PREDICTIONS
from ctxval.certificates.dynamics_evidence import CheckedPrediction, DynamicsEvidence, StateInputCoverage
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError
from ctxval.learning import Coverage, DynamicsStudy, ExecutionPrediction, LearnedDynamics
from ctxval.storage.store import Store

PREDICTION = "prediction"
"""Key of the prediction of an execution in the note of its trial."""

AUDIT = "prediction_audit"
"""Key in the note of a trial that tests a prediction at a fresh random task."""

_REMEMBERED = 4
"""Number of sets of executions whose dynamics are kept."""


class CampaignDynamics:
    """The dynamics learned from the trials of a campaign. The system is never executed.

    Args:
        validation: the map p -> d(p).
        store: the store of the trajectories.
        seed: the seed of the campaign.
    """

    def __init__(self, validation: Validation, store: Store, seed: int) -> None:
        self._study = DynamicsStudy(validation, seed)
        self._store = store
        self._trajectories: dict[int, Trajectory | None] = {}
        self._learned: dict[tuple[int, ...], LearnedDynamics | None] = {}

    def learned(self, trials: Sequence[Trial]) -> LearnedDynamics | None:
        """Return what the completed trials teach; None if they teach nothing."""
        executed = self._executed(trials)
        key = tuple(trial.number for trial, _ in executed)
        if key not in self._learned:
            if len(self._learned) == _REMEMBERED:
                del self._learned[next(iter(self._learned))]
            self._learned[key] = self._learn(executed)
        return self._learned[key]

    def predict(self, trials: Sequence[Trial], point: Array) -> ExecutionPrediction | None:
        """Return the prediction of the execution of a task from completed trials; None if nothing can be predicted."""
        learned = self.learned(trials)
        try:
            return None if learned is None else learned.predict(point)
        except (CtxvalError, np.linalg.LinAlgError):
            return None

    def evidence(self, trials: Sequence[Trial]) -> DynamicsEvidence | None:
        """Return what the learned dynamics say about d*; None if nothing can be learned."""
        learned = self.learned(trials)
        if learned is None:
            return None
        worst = learned.worst_case
        return DynamicsEvidence(
            worst.maxima,
            worst.points,
            worst.of_mean,
            worst.elites,
            worst.evaluations,
            len(learned.executed),
            worst.left_out,
            learned.posterior.noise,
            self._checked(trials),
            _coverage(learned.coverage, learned.posterior.data.inputs),
        )

    def _learn(self, executed: Sequence[tuple[Trial, Trajectory]]) -> LearnedDynamics | None:
        try:
            return self._study.learn([(trial.unit_point, trajectory) for trial, trajectory in executed])
        except (CtxvalError, np.linalg.LinAlgError):
            return None  # a failure of the linear algebra must not end a campaign

    def _executed(self, trials: Sequence[Trial]) -> list[tuple[Trial, Trajectory]]:
        """Return the completed trials that have a trajectory."""
        completed = [trial for trial in trials if trial.state == "completed"]
        found = ((trial, self._trajectory(trial)) for trial in completed)
        return [(trial, trajectory) for trial, trajectory in found if trajectory is not None]

    def _trajectory(self, trial: Trial) -> Trajectory | None:
        if trial.number not in self._trajectories:
            self._trajectories[trial.number] = self._store.trajectory(trial.number, "system")
        return self._trajectories[trial.number]

    def _checked(self, trials: Sequence[Trial]) -> tuple[CheckedPrediction, ...]:
        """Return the stored predictions and, for the last trials without one, those from the trials before them."""
        executed, found = self._executed(trials), []
        for place, (trial, trajectory) in enumerate(executed):
            stored = ExecutionPrediction.from_json((trial.note or {}).get(PREDICTION) or {})
            prediction = stored
            if stored is None and place >= len(executed) - PREDICTIONS:
                prediction = self.predict([one for one, _ in executed[:place]], trial.unit_point)
            if prediction is None or trial.distance is None:
                continue
            score = prediction.score(trajectory, trial.distance)
            if score is not None:
                facts = (score.z2, score.rank, prediction.median, prediction.upper, trial.distance, stored is not None)
                found.append(CheckedPrediction(trial.number, *facts, audit=AUDIT in (trial.note or {})))
        return tuple(found)

    def __repr__(self) -> str:
        return call(self, self._study)


def _coverage(found: Coverage, inputs: int) -> StateInputCoverage:
    states = len(found.place) - inputs
    names = [*(f"x[{i}]" for i in range(states)), *(f"u[{i}]" for i in range(inputs))]
    return StateInputCoverage(
        found.marginal,
        found.beyond,
        found.pair,
        names[found.coordinate],
        dict(zip(names, found.place.tolist(), strict=True)),
        dict(zip(names, found.resolution.tolist(), strict=True)),
        found.task,
        found.tasks,
    )
