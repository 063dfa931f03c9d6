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
from ctxval.core.quantiles import QUANTILE
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.core.uncertain import uncertain_in
from ctxval.core.validation import Validation
from ctxval.errors import InputError
from ctxval.learning.actuators import ActuatorSettings, found_actuator
from ctxval.learning.closed_loops import LoopPlanner, unseen_parameters
from ctxval.learning.dry_friction import DryFriction, FrictionSettings, found_friction
from ctxval.learning.dynamics_posterior import LearnedCovariances, PosteriorSettings, condition, learn_covariances
from ctxval.learning.extended import ExtendedValidation
from ctxval.learning.histories import Record
from ctxval.learning.learned_dynamics import LearnedDynamics
from ctxval.learning.noise_study import NoiseSettings, NoiseStudy
from ctxval.learning.parametric_dynamics import ParametricDynamics, ParametricSettings, learned_parameters
from ctxval.learning.precision import AgreeingDynamics, AgreementSettings, agreeing_posterior
from ctxval.learning.prediction import ErrorVectors, Executed, PredictedDistance, predict_composed
from ctxval.learning.recorded import data_near, digest, recorded_transitions, schedule, scheduled
from ctxval.learning.regular import RegularSettings, split_transitions
from ctxval.learning.share_search import ShareSearch
from ctxval.learning.stage_costs import Costs, Ledger, ThinkingSettings, reduced
from ctxval.learning.worst_case import WorstCaseSearch, WorstCaseSettings
from ctxval.models.corrected import before_refinement
from ctxval.searches import Prediction
from ctxval.systems.actuator import Actuator


@dataclass(frozen=True)
class LearningSettings:
    """How many executions, and how much smaller errors of left-out ones, show that the dynamics have a further part."""

    small_error: float = 0.1  # left-out error below which no further part is looked for
    clear_factor: float = 3.0  # by which errors must fall without M's data, or with a task parameter, to be small
    actuator_error: float = 0.02  # left-out error below which nobody asks whether inputs act late
    actuator_from: int = 3  # executions from which on delays, and wrong data that M was made from, are looked for
    friction_from: int = 4  # executions from which on dry friction is looked for
    parameter_from: int = 6  # executions from which on a task parameter is suspected of changing the dynamics
    friction_share: float = 0.5  # share of the left-out error of rates that dry friction must leave at most
    kept_share: float = 2.0  # the same, of friction that was found before: single steps tell less of it than loops do
    noise_share: float = 0.75  # largest share of the squares of these errors that counts as noise
    slow_loop: float = 0.02  # seconds of a closed loop on M from which on loops are distributed over the cores
    thinking: ThinkingSettings = field(default_factory=ThinkingSettings)
    friction: FrictionSettings = field(default_factory=FrictionSettings)
    actuators: ActuatorSettings = field(default_factory=ActuatorSettings)
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
        quantile: the share of the executions of a task that a distance is about, if the system is noisy.
        share: the share of the tasks whose distances are asked for; 1 for the largest one.
        actuator: how the m inputs act; None if they act at once.
        friction: M with the dry friction that it lacks, of which the residual is learned; None without.
        settings: the numbers that decide what is learned.
    """

    def __init__(
        self,
        validation: Validation,
        seed: int = 0,
        quantile: float = QUANTILE,
        extended: ExtendedValidation | None = None,
        friction: DryFriction | None = None,
        settings: LearningSettings | None = None,
        share: float = 1.0,
    ) -> None:
        self.settings, self.share = settings or LearningSettings(), share
        self.given, self.seed, self.quantile, self.friction = validation, seed, quantile, friction
        self.extended = ExtendedValidation(validation) if extended is None else extended
        self.actuator, self.validation = self.extended.actuator, self.extended.validation
        self.planner = LoopPlanner(self.validation)
        self._errors = ErrorVectors(self.planner if validation.outputs is None else LoopPlanner(validation))
        self._covariances = Latest[bytes, LearnedCovariances | None](8)
        self._found: dict[bytes, str | None] = {}
        self._others: dict[str, DynamicsStudy] = {}
        self._actuators: dict[bytes, Actuator | None] = {}
        self._actuated: DynamicsStudy | None = None
        self._slowed: dict[bytes, DynamicsStudy | None] = {}
        self._searches: dict[float, WorstCaseSearch] = {}
        #: largest distances of tasks if M errs by so much in each step, of each error and task
        self.under_errors: dict[bytes, dict[bytes, float]] = {}

    def fresh_copy(self, quantile: float | None = None, share: float | None = None) -> DynamicsStudy:
        """Return a study of the same experiment that has learned nothing yet, with what is given."""
        quantile = self.quantile if quantile is None else quantile
        share = self.share if share is None else share
        return DynamicsStudy(self.given, self.seed, quantile, settings=self.settings, share=share)

    def _with(
        self, given: Validation, extended: ExtendedValidation, friction: DryFriction | None = None
    ) -> DynamicsStudy:
        return DynamicsStudy(given, self.seed, self.quantile, extended, friction, self.settings, self.share)

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
        """Searches the tasks for the largest distance of each draw."""
        settings = WorstCaseSettings.for_dimension(self.validation.space.dimension, self.planner.batched)
        if self.share < 1:
            return ShareSearch(self.planner, self.seed, self.share, settings)
        return WorstCaseSearch(self.planner, self.seed, settings)

    def search_within(self, ledger: Ledger, replicates: int) -> WorstCaseSearch:
        """Return the search, of fewer tasks if the budget of a ledger does not allow all of them."""
        if not ledger.is_limited or self.share < 1:  # fewer tasks tell nothing of a share of them
            return self.search
        shares = self.settings.thinking.shares if self.search.members is None else (1.0,)
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
        learned, settings = self._learn(extended, logged, with_data=True, ledger=ledger), self.settings
        ledger.charge("learning", lambda costs: costs.learning())
        with contextlib.suppress(np.linalg.LinAlgError, InputError, ValueError):
            if learned is None or len(executed) < settings.actuator_from:
                return learned
            asks = not logged and self.friction is None
            if asks and self.actuator is None and learned.left_out_error > settings.actuator_error:
                asks = ledger.learns("learning", "inputs that act late", lambda costs: costs.actuators())
            actuator = self._found_actuator(executed, learned) if asks else None
            if actuator is not None:
                if self._actuated is None or self._actuated.actuator != actuator:
                    acting = ExtendedValidation(self.given, actuator, executed[0][1].inputs.shape[-1])
                    self._actuated = self._with(self.given, acting)
                return self._actuated.learn(executed, ledger=ledger) or learned
            asks = not logged
            if asks and self.friction is None and learned.left_out_error > settings.small_error:
                asks = ledger.learns("learning", "dry friction", lambda costs: costs.friction())
            held = self._with_friction(executed, learned, ledger) if asks else None
            if held is not None:
                return held
            if not learned.left_out_error > settings.small_error:
                return learned
            has_data = bool((learned.posterior.data.sources == -1).any())
            if has_data and ledger.learns("learning", "the data of M", lambda costs: costs.learning()):
                without = self._learn(extended, logged, with_data=False, ledger=ledger)
                clear = min(settings.small_error, learned.left_out_error / settings.clear_factor)
                if without is not None and without.left_out_error < clear:
                    learned = without
            large = learned.left_out_error > settings.small_error
            asks = not logged and len(executed) >= settings.parameter_from and large
            names = len(self.given.space.units) + 1
            stage = "parameters that change the dynamics"
            if asks and ledger.learns("learning", stage, lambda costs: names * costs.learning()):
                # A task parameter that explains the errors of predictions; asked in each doubling of the executions.
                some = settings.parameter_from
                while 2 * some <= len(executed):
                    some *= 2
                key = digest(trajectory for _, trajectory in executed[:some])
                if key not in self._found:
                    name, with_it, without_it = self._most_telling(executed[:some])
                    # If errors remain, it may be a sign of noise, or of a state that is not recorded.
                    clear = min(settings.small_error, without_it / settings.clear_factor)
                    self._found[key] = name if with_it < clear else None
                parameter = self._found[key]
                learned = (
                    learned if parameter is None else self._with_parameter(parameter).learn(executed, ledger=ledger)
                )
        return learned

    def _parametric(self, executed: Executed, ledger: Ledger) -> LearnedDynamics | None:
        """Return what executions teach of the uncertain parameters of M; None if it has none, or nothing is usable."""
        model = uncertain_in(before_refinement(self.validation.model))
        if model is None or not executed or self.extended.needs_tasks or self.friction is not None:
            return None
        loops, recorded = [trajectory for _, trajectory in executed], self._recorded(executed, (), with_data=False)
        if recorded is None:
            return None
        seed = self.seed, len(executed), 0
        posterior = learned_parameters(model, loops, recorded, seed, settings=self.settings.parametric)
        if posterior is None:
            return None
        points = np.array([point for point, _ in executed])
        return ParametricDynamics(self, posterior.plain, points, loops, ledger=ledger, parametric=posterior)

    def regular(self, executed: Executed) -> LearnedDynamics | None:
        """Return what the regular transitions of executions teach; None if there are no irregular ones."""
        extended, model = self.extended.executions(executed), before_refinement(self.validation.model)
        for with_data in (True, False):
            recorded = self._recorded(extended, (), with_data) if extended else None
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
        if not executed or self.friction is not None or self.actuator is not None:
            return None  # M alone does not explain them
        recorded = self._recorded(executed, logged, with_data=False)
        if recorded is None:
            return None
        points, loops = np.array([point for point, _ in executed]), [loop for _, loop in executed]
        seed = self.seed, len(executed), 0
        posterior = agreeing_posterior(before_refinement(self.validation.model), *recorded, seed)
        agreeing = None if posterior is None else AgreeingDynamics(self, posterior, points, loops, allowed=allowed)
        if agreeing is None or agreeing.is_rounding(recorded_as):
            return agreeing
        return agreeing if allowed and agreeing.negligible <= allowed else None

    def _learn(
        self, executed: Executed, logged: Sequence[Trajectory], *, with_data: bool, ledger: Ledger | None = None
    ) -> LearnedDynamics | None:
        recorded = self._recorded(executed, logged, with_data)
        if recorded is None:
            return None
        # Hyperparameters are learned as scheduled, or now if nothing could be learned then; the latest ones are kept.
        for count in dict.fromkeys((scheduled(len(executed)), len(executed))):
            key = digest([*(trajectory for _, trajectory in executed[:count]), *logged]) + bytes([with_data])
            if key not in self._covariances:
                some = recorded if count == len(executed) else self._recorded(executed[:count], logged, with_data)
                if some is None or self.extended.loops is None:
                    continue
                model, seed = self.friction or before_refinement(self.validation.model), (self.seed, count, 0)
                settings = PosteriorSettings.for_horizon(self.extended.loops.horizon)
                self._covariances[key] = learn_covariances(model, *some, seed, settings)
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
        recorded = self._recorded(together, logged, learned.with_data)
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
            learn_noisy=lambda ledger: self.noise.learn(posterior, self.extended.records(executed), ledger),
        )  # fmt: skip

    @functools.cached_property
    def noise(self) -> NoiseStudy:
        """Learns dynamics with noise."""
        settings = self.settings.noise
        if self.friction is not None:  # what it does within a step would seem to be a history
            settings = replace(settings, structures=tuple(each for each in settings.structures if not each.lags))
        return NoiseStudy(self.extended, self.planner, self.search, self.seed, self.quantile, settings)

    def without(self, learned: LearnedDynamics, k: int) -> LearnedDynamics | None:
        """Return what all executions but one teach, with the same hyperparameters and structure of noise."""
        executed, noisy = learned.executions, learned.noisy
        kept = executed[:k] + executed[k + 1 :]
        if isinstance(learned, AgreeingDynamics):
            return self._agreeing(kept, (), kept, learned.allowed)
        recorded = self._recorded(kept, (), learned.with_data)
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

    def _recorded(
        self, executed: Executed, logged: Sequence[Trajectory], with_data: bool
    ) -> tuple[Transitions, Rows] | None:
        if self.extended.loops is None:
            return None
        # The data that M was made from tell no earlier inputs.
        data = self._data if with_data and self.actuator is None else None
        loops = [replace(loop, inputs=self.extended.acting(loop)) for _, loop in executed]
        return recorded_transitions(self.validation.model, data, loops, self.extended.loops, logged)

    def _with_parameter(self, name: str) -> DynamicsStudy:
        if name not in self._others:
            given = self.given.with_parts(physical=[*self.given.physical, name])
            self._others[name] = self._with(given, self.extended.of(given))
        return self._others[name]

    def _found_actuator(self, executed: Executed, learned: LearnedDynamics) -> Actuator | None:
        """Return a delay and a lag of inputs that explain the errors of predictions; one that is found is refined."""
        actuator = None
        counts = schedule(self.settings.actuator_from, len(executed)) if self.actuator is None else ()
        for some in (executed[:count] for count in counts):
            key = digest(trajectory for _, trajectory in some)
            if key not in self._actuators:
                self._actuators[key] = None  # also if its search fails
                known: LearnedDynamics | None = learned
                if actuator is None and len(some) < len(executed):
                    known = self._learned_alone(some, with_data=True)
                if actuator is not None or (known is not None and known.left_out_error > self.settings.actuator_error):
                    self._actuators[key] = self._search_actuator(some, actuator)
            actuator = self._actuators[key]
        return actuator

    def _search_actuator(self, executed: Executed, before: Actuator | None) -> Actuator | None:
        estimated = self.given.outputs is not None
        # Estimates of states cost as much as hundreds of steps, so the latest few executions have to suffice.
        among = executed[-5:] if estimated else executed
        commanded = [trajectory.inputs for _, trajectory in among]
        alike = len({u.shape for u in commanded}) == 1

        def with_inputs(actuator: Actuator) -> list[Record]:
            acting = actuator.acting(np.stack(commanded)) if alike else map(actuator.acting, commanded)
            return [replace(record, inputs=u) for record, u in zip(plain, acting, strict=True)]

        def estimated_with(actuator: Actuator) -> list[Record]:
            extended = ExtendedValidation(self.given, actuator, commanded[0].shape[-1])
            known = extended.executions(among, len(among))
            if known is None:
                raise np.linalg.LinAlgError
            return extended.records(known)

        # If states are recorded, they are the same with every actuator.
        plain = [] if estimated else estimated_with(Actuator())
        model, records_of = before_refinement(self.validation.model), estimated_with if estimated else with_inputs
        with single_threaded(), np.errstate(all="ignore"):
            return found_actuator(model, records_of, before, 30 if estimated else 80, self.settings.actuators)

    def _with_friction(self, executed: Executed, learned: LearnedDynamics, ledger: Ledger) -> LearnedDynamics | None:
        """Return what executions teach beside the dry friction that scheduled ones show; None if they show none.

        Without friction, predictions of left-out executions must have erred once, and at least twice as much in rates.
        """
        if self.friction is not None or self.given.outputs is not None:
            return None
        study, settings = None, self.settings
        for some in (executed[:count] for count in schedule(settings.friction_from, len(executed))):
            key = digest(trajectory for _, trajectory in some)
            if key not in self._slowed:
                self._slowed[key] = study  # also if its search fails
                without = learned if len(some) == len(executed) else self._learned_alone(some, with_data=True)
                if without is not None and (study is not None or without.left_out_error > settings.small_error):
                    tried = self._friction_study(some)
                    share = settings.friction_share
                    if tried and (study is not None or _error_of_rates(tried.learn(some), without) < share):
                        self._slowed[key] = tried
            study = self._slowed[key]
        held = None if study is None else study.learn(executed, ledger=ledger)
        return held if _error_of_rates(held, learned) < settings.kept_share else None

    def _friction_study(self, executed: Executed) -> DynamicsStudy | None:
        """Return a study of M with the dry friction that executions show; None if they show none."""
        extended, model = self.extended.executions(executed), before_refinement(self.validation.model)
        recorded = self._recorded(extended, (), with_data=False) if extended else None
        friction, settings = None, self.settings.friction
        with single_threaded(), np.errstate(all="ignore"), contextlib.suppress(RuntimeError):  # of the least squares
            friction = None if recorded is None else found_friction(model, recorded[0], settings)
        if friction is None:
            return None
        return self._with(self.given, self.extended, friction)

    def _most_telling(self, executed: Executed) -> tuple[str | None, float, float]:
        """Return the task parameter with which predictions err least, and the left-out errors with it and without."""
        name, least = None, np.inf  # the data that M was made from tell no parameters
        for other in self.given.space.units:
            if other not in self.given.physical:
                study = self._with_parameter(other)
                learned = study._learned_alone(executed, with_data=False)
                if learned is not None and learned.left_out_error < least:
                    name, least = other, learned.left_out_error
        without_it = self._learned_alone(executed, with_data=False)
        return name, least, 0.0 if without_it is None else without_it.left_out_error

    def _learned_alone(self, executed: Executed, *, with_data: bool) -> LearnedDynamics | None:
        extended = self.extended.executions(executed)
        return None if extended is None else self._learn(extended, (), with_data=with_data)

    def suspected_parameter(self, learned: LearnedDynamics) -> tuple[str, float] | None:
        """Return the task parameter that the dynamics depend on most clearly, and how many times less predictions err.

        Each execution is predicted from the others, with the parameter as a state and without it. It is None if there
        are too few executions, or if no parameter halves the error.
        """
        settings = self.settings
        if len(learned.executed) < settings.parameter_from or not learned.left_out_error > settings.small_error:
            return None
        plain = [(point, self.extended.recorded(trajectory)) for point, trajectory in learned.executions]
        name, with_it, without_it = self._most_telling(plain)
        return None if name is None or with_it > without_it / 2 else (name, without_it / max(with_it, 1e-300))

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


def _error_of_rates(held: LearnedDynamics | None, without: LearnedDynamics) -> float:
    """Return the left-out error of the rates that friction slows, as a share of that without it; infinity for None.

    What the Gaussian processes take for noise is no part of them. Where a joint stops within a step changes
    its position a little, which nothing predicts.
    """
    if held is None or held.study.friction is None:
        return np.inf
    rates = held.study.friction.rates
    noise = (held.posterior.deviations[rates] / np.maximum(held.model_errors[rates], 1e-300)) ** 2
    squares, squares_without = (float((each.left_out_errors[rates] ** 2).sum()) for each in (held, without))
    noise_alone = min(float(noise.sum()), held.study.settings.noise_share * min(squares, squares_without))
    return float(np.sqrt((squares - noise_alone) / max(squares_without - noise_alone, 1e-300)))
