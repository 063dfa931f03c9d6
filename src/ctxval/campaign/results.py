"""The results of a campaign: its trials, the bounds and verdicts that follow from them, and how they are shown."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import NonNegativeInt, PositiveFloat, checked
from ctxval._util.progress import progress_shown, stage
from ctxval._util.representation import Shown, call, counted, lines, named, number, shown, table
from ctxval.campaign.choices import OpenTrial
from ctxval.campaign.dynamics import LearnedFromTrials
from ctxval.campaign.envelope import EnvelopeSearch
from ctxval.campaign.history import executed_trials
from ctxval.campaign.interval_search import IntervalSearch, with_next_task
from ctxval.campaign.storage.other_stores import provenance_of_store
from ctxval.campaign.storage.store import Store
from ctxval.campaign.trials import TrialRecorder
from ctxval.certificates import RESOLUTION, Certificate, CertificateOptions, Provenance, Verdict, assess, judge
from ctxval.certificates.envelope import Envelope
from ctxval.certificates.options import CONFIDENCE
from ctxval.core.distance import Distance
from ctxval.core.plan import StartOffset, input_difference, start_offset
from ctxval.core.task_suite import TASK, TaskSuite
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError, InputError
from ctxval.gp.surrogate import Surrogate, fit_surrogate
from ctxval.searches import Search

if TYPE_CHECKING:
    from pandas import DataFrame


class CampaignResults:
    """What a campaign has found; :class:`Campaign` adds what executes tasks and records results."""

    recorder: TrialRecorder
    search: Search
    seed: NonNegativeInt
    name: str

    # The trials

    @property
    def validation(self) -> Validation:
        """The map p -> d(p), with the present distance function."""
        return self.recorder.validation

    @property
    def store(self) -> Store:
        """The store of the trials."""
        return self.recorder.store

    @property
    def trials(self) -> tuple[Trial, ...]:
        """All trials in the order of asking."""
        return self.recorder.trials

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
        return self.recorder.executions

    @property
    def worst(self) -> Trial | None:
        """The completed trial with the largest distance."""
        return max(self.completed, key=lambda trial: trial.distance or 0.0, default=None)

    def trajectories(self, trial: Trial) -> tuple[Trajectory | None, Trajectory | None]:
        """Return the trajectories of the model and of the system in a trial; None if a trajectory is not stored.

        That of a failed execution has the steps before the failure.
        """
        return self.store.trajectory(trial.number, "model"), self.store.trajectory(trial.number, "system")

    def start_offset(self, trial: Trial) -> StartOffset | None:
        """Return how far an execution started from the initial state of its task; None if it was not recorded."""
        executed = self.store.trajectories([trial.number], "system").get(trial.number)
        point = self.validation.space.point(trial.parameters)
        return None if executed is None else start_offset(self.validation, point, executed)

    def input_difference(self, trial: Trial) -> str | None:
        """Return where the recorded inputs of a trial are not those of its controller at the recorded states.

        It is a hint that the recording is of another run, or begins at another moment than the controller. Returns None
        if they agree up to a third, or if nothing was recorded.
        """
        executed = self.store.trajectories([trial.number], "system").get(trial.number)
        if executed is not None:
            with suppress(CtxvalError):  # the result is stored, whether or not its controller can be designed again
                return input_difference(self.validation, self.recorder.plan(trial), executed)
        return None

    def refresh(self) -> None:
        """Read the trials again if another process has changed the store; refuse it if its experiment has changed."""
        self.recorder.refresh()

    def remeasure(self, distance: Distance | None = None) -> list[Trial]:
        """Recompute the distances of all stored executions, without an execution; return the trials that changed.

        The history of the store keeps the earlier values. A distance without a trajectory cannot be recomputed: if the
        distance function has changed, the trial becomes unmeasured.

        Args:
            distance: the new distance; by default, that of the validation.

        Raises:
            DistanceError: if the distance of a measured trial cannot be computed any more; nothing is changed.
        """
        return self.recorder.remeasure(distance)

    def reopen(self, number: int, *, ended: bool = False) -> OpenTrial:
        """Return an open trial again, with its task and controller.

        With ``ended``, return a trial whose result was told, to replace the result.
        """
        self.refresh()
        trial = self.recorder.trial(number, ended=ended)
        return OpenTrial(trial, self.recorder.plan(trial))

    # Results

    @property
    def estimate(self) -> float | None:
        """The search's estimate of d*: the largest distance, unless the search discards some (SD) or repeats its tasks.

        If the search repeats its tasks, the estimate is the largest mean distance of a task with all its repetitions.
        It is None if there are too few distances.
        """
        return self.recorder.search.estimate(*self._distances())

    @property
    def provenance(self) -> Provenance:
        """What a certificate needs besides the trials: the task space, the search, changes, and what M predicts."""
        recorder, validation, trials = self.recorder, self.recorder.validation, self.recorder.trials
        offsets = [
            (start_offset(validation, validation.space.point(trial.parameters), executed), trial.number)
            for trial, executed in executed_trials(recorder.store, trials)
        ]
        return replace(
            provenance_of_store(recorder.store),
            space=validation.space,
            learned=LearnedFromTrials(validation, trials, recorder.dynamics),
            start=max(((offset.size, f"{offset.text} (trial {number})") for offset, number in offsets), default=None),
            units=validation.labels.units,
        )

    @checked
    def state_threshold(self, threshold: PositiveFloat) -> None:
        """Record in the store that a threshold was stated, and how many distances were known.

        A verdict says so if the threshold was first stated after distances were known. :meth:`run`,
        :meth:`ask_for_verdict` and :meth:`verdict` state their thresholds; call this if the trials come from
        :meth:`ask`, :meth:`audit` or :meth:`add`. A threshold that was stated before is not recorded again.
        """
        self.store.state_threshold(float(threshold))

    @checked
    def verdict(
        self,
        threshold: PositiveFloat,
        confidence: float = CONFIDENCE,
        *,
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
            confidence: the confidence level of the certificate, at least 0.5.
            resolution: the largest distance between a task and its nearest trial that a validation permits, in
                diagonals of the task space.
            certificate: the kind and the options of the certificate, in place of ``auto`` with the two options above.
            progress: as in :meth:`run`.

        Raises:
            CertificateError: if an option of the certificate is not valid.
        """
        options, recorder = CertificateOptions.or_automatic(certificate, confidence, resolution), self.recorder
        self.state_threshold(threshold)
        with progress_shown(progress), stage("certifying"):
            return with_next_task(judge(recorder.trials, threshold, options, self.provenance), recorder, options)

    @checked
    def certify(
        self,
        confidence: float = CONFIDENCE,
        *,
        resolution: float = RESOLUTION,
        certificate: CertificateOptions | None = None,
        progress: bool | None = None,
    ) -> Certificate:
        """Return the bound on d*, which needs no threshold. The arguments are those of :meth:`verdict`.

        A CertificateError is raised if the theory of the certificate refuses the trials.
        """
        options = CertificateOptions.or_automatic(certificate, confidence, resolution)
        with progress_shown(progress), stage("certifying"):
            certified = assess(self.trials, options, provenance=self.provenance).certificate
        assert certified is not None  # without a threshold, a refusal is raised
        return certified

    @checked
    def envelope(
        self,
        threshold: PositiveFloat,
        confidence: float = CONFIDENCE,
        *,
        certificate: CertificateOptions | None = None,
        progress: bool | None = None,
    ) -> Envelope:
        """Return the set of tasks on which d stays below a threshold, with a confidence for all of them at once.

        It follows from the learned dynamics, and says why it is not stated if these do not suffice: it needs the tests
        that a validation needs. ``run(..., envelope=True)`` executes what is missing.

        Args:
            threshold: tau, in the units of the distance.
            confidence: the confidence that d stays below the threshold on all tasks of the set.
            certificate: the options ``auto`` or ``dynamics``, in place of the confidence.
            progress: as in :meth:`run`.

        Raises:
            CertificateError: if the confidence needs too many posterior samples.
        """
        options = CertificateOptions.or_automatic(certificate, confidence, RESOLUTION)
        search = EnvelopeSearch(IntervalSearch(self.recorder, options, self.executions + 1, threshold, keeps=False))
        with progress_shown(progress):
            return search.envelope()

    def surrogate(self) -> Surrogate:
        """Return the Gaussian process of the distance over the task space, for every search, from two distances on."""
        of_search = self.recorder.search.surrogate()
        return fit_surrogate(*self._distances()) if of_search is None else of_search

    def to_dataframe(self) -> DataFrame:
        """Return the trials as a table of pandas, one row for each.

        The columns are number, origin, state, one for each task parameter (``name[0], name[1], ...`` for a vector),
        distance, seconds, attempts and failure. If a parameter has the name of another column, such as ``distance``,
        its column is ``parameters.distance``. Unknown values are missing values.
        """
        try:
            from pandas import DataFrame
        except ImportError as error:
            raise InputError("a table of trials needs pandas, which is not installed: pip install pandas.") from error
        trials, space = self.trials, self.validation.space
        before, after = ("number", "origin", "state"), ("distance", "seconds", "attempts", "failure")
        columns: dict[str, list[Any]] = {name: [getattr(trial, name) for trial in trials] for name in before}
        points = [space.point(trial.parameters) for trial in trials]
        if isinstance(space, TaskSuite):
            names = [space.task_names_at(point) for point in points]
            values = {TASK: names} | {name: [space.values_of(name, point) for point in points] for name in space.names}
        else:
            values = {name: [point[axis] for point in points] for axis, name in enumerate(space.names)}
        columns |= {f"parameters.{name}" if name in (*before, *after) else name: of for name, of in values.items()}
        columns |= {name: [getattr(trial, name) for trial in trials] for name in after}
        texts = [name for name, of in columns.items() if any(isinstance(value, str) for value in of)]
        asked = ("distance", "seconds", *list(columns)[len(before) : -len(after)])
        numbers = {name: "float64" for name in asked if name not in texts}
        return DataFrame(columns).astype({"number": "int64", "attempts": "int64", **numbers})

    def _distances(self) -> tuple[Array, Array]:
        """Return the points of the unit cube with a distance ``(n, d)``, and the distances ``(n,)``."""
        completed = self.completed
        points = np.array([trial.unit_point for trial in completed]).reshape(-1, self.validation.space.dimension)
        return points, np.array([trial.distance for trial in completed], dtype=np.float64)

    def __repr__(self) -> str:
        worst, at = self.worst, "no distance is known"
        if worst is not None and worst.distance is not None:
            where = named(worst.parameters, self.validation.space.units)
            at = f"trial {worst.number} with distance {number(worst.distance)} at {where}"
        return lines(
            call(self, self.validation.space, name=self.name or None, seed=self.seed),
            f"search: {shown(self.search)}",
            f"trials: {self._counts()}",
            f"worst: {at}",
            f"store: {shown(self.store)}",
        )

    def _repr_html_(self) -> str:
        worst, units = self.worst, self.validation.space.units
        parameters = {} if worst is None else worst.parameters
        return table(
            f"Campaign {self.name}",
            [
                ("search", shown(self.search)),
                ("seed", self.seed),
                ("trials", self._counts()),
                ("worst trial", "no distance is known" if worst is None else worst.number),
                ("distance", None if worst is None else worst.distance),
                *((name, f"{shown(value)} {units.get(name, '')}") for name, value in parameters.items()),
                ("store", shown(self.store)),
            ],
        )

    def _counts(self) -> Shown:
        states = Counter(trial.state for trial in self.trials)
        counts = [counted(self.executions, "execution"), *(f"{count} {state}" for state, count in states.items())]
        return Shown(f"{len(self.trials)} ({', '.join(counts)})")
