"""Campaigns whose tasks people execute: they ask for a task, and tell its result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ctxval._util.checked import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, checked
from ctxval._util.progress_display import progress_shown
from ctxval.campaign.choices import Choice, OpenTrial
from ctxval.campaign.interval_search import IntervalSearch
from ctxval.campaign.known import KnownExecution, TrialResult, check_known, measurement_of
from ctxval.campaign.results import CampaignResults
from ctxval.certificates import RESOLUTION, CertificateOptions
from ctxval.certificates.options import CONFIDENCE
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.errors import InputError


class OperatedCampaign(CampaignResults):
    """The part of a campaign that opens trials for people and records their results.

    None of its methods executes the system: people do.
    """

    @checked
    def ask(
        self,
        parameters: Mapping[str, Any] | None = None,
        *,
        draw: bool = False,
        because: str | None = None,
        wait: NonNegativeFloat = 0.0,
        progress: bool | None = None,
    ) -> OpenTrial:
        """Open the next trial: the search's choice, the task with these parameters, or an independent draw.

        Args:
            parameters: the parameters of a task that you chose yourself.
            draw: draw the task from the distribution of tasks, for an audit.
            because: the change that was made to the system since the task with these parameters was executed before.
            wait: seconds to wait while another process chooses a task.
            progress: as in :meth:`ctxval.Campaign.run`.

        Raises:
            InputError: if the parameters are not in the task space.
            StoreAccessError: if another process is running the store.
            ModelError, DesignError: if no controller can be designed and run on the model. The trial is stored as
                failed and does not count as an execution.
        """
        if because is not None and (parameters is None or not because.strip()):
            raise InputError('because needs the parameters of an earlier task and a reason, such as "fuse replaced".')
        # An operator's time is worth a prediction: it is stored, and the execution tests it.
        predicts = self._recorder.search.uses_prediction
        with progress_shown(progress), self.store.sole_writer(wait), self._recorder.predicting(predicts):
            self._recorder.refresh()
            if parameters is not None:
                point = self.validation.space.point(parameters)
                given = self.validation.space.describe_point(point)
                unit_point = self.validation.space.to_unit(point)
                return self._recorder.open(Choice(unit_point, "manual", because, parameters=given))
            return self._recorder.open(Choice(self._recorder.draw(), "iid") if draw else Choice())

    @checked
    def ask_for_verdict(
        self,
        threshold: PositiveFloat,
        budget: PositiveInt,
        *,
        confidence: float = CONFIDENCE,
        stochastic: bool = False,
        resolution: float = RESOLUTION,
        certificate: CertificateOptions | None = None,
        wait: NonNegativeFloat = 0.0,
        progress: bool | None = None,
    ) -> OpenTrial | None:
        """Open the trial that :meth:`ctxval.Campaign.run` would execute next for a threshold, if people execute it.

        Returns None if the model is validated or falsified for the threshold, or if the budget is spent. Open trials
        count for the budget.

        Args:
            threshold, budget, confidence, stochastic, resolution, certificate: as in
                :meth:`ctxval.Campaign.run`.
            wait, progress: as in :meth:`ask`.

        Raises:
            InputError, StoreAccessError, ModelError, DesignError: as in :meth:`ask`.
            CertificateError: if an option of the certificate is not valid.
        """
        by = CertificateOptions.or_automatic(certificate, confidence, stochastic, resolution)
        with progress_shown(progress), self.store.sole_writer(wait):
            self._recorder.refresh()
            search = IntervalSearch(self._recorder, by, budget, threshold)
            waiting = sum(trial.state == "open" for trial in self.trials)
            with self._recorder.predicting(search.predicts):
                choice = search.choose() if self.executions + waiting < budget else None
                return None if choice is None else self._recorder.open(choice)

    def reopen(self, number: int, *, ended: bool = False) -> OpenTrial:
        """Return an open trial again, with its task and controller.

        Args:
            number: the number of the trial.
            ended: return a trial whose result was told, to replace the result.

        Raises:
            InputError: if there is no such trial, or it is in another state.
        """
        self._recorder.refresh()
        trial = self._recorder.told_trial(number) if ended else self._recorder.open_trial(number)
        return OpenTrial(trial, self._recorder.plan(trial))

    @checked
    def tell(
        self,
        opened: OpenTrial | NonNegativeInt,
        trajectory: Trajectory | None = None,
        *,
        distance: NonNegativeFloat | None = None,
        failed: str | None = None,
        start_tolerance: NonNegativeFloat | None = None,
        replace: str | None = None,
    ) -> Trial:
        """Record the result of an open trial: its trajectory, its distance, or the reason of its failure.

        Args:
            opened: the open trial, or its number.
            trajectory: the recorded trajectory.
            distance: the distance, if there is no recording.
            failed: the reason why there is no result.
            start_tolerance: replaces the start tolerance of the validation.
            replace: why this result replaces one that was told before, such as "wrong file". The history of the store
                keeps the earlier result with its trajectory.

        Raises:
            InputError: if not exactly one result is given, if the trial is not open (with ``replace``: if its result
                was not told by a person), or if the trajectory belongs to
                another task.
            ExecutionError: if the trajectory is not a complete execution of the task; the trial stays open.
            DistanceError: if the distance function gives no usable number; the execution is stored.
        """
        recorder = self._recorder
        recorder.refresh()
        if replace is not None and not replace.strip():
            raise InputError('replace needs a reason, such as "wrong file".')
        known = recorder.open_trial if replace is None else recorder.told_trial
        trial = known(opened.number if isinstance(opened, OpenTrial) else opened)
        if isinstance(opened, OpenTrial) and not np.array_equal(opened.trial.unit_point, trial.unit_point):
            raise InputError(f"the open trial {opened.number} belongs to another campaign.")
        result = TrialResult(trajectory, distance, failed)
        with recorder.not_executing(trial):
            trial = known(trial.number)
            if result.failed is not None:
                return recorder.fail(trial, result.failed, replacing=replace)
            if result.distance is not None:
                return recorder.complete(trial, measurement_of(result.distance), replacing=replace)
            plan = opened.plan if isinstance(opened, OpenTrial) else recorder.plan(trial)
            measurement = self.validation.accept(plan, result.trajectory, start_tolerance)
            return recorder.complete(trial, measurement, result.trajectory, replacing=replace)

    @checked
    def add(
        self,
        parameters: Mapping[str, Any],
        trajectory: Trajectory | None = None,
        *,
        distance: NonNegativeFloat | None = None,
        failed: str | None = None,
        start_tolerance: NonNegativeFloat | None = None,
        wait: NonNegativeFloat = 0.0,
    ) -> Trial | None:
        """Record an earlier execution as a trial with the origin manual. It counts as an execution.

        Returns:
            the trial; None if the execution is already in the store.

        Raises:
            InputError, ExecutionError: as in :meth:`tell`; nothing is stored.
            ModelError, DesignError: if the task cannot be planned; nothing is stored.
        """
        point = self.validation.space.point(parameters)
        result = TrialResult(trajectory, distance, failed)
        return self.add_known([check_known(self.validation, point, result, start_tolerance)], wait)[0]

    def add_known(self, executions: Sequence[KnownExecution], wait: NonNegativeFloat = 0.0) -> list[Trial | None]:
        """Record executions after ``campaign.known.check_known``; None if one is already in the store."""
        return self._recorder.add(executions, wait)

    def refresh(self) -> None:
        """Read the trials again if another process has changed the store.

        Raises:
            StoreMismatchError: if the store now belongs to another experiment.
        """
        self._recorder.refresh()
