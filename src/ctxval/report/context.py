"""What a report is made from: the trials of a store, and the experiment if it is known. Nothing here executes S."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.progress import stage
from ctxval._util.representation import ShortRepr
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.dynamics import NEAR, CampaignDynamics
from ctxval.campaign.envelope import has_tests
from ctxval.campaign.storage.other_stores import provenance_of_store
from ctxval.campaign.storage.store import CAUSE, Store
from ctxval.certificates import Certificate, CertificateOptions, Provenance, Verdict, judge
from ctxval.certificates.envelope import Envelope
from ctxval.core.labels import Labels, labels_of
from ctxval.core.space import TaskSpace
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial, Trials, designs_sentence
from ctxval.core.validation import Validation
from ctxval.errors import InputError
from ctxval.learning.replays import Replay, replay_executed
from ctxval.report.distance_model import DistanceModel, distance_of
from ctxval.report.findings import DIAGNOSTICS, Finding, findings_of, not_tested
from ctxval.report.insights import INSIGHTS


class TrajectoryPair(NamedTuple):
    """A completed trial with its closed loop on M, and the execution of S."""

    trial: Trial
    model: Trajectory
    system: Trajectory

    @property
    def distance(self) -> float:
        """The distance of the trial."""
        return distance_of(self.trial)


@dataclass(frozen=True, eq=False)
class ReportContext(ShortRepr):
    """Everything that the sections of a report read."""

    name: str  #: the name of the experiment
    space: TaskSpace
    trials: tuple[Trial, ...]  #: all trials, in the order of asking
    store: Store
    verdict: Verdict | None = None  #: the verdict; None if there is no threshold
    validation: Validation | None = None  #: the map p -> d(p), which is never executed; None if it is not loaded
    dynamics: CampaignDynamics | None = None  #: what the campaign has learned; None if the experiment is not loaded
    missing: str = ""  #: why the experiment is not loaded, as a sentence; empty if it is
    labels: Labels = field(default_factory=Labels)
    budget: int | None = None  #: the budget of the campaign; None if it is not known
    provenance: Provenance = field(default_factory=Provenance)  #: what a certificate knows besides the trials
    envelope: Envelope | None = None  #: the tasks on which the threshold is kept; None if it was not computed
    thinking: float | None = None  #: seconds for what pictures need of learned dynamics; None for the default

    @functools.cached_property
    def settings(self) -> Mapping[str, Any]:
        """The settings in the store, which make the experiment again."""
        return self.store.settings()

    @functools.cached_property
    def description(self) -> Mapping[str, Any]:
        """What the store knows of the experiment."""
        return self.store.description()

    @property
    def parts(self) -> Mapping[str, Any]:
        """The descriptions of the parts of the validation by name; a store may hold anything instead."""
        parts = self.description.get("validation")
        return parts if isinstance(parts, Mapping) else {}

    @functools.cached_property
    def cause(self) -> str:
        """What M lacks, as ``ctxval why`` has kept it for the present trials; empty if it has not."""
        kept = self.store.computed(CAUSE)
        return kept if isinstance(kept, str) else ""

    # Trials

    @functools.cached_property
    def completed(self) -> Trials:
        """The trials with a distance."""
        return Trials(self.trials).completed

    @functools.cached_property
    def failed(self) -> Trials:
        """The trials that failed or could not be measured."""
        return Trials(self.trials).in_state("failed", "unmeasured")

    @property
    def executions(self) -> int:
        """The number of executions of S that have ended."""
        return Trials(self.trials).executions

    @functools.cached_property
    def worst_first(self) -> tuple[Trial, ...]:
        """The trials with a distance, the largest first."""
        return tuple(sorted(self.completed, key=distance_of, reverse=True))

    def worst_tasks(self, count: int = 5, *, recorded: bool = False) -> list[Trial]:
        """Return the trials with the largest distances at different tasks, the largest first.

        A search executes its worst task several times, almost unchanged; of such trials only the first is returned.
        """
        chosen: list[Trial] = []
        for trial in self.worst_first:
            known = not recorded or trial.number in self.recordings
            if known and all(np.abs(trial.unit_point - other.unit_point).max() > NEAR for other in chosen):
                chosen.append(trial)
            if len(chosen) == count:
                break
        return chosen

    @functools.cached_property
    def points(self) -> Array:
        """The points of the unit cube with a distance ``(n, d)``."""
        return self.completed.points(self.space.dimension)

    @functools.cached_property
    def distances(self) -> Array:
        """The distances ``(n,)`` of these points."""
        return self.completed.distances

    @property
    def axes(self) -> int:
        """The number of parameters along which the distance is drawn."""
        return self.space.axes

    @property
    def task_labels(self) -> tuple[str, ...]:
        """What heads the columns of :meth:`tasks_of`: the parameters with their units, or ``task``."""
        return tuple(self.space.labelled(self.space.low))

    def tasks_of(self, trials: Sequence[Trial]) -> list[list[float | str]]:
        """Return one row for each trial: the parameters of its task, or its name if it is one of a suite."""
        return [list(self.space.labelled(point).values()) for point in self.coordinates(trials)]

    def coordinates(self, trials: Sequence[Trial]) -> Array:
        """Return the tasks of trials in the units of the parameters, ``(n, d)``."""
        return self.space.from_unit(Trials(trials).points(self.space.dimension))

    # The verdict

    @property
    def threshold(self) -> float | None:
        """The threshold of the verdict; None if there is none."""
        return None if self.verdict is None else self.verdict.threshold

    @property
    def certificate(self) -> Certificate | None:
        """The certificate of the verdict; None if there is none."""
        return None if self.verdict is None else self.verdict.certificate

    @property
    def bound(self) -> float | None:
        """The bound on d*; None if there is none, or it is withdrawn."""
        return None if self.verdict is None else self.verdict.bound

    @property
    def limits(self) -> list[float]:
        """The threshold and the bound, as far as there are any."""
        return [limit for limit in (self.threshold, self.bound) if limit is not None]

    @property
    def designs(self) -> str | None:
        """Which controllers did not converge or jump, as a clause; None if that is not known of any."""
        return designs_sentence(self.trials)

    # Trajectories

    @functools.cached_property
    def recordings(self) -> dict[int, TrajectoryPair]:
        """The trajectories of the worst trials that have both, by number; those of another size are left out."""
        pairs, first = dict[int, TrajectoryPair](), None
        for trial in self.worst_first[:400]:
            model, system = (self.store.trajectory(trial.number, side) for side in ("model", "system"))
            if model is None or system is None or model.batch_shape or system.batch_shape:
                continue
            widths = system.states.shape[-1], system.inputs.shape[-1]
            alike = model.states.shape == system.states.shape and model.inputs.shape == system.inputs.shape
            if alike and model.horizon and model.finite and system.finite and widths == (first or widths):
                first = widths
                pairs[trial.number] = TrajectoryPair(trial, model, system)
        return pairs

    @functools.cached_property
    def signals(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The labels of the states and of the inputs, with units."""
        if not self.recordings:
            return (), ()
        run = next(iter(self.recordings.values())).system
        system = None if self.validation is None else self.validation.system
        states, inputs = self.labels.names(system, run.states.shape[-1], run.inputs.shape[-1])
        return labels_of(states), labels_of(inputs)

    @property
    def distance_label(self) -> str:
        """The label of an axis of the distance."""
        return f"distance [{self.labels.units}]" if self.labels.units else "distance"

    # What follows from them

    @functools.cached_property
    def diagnostics(self) -> list[Finding]:
        """What would speak against the verdict."""
        return findings_of(self, DIAGNOSTICS)

    @functools.cached_property
    def insights(self) -> list[Finding]:
        """What the trials show of M, of the controllers and of the tasks."""
        return findings_of(self, INSIGHTS)

    @functools.cached_property
    def not_tested(self) -> list[str]:
        """What was not tested, one sentence each."""
        return not_tested(self)

    @functools.cached_property
    def distance_model(self) -> DistanceModel | None:
        """The distance over the tasks as the trials show it; None if it cannot be fitted."""
        return DistanceModel.of(self.completed, self.space)

    @property
    def batched(self) -> bool:
        """Whether the experiment is loaded, and its synthesizer designs many controllers at once."""
        return self.validation is not None and bool(getattr(self.validation.synthesizer, "batched", False))

    @contextmanager
    def thinks(self) -> Iterator[CampaignDynamics]:
        """Give the learned dynamics, whose budget is meanwhile that of the report."""
        assert self.dynamics is not None
        with self.dynamics.thinking.limited(self.thinking):
            self.dynamics.thinking.measure(self.trials)
            yield self.dynamics

    @functools.cached_property
    def replays(self) -> dict[int, Replay]:
        """The replays of the trials with recordings on the corrected model, by number; empty without the experiment."""
        if self.validation is None or self.dynamics is None or not self.recordings:
            return {}
        # Designs that cannot be made in a batch take long.
        points = [pair.trial.unit_point for pair in self.recordings.values()][: 120 if self.batched else 40]
        with stage("replaying executed tasks", len(points), "tasks"), self.thinks() as dynamics:
            learned = dynamics.learned(self.trials) if dynamics.affords(self.trials, len(points)) else None
            replays = replay_executed(self.validation, learned, points)
        return {k: replay for k, replay in zip(self.recordings, replays, strict=False) if replay is not None}


def context_of_campaign(
    campaign: Campaign,
    verdict: Verdict | None = None,
    *,
    threshold: float | None = None,
    certificate: CertificateOptions | None = None,
    budget: int | None = None,
    envelope: Envelope | None = None,
    thinking: float | None = None,
) -> ReportContext:
    """Return what a report of a campaign is made from.

    Its verdict is ``verdict``, if that was computed before, or else that against ``threshold`` by ``certificate``. If
    it is falsified and the tests of an envelope were executed, the envelope is ``envelope`` or computed. Verdict and
    pictures take at most ``thinking`` seconds each, as in :meth:`ctxval.Campaign.verdict`; infinity for no limit.
    """
    options = certificate or CertificateOptions()
    known = campaign.provenance
    if verdict is None and threshold is not None:
        # A report only reads: it does not record that the threshold was stated.
        verdict, known = campaign.judged(threshold, options, thinking)
    falsified = verdict is not None and verdict.answer == "falsified"
    if envelope is None and verdict is not None and falsified and has_tests(campaign.recorder, options):
        envelope = campaign.envelope(verdict.threshold, options.confidence, certificate=options, thinking=thinking)
    return ReportContext(
        campaign.name,
        campaign.validation.space,
        campaign.trials,
        campaign.store,
        verdict,
        campaign.validation,
        campaign.recorder.dynamics,
        labels=campaign.validation.labels,
        budget=budget,
        provenance=known,
        envelope=envelope,
        thinking=thinking,
    )


def context_of_store(
    store: Store,
    threshold: float | None = None,
    *,
    certificate: CertificateOptions | None = None,
    missing: str = "the experiment is not loaded",
    labels: Labels | None = None,
    budget: int | None = None,
) -> ReportContext:
    """Return what a report of a store is made from, if its experiment is not loaded. No code is imported or run.

    Without ``threshold`` there is no verdict; ``missing`` says why the experiment is not loaded, as a sentence.

    Raises:
        InputError: if the store has no readable task space.
    """
    with store.snapshot():
        name, trials = store.description().get("name"), tuple(store.trials())
    known = provenance_of_store(store)
    space = known.space
    if space is None or any(len(trial.unit_point) != space.dimension for trial in trials):
        raise InputError(f"{store.name} has no readable task space, so there is nothing to report.")
    verdict = None if threshold is None else judge(trials, threshold, certificate, known)
    return ReportContext(
        name if isinstance(name, str) else "",
        space,
        trials,
        store,
        verdict,
        missing=missing,
        labels=labels or Labels(),
        budget=budget,
        provenance=known,
    )
