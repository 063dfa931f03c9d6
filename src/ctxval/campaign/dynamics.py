"""What the trajectories of a campaign teach of the dynamics: predictions of executions, and evidence on d*."""

from __future__ import annotations

import contextlib
import hashlib
import json
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ctxval import learning
from ctxval._util.arrays import Array
from ctxval._util.latest import Latest
from ctxval._util.progress import stage
from ctxval._util.texts import reason_of
from ctxval.campaign.history import at_points, executed_trials
from ctxval.campaign.storage.store import Store
from ctxval.campaign.thinking import CampaignThinking, TimeShortage
from ctxval.certificates.checks import is_open
from ctxval.certificates.dynamics import draws_for
from ctxval.certificates.evidence import Evidence, Learned, SuiteRuns
from ctxval.certificates.explained import ExplainedExecution
from ctxval.certificates.limits import LIMITS
from ctxval.certificates.options import CertificateOptions
from ctxval.certificates.predictions import CheckedPrediction
from ctxval.certificates.sample import Sample
from ctxval.core.target import LARGEST_DISTANCE, Target
from ctxval.core.task_suite import TaskSuite
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.core.trial import REDEFINED, Trial, Trials
from ctxval.core.trial_note import TrialNote
from ctxval.core.validation import Validation
from ctxval.errors import CertificateError
from ctxval.searches import Prediction
from ctxval.searches.base import Pending

if TYPE_CHECKING:
    from ctxval.learning import (
        DynamicsStudy,
        Executed,
        ExecutionPrediction,
        LearnedDynamics,
        Ledger,
        Sensitivity,
        Thinking,
        WorstCase,
    )

    _Known = tuple[Sequence[Trajectory], LearnedDynamics | None, str | None, Ledger]

NEAR = 0.02  #: a task that differs from an executed one by less than this in every coordinate is no new one


def prediction_in(note: TrialNote) -> ExecutionPrediction | None:
    """Return the prediction of an execution in the note of its trial, of whichever distance; None if there is none."""
    return None if note.prediction is None else learning.ExecutionPrediction.from_json(note.prediction)


class SensitivityWarning(UserWarning):
    """Closed loops on M are not smooth, so that the largest distance over the tasks is no stable number."""


class CampaignDynamics:
    """The dynamics learned from the trials of a campaign. The system is never executed.

    Users' parts run here at states that no execution has reached, so any exception of theirs means that nothing is
    learned or predicted; it must not end a campaign. ``failure`` is the last one in words.

    A stored prediction belongs to one ``experiment``, a digest of the description and of how often the distance has
    changed. ``extra_recordings`` returns recordings of the same system that belong to no trial of this campaign: they
    teach the dynamics, and they are no executions of this model's controllers.
    """

    def __init__(self, validation: Validation, store: Store, seed: int, description: Mapping[str, Any]) -> None:
        redefined = sum(change.why == REDEFINED for change in store.history())
        identity = [redefined, description.get("validation"), *validation.physical]
        text = json.dumps(identity, sort_keys=True)
        self.experiment = hashlib.sha256(text.encode()).hexdigest()[:16]
        self._store = store
        self.extra_recordings: Callable[[], Sequence[Trajectory]] = tuple
        self.failure: str | None = None
        self.sensitivity: Sensitivity | None = None  #: of M, if its closed loops are not smooth
        self.shortage: TimeShortage | None = None  #: why the last verdict has no evidence; None if it has some
        self._validation, self._seed = validation, seed
        self._target: Target = LARGEST_DISTANCE
        self._study: DynamicsStudy | None = None
        self._use(None)
        manual = bool(getattr(validation.system, "manual", False))
        self.thinking = CampaignThinking(lambda: self.study, manual)

    @property
    def study(self) -> DynamicsStudy:
        """What learns; a finished campaign, whose evidence is stored, needs none."""
        if self._study is None:
            self._study = learning.DynamicsStudy(self._validation, self._seed, self._target)
        return self._study

    def _use(self, study: DynamicsStudy | None) -> None:
        self._study = study
        self._learned: Latest[tuple[object, ...], _Known] = Latest(LIMITS.predictions + 3)
        self._of_suite: Array | None = None  # the ends of the run of M on each task of a suite, (N, 2, n + m)
        self._parts: tuple[str, bytes] | None = None  # of the study, when it learned first
        # Predictions that no store has, by their trials: each verdict checks those of the last trials.
        self._afterwards: Latest[Any, ExecutionPrediction | None] = Latest(2 * LIMITS.predictions)

    def ask_of(self, target: Target) -> None:
        """State what is asked for, before it is known whether the system is noisy."""
        if target != self._target:
            self._target = target
            self._use(None if self._study is None else self._study.fresh_copy(target))

    def learned(self, trials: Sequence[Trial], *, alone: bool = False) -> LearnedDynamics | None:
        """Return what the completed trials, and unless ``alone`` other recordings teach; None if it is nothing."""
        executed, others = executed_trials(self._store, trials), () if alone else self.extra_recordings()
        if self._parts is not None and self._parts != self.study.state_of_parts():  # they were changed in place
            self._use(self.study.fresh_copy())
        # The other recordings are kept with what they taught, so that their identities stay theirs. A result may be
        # replaced, and then has another distance.
        allowed = self._allowed(trials)
        results = tuple((trial.number, trial.distance) for trial, _ in executed)
        key = (self.thinking.after(trials), allowed, *results, *map(id, others))
        if key not in self._learned:
            learned, failure = None, None
            ledger = self.thinking.ledger(trials, len(executed))
            try:
                with ledger.spending("learning"):
                    if not ledger.spent_up:
                        self._parts = self._parts or self.study.state_of_parts()
                        learned = self.study.learn(at_points(executed), others, allowed, ledger)
            except Exception as error:  # users' parts
                failure = reason_of(error)
            self._learned[key] = others, learned, failure, ledger
        _, learned, self.failure, self._ledger = self._learned[key]
        return learned

    def ledger(self, trials: Sequence[Trial]) -> Ledger:
        """Return the budget of the choice after trials, and what its stages took."""
        self.learned(trials)
        return self._ledger

    def has_no_time(self, trials: Sequence[Trial]) -> bool:
        """Return whether the budget of the choice after trials allows no closed loops; nothing is learned."""
        if self.thinking.after(trials) is None:  # then no trajectory is read
            return False
        return self.thinking.ledger(trials, len(executed_trials(self._store, trials))).spent_up

    def affords(self, trials: Sequence[Trial], loops: int) -> bool:
        """Return whether loops on what trials teach fit into a budget of their own, beside that of learning it."""
        ledger = self.ledger(trials)
        seconds = ledger.seconds("loops", lambda costs: costs.plan(loops) + costs.run(1, loops))
        return ledger.costs is None or seconds <= ledger.costs.thinking.seconds

    def noted(self, trials: Sequence[Trial]) -> dict[str, Any]:
        """Return fields of the note of the next trial: the thinking on its task, if it is limited, and sensitivity."""
        sensitivity = None if trials or self.sensitivity is None else self.sensitivity.to_json()
        thinking = self.thinking.noted(trials, self.ledger(trials) if trials else learning.Ledger())
        return {"thinking": thinking, "sensitivity": sensitivity}

    def find_sensitivity(self, threshold: float | None) -> None:
        """Warn if small changes of M change distances as far as matters to a threshold; the first trial stores it.

        Nothing is found without a budget of thinking, or if it does not suffice.
        """
        self.thinking.measure(())
        thinking = self.thinking.after(())
        if thinking is not None:
            with contextlib.suppress(Exception):  # users' parts
                self.sensitivity = learning.found_sensitivity(self.study.planner, thinking, threshold)
        if self.sensitivity is not None:
            units = self.study.given.labels.units
            warnings.warn(self.sensitivity.in_words(units), SensitivityWarning, stacklevel=2)

    def _allowed(self, trials: Sequence[Trial]) -> float:
        """Return the distance that is negligible beside all stated thresholds; 0 if executed ones are larger."""
        least = min((stated.threshold for stated in self._store.thresholds() or ()), default=0.0)
        allowed = learning.AgreementSettings().share * least
        return allowed if Trials(trials).largest <= allowed else 0.0

    def regular(self, trials: Sequence[Trial]) -> LearnedDynamics | None:
        """Return what the regular transitions of the completed trials teach; None if there are no irregular ones."""
        return self.study.regular(at_points(executed_trials(self._store, trials)))

    def prediction(self, trials: Sequence[Trial], *, pending: bool = False) -> Prediction | None:
        """Return the distance predicted from the executed trajectories, for a search; None if there is none.

        With ``pending``, open trials count as if they had been executed as predicted. How good a prediction is, is
        still seen from what was executed.
        """
        learned = self.learned(trials)
        executed, waiting = at_points(executed_trials(self._store, trials)), self._waiting(trials)
        prediction = self.study.prediction_of(learned, executed)
        if prediction is None or not pending or not len(waiting):
            return prediction
        otherwise = prediction.otherwise

        def after() -> Prediction:
            as_if = None if learned is None else self._as_if(learned, executed, waiting)
            return (None if as_if is None else self.study.prediction_of(as_if, executed)) or prediction

        def fallback() -> Prediction | None:
            other = None if otherwise is None else otherwise()
            return None if other is None else replace(other, pending=Pending(waiting, lambda: other))

        return replace(prediction, otherwise=fallback, pending=Pending(waiting, after))

    def _waiting(self, trials: Sequence[Trial]) -> Array:
        return Trials(trials).open.points(self.study.validation.space.dimension)

    def _as_if(self, learned: LearnedDynamics, executed: Executed, waiting: Array) -> LearnedDynamics | None:
        try:
            return self.study.as_if_executed(learned, executed, learned.trajectories(waiting), self.extra_recordings())
        except Exception:  # users' parts
            return None

    def predict(self, trials: Sequence[Trial], point: Array, *, alone: bool = False) -> ExecutionPrediction | None:
        """Return the prediction at a point ``(d,)``, with ``alone`` from trials alone; None if there is none."""
        try:
            with stage("predicting the execution", unit="closed loops"), self.ledger(trials).spending("loops"):
                learned = self.learned(trials, alone=alone)
                return None if learned is None else learned.predict(point)
        except Exception:  # users' parts
            return None

    def screening(self, trials: Sequence[Trial], *, pending: bool = False) -> Evidence | None:
        """Return quick evidence, whose bound is too low and whose diagnostics lack expensive ones.

        It has a few draws, and none but the posterior mean after fewer executions than a bound needs. With ``pending``
        as in :meth:`prediction`, it helps to choose a task and decides nothing.
        """
        if self.has_no_time(trials):
            return None
        ledger, loops = self.ledger(trials), self.study.search.screening_loops
        with stage("searching the learned dynamics", loops, "closed loops"), ledger.spending("loops"):
            learned = self.learned(trials)
            few = learned is not None and len(learned.executed) < LIMITS.fewest
            if learned is not None and pending:
                learned = self._as_if(learned, at_points(executed_trials(self._store, trials)), self._waiting(trials))
            try:
                worst = None if learned is None else learned.worst_of_mean if few else learned.screened
                return None if learned is None or worst is None else self._evidence(learned, trials, worst)
            except Exception as error:  # users' parts
                self.failure = reason_of(error)
                return None

    def evidence(self, trials: Sequence[Trial], confidence: float, *, keep: bool = False) -> Evidence | None:
        """Return what the learned dynamics say about d*, which the store may keep; None if nothing can be learned."""
        kept = self.kept_evidence(trials, confidence)
        if kept is not None:
            return kept
        digest, draws, self.shortage = self._store.digest(), draws_for(confidence), None
        loops = None if self.has_no_time(trials) else self.study.search.expected_loops(draws)
        with stage("searching the learned dynamics", loops, "closed loops"):
            try:
                evidence = self._within_budget(trials, confidence)
            except Exception as error:  # users' parts
                self.failure, evidence = reason_of(error), None
        if keep and evidence is not None and not self.extra_recordings():
            self._store.keep_computed(self._key(trials, confidence), evidence.to_json(), digest)
        return evidence

    def _within_budget(self, trials: Sequence[Trial], confidence: float) -> Evidence | None:
        """Return the whole evidence; None if nothing can be learned, or if the budget of a verdict does not suffice."""
        with self.deciding(trials) as (learned, ledger, budget):
            if budget is None or ledger.costs is None:
                return None if learned is None else self._whole(learned, trials, confidence, ledger)
            if learned is None and not ledger.spent_up:
                return None
            by, draws, replicates = self.study.search.settings, draws_for(confidence), 1
            if learned is not None and learned.is_complete:
                replicates = 1 if learned.noisy is None else learned.noisy.replicates
                learned = learned.with_whole_search()
            with ledger.within(budget), ledger.spending("loops"):
                # Errors of M that are negligible are no function to search.
                is_cheap = learned is not None and not learned.posterior.data.learned.any()
                needed = 0.0 if is_cheap else ledger.seconds("loops", lambda costs: costs.whole(by, draws, replicates))
                if learned is not None and not ledger.incomplete and needed <= ledger.left:
                    ledger.add("loops", needed)
                    evidence = self._whole(learned, trials, confidence, ledger)
                    if not ledger.missing:
                        return replace(evidence, replaced=tuple(dict.fromkeys(ledger.replaced)))
                    needed = ledger.missing
                needed += sum(ledger.expected.values()) + ledger.incomplete
                self.shortage = TimeShortage(needed, budget.seconds, tuple(dict.fromkeys(ledger.replaced)))
                return None

    @contextlib.contextmanager
    def limited(self, thinking: float | None, trials: Sequence[Trial]) -> Iterator[None]:
        """Limit all that is computed of trials meanwhile to a number of seconds; None for the default."""
        self.shortage = None
        with self.thinking.limited(thinking):
            self.thinking.measure(trials)
            yield

    def ledger_of_decision(self, thinking: float | None, trials: Sequence[Trial]) -> Ledger:
        """Return a ledger with the time of a verdict, for a study that learns nothing else."""
        with self.limited(thinking, trials), self.thinking.deciding():
            budget = self.thinking.after(trials)
        if budget is None:
            return learning.Ledger()
        known = Trials(trials).executions
        return learning.Ledger(
            learning.Costs(budget, learning.Sizes.of(budget.speed, self.study.validation.space.dimension, known, 0))
        )

    @contextlib.contextmanager
    def deciding(self, trials: Sequence[Trial]) -> Iterator[tuple[LearnedDynamics | None, Ledger, Thinking | None]]:
        """Give what trials teach in the time of a verdict, the ledger of this, and the budget of the verdict."""
        learned, ledger = self.learned(trials), self.ledger(trials)
        with contextlib.ExitStack() as stack:
            with self.thinking.deciding():
                budget = self.thinking.after(trials)
            if budget is not None and ledger.costs is not None:
                # The choice of a task may have left out what the longer time of a verdict allows.
                incomplete = ledger.spent_up or (learned is not None and not learned.is_complete)
                if incomplete and budget.seconds > ledger.costs.thinking.seconds:
                    stack.enter_context(self.thinking.deciding())
                    learned, ledger = self.learned(trials), self.ledger(trials)
            yield learned, ledger, budget

    def kept_evidence(self, trials: Sequence[Trial], confidence: float) -> Evidence | None:
        """Return :meth:`evidence` that the store keeps for these trials; None if there is none."""
        if self.extra_recordings():
            return None
        return Evidence.from_json(self._store.computed(self._key(trials, confidence)))

    def _key(self, trials: Sequence[Trial], confidence: float) -> str:
        of_trials = ((trial.number, trial.state, trial.distance, trial.note.to_json()) for trial in trials)
        text = json.dumps([self._allowed(trials), *of_trials])
        physical = "".join(f"{name} " for name in self._validation.physical)
        return f"evidence {confidence} {self._target} {physical}{hashlib.sha256(text.encode()).hexdigest()}"

    def _whole(self, learned: LearnedDynamics, trials: Sequence[Trial], confidence: float, ledger: Ledger) -> Evidence:
        draws, drawn_from = draws_for(confidence), learned.drawn_from
        without_model = learned.posterior.covariances.without_model
        known = {"noise": drawn_from.noise, "groups": drawn_from.functions_for(draws), "without_model": without_model}
        evidence = self._evidence(learned, trials, learned.worst_case_of(draws), confidence=confidence, **known)
        names, part = len(self.study.given.space.units) + 1, "the parameter that the dynamics seem to depend on"
        asks = evidence.failed is not None
        asks = asks and ledger.optional("learning", part, lambda costs: names * costs.learning())
        influential, study = learned.influential, learned.study
        executed = at_points(executed_trials(self._store, trials)) if asks else []
        evidence = replace(
            evidence,
            executed=self._explained(learned, trials),
            influential=None if influential is None else tuple(influential.tolist()),
            drift=learned.drift,
            uneven=learned.uneven_friction,
            suspect=study.suspected_parameter(learned, executed) if asks else None,
        )
        # How many tests a verdict needs is not known here. Negligible errors are no function to search, nor to push.
        if evidence.negligible or is_open(evidence, "learning", "coverage", "tested", "explained", "search"):
            return evidence
        if self.study.target.by_draws:  # no largest distance is searched
            return replace(evidence, unvisited_region=learned.unvisited_region)
        # Many closed loops, which only matter to a bound that nothing else withdraws.
        jump, further = learned.study.search.largest_jump(drawn_from), dict[str, Any]()
        further |= {"jump": jump, "unvisited_region": learned.unvisited_region}
        # The maxima of a distance with kinks lie on ridges, which deeper searches climb higher.
        if learning.is_kinked(learned.study.given.distance) or (
            evidence.low_dimensional and replace(evidence, jump=jump).jumps
        ):
            if not ledger.fits("loops", lambda costs: costs.intensified(learned.search.settings)):
                ledger.missing = ledger.seconds("loops", lambda costs: costs.intensified(learned.search.settings))
                return replace(evidence, **further)
            values, points = learned.intensified_search
            low, high = values.min(), values.max()
            further["disagreement"] = float(1 - low / high) if high > 0 else 0.0
            if high > evidence.highest:
                local_maxima = np.concatenate([points[values.argmax()][None], evidence.local_maxima])
                further |= {
                    "search_shortfall": float(high / evidence.highest),
                    "highest": float(high),
                    "local_maxima": local_maxima,
                }
        # A push is compared with residuals of state and input, which do not hold with noise.
        if learned.noisy is None and ledger.optional(
            "loops", "pushes that the bound survives", lambda costs: costs.pushes(learned.search.settings)
        ):
            further["pushed"] = learned.push_response
        return replace(evidence, **further)

    def _explained(self, learned: LearnedDynamics, trials: Sequence[Trial]) -> tuple[ExplainedExecution, ...]:
        """Return all executions beside what they teach."""
        executed, points = executed_trials(self._store, trials), learned.executed
        noisy = learned.predicts_distributions
        expected = [] if noisy else np.nan_to_num(learned.expected(points), nan=np.inf).tolist()
        predictions, explained = learned.predictions(points) if noisy else [None] * len(points), []
        for k, ((trial, trajectory), prediction) in enumerate(zip(executed, predictions, strict=True)):
            distance, at = trial.distance or 0.0, tuple(trial.unit_point.tolist())
            if not noisy:
                explained.append(ExplainedExecution(trial.number, at, distance, expected[k]))
            elif prediction is not None and prediction.noise is not None:
                score, noise = prediction.score(trajectory, distance), prediction.noise
                p_values = () if score is None else score.p_values
                law = prediction.median, noise.distances, noise.runs, p_values
                explained.append(ExplainedExecution(trial.number, at, distance, *law))
        return tuple(explained)

    def _evidence(
        self, learned: LearnedDynamics, trials: Sequence[Trial], worst: WorstCase, noise: float = 0.0, **known: Any
    ) -> Evidence:
        noisy, asked, predictions = learned.noisy, self.study.target, list(self.checked(trials))
        # Drawn tests come with the distances of their tasks on what is learned by now.
        drawn = [k for k, test in enumerate(predictions) if test.is_test and not test.is_noisy]
        if drawn:
            expected = learned.expected(np.array([predictions[k].point for k in drawn]))
            for k, distance in zip(drawn, np.nan_to_num(expected, nan=1e30, posinf=1e30).tolist(), strict=True):
                predictions[k] = replace(predictions[k], explained=distance)
        if learned.negligible:
            predictions = [replace(each, negligible=learned.negligible) for each in predictions]
        return Evidence(
            **vars(worst),
            executions=len(learned.executed),
            noise=noise,
            predictions=tuple(predictions),
            coverage=learned.coverage,
            unsampled_parameter=learned.unsampled_parameter,
            unsampled_corner=learning.unsampled_corner(
                learned.executed, self.study.validation.space, learned.coverage.task
            ),
            # Loops on M with other parameters are cheap enough to search more of them.
            low_dimensional=self.study.planner.batched
            and (worst.points.shape[1] <= LIMITS.low_dimensional or bool(learned.values)),
            target=asked.with_noise() if noisy is not None and noisy.is_noisy else asked,
            lags=0 if noisy is None else noisy.fit.history.structure.lags,
            acting=learned.acting,
            friction=learned.friction,
            untested_rest=learned.untested_rest,
            parameters=learned.values,
            scatter=learned.scatter if learned.predicts_distributions else 0.0,
            physical=learned.study.given.physical,
            without_data=not learned.with_data,
            estimated=learned.study.given.outputs.hide_states,
            negligible=learned.negligible,
            best=Trials(trials).largest,
            worst=() if (largest := Trials(trials).worst) is None else tuple(largest.unit_point.tolist()),
            idle=tuple(learned.unseen_parameters),
            **known,
        )

    def checked(self, trials: Sequence[Trial]) -> tuple[CheckedPrediction, ...]:
        """Return the predictions of completed trials; of those without a stored one, of the last few that have any."""
        completed = Trials(trials).completed
        checked = []
        for place, trial in enumerate(completed):
            before = completed[:place]
            prediction = stored = self.stored_prediction(trial)
            if stored is None:
                if place < len(completed) - LIMITS.predictions - 1:
                    continue
                part = "predictions of executions afterwards"
                if not self.ledger(trials).optional(
                    "learning", part, lambda costs: costs.learning() + costs.prediction(40)
                ):
                    continue
                if self.learned(before, alone=True) is None:
                    continue
                key = tuple((each.number, each.distance) for each in completed[: place + 1])
                if key not in self._afterwards:
                    self._afterwards[key] = self.predict(before, trial.unit_point, alone=True)
                prediction = self._afterwards[key]
            known = Trials(before).points(len(trial.unit_point))
            how: dict[str, Any] = {
                "stored": stored is not None,
                "new": not len(known) or float(np.abs(known - trial.unit_point).max(axis=1).min()) > NEAR,
                "origin": trial.origin,
                "point": tuple(trial.unit_point.tolist()),
            }
            distance, rank, median, upper, z2 = trial.distance or 0.0, np.nan, np.inf, np.inf, np.nan
            if prediction is not None:
                median, upper = prediction.median, prediction.upper
                trajectory = self._store.trajectory(trial.number, "system")
                if trajectory is not None and (score := prediction.score(trajectory, distance)) is not None:
                    z2, rank = score.z2, score.rank
                    if prediction.noise is not None:
                        noise = prediction.noise
                        how |= {"quantiles": noise.distances, "runs": noise.runs, "p_values": score.p_values}
            checked.append(CheckedPrediction(trial.number, rank, median, upper, distance, z2, **how))
        return tuple(checked)

    def expected(self, trials: Sequence[Trial], points: Array, before: int) -> Array:
        """Return distances ``(m,)`` at points ``(m, d)`` predicted from trials with smaller numbers; NaN if unknown."""
        prediction = self.prediction([trial for trial in trials if trial.number < before])
        return np.full(len(points), np.nan) if prediction is None else prediction.expected(points)[0]

    def learned_for(self, trials: Sequence[Trial], options: CertificateOptions) -> Learned:
        """Return what a certificate of all trials reads of the learned dynamics."""
        kind, space = options.kind, self._validation.space
        with contextlib.suppress(CertificateError):  # the certificate refuses the trials itself
            sample = replace(Sample.of(trials), suite=space.members)
            if kind.needs_evidence(sample):
                self.ask_of(kind.target)
                evidence = self.evidence(trials, options.confidence)
                if evidence is not None:
                    return Learned(evidence)
                return Learned(None, self.failure, self.runs_of_suite(trials))
        return Learned()

    def runs_of_suite(self, trials: Sequence[Trial]) -> SuiteRuns | None:
        """Return how far runs of M on the tasks of a suite leave the records, with the features of its tasks.

        Returns None if tasks fill a box, if a parameter is a category, or if S records outputs.
        """
        space = self.study.given.space
        features = space.features if isinstance(space, TaskSuite) else None
        if features is None or self.study.given.outputs.hide_states:
            return None
        records = [_ends(run.states, run.inputs) for _, run in executed_trials(self._store, trials)]
        data = getattr(self.study.given.model, "data", None)
        records += [_ends(data.x, data.u)] if isinstance(data, Transitions) else []
        if not records:
            return None
        if self._of_suite is None:
            of_suite = np.full((len(features), *records[0].shape), np.nan)
            with stage("planning the suite", len(features), "tasks"):
                for row, member in enumerate(np.asarray(space.members)):
                    for planned in self.study.planner.plan(member[None]):
                        of_suite[row] = _ends(planned.nominal.states, planned.nominal.inputs)
            self._of_suite = of_suite
        recorded = np.concatenate(records)
        beyond = learning.beyond_range(recorded, self._of_suite) / np.maximum(np.ptp(recorded, axis=0), 1e-9)
        return SuiteRuns(features, np.where(np.isfinite(beyond), beyond, np.inf).max(axis=(1, 2)))

    def stored_prediction(self, trial: Trial) -> ExecutionPrediction | None:
        """Return the prediction that was stored before an execution, if it is one of the present distance."""
        stored = trial.note.prediction
        return None if stored is None or stored.get("experiment") != self.experiment else prediction_in(trial.note)


def _ends(states: Array, inputs: Array) -> Array:
    """Return the smallest and the largest of states ``(..., n)`` and inputs ``(..., m)``, ``(2, n + m)``."""
    both = [part.reshape(-1, part.shape[-1]) for part in (states, inputs)]
    return np.array([np.concatenate([end(part, axis=0) for part in both]) for end in (np.min, np.max)])
