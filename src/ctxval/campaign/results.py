"""The results of a campaign so far."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import PositiveFloat, checked
from ctxval._util.progress import stage
from ctxval._util.progress_display import progress_shown
from ctxval.campaign import display
from ctxval.campaign.history import executed_trials
from ctxval.campaign.interval_search import IntervalSearch, is_decisive
from ctxval.campaign.learned import LearnedFromTrials
from ctxval.campaign.plot import overview
from ctxval.campaign.storage.store import Store
from ctxval.campaign.trials import TrialRecorder
from ctxval.certificates import RESOLUTION, Certificate, CertificateOptions, Provenance, Verdict, assess, judge
from ctxval.certificates.bounds import with_units
from ctxval.certificates.options import CONFIDENCE
from ctxval.core.preflight import StartOffset, start_offset
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.gp.surrogate import Surrogate, fit_surrogate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame


class CampaignResults:
    """The trials of a campaign and the results that follow from them. Nothing here executes or stores anything.

    Args:
        recorder: the recorder of the trials.
    """

    def __init__(self, recorder: TrialRecorder) -> None:
        self._recorder = recorder

    @property
    def recorder(self) -> TrialRecorder:
        """The recorder of the trials, for code that chooses the tasks of several campaigns."""
        return self._recorder

    @property
    def validation(self) -> Validation:
        """The map p -> d(p), with the present distance function."""
        return self._recorder.validation

    @property
    def store(self) -> Store:
        """The store of the trials."""
        return self._recorder.store

    @property
    def trials(self) -> tuple[Trial, ...]:
        """All trials in the order of asking."""
        return self._recorder.trials

    @property
    def completed(self) -> list[Trial]:
        """The trials with a distance."""
        return [trial for trial in self.trials if trial.state == "completed"]

    @property
    def failed(self) -> list[Trial]:
        """The trials that failed."""
        return [trial for trial in self.trials if trial.state == "failed"]

    @property
    def unmeasured(self) -> list[Trial]:
        """The trials that were executed but have no distance, because it could not be measured."""
        return [trial for trial in self.trials if trial.state == "unmeasured"]

    @property
    def executions(self) -> int:
        """The number of executions of S that have ended, with or without success."""
        return self._recorder.executions

    def trajectories(self, trial: Trial) -> tuple[Trajectory | None, Trajectory | None]:
        """Return the trajectories of the model and of the system in a trial; None if a trajectory is not stored."""
        return self.store.trajectory(trial.number, "model"), self.store.trajectory(trial.number, "system")

    def start_offset(self, trial: Trial) -> StartOffset | None:
        """Return how far an execution started from the initial state of its task; None if it was not recorded."""
        return self._recorder.start_offset(trial)

    @property
    def worst(self) -> Trial | None:
        """The completed trial with the largest distance."""
        return max(self.completed, key=_distance, default=None)

    @property
    def estimate(self) -> float | None:
        """The search's estimate of d*: the largest distance, unless the search discards some (SD) or repeats its tasks.

        If the search repeats its tasks, the estimate is the largest mean distance of a task with all its repetitions.
        It is None if there are too few distances.
        """
        return self._recorder.search.estimate(*self._distances())

    @checked
    def verdict(
        self,
        threshold: PositiveFloat,
        confidence: float = CONFIDENCE,
        *,
        stochastic: bool = False,
        resolution: float = RESOLUTION,
        certificate: CertificateOptions | None = None,
        progress: bool | None = None,
    ) -> Verdict:
        """Return whether the model can be trusted up to a threshold tau.

        The model is falsified if an executed distance exceeds the threshold, and validated if a certificate bounds d*
        by the threshold. Otherwise the verdict is undecided, with a forecast of the executions that would decide
        and, if learned dynamics choose it, the next task.

        Args:
            threshold: tau, in the units of the distance.
            confidence: the confidence level of the certificate.
            stochastic: whether two executions of one task may differ.
            resolution: the largest distance between a task and its nearest trial that a validation permits, in
                diagonals of the task space.
            certificate: the kind and the options of the certificate, in place of ``auto`` with the three options above.
            progress: whether to show the progress on standard error; None to show it at a terminal and in a notebook.

        Raises:
            InputError: if the threshold is not a positive number, or the confidence is below 0.5.
            CertificateError: if an option of the certificate is not valid.
        """
        chosen = CertificateOptions.or_automatic(certificate, confidence, stochastic, resolution)
        with progress_shown(progress), stage("certifying"):
            verdict = judge(self.trials, threshold, chosen, self.provenance)
            return self._with_next_task(verdict, chosen) if verdict.answer == "undecided" else verdict

    def _with_next_task(self, verdict: Verdict, options: CertificateOptions) -> Verdict:
        """Return an undecided verdict with the task to execute next, if learned dynamics choose it."""
        if not is_decisive(options) or self.failed:
            return verdict
        budget = self.executions + 1
        unit_point = IntervalSearch(self._recorder, options, budget, verdict.threshold, keeps=False).by_dynamics()
        if unit_point is None:
            return verdict
        space = self.validation.space
        point = space.from_unit(space.rounded(unit_point))
        sentence = f"next task: {with_units(dict(zip(space.labels, point.tolist(), strict=True)))}"
        return replace(
            verdict,
            reason=f"{verdict.reason.removesuffix('.')}; {sentence}.",
            next_task=space.describe_point(point),
        )

    @checked
    def certify(
        self,
        confidence: float = CONFIDENCE,
        *,
        stochastic: bool = False,
        resolution: float = RESOLUTION,
        certificate: CertificateOptions | None = None,
        progress: bool | None = None,
    ) -> Certificate:
        """Return the bound on d*, which needs no threshold.

        Args:
            confidence, stochastic, resolution, certificate, progress: as in :meth:`verdict`.

        Raises:
            InputError: if the confidence is below 0.5.
            CertificateError: if an option of the certificate is not valid, or its theory refuses the trials.
        """
        chosen = CertificateOptions.or_automatic(certificate, confidence, stochastic, resolution)
        with progress_shown(progress), stage("certifying"):
            found = assess(self.trials, chosen, provenance=self.provenance).certificate
        assert found is not None  # without a threshold, a refusal is raised
        return found

    @property
    def provenance(self) -> Provenance:
        """What a certificate needs besides the trials: the task space, the search, changes, and what M predicts."""
        with self.store.snapshot():
            known = Provenance.of(self.store.description(), self.store.history())
        learned = LearnedFromTrials(self.validation, self.trials, self._recorder.dynamics)
        space = self.validation.space
        offsets = [
            (start_offset(self.validation, space.point(trial.parameters), executed), trial.number)
            for trial, executed in executed_trials(self.store, self.trials)
        ]
        start = max(((offset.size, f"{offset.text} (trial {number})") for offset, number in offsets), default=None)
        return replace(known, space=space, learned=learned, start=start, units=self.validation.labels.units)

    def surrogate(self) -> Surrogate:
        """Return the Gaussian process of the distance over the task space, for every search.

        Raises:
            InputError: if fewer than two distances are known.
        """
        own = self._recorder.search.surrogate()
        return fit_surrogate(*self._distances()) if own is None else own

    def to_dataframe(self) -> DataFrame:
        """Return the trials as a table of pandas, one row for each.

        The columns are number, origin, state, one for each task parameter (``name[0], name[1], ...`` for a vector),
        distance, seconds, attempts and failure. If a parameter has the name of another column, such as ``distance``,
        its column is ``parameters.distance``. Unknown values are missing values.

        Raises:
            InputError: if pandas is not installed.
        """
        return display.to_dataframe(self.trials, self.validation.space)

    def plot(
        self,
        *,
        units: str = "",
        threshold: float | None = None,
        bound: float | None = None,
        ax: Axes | None = None,
    ) -> Axes:
        """Draw the surrogate over one task parameter, or else the distances in their order; return the axes.

        Args:
            units: the units of the distance; by default, those of the validation.
            threshold: tau, drawn as a line; None if there is none.
            bound: a bound on d* from a certificate, drawn as a line; None if there is none.
            ax: matplotlib axes to draw into; new ones of ``matplotlib.pyplot`` by default.

        Raises:
            InputError: if no distance is known.
        """
        return overview(self, units=units, threshold=threshold, bound=bound, ax=ax)

    def _distances(self) -> tuple[Array, Array]:
        """Return the points of the unit cube with a distance ``(n, d)``, and the distances ``(n,)``."""
        completed = self.completed
        points = np.array([trial.unit_point for trial in completed]).reshape(-1, self.validation.space.dimension)
        return points, np.array([_distance(trial) for trial in completed])


def _distance(trial: Trial) -> float:
    assert trial.distance is not None  # completed trials have one
    return trial.distance
