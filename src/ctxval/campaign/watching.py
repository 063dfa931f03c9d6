"""A watch over a certificate: later executions are tested against what the certified ones predict."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ctxval import learning
from ctxval._util.checked import require
from ctxval._util.progress import advance, stage
from ctxval.campaign.choices import Execution
from ctxval.campaign.history import at_points, executed_trials
from ctxval.campaign.trials import TrialRecorder
from ctxval.certificates.expiry import EXCEEDED, FEWEST, WatchedChannel, WatchState
from ctxval.core.trajectory import COMPLETE, Trajectory
from ctxval.core.trial import Trial
from ctxval.errors import CertificateError, InputError

FALSE_ALARMS = 1e-3  #: usual rate of false alarms: one in 1,000 executions
_MOST = 24  # certified executions that are predicted from the others, the latest ones: each is learned from anew


class Watch:
    """Tests one execution after the other against the predictions of the dynamics that a campaign has learned.

    Nothing is executed, and nothing is stored; the state is plain numbers. With the same campaign and the same
    executions, it is the same.

    Attributes:
        state: what the executions say so far.

    Raises:
        CertificateError: if the campaign has too few executions with trajectories, or if nothing can be learned from
            them.
        InputError: if the state belongs to another watch.
    """

    def __init__(
        self, recorder: TrialRecorder, threshold: float, false_alarms: float, state: WatchState | None = None
    ) -> None:
        self._recorder, dynamics = recorder, recorder.dynamics
        executed = executed_trials(recorder.store, recorder.trials)
        self._trials = [trial for trial, _ in executed]
        self._executed = at_points(executed)
        if len(executed) < FEWEST:
            needs = f"at least {FEWEST} executions with trajectories in the store, got {len(executed)}"
            raise CertificateError(f"a watch needs {needs}.")
        learned = dynamics.learned(recorder.trials, alone=True)
        if learned is None:
            why = dynamics.failure or "the model explains them all, or they cannot be predicted"
            raise CertificateError(f"nothing can be learned from the executions in the store: {why}.")
        latest = range(max(0, len(executed) - _MOST), len(executed))
        certified = []
        with stage("predicting the certified runs", len(latest), "runs"):
            self._statistics = learning.run_statistics.RunStatistics.of(learned, threshold)
            for k in latest:
                certified.append(self._statistics.certified(k, self._trials[k].distance or 0.0))
                advance(1)
        known = [each for each in certified if each]
        if len(known) < FEWEST:
            raise CertificateError("the executions in the store cannot be predicted from each other.")
        self._states = list(learning.run_statistics.names(learned.study, len(learned.posterior.data.sizes)))
        named = {name: [each[name] for each in known if name in each] for name in max(known, key=len)}
        channels = []
        for name, runs in named.items():
            if len(runs) >= FEWEST:
                freedom = float(np.median([each.freedom for each in runs])) if self._statistics.has_noise else None
                informations = [each.information for each in runs if each.information is not None]
                information = np.sum(informations, axis=0) if informations else None
                channels.append(WatchedChannel(name, tuple(each.value for each in runs), freedom, information))
        self.state = WatchState(threshold, false_alarms, tuple(channels))
        if state is not None:
            settings = len(state.channels), state.threshold, state.false_alarms
            # It follows from the same beginning, up to the rounding of another processor.
            same = settings == (len(channels), threshold, false_alarms) and all(
                known.name == channel.name
                and len(known.certified) == len(channel.certified)
                and np.allclose(known.certified, channel.certified, rtol=1e-4)
                for known, channel in zip(state.channels, channels, strict=True)
            )
            if not same:
                raise InputError("the state belongs to a watch of another campaign, threshold or rate of false alarms.")
            self.state = state

    def update(
        self,
        run: Trajectory | Execution,
        parameters: Mapping[str, Any] | None = None,
        *,
        name: str | None = None,
        start_tolerance: float | None = None,
    ) -> WatchState:
        """Return the state after another execution.

        Args:
            run: the trajectory of the system, or an execution.
            parameters: those of its task. Without them, only the steps of the run are tested, not its distance.
            name: the name of the run in sentences; its number by default.
            start_tolerance: replaces the start tolerance of the validation.

        Raises:
            ExecutionError: if the trajectory is not a complete execution of the task.
            InputError: if the run has no trajectory, missing values, or states that cannot be estimated.
        """
        require("run", Trajectory | Execution, run)
        execution = Execution(run) if isinstance(run, Trajectory) else run
        trajectory, distance, validation = execution.trajectory, execution.distance, self._recorder.validation
        if trajectory is None:
            advice = "a distance or a failure alone says nothing"
            raise InputError(f"a watch needs the trajectory of an execution; {advice}.")
        point = None
        if parameters is None:
            self._require_states(trajectory)
        else:
            place = validation.space.point(parameters)
            point = validation.space.to_unit(place)
            if distance is None:
                distance = execution.measured(validation, validation.plan(place), start_tolerance).distance
            extended = self._statistics.learned.study.with_states(self._executed, point, trajectory)
            if extended is None:
                raise InputError("the states of the model cannot be estimated along the run.")
            trajectory = extended
        name = str(len(self.state.runs) + 1) if name is None else name
        statistics = self._statistics.later(trajectory, point, distance)
        if not all(0 < each.value < np.inf for each in statistics.values()):
            raise InputError(f"the run {name} has values that are missing, or too large for a comparison.")
        self.state = self.state.after(name, statistics, distance)
        return self.state

    def again(self, count: int = 3) -> list[Trial]:
        """Return the trials to execute again if the certificate has expired, the most telling first; else none.

        These are the executed tasks whose distance the change may move most towards the threshold, or beyond.
        """
        if not self.state.expired:
            return []
        distances = np.array([trial.distance or 0.0 for trial in self._trials])
        cause = self.state.cause
        if cause not in (learning.run_statistics.DISTANCE, EXCEEDED):
            channel = next(each for each in self.state.channels if each.name == cause)
            kinds = [(f"{each} residuals", f"systematic {each} residuals") for each in self._states]
            state = next(i for i, each in enumerate(kinds) if cause in each)
            later = [each.value for each in channel.later[(self.state.since or 1) - 1 :] if each is not None]
            size = self._statistics.floors[state] * np.sqrt(np.mean(later))
            distances = distances + self._statistics.influences[state] * size
        of_tasks: dict[bytes, Trial] = {}
        for k in np.argsort(-distances, kind="stable"):
            of_tasks.setdefault(self._trials[k].unit_point.tobytes(), self._trials[k])
        return list(of_tasks.values())[:count]

    def _require_states(self, trajectory: Trajectory) -> None:
        """Refuse a recording without a task that cannot be compared with predictions."""
        learned, validation = self._statistics.learned, self._recorder.validation
        if learned.study.given.physical or validation.outputs.hide_states:
            raise InputError(
                f"a recording needs the parameters of its task, {', '.join(validation.space.names)}: the "
                "learned dynamics depend on a task parameter, or only outputs are recorded. On the command line, give "
                "--set NAME=VALUE for one recording, or a table of recordings with a column for each parameter."
            )
        wanted = len(learned.posterior.data.sizes), learned.posterior.data.inputs
        if (trajectory.states.shape[-1], trajectory.inputs.shape[-1]) != wanted or trajectory.ended != COMPLETE:
            raise InputError(
                f"a recording must have {wanted[0]} states and {wanted[1]} inputs of complete runs, got "
                f"{trajectory.states.shape[-1]} and {trajectory.inputs.shape[-1]} ({trajectory.ended})."
            )

    def __repr__(self) -> str:
        return f"Watch({self.state.sentence})"
