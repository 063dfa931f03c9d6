"""Learning the dynamics from executions: from which data, with which task parameters and histories."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ctxval._util.arrays import Array, Rows, single_threaded
from ctxval._util.describe import describe
from ctxval._util.latest import Latest
from ctxval._util.representation import ShortRepr
from ctxval.core.distance import ComposedDistance
from ctxval.core.model import Model
from ctxval.core.target import LARGEST_DISTANCE, Target
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.core.uncertain import uncertain_in
from ctxval.core.validation import Validation
from ctxval.errors import InputError
from ctxval.learning.agreement import AgreementSettings
from ctxval.learning.closed_loops import LoopPlanner, unseen_parameters
from ctxval.learning.dynamics_posterior import (
    DynamicsPosterior,
    LearnedCovariances,
    PosteriorSettings,
    condition,
    learn_covariances,
)
from ctxval.learning.effects.model import ModelWithEffects
from ctxval.learning.effects.mujoco import further_attributes
from ctxval.learning.extended import ExtendedValidation
from ctxval.learning.input_effects import Found, input_candidates
from ctxval.learning.learned_dynamics import LearnedDynamics
from ctxval.learning.noise_study import NoiseSettings, NoiseStudy
from ctxval.learning.noisy_draws import NoisyPosterior
from ctxval.learning.parameter_posterior import PRIOR_SEARCH, Known
from ctxval.learning.parametric_dynamics import ParametricDynamics, ParametricSettings, learned_parameters
from ctxval.learning.precision import AgreeingDynamics, agreeing_posterior
from ctxval.learning.prediction import ErrorVectors, Executed, PredictedDistance, predict_composed
from ctxval.learning.recorded import Memories, data_near, digest, recorded_transitions, scheduled
from ctxval.learning.regular import RegularSettings, split_transitions
from ctxval.learning.settling import SettlingModel
from ctxval.learning.share_search import ShareSearch
from ctxval.learning.stage_costs import Costs, Ledger, ThinkingSettings, reduced
from ctxval.learning.structure import StructureSearch, StructureSettings, most_telling
from ctxval.learning.worst_case import SuiteSearch, WorstCaseSearch, WorstCaseSettings
from ctxval.models.corrected import before_refinement
from ctxval.searches import Prediction


@dataclass(frozen=True)
class LearningSettings:
    """How dynamics are learned from executions."""

    slow_loop: float = 0.02  # seconds of a closed loop on M from which on loops are distributed over the cores
    thinking: ThinkingSettings = field(default_factory=ThinkingSettings)
    structure: StructureSettings = field(default_factory=StructureSettings)
    regular: RegularSettings = field(default_factory=RegularSettings)
    noise: NoiseSettings = field(default_factory=NoiseSettings)
    agreement: AgreementSettings = field(default_factory=AgreementSettings)
    parametric: ParametricSettings = field(default_factory=ParametricSettings)


class DynamicsStudy(ShortRepr):
    """Learns the dynamics of one experiment from growing sets of executions.

    Everything is a function of the executions and the seed. Controllers that are designed are kept.

    Attributes:
        given: the user's validation.
        validation: the same with the states of M if only outputs are recorded, and with the physical task parameters
            as further states; everything is learned of these.
        target: what is asked for of the distances over all tasks.
        effects: what the dynamics have beside M and a smooth residual, with sizes: ``within_steps`` and ``of_inputs``.
        model: M with those effects that change its steps; the residual is learned of it.
        with_data: whether the data that M was made from are learned from.
        settings: the numbers that decide what is learned.
    """

    def __init__(
        self,
        validation: Validation,
        seed: int = 0,
        target: Target = LARGEST_DISTANCE,
        extended: ExtendedValidation | None = None,
        settings: LearningSettings | None = None,
        *,
        effects: Found = (),
        with_data: bool = True,
        memories: Memories | None = None,
    ) -> None:
        self.settings, self.memories = settings or LearningSettings(), memories or Memories()
        self.given, self.seed, self.target = validation, seed, target
        self.effects, self.with_data = effects, with_data
        self.within_steps = tuple(each for each in effects if isinstance(each.effect, SettlingModel))
        self.of_inputs = tuple(each for each in effects if not isinstance(each.effect, SettlingModel))
        of_inputs = _with_effects(validation.model, effects).of_inputs
        self.extended = ExtendedValidation(validation, of_inputs) if extended is None else extended
        self.validation = self.extended.validation
        self.model = _with_effects(before_refinement(self.validation.model), effects).mechanics
        self.planner = LoopPlanner(self.validation, of_inputs)
        self._errors = ErrorVectors(LoopPlanner(validation) if validation.outputs.hide_states else self.planner)
        self._covariances = Latest[bytes, LearnedCovariances | None](8)
        self._known_of = Latest[bytes, Known | None](8)
        self._made = Latest[tuple[object, ...], DynamicsStudy](8)
        self._searches: dict[float, WorstCaseSearch] = {}
        #: largest distances of tasks if M errs by so much in each step, of each error and task
        self.under_errors: dict[bytes, dict[bytes, float]] = {}

    def fresh_copy(self, target: Target | None = None) -> DynamicsStudy:
        """Return a study of the same experiment that has learned nothing yet, with what is given."""
        return DynamicsStudy(self.given, self.seed, target or self.target, settings=self.settings)

    def made(
        self,
        *,
        given: Validation | None = None,
        effects: Found | None = None,
        with_data: bool | None = None,
    ) -> DynamicsStudy:
        """Return a study with other parts; the others stay. The latest ones are kept."""
        given, kept = given or self.given, self.effects if effects is None else effects
        with_data = self.with_data if with_data is None else with_data
        if (given, kept, with_data) == (self.given, self.effects, self.with_data):
            return self
        key = tuple(given.physical), kept, with_data
        if key not in self._made:
            same = self.extended if given is self.given else self.extended.of(given)
            extended = same if _with_effects(given.model, kept).of_inputs == same.effects else None
            self._made[key] = DynamicsStudy(
                given, self.seed, self.target, extended, self.settings,
                effects=kept, with_data=with_data, memories=self.memories,
            )  # fmt: skip
        return self._made[key]

    @functools.cached_property
    def structures(self) -> StructureSearch:
        """Finds what the dynamics of executions consist of."""
        return StructureSearch(self, self.settings.structure)

    def state_of_parts(self) -> tuple[str, bytes]:
        """Return the description of M and the synthesizer, and some steps of M, which a description may not show."""
        parts, loops, steps = self.validation, self.extended.loops, b""
        if loops is not None:
            middle = loops.horizon // 2
            pairs = loops.states[..., middle, :], loops.inputs[..., middle, :]
            steps = np.asarray(parts.model.step(*pairs)).tobytes()
        return repr(describe([parts.model, parts.synthesizer])), steps

    @functools.cached_property
    def search(self) -> WorstCaseSearch:
        """Searches the tasks for the target of each draw."""
        settings = WorstCaseSettings.for_space(self.validation.space, self.planner.batched)
        if self.target.by_draws:
            return ShareSearch(self.planner, self.seed, self.target.share, settings)
        of_largest = WorstCaseSearch if self.validation.space.members is None else SuiteSearch
        return of_largest(self.planner, self.seed, settings)

    def search_within(self, ledger: Ledger, replicates: int) -> WorstCaseSearch:
        """Return the search, of fewer tasks if the budget of a ledger does not allow all of them."""
        if not ledger.is_limited or not self.search.settings.reducible:
            return self.search
        shares, ledger.owed = self.settings.thinking.shares, 0.0
        for share in shares:
            settings = reduced(self.search.settings, share) if share < 1 else self.search.settings

            def seconds(costs: Costs, settings: WorstCaseSettings = settings, whole: bool = share == 1) -> float:
                return costs.search(settings, replicates, whole=whole)

            if share == shares[-1] or ledger.fits("loops", seconds, ledger.reserve):
                break
        if share == 1:
            return self.search
        if share == shares[-1]:
            ledger.charge("loops", seconds)
        ledger.replaced.append(f"a search of {settings.pool} tasks in place of {self.search.settings.pool}")
        if share not in self._searches:
            self._searches[share] = WorstCaseSearch(self.planner, self.seed, settings)
        return self._searches[share]

    @functools.cached_property
    def unseen_parameters(self) -> tuple[int, ...]:
        """The indices of the task parameters that hardly change the closed loops of M."""
        return unseen_parameters(self.planner, self.search.pool[:8])

    @property
    def seen_parameters(self) -> Rows:
        """The indices of the other task parameters; of all if none changes the closed loops of M."""
        every = np.arange(self.validation.space.dimension)
        seen = np.setdiff1d(every, self.unseen_parameters)
        return seen if len(seen) else every

    def learn(
        self,
        executed: Executed,
        logged: Sequence[Trajectory] = (),
        allowed: float = 0.0,
        ledger: Ledger | None = None,
    ) -> LearnedDynamics | None:
        """Return what executions, and recordings that belong to no task, teach; None if it is nothing.

        Errors of M are not learned if they are rounding, or if no distance under them exceeds an ``allowed`` one. What
        does not fit into the budget of a ledger is left out.
        """
        ledger = Ledger() if ledger is None else ledger
        extended, logged = self.extended.executions(executed), () if self.extended.needs_tasks else logged
        if extended is None:
            return None
        agreeing = self._agreeing(extended, logged, executed, allowed)
        if agreeing is not None:
            return replace(agreeing, ledger=ledger)
        parametric = None if logged else self._parametric(extended, ledger)
        if parametric is not None:
            return parametric
        learned = self._learn(extended, logged, ledger)
        ledger.charge("learning", lambda costs: costs.learning())
        if learned is None or logged:
            return learned
        with contextlib.suppress(np.linalg.LinAlgError, InputError, ValueError):
            return self.structures.best(executed, learned, ledger)
        return learned

    def _parametric(self, executed: Executed, ledger: Ledger) -> LearnedDynamics | None:
        """Return what executions teach of the uncertain parameters of M; None if it has none, or nothing is usable."""
        model = uncertain_in(before_refinement(self.validation.model))
        if model is None or not executed or self.extended.needs_tasks or self.effects:
            return None
        loops, on_model, settings = [trajectory for _, trajectory in executed], self.extended.loops, self.settings
        if on_model is None:
            return None
        count = scheduled(len(loops))
        key = digest(loops[:count])
        posterior, seed = None, (self.seed, count, 0)

        def affords(steps: int) -> bool:
            return ledger.optional("learning", PRIOR_SEARCH, lambda costs: costs.steps(steps))

        if key not in self._known_of:
            candidates = self.input_candidates(loops, together=True) + further_attributes(model, loops)
            posterior = learned_parameters(
                model, loops[:count], on_model, seed, candidates, None, settings.parametric, affords
            )
            self._known_of[key] = None if posterior is None else posterior.known
        if (known := self._known_of[key]) is not None and (posterior is None or count < len(loops)):
            seed = self.seed, len(loops), 0
            posterior = learned_parameters(model, loops, on_model, seed, (), known, settings.parametric, affords)
        if posterior is None:
            return None
        points = np.array([point for point, _ in executed])
        return ParametricDynamics(self, posterior.plain, points, loops, ledger=ledger, parametric=posterior)

    def regular(self, executed: Executed) -> LearnedDynamics | None:
        """Return what the regular transitions of executions teach; None if there are no irregular ones."""
        extended, model = self.extended.executions(executed), before_refinement(self.validation.model)
        for with_data in (True, False):
            recorded = self.transitions_of(extended, (), with_data) if extended else None
            if recorded is None or self.extended.loops is None or not extended:
                return None
            settings, seed = PosteriorSettings.for_horizon(self.extended.loops.horizon), (self.seed, len(executed), 0)
            split = split_transitions(model, *recorded, seed, settings, self.settings.regular)
            if split is not None and (parts := split.posterior()) is not None:
                points, loops = np.array([point for point, _ in extended]), [loop for _, loop in extended]
                return LearnedDynamics(self, parts[0], points, loops, with_data, split, parts[1])
        return None

    def _agreeing(
        self, executed: Executed, logged: Sequence[Trajectory], recorded_as: Executed, allowed: float
    ) -> AgreeingDynamics | None:
        """Return M itself, with an error bound, if it explains all executions up to negligible errors."""
        if not executed or self.effects:
            return None  # M alone does not explain them
        recorded = self.transitions_of(executed, logged, with_data=False)
        if recorded is None:
            return None
        points, loops = np.array([point for point, _ in executed]), [loop for _, loop in executed]
        seed = self.seed, len(executed), 0
        posterior = agreeing_posterior(before_refinement(self.validation.model), *recorded, seed)
        agreeing = None if posterior is None else AgreeingDynamics(self, posterior, points, loops, allowed=allowed)
        if agreeing is None or agreeing.is_rounding(recorded_as):
            return agreeing
        return agreeing if allowed and agreeing.negligible <= allowed else None

    def learned_alone(self, executed: Executed, ledger: Ledger | None = None) -> LearnedDynamics | None:
        """Return what executions teach with the parts of this study; None if it is nothing."""
        extended = self.extended.executions(executed)
        return None if extended is None else self._learn(extended, (), ledger)

    def _learn(
        self, executed: Executed, logged: Sequence[Trajectory], ledger: Ledger | None = None
    ) -> LearnedDynamics | None:
        with_data = self.with_data
        recorded = self.transitions_of(executed, logged, with_data)
        if recorded is None:
            return None
        # Hyperparameters are learned as scheduled, or now if nothing could be learned then; the latest ones are kept.
        for count in dict.fromkeys((scheduled(len(executed)), len(executed))):
            key = digest([*(trajectory for _, trajectory in executed[:count]), *logged])
            if key not in self._covariances:
                some = recorded if count == len(executed) else self.transitions_of(executed[:count], logged, with_data)
                if some is None or self.extended.loops is None:
                    continue
                seed = self.seed, count, 0
                settings = PosteriorSettings.for_horizon(self.extended.loops.horizon)
                self._covariances[key] = learn_covariances(self.model, *some, seed, settings)
            covariances = self._covariances[key]
            if covariances is not None:
                return self._conditioned(covariances, recorded, executed, with_data, ledger)
        return None

    def as_if_executed(
        self, learned: LearnedDynamics, executed: Executed, pending: Executed, logged: Sequence[Trajectory] = ()
    ) -> LearnedDynamics | None:
        """Return what executions teach with pending ones, as if these had gone as predicted; hyperparameters stay."""
        if learned.study is not self:
            return learned.study.as_if_executed(learned, executed, pending, logged)
        together = [*(self.extended.executions(executed) or ()), *pending]
        logged = () if self.extended.needs_tasks else logged
        if isinstance(learned, AgreeingDynamics):
            return self._agreeing(together, logged, executed, learned.allowed)
        recorded = self.transitions_of(together, logged, learned.with_data)
        covariances, ledger = learned.posterior.covariances, learned.ledger
        return self._conditioned(covariances, recorded, together, learned.with_data, ledger)

    def _conditioned(
        self,
        covariances: LearnedCovariances,
        recorded: tuple[Transitions, Rows] | None,
        executed: Executed,
        with_data: bool,
        ledger: Ledger | None = None,
    ) -> LearnedDynamics | None:
        if recorded is None:
            return None
        posterior = condition(covariances, *recorded)
        if posterior is None or not np.isfinite(posterior.most_probable.weights).all():
            return None
        points = np.array([point for point, _ in executed]).reshape(-1, self.validation.space.dimension)
        loops = [trajectory for _, trajectory in executed]
        return LearnedDynamics(
            self, posterior, points, loops, with_data, ledger=Ledger() if ledger is None else ledger,
            learn_noisy=lambda ledger: self._noisy(posterior, executed, ledger),
        )  # fmt: skip

    def _noisy(self, posterior: DynamicsPosterior, executed: Executed, ledger: Ledger) -> NoisyPosterior | None:
        """Return dynamics with noise and histories; None without any, or if their closed loops contradict executions.

        Along each record, earlier errors of M tell the next one even if it is a function of state and input that few
        records show. In closed loops, errors that such a history makes itself tell nothing, and loops may diverge.
        """
        noisy, settings = self.noise.learn(posterior, self.extended.records(executed), ledger), self.settings.noise
        if noisy is None or noisy.noise > settings.exact or self.given.outputs.hide_states:
            return noisy  # estimates of states from outputs need histories
        pool = self.search.pool[: settings.batched_pool if self.planner.batched else settings.pool]
        points = np.array([*(point for point, _ in executed), *pool])
        planned, count = self.planner.plan(points), len(executed)
        with single_threaded(), np.errstate(all="ignore"):
            of_system = np.array([self.planner.distance_of(*each) for each in executed])
            without, with_it = (
                np.nan_to_num(self.planner.distances(each.mean, planned, len(points))[0], nan=0.0, posinf=np.inf)
                for each in (posterior, noisy)
            )
            errors, errors_without = (np.abs(each[:count] - of_system).max() for each in (with_it, without))
        diverges = with_it.max() > settings.diverged * max(without.max(), of_system.max())
        misses = errors > max(settings.reproduced * of_system.max(), errors_without)
        return None if diverges or misses else noisy

    @functools.cached_property
    def noise(self) -> NoiseStudy:
        """Learns dynamics with noise."""
        settings = self.settings.noise
        if isinstance(self.model, SettlingModel):  # what friction does within a step would seem to be a history
            settings = replace(settings, structures=tuple(each for each in settings.structures if not each.lags))
        return NoiseStudy(self.extended, self.planner, self.search, self.seed, self.target.quantile, settings)

    def without(self, learned: LearnedDynamics, k: int) -> LearnedDynamics | None:
        """Return what all executions but one teach, with the same hyperparameters and structure of noise."""
        executed, noisy = learned.executions, learned.noisy
        kept = executed[:k] + executed[k + 1 :]
        if isinstance(learned, AgreeingDynamics):
            return self._agreeing(kept, (), kept, learned.allowed)
        recorded = self.transitions_of(kept, (), learned.with_data)
        others = self._conditioned(learned.posterior.covariances, recorded, kept, learned.with_data)
        if others is None:
            return None
        records = self.extended.records
        again = noisy and self.noise.again(noisy, records(executed), others.posterior, records(kept))
        return None if noisy and again is None else replace(others, learn_noisy=lambda ledger: again)

    def with_states(self, executed: Executed, point: Array, trajectory: Trajectory) -> Trajectory | None:
        """Return a later execution of a task ``(d,)`` with the states that are learned; None without estimates."""
        extended = self.extended.executions([*executed, (point, trajectory)])
        return None if extended is None else extended[-1][1]

    @functools.cached_property
    def _data(self) -> Transitions | None:
        loops = self.extended.loops
        return None if loops is None else data_near(self.validation.model, loops)

    @property
    def has_data(self) -> bool:
        """Whether it learns from data that M was made from."""
        return self.with_data and self._data is not None

    def transitions_of(
        self, executed: Executed, logged: Sequence[Trajectory] = (), with_data: bool = True
    ) -> tuple[Transitions, Rows] | None:
        """Return the transitions of executions of the extended validation; None if no task can be planned."""
        if self.extended.loops is None:
            return None
        # The data that M was made from tell no earlier inputs.
        data = self._data if with_data and not self.of_inputs else None
        loops = [loop for _, loop in executed]
        return recorded_transitions(
            self.validation.model, data, loops, self.extended.loops, logged, memories=self.memories
        )

    def input_candidates(self, loops: Sequence[Trajectory], *, together: bool) -> Found:
        """Return the effects that inputs may have in executions, alone or only those of all inputs ``together``."""
        commands, times = np.concatenate([each.inputs for each in loops]), max((each.times for each in loops), key=len)
        seconds = float(times[-1] - times[0])
        dt, names = seconds / max(len(times) - 1, 1), self.input_names(commands.shape[1])
        model = before_refinement(self.validation.model)
        return input_candidates(model, dt, names, commands, seconds, together=together)

    def input_names(self, inputs: int) -> list[tuple[str, str]]:
        """Return the names and units of the m inputs."""
        return list(self.validation.names(0, inputs)[1].items())

    def suspected_parameter(self, learned: LearnedDynamics, executed: Executed) -> tuple[str, float] | None:
        """Return the task parameter that the dynamics depend on most clearly, and how many times less predictions err.

        Each of the given executions is predicted from the others, with the parameter as a state and without it. Returns
        None if there are too few executions, or if no parameter halves the error.
        """
        limits = self.settings.structure.parameter
        if len(executed) < limits.after or not learned.left_out_error > limits.error:
            return None
        found, with_it, without_it = most_telling(self, executed)
        if found is None or with_it > without_it / 2:
            return None
        return found.given.physical[-1], without_it / max(with_it, 1e-300)

    def prediction_of(self, learned: LearnedDynamics | None, executed: Executed) -> Prediction | None:
        """Return the distances that executions, and what was learned from them, predict; None if nothing is known.

        If the distance is composed of a short vector, such as the error of the final state, a second prediction models
        the vector as a function of p, because an error that is no function of state and input may still be a function
        of p. The first prediction offers the second one as ``otherwise``. If nothing was learned, the second one is
        returned instead.
        """
        with single_threaded():
            if learned is None or isinstance(learned, ParametricDynamics):
                return self._predict_vectors(executed)
            loops = self.extended.loops
            slow = self.extended.seconds > self.settings.slow_loop
            in_parallel = loops is not None and not loops.batch_shape and slow
            planner, posterior = learned.study.planner, learned.posterior
            exact = PredictedDistance(planner, posterior, learned.executed, in_parallel, posterior.mean)
            # If few centres do not suffice, both predictions are one, so that no task is predicted twice.
            few = posterior.rough_mean
            rough = exact if few is posterior.mean else replace(exact, mean=few)
            count = 2000 if planner.batched else 150
            return Prediction(exact, exact.left_out, count, lambda: self._predict_vectors(executed), rough=rough)

    def _predict_vectors(self, executed: Executed) -> Prediction | None:
        distance, vectors = self._errors.validation.distance, self._errors.of(executed)
        if vectors is None or not isinstance(distance, ComposedDistance):
            return None
        return predict_composed(np.array([point for point, _ in executed]), vectors, distance.compose)


def _with_effects(model: Model, effects: Found) -> ModelWithEffects:
    return ModelWithEffects(model, tuple(each.effect for each in effects))
