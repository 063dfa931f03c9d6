"""Why a model fails: causes that evidence chooses, and that predict held-out executions in closed loop."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval._util.progress import advance, stage
from ctxval._util.representation import ShortRepr
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.history import at_points, executed_trials
from ctxval.core.plan import Plan, observation_delay
from ctxval.core.trajectory import Trajectory
from ctxval.core.trial import Trial
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError, DistanceError, InputError
from ctxval.learning.effects.dictionary import candidates
from ctxval.learning.effects.effect import Effect, EffectCandidate, all_sized
from ctxval.learning.effects.fit import Explanation, Segments, SegmentSettings, explained, screened
from ctxval.learning.effects.force import Force
from ctxval.learning.effects.joint_stop import seen_stops
from ctxval.learning.effects.model import ModelWithEffects
from ctxval.learning.effects.mujoco import SharedAttribute, attribute_of, further_attributes
from ctxval.learning.effects.plant import plant_of
from ctxval.learning.effects.sensor import SensorOffset, wrapped_angles
from ctxval.learning.effects.transport import ObservationDelay
from ctxval.learning.effects.uncertain import UncertainEffects
from ctxval.learning.extended import estimates_by_loops_on_model
from ctxval.learning.input_effects import input_candidates
from ctxval.learning.parameter_posterior import PRIOR_SEARCH, ParameterSettings, most_probable
from ctxval.learning.stage_costs import Ledger
from ctxval.models import MuJoCo
from ctxval.studies.causes.budget import CauseCosts, CauseSettings, fitting_settings
from ctxval.studies.causes.report import CauseReport, Explained, Separating


@dataclass(frozen=True, eq=False)
class ExecutedTask(ShortRepr):
    """An executed task: its plan, and what the system did; if the execution failed, the steps before its failure."""

    plan: Plan
    executed: Trajectory


@dataclass(frozen=True, eq=False)
class Predicted(ShortRepr):
    """What a model with causes predicts of an execution."""

    deviation: float  #: the mean squared deviation of the execution from the mean of the loops, in shares of ranges
    by_noise: Array  #: those of loops with noise from their mean, shape ``(K,)``; 0 without noise
    distance: float  #: between the execution and the mean of the loops


class ClosedLoops:
    """Executions, their deviations and distances from the loops on M, and closed loops on models with causes."""

    def __init__(self, validation: Validation, executions: Sequence[ExecutedTask], draws: int = 12) -> None:
        self.validation, self.executions, self.draws = validation, executions, draws
        whole = [np.concatenate([getattr(each.executed, name) for each in executions]) for name in ("states", "inputs")]
        self.ranges, self.efforts = (np.maximum(np.ptp(values, axis=0), 1e-12) for values in whole)
        pairs = [(each, each.plan.model_trajectory.first(each.executed.horizon)) for each in executions]
        self.without = [self._deviation(each.executed, loop) for each, loop in pairs]
        self.distances = [self._distance(each, loop) for each, loop in pairs]

    def predicted(self, repaired: ModelWithEffects, execution: ExecutedTask, noise: Array) -> Predicted:
        """Return the prediction of an execution from where it began: the mean of loops with noise.

        Noise of measurements, white with standard deviations ``(n,)``, acts on the system through the controller, and
        may move it out of dead zones and plays.
        """
        loops = self._noisy(repaired, execution, noise)
        if not loops:
            start = None if self.validation.outputs.hide_states else execution.executed.states[0]
            loop = self.of_plan(repaired, execution.plan, execution.executed.horizon, start)
            if loop is None:
                return Predicted(np.inf, np.zeros(1), np.inf)
            loops = [loop]
        means = (np.mean([getattr(loop, name) for loop in loops], axis=0) for name in ("states", "inputs"))
        mean = Trajectory(loops[0].times, *means)
        by_noise = np.array([self._deviation(loop, mean) for loop in loops]) * (len(loops) + 1) / max(len(loops) - 1, 1)
        return Predicted(self._deviation(execution.executed, mean), by_noise, self._distance(execution, mean))

    def distance_from_tasks(self, repaired: ModelWithEffects) -> float | None:
        """Return the largest distance of executions from loops that begin where tasks begin; None if a loop fails."""
        loops = (
            (each, self.of_plan(repaired.in_run(k), each.plan, each.executed.horizon))
            for k, each in enumerate(self.executions)
        )
        largest = max(np.inf if loop is None else self._distance(each, loop) for each, loop in loops)
        return largest if np.isfinite(largest) else None

    def of_plan(
        self, repaired: ModelWithEffects, plan: Plan, steps: int, start: Array | None = None
    ) -> Trajectory | None:
        """Return the first steps of a plan's closed loop on a model with causes, without noise; None if it fails."""
        system = self.validation.outputs.recording(repaired)
        try:
            loop = system.execute(plan.controller, plan.task if start is None else plan.task.starting_at(start))
        except Exception:  # the user's own parts, at states that they never saw
            return None
        loop = loop.first(steps)
        return loop if loop.finite.all() else None

    def _noisy(self, repaired: ModelWithEffects, execution: ExecutedTask, noise: Array) -> list[Trajectory]:
        """Return loops with noise; none if there is no noise, or if one fails."""
        if not noise.any():
            return []
        plan, start = execution.plan, execution.executed.states[0]
        drawn = noise * np.random.default_rng(0).standard_normal((plan.task.horizon + 1, self.draws, len(noise)))

        def of(draws: int | slice) -> Trajectory:
            initial = np.broadcast_to(start, drawn[0, draws].shape)
            loop = repaired.execute(plan.controller, plan.task.starting_at(initial), drawn[:, draws])
            return loop.first(execution.executed.horizon)

        loops: list[Trajectory] = []
        with contextlib.suppress(Exception):  # the user's own parts, at states that they never saw
            first = of(0)
            with contextlib.suppress(Exception):  # a controller that takes no batch
                together = of(slice(None))
                if np.allclose(together.states[0], first.states, rtol=1e-6, atol=1e-9 * float(self.ranges.max())):
                    loops = [together[k] for k in range(self.draws)]
            loops = loops or [first, *(of(k) for k in range(1, self.draws))]
        return loops if all(loop.finite.all() for loop in loops) else []

    def _deviation(self, executed: Trajectory, loop: Trajectory) -> float:
        """Return the mean squared deviation of a loop from another one without white noise, in shares of ranges."""
        squares = 0.0
        # White noise is what second differences over time show: what a cause makes is smooth beside it.
        for each in ((loop.states - executed.states) / self.ranges, (loop.inputs - executed.inputs) / self.efforts):
            noise = (np.diff(each, 2, axis=0) ** 2).mean(axis=0) / 6 if len(each) > 2 else 0.0
            squares += float(np.maximum((each**2).mean(axis=0) - noise, 0.0).mean())
        return squares

    def _distance(self, execution: ExecutedTask, loop: Trajectory) -> float:
        with contextlib.suppress(DistanceError):
            return float(self.validation.distance_between(loop, execution.executed, execution.plan.task))
        return np.inf


def find_causes(
    campaign: Campaign, *, most: int = 2, thinking: float | None = None, settings: CauseSettings | None = None
) -> CauseReport:
    """Return what M lacks, found in the executions of a campaign. Nothing is executed.

    Every cause of the dictionary is fitted alone, and then each beside the best one. The Bayesian information criterion
    chooses. A cause counts if M with it, fitted without an execution, predicts this execution in closed loop better
    than M does, and if the largest distance so predicted is smaller. Of executions that failed, the steps before the
    failure are used.

    Args:
        most: the largest number of causes together.
        thinking: seconds of CPU, as in :meth:`ctxval.Campaign.verdict`. Fewer executions are read, and stages left out,
            if the search does not fit; the report says so.
        settings: how many causes are tried, and what they must explain.

    Raises:
        InputError: if there are fewer than two executions with trajectories, if they do not say enough, or if even the
            smallest search does not fit into ``thinking``.
    """
    validation = campaign.validation
    ledger = campaign.recorder.dynamics.ledger_of_decision(thinking, campaign.trials)
    settings = fitting_settings(ledger, settings or CauseSettings())
    trials = sorted(executed_trials(campaign.store, campaign.trials), key=lambda pair: -(pair[0].distance or 0.0))
    failed = list[tuple[Trial, Trajectory]]()
    for trial in () if validation.outputs.hide_states else campaign.failed:
        nominal, run = campaign.trajectories(trial)
        if nominal is not None and run is not None and len(failed) < settings.failed:
            # What was recorded until the system left the surroundings of what M promised.
            far = np.abs(run.states - nominal.states[0]) > settings.away * np.ptp(nominal.states, axis=0).clip(1e-12)
            steps = min([run.horizon, *(np.flatnonzero(far.any(axis=1))[:1] - 1)])
            if steps >= settings.steps:
                failed.append((trial, run.first(steps)))
    trials = failed + trials[: settings.executions - len(failed)]  # those with the largest distances
    if len(trials) < 2:
        raise InputError(
            f"causes need at least 2 executions with trajectories in the store, got {len(trials)}; `ctxval run` with "
            "--envelope goes on after the model is falsified."
        )
    executed = at_points(trials)
    with single_threaded():
        estimates = estimates_by_loops_on_model(validation)
        states = None if estimates is None else estimates.of(executed, len(executed))
        if states is None:
            raise InputError("the states of the model cannot be estimated from the recorded outputs.")
        plan = validation.plan
        executions = [ExecutedTask(plan(validation.space.from_unit(point)), run) for point, run in executed]
        kind = _EstimatedStudy if validation.outputs.hide_states else _Study
        report = kind(validation, executions, states, settings, ledger).report(most)
        return replace(report, failed=len(failed), replaced=tuple(ledger.replaced))


class _Study:
    """What explains the executions of a validation whose states are recorded."""

    estimated: ClassVar[bool] = False

    def __init__(
        self,
        validation: Validation,
        executions: list[ExecutedTask],
        runs: list[Trajectory],
        settings: CauseSettings,
        ledger: Ledger,
    ) -> None:
        self.validation, self.executions, self.model, self.runs = validation, executions, validation.model, runs
        self.settings, self.ledger = settings, ledger
        horizon = min(len(run.inputs) for run in runs)
        # What inputs and jumps of the records tell is known, and not fitted.
        old = observation_delay([(each.plan.controller, each.plan.task, each.executed) for each in executions])
        late = [EffectCandidate(ObservationDelay(steps=old))] if old else []
        with np.errstate(all="ignore"):
            following = [np.asarray(self.model.step(*map(np.array, (run.states[:-1], run.inputs)))) for run in runs]
        self.known = (*late, *wrapped_angles([run.states for run in runs], following))
        known = tuple(each.effect for each in self.known)
        taken = self._segments_of(horizon).part(settings.segments)
        self.segments = Segments(self.model, runs, settings=taken, known=known)
        floors = [window.floors for window in self.segments.windows]
        self.some = Segments(self.model, runs, floors, taken.part(1 / 3), known)  # all causes are screened on these
        numbers = range(len(runs))
        self.others = [
            Segments(self.model, [runs[k] for k in rest], floors, settings=taken, known=known, numbers=rest)
            for rest in ([k for k in numbers if k != out] for out in numbers)
        ]
        x, u, residuals = self.segments.pairs
        usable = np.isfinite(residuals).all(axis=1)
        if not usable.any():
            raise InputError("the model's steps are not finite at the recorded states.")
        names = validation.names(x.shape[1], u.shape[1])
        self.plant = plant_of(self.model, executions[0].plan.task.dt, *names, x[usable], u[usable])
        self.known = (*self.known, *self._stops(following))
        seconds = max(run.horizon for run in runs) * self.plant.dt
        records = x[usable], u[usable], residuals[usable]
        self.dictionary = candidates(self.plant, *records, seconds=seconds, estimated=self.estimated, runs=len(runs))
        self.loops = ClosedLoops(validation, executions)
        self.before = max(self.loops.distances)

    def _segments_of(self, horizon: int) -> SegmentSettings:
        return SegmentSettings()

    def _stops(self, following: list[Array]) -> Iterable[EffectCandidate]:
        return seen_stops(self.plant.joints, [run.states for run in self.runs], following, self.plant.dt)

    def _by_what_is_seen(self) -> Explained | None:
        """Return how well what inputs and jumps of the records tell explains the executions."""
        known = ModelWithEffects(self.model, tuple(each.effect for each in self.known))
        return self._in_closed_loop(Explanation(self.known, known, 0.0, 1.0))

    def _noise(self, explanation: Explanation) -> Array:
        return self.segments.noise(explanation.repaired)

    def _distance_from_tasks(self, repaired: ModelWithEffects) -> float | None:
        return self.loops.distance_from_tasks(repaired)

    def report(self, most: int) -> CauseReport:
        first = self._by_what_is_seen()
        if first is not None and first.complete >= self.settings.named:
            if self.known:
                return self._reported([first], [], False)
            offset = self._offset_of_starts()
            return self._reported([] if offset is None else [replace(first, explanation=offset)], [], True)
        parameters = None if self.known else self._of_parameters()
        if parameters is not None and parameters.counts(self.before) and parameters.complete >= self.settings.partial:
            return self._reported([parameters], [], False)
        with stage("fitting causes", (2 * most - 1) * len(self.dictionary), "causes"):
            ranked = self._ranked(())
            chosen, alike = self._chosen(ranked)
            while chosen is not None and chosen.counts(self.before) and len(self._fitted(chosen)) < most:
                if not self._affords("a further cause", CauseCosts.second):
                    break
                is_small = chosen.explanation.left < 0.02 and chosen.complete >= self.settings.named
                if is_small or chosen.complete > 0.99:  # nothing is left for another cause
                    break
                better, others = self._chosen(self._ranked(self._fitted(chosen)))
                if better is not None:  # the first one was chosen without the other ones
                    better, others = self._chosen(self._ranked(self._fitted(better)[1:]))
                if better is not None and _unsized(self._fitted(better)[-1]) != _unsized(self._fitted(chosen)[0]):
                    better, others = self._chosen(self._ranked(self._fitted(better)[1:]))
                if better is None or not better.counts(self.before):
                    break
                if better.explanation.criterion > chosen.explanation.criterion - self.settings.alike:
                    break
                if 1 - better.complete > 0.5 * (1 - chosen.complete):
                    break
                chosen, alike = better, others
        left = 1.0 if chosen is None else 1 - chosen.share
        if parameters is not None and parameters.counts(self.before) and 1 - parameters.share <= 0.5 * left:
            chosen, alike = parameters, []
        if chosen is None and first is not None and self.known:
            chosen, alike = first, []
        return self._reported([] if chosen is None else [chosen, *alike], ranked, False)

    def _affords(self, stage: str, of: Callable[[CauseCosts], float]) -> bool:
        """Return whether an optional stage fits into the budget; it is left out otherwise."""
        return self.ledger.optional("causes", stage, lambda costs: of(CauseCosts(costs, self.settings)))

    def _of_parameters(self) -> Explained | None:
        """Return the uncertain parameters that differ from those of M, with what is found beside them as in verdicts.

        Returns None if M has none, or is no model of MuJoCo.
        """
        model, plant = self.model, self.plant
        if not isinstance(model, MuJoCo) or not model.uncertain:
            return None
        count = len(model.uncertain)
        if not self._affords("the uncertain parameters of M", lambda costs: costs.parameters(count)):
            return None
        commands, seconds = np.concatenate([run.inputs for run in self.runs]), max(r.times[-1] for r in self.runs)
        late = input_candidates(model, plant.dt, plant.inputs, commands, float(seconds), together=True)
        beside, rng = (*late, *further_attributes(model, self.runs)), np.random.default_rng(0)
        found = most_probable(
            model, self.runs, beside, None, rng, ParameterSettings(),
            lambda steps: self._affords(PRIOR_SEARCH, lambda costs: costs.costs.steps(steps)),
        )  # fmt: skip
        if found is None:
            return None
        deviations = np.sqrt(np.diag(np.linalg.inv(found.precision)))
        sizes = [float(each.at(z)) for each, z in zip(found.model.uncertain, found.z, strict=True)]
        least, many = self.settings.differs
        differing = tuple(
            attribute_of(each, size)
            for each, size, z, deviation in zip(model.uncertain, sizes, found.z, deviations, strict=False)
            if abs(z) > max(least, many * deviation)
        )
        effects = found.model.effects if isinstance(found.model, UncertainEffects) else ()
        candidates = (*differing, *all_sized(effects, sizes[len(model.uncertain) :]))
        if not candidates:
            return None
        fitted = explained(
            self.segments, candidates, [float(s) for each in candidates for s in each.effect.sizes], near=True
        )
        # What the parameters needed on the way, and all records do not.
        kept = tuple(each for each in fitted.candidates if not _is_nothing(each))
        if kept and len(kept) < len(candidates):
            fitted = explained(self.segments, kept, [float(s) for each in kept for s in each.effect.sizes], near=True)
        return self._in_closed_loop(fitted)

    def _fitted(self, chosen: Explained) -> tuple[EffectCandidate, ...]:
        return chosen.explanation.candidates[len(self.known) :]

    def _reported(self, group: list[Explained], ranked: list[Explanation], began_elsewhere: bool) -> CauseReport:
        named = bool(group) and group[0].counts(self.before) and group[0].complete >= self.settings.named
        is_measured = group and not began_elsewhere
        from_tasks = self._distance_from_tasks(group[0].explanation.repaired) if is_measured else None
        return CauseReport(
            plant=self.plant,
            explained=tuple(group),
            named=named,
            began_elsewhere=began_elsewhere,
            tried=len(self.dictionary),
            executions=len(self.executions),
            before=self.before,
            from_tasks=from_tasks,
            units=self.validation.labels.units,
            seen=tuple(each.effect for each in self.known),
            separating=self._separating(group) if named and len(group) > 1 else None,
            ranked=tuple(ranked[:5]),
        )

    def _offset_of_starts(self) -> Explanation | None:
        """Return the offset of the sensor that gives all executions the same start; None if they differ."""
        gaps = np.array([each.executed.states[0] - each.plan.model_trajectory.states[0] for each in self.executions])
        state = int((np.abs(gaps.mean(axis=0)) / self.loops.ranges).argmax())
        gap = float(gaps[:, state].mean())
        alike = np.ptp(gaps[:, state]) < 0.5 * abs(gap)
        for each in self.dictionary:
            if alike and isinstance(each.effect, SensorOffset) and each.effect.state == state:
                repaired = ModelWithEffects(self.model, (each.effect.with_sizes([gap]),))
                return Explanation((replace(each, effect=repaired.effects[0]),), repaired, 0.0, 1.0)
        return None

    def _ranked(self, beside: tuple[EffectCandidate, ...]) -> list[Explanation]:
        """Return explanations by each cause beside given ones, the most probable first; the best of a screening."""
        kinds = [each.effect.kind for each in (*self.known, *beside)]
        results = []
        for each in self.dictionary:
            together = (*self.known, *beside, each)
            if each.effect.kind not in kinds and sum(other.effect.in_parts for other in together) < 2:
                results.append((*screened(self.some, together), together))
            advance(1)
        results.sort(key=lambda result: result[0])
        # What comes to less than a quarter of the evidence of the best one is not worth a fit.
        worth = [result for result in results[: self.settings.fitted] if result[0] <= 0.25 * results[0][0]]
        refined = [explained(self.segments, together, begun) for _, begun, together in worth or results[:1]]
        for each in self._simpler(min(refined, key=lambda each: each.criterion)):
            together = (*self.known, *beside, each)
            refined.append(explained(self.segments, together, screened(self.some, together)[1]))
        distinct = list[Explanation]()
        for explanation in sorted(refined, key=lambda each: each.criterion):
            if not any(_is_same(explanation, other) for other in distinct):
                distinct.append(explanation)
        return distinct

    def _simpler(self, explanation: Explanation) -> list[EffectCandidate]:
        """Return causes of the same joint with fewer sizes, if a size of the last cause of an explanation is 0."""
        last = explanation.candidates[-1]
        sizes = zip(last.effect.sizes, last.parameters, strict=True)
        if len(last.parameters) < 2 or not any(abs(float(size)) < 0.01 * p.scale for size, p in sizes):
            return []
        joint = getattr(last.effect, "joint", None)
        return [
            each
            for each in self.dictionary
            if isinstance(each.effect, Force)
            and each.effect.joint == joint
            and len(each.parameters) < len(last.parameters)
        ]

    def _chosen(self, ranked: list[Explanation]) -> tuple[Explained | None, list[Explained]]:
        """Return the most probable explanation that counts, and those that the executions do not tell from it.

        Of those that explain alike, the one with the fewest sizes is the first, and what has it as a special case is
        no other explanation. If none counts, it is the one that explains most, if this is not little.
        """
        tried = list[Explained]()
        for each in ranked[: self.settings.checked]:
            tried.append(self._in_closed_loop(each))
            if tried[-1].counts(self.before):
                break
        else:
            most = max(tried, key=lambda each: each.share)
            return (most if most.resolved and most.share > self.settings.little else None), []
        best = tried[-1]
        # Of residuals that are nearly explained, differences by a third may be the way of integration.
        left, most_probable = best.explanation.left, best.explanation.criterion
        most_left = 1.3 * left + 2e-4 if left < 0.02 else -np.inf
        least = most_probable + self.settings.alike
        alike = [each for each in ranked if each.criterion < least or each.left < most_left]
        others = [each for each in alike if each is not best.explanation]
        others.sort(key=lambda each: len(each.sizes))  # the simplest are tried first
        group = [best, *(self._in_closed_loop(each) for each in others[: self.settings.checked])]
        group = [each for each in group if 1 - each.share <= 2 * (1 - best.share) + 1e-3]
        # The fewest sizes; and a real actuator acts late by parts of a step, not by means over whole ones.
        counting = [each for each in group if each.counts(self.before)]
        first = min(counting, key=lambda each: (len(each.explanation.sizes), not any(c.in_parts for c in each.causes)))
        return first, [each for each in group if each is not first and not _contains(each, first)]

    def _in_closed_loop(self, explanation: Explanation) -> Explained:
        """Return how well causes predict each execution if they are fitted to the others."""
        noise = self._noise(explanation)
        predicted, sizes = list[Predicted](), []
        for k, (execution, others) in enumerate(zip(self.executions, self.others, strict=True)):
            fitted = explained(others, explanation.candidates, explanation.sizes, near=True)
            sizes.append(fitted.sizes)
            predicted.append(self.loops.predicted(fitted.repaired.in_run(k), execution, noise))
        by_noise = float(np.sum([each.by_noise.mean() for each in predicted]))
        spread = float(np.sqrt(np.sum([each.by_noise.var() for each in predicted])))
        left = float(np.sum([each.deviation for each in predicted])) - by_noise
        # Without any effect beside noise, what is left says only whether it is more than noise.
        before = max(float(np.sum(self.loops.without)) - by_noise, spread, 1e-300)
        structure, uncertain = self.segments.explained(explanation.repaired, noise)
        return Explained(
            explanation,
            share=1 - max(left, 0.0) / before,
            distance=float(np.max([each.distance for each in predicted])),
            spreads=tuple(map(float, np.ptp(sizes, axis=0))),
            uncertainty=spread / before,
            structure=structure,
            uncertain_structure=uncertain,
        )

    def _separating(self, group: Sequence[Explained]) -> Separating | None:
        """Return the task at which the predictions of causes that the executions do not tell apart differ most."""
        best, space = None, self.validation.space
        if not self._affords("the task that tells causes apart", lambda costs: costs.separating(len(group))):
            return None
        for point in space.from_unit(np.random.default_rng(0).random((24, space.dimension))):
            try:
                plan = self.validation.plan(point)
            except CtxvalError:
                continue
            steps = plan.task.horizon
            first, *others = (self.loops.of_plan(each.explanation.repaired, plan, steps) for each in group)
            for number, loop in enumerate(others, start=1):
                if first is None or loop is None:
                    continue
                gap = float(np.max(np.abs(loop.states - first.states) / self.loops.ranges))
                if best is None or gap > best.gap:
                    apart = float(self.validation.distance_between(first, loop, plan.task))
                    best = Separating(space.describe_point(point), apart, number, gap)
        return best


class _EstimatedStudy(_Study):
    """What explains the executions of a validation whose states are estimated from outputs, and begin anywhere."""

    estimated = True

    def _segments_of(self, horizon: int) -> SegmentSettings:
        return SegmentSettings((max(1, horizon // 60), max(1, horizon // 12)))  # one step of estimates is worth little

    def _stops(self, following: list[Array]) -> Iterable[EffectCandidate]:
        return ()

    def _by_what_is_seen(self) -> Explained | None:
        return super()._by_what_is_seen() if self.known else None

    def _of_parameters(self) -> Explained | None:
        return None

    def _noise(self, explanation: Explanation) -> Array:
        return np.zeros(self.segments.states.shape[1])

    def _distance_from_tasks(self, repaired: ModelWithEffects) -> float | None:
        return None


def _is_nothing(candidate: EffectCandidate) -> bool:
    """Return whether an attribute differs from that of M by less than a hundredth of what matters."""
    effect = candidate.effect
    if not isinstance(effect, SharedAttribute):
        return False
    return abs(float(effect.sizes[0]) - (0.0 if effect.added else 1.0)) < 0.01 * candidate.parameters[0].scale


def _unsized(candidate: EffectCandidate) -> Effect:
    return replace(candidate.effect, sizes=())


def _is_same(explanation: Explanation, other: Explanation) -> bool:
    """Return whether causes of the same kinds have the same sizes: in fine sampling, a delay may be held or not."""
    kinds = [[cause.kind for cause in each.repaired.effects] for each in (explanation, other)]
    return kinds[0] == kinds[1] and np.allclose(explanation.sizes, other.sizes, rtol=0.02)


def _contains(general: Explained, special: Explained) -> bool:
    """Return whether an explanation has another one as a special case, as Stribeck friction has Coulomb friction."""
    ends = general.causes[-1], special.causes[-1]
    forces = [cause for cause in ends if isinstance(cause, Force)]
    more = len(general.explanation.sizes) > len(special.explanation.sizes)
    return more and len(forces) == 2 and forces[0].joint.rate == forces[1].joint.rate
