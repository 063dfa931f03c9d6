"""A budget of thinking: the cost of each stage of a choice, known from its sizes before it starts.

A stage that does not fit is replaced by a named cheaper one. Sizes become seconds by the speed of one machine, which
is measured once per campaign and stored with a trial, and by how much longer stages of the choice before took than
was expected, which each trial stores. So a choice with a budget is a function of the stored history, too.

Seconds are those of CPU of this process: elapsed time would depend on what else the machine does.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval.core.task import Task
from ctxval.core.validation import Validation

if TYPE_CHECKING:
    from ctxval.learning.worst_case import WorstCaseSettings


@dataclass(frozen=True)
class ThinkingSettings:
    """How budgets are shared, and the costs of numerical work on the reference machine, in seconds.

    The costs are those of one core of 2026 (benchmarks/bench_thinking.py); ``Speed.machine`` scales them.
    """

    # Seconds for one choice, if an execution takes less. With 5 s, noisy campaigns need 3 executions more: what a stage
    # costs is at first estimated several times too high.
    default: float = 20.0
    manual: float = 60.0  # seconds for one choice, if people execute the tasks: an execution takes longer than that
    decisive: float = 3.0  # multiple of these that the evidence of a verdict may take; 1 if the budget is stated
    shares: tuple[float, ...] = (1.0, 0.25, 0.06)  # of the tasks of a search, the largest that fits
    few_draws: int = 8  # posterior samples that predict an execution if all of them do not fit
    slower: tuple[float, float] = (0.8, 4.0)  # bounds of the correction by the choice before
    noted: float = 0.02  # least share of the budget that a stage must take to be corrected by
    probe: float = 3.2e-3  # of a product, a factorisation and exponentials that measure the machine
    step: float = 7e-5  # of one step of closed loops that run together, beside controller and M
    row: float = 1.5e-6  # of the step of each of them
    centre: float = 5e-9  # of one covariance in it, and of each coordinate of it
    coordinate: float = 1.2e-10
    distance: float = 8e-5  # of the distances of one draw on one batch
    density: float = 4e-4  # of one density of hyperparameters from 120 transitions, and of each coordinate of it
    density_coordinate: float = 1.2e-5
    component: float = 2.5e-2  # of draws with one set of hyperparameters
    pivot: float = 8e-6  # of one pivot, and of each transition from which it is chosen
    pivot_row: float = 7e-8
    eigen: float = 1.8e-10  # of eigenvalues of F features, divided by F^3
    gram: float = 1.2e-10  # of their second moments, divided by N F^2
    invert: float = 1.5e-10  # of the inverse of a matrix of D rows, divided by D^3
    moments: float = 2.4e-11  # of the second moments of N n sensitivities, divided by N n D^2


@dataclass(frozen=True)
class Speed:
    """The speed of a machine, and of an experiment's own parts on it, in seconds."""

    machine: float  #: how many times longer numerical work takes than on the reference machine
    design: float  #: of the design of one controller
    another_design: float  #: of each further one in a batch
    step: float  #: of one step of a closed loop on M
    another_step: float  #: of each further loop that runs together with it
    together: bool  #: whether controllers take several draws of the dynamics at once
    batched: bool  #: whether several tasks are planned at once
    # states, inputs, horizon: the numbers n and m, and the steps H of a task
    states: int
    inputs: int
    horizon: int

    @classmethod
    def measured(cls, parts: Validation, points: Array, settings: ThinkingSettings) -> Self | None:
        """Measure the speed at tasks ``(q, d)``, one of them alone; None if it cannot be planned."""
        machine = _probe() / settings.probe

        def task_at(rows: Array) -> Task:
            return parts.task_at(parts.space.parameters(parts.space.from_unit(rows)))

        with suppress(Exception), single_threaded(), np.errstate(all="ignore"):  # users' parts
            one = task_at(points[0])
            controller, design = _timed(lambda: parts.synthesizer.design(one, parts.model))
            step = _seconds_of_step(controller, one, parts.closed_loop)
            many = 8
            draws = one.starting_at(np.repeat(one.initial_state[None], many, axis=0))
            together, another_step, another_design = False, step, design
            alone = parts.closed_loop(controller, _shortened(one, 1)).inputs
            with suppress(Exception):  # a controller that takes one state alone
                inputs = parts.closed_loop(controller, _shortened(draws, 1)).inputs
                together = inputs.shape == (many, *alone.shape) and np.allclose(inputs, alone)
                if together:
                    seconds = _seconds_of_step(controller, draws, parts.closed_loop)
                    another_step = float(np.clip((seconds - step) / (many - 1), 0.0, step))
            batched = False
            if getattr(parts.synthesizer, "batched", False) and len(points) > 1:
                with suppress(Exception):  # tasks that may never be executed
                    batch = task_at(points)
                    designed, seconds = _timed(lambda: parts.synthesizer.design(batch, parts.model))
                    another_design = float(np.clip((seconds - design) / (len(points) - 1), 0.0, design))
                    seconds = _seconds_of_step(designed, batch, parts.closed_loop)
                    another_step = float(np.clip((seconds - step) / (len(points) - 1), 0.0, step))
                    batched = True
            sizes = one.initial_state.shape[-1], alone.shape[-1], one.horizon
            return cls(machine, design, another_design, step, another_step, together, batched, *sizes)
        return None

    @classmethod
    def from_json(cls, values: Any) -> Self | None:
        """Return the speed in the note of a trial; None if these are not its values."""
        with suppress(TypeError, ValueError, AttributeError):
            speed = cls(**values)
            numbers = [value for name, value in vars(speed).items() if name not in ("together", "batched")]
            if all(isinstance(each, int | float) and 0 <= each < np.inf for each in numbers):
                return speed
        return None


@dataclass(frozen=True)
class Thinking:
    """What the next choice may cost: it follows from what is stored."""

    seconds: float  #: for one choice
    decisive: float  #: for a verdict, with the choice of a task if it is undecided
    speed: Speed
    slower: tuple[tuple[str, float], ...] = ()  #: how many times longer kinds of stages take than expected
    settings: ThinkingSettings = field(default_factory=ThinkingSettings)

    @classmethod
    def after(
        cls, notes: Sequence[dict[str, Any]], stated: float | None, execution: float | None, speed: Speed,
        settings: ThinkingSettings,
    ) -> Self:  # fmt: skip
        """Return it after trials with these notes.

        The budget is the one that is stated or, by default, follows from the seconds of an ``execution``; infinity if
        people make it, None if none was timed.
        """
        seconds, many = stated, 1.0
        if seconds is None:
            manual = execution == np.inf
            seconds = settings.manual if manual else max(settings.default, execution or 0.0)
            many = settings.decisive
        low, high = settings.slower
        ratios: dict[str, float] = {}
        for note in notes:
            with suppress(AttributeError, TypeError, ValueError):  # the note of a store
                for kind, (expected, spent) in note.get("spent", {}).items():
                    if expected >= settings.noted * seconds:
                        # What was kept from earlier choices takes no time, and may have to be computed again.
                        ratios[kind] = float(np.clip(ratios.get(kind, 1.0) * spent / expected, low, high))
        return cls(seconds, many * seconds, speed, tuple(ratios.items()), settings)


@dataclass(frozen=True)
class Sizes:
    """Numbers on which the costs of a choice depend."""

    states: int
    inputs: int
    horizon: int
    transitions: int
    executions: int
    dimension: int
    batched: bool
    centres: int

    @classmethod
    def of(cls, speed: Speed, dimension: int, executions: int, known: int) -> Self:
        """Return the sizes after so many executions, with so many known transitions beside them."""
        from ctxval.learning.dynamics_posterior import PosteriorSettings  # imported here: a stored speed needs it not

        transitions = min(executions * speed.horizon + known, 3000)
        centres = min(transitions, PosteriorSettings.for_horizon(speed.horizon).centres)
        sizes = speed.states, speed.inputs, speed.horizon, transitions, executions, dimension
        return cls(*sizes, speed.batched, centres)


@dataclass(frozen=True)
class Costs:
    """The seconds that stages of given sizes take."""

    thinking: Thinking
    sizes: Sizes

    def _own(self, seconds: float) -> float:
        return self.thinking.speed.machine * seconds

    # Closed loops

    def plan(self, tasks: float) -> float:
        """Return the seconds of the plans of so many tasks."""
        speed, H = self.thinking.speed, self.sizes.horizon
        calls = -(-tasks // 512) if self.sizes.batched else tasks
        step = speed.step + self._own(2e-5)
        return calls * (speed.design + H * step) + (tasks - calls) * (speed.another_design + H * speed.another_step)

    def run(self, draws: float, tasks: float, replicates: float = 1.0, batches: float | None = None) -> float:
        """Return the seconds of closed loops of draws, with sequences of noise each, on planned tasks."""
        speed, s, settings = self.thinking.speed, self.sizes, self.thinking.settings
        systems = draws * replicates
        batches = (-(-tasks // 512) if s.batched else tasks) if batches is None else batches
        calls = batches * (1 if speed.together else systems)
        rows = systems * tasks
        features = s.centres if replicates == 1 else 100
        own = settings.row + features * (settings.centre + settings.coordinate * (2 * s.states + s.inputs))
        user = calls * speed.step + max(rows - calls, 0) * speed.another_step
        each = s.horizon * (user + self._own(calls * settings.step + rows * own))
        return each + self._own(settings.distance * systems * batches)

    def steps(self, count: float) -> float:
        """Return the seconds of so many steps of M in large batches."""
        return count * self.thinking.speed.another_step

    # Learning

    def _density(self) -> float:
        settings, rows = self.thinking.settings, min(self.sizes.transitions, 120) / 120
        return (settings.density + settings.density_coordinate * self._coordinates) * max(rows**2, 0.2)

    @property
    def _coordinates(self) -> int:
        return self.sizes.states + self.sizes.inputs

    def hyperparameters(self) -> float:
        """Return the seconds of the posterior of the hyperparameters, from which draws are made."""
        climbs = 3 * 2 * 70
        return self._own(self._density() * climbs)

    def posterior(self) -> float:
        """Return the seconds of conditioning on transitions, and of the errors of executions that are left out."""
        settings, s = self.thinking.settings, self.sizes
        pivots = s.centres * (settings.pivot + settings.pivot_row * s.transitions)
        return self._own(0.01 + 2 * pivots + 1e-8 * s.transitions * s.centres + 2e-10 * (s.centres + 100) ** 3)

    def learning(self) -> float:
        """Return the seconds of both, and of steps of M along all transitions."""
        return self.hyperparameters() + self.posterior() + 3 * self.sizes.transitions * self.thinking.speed.another_step

    def draws(self, hyperparameters: int) -> float:
        """Return the seconds of draws with so many sets of hyperparameters, which are drawn themselves."""
        curvature = 3 * (2 * (self._coordinates + 3) + 48) * self._density()
        share = (self.sizes.centres / 400) ** 2
        return self._own(curvature + hyperparameters * self.thinking.settings.component * max(share, 0.1))

    def input_effects(self, single: int) -> float:
        """Return the seconds of a search for effects of inputs, of single ones if there are at most so many."""
        m = self.sizes.inputs
        guesses = 10 + (18 * m if m <= single else 0)
        return self._own(self._density() * (4 * 140 + 2 * 80 + guesses))

    def friction(self) -> float:
        """Return the seconds of a search for dry friction, and of learning with it."""
        return self._own(0.3 + 2e-5 * self.sizes.transitions * self.sizes.states) + self.hyperparameters()

    # Noise and histories

    def features(self, lags: int = 0, centres: int = 64) -> int:
        """Return the number of features of noisy dynamics with so many lags."""
        return centres + 1 + (1 + lags) * self._coordinates + self.sizes.states * self.sizes.inputs

    def evidence_of_lags(self, lags: int, evaluations: int) -> float:
        """Return the seconds of the evidence of one structure for so many hyperparameters."""
        settings, N, F = self.thinking.settings, self.sizes.transitions, self.features(lags)
        one = settings.eigen * F**3 + settings.gram * N * F**2 + 342 * F * self.sizes.states * 4e-9 + 5e-8 * N * F
        return self._own(evaluations * (one + 3e-4))

    def filter(self) -> float:
        """Return the seconds of the posterior of one structure with measurement noise."""
        settings, s = self.thinking.settings, self.sizes
        D, rows = self.features(centres=32) * s.states, s.transitions * s.states
        steps = 5 * (1 + s.executions * s.horizon * s.states * 2e-6) * 0.02
        return self._own(
            5 * (settings.invert * D**3 + settings.moments * rows * D**2 + 2e-9 * rows * s.states * D) + steps
        )

    def noise_on_distances(self) -> float:
        """Return the seconds that tell whether noise and starts matter to distances."""
        return self.plan(38) + 2 * self.run(1, 32) + 10 * self.run(1, 6)

    def usual_lags(self) -> float:
        """Return the seconds that tell whether histories predict better."""
        return sum(self.evidence_of_lags(each, 2) for each in (1, 2, 3))

    def lags(self, structures: Sequence[int]) -> float:
        """Return the seconds of the most probable of structures with so many lags."""
        moves = 3 * (self._coordinates + 2) + 6
        return sum(self.evidence_of_lags(each, moves) for each in structures)

    # Searches

    def search(self, settings: WorstCaseSettings, replicates: float = 1.0, *, whole: bool = True) -> float:
        """Return the seconds of a search on the mean, with the pool's plans and the coverage of their loops."""
        tasks = settings.random or min(1500, settings.evaluations)
        loops = self.run(1, settings.pool, replicates) + self.run(1, tasks, min(replicates, 3.0), self._batches(tasks))
        loops += self.run(1, self.sizes.executions)
        beside = self.plan(16 * self.sizes.dimension) if whole else 0.0  # parameters that change no loop
        return self.plan(settings.pool) + self.plan(tasks) + loops + beside + self._own(0.05)

    def _batches(self, tasks: float) -> float | None:
        return 20.0 if self.sizes.batched and tasks > 64 else None  # an ascent has many small batches

    def screening(self, settings: WorstCaseSettings, replicates: float = 1.0, rests: bool = False) -> float:
        """Return the seconds of a few draws on some tasks."""
        tasks = settings.local_maxima + settings.shared // 4 + self.sizes.executions
        tasks = settings.shared if settings.random else tasks
        own = 8 * settings.rounds * (2 * self.sizes.dimension + settings.moves + 1) if rests else 0
        tasks += 256 if rests else 0  # friction at rest differs
        seconds = self.draws(8) + self.plan(tasks + own) + self.run(1, tasks) + self.run(8, tasks, replicates)
        return seconds + self.run(1, own, replicates, 8.0)

    def prediction(self, draws: int, replicates: float = 1.0) -> float:
        """Return the seconds of the prediction of one execution."""
        return self.plan(1) + self.run(1, 1) + self.run(draws, 1, replicates) + self.draws(draws // 2)

    def next_task(self) -> float:
        """Return the seconds of a test whether a task is steady, and of a move of its unseen parameters."""
        return self.plan(3) + self.run(1, 3)

    def whole(self, settings: WorstCaseSettings, draws: int, replicates: float = 1.0) -> float:
        """Return the seconds of all evidence of a verdict that each campaign needs."""
        s = self.sizes
        groups = 20 if replicates == 1 else 5
        if settings.random:
            seconds = self.plan(settings.shared) + self.run(draws, settings.shared, replicates) + self.draws(groups)
            return seconds + self.run(1, min(256, settings.pool), replicates) + self.run(1, s.executions)
        shared = settings.local_maxima + settings.shared + s.executions
        moves = 2 * s.dimension + settings.moves + 1
        beside = settings.peaks * (settings.nearby + 1)
        seconds = self.plan(settings.evaluations + shared + beside + 3 * settings.pool)
        seconds += self.run(1, settings.evaluations, min(replicates, 3.0), self._batches(settings.evaluations))
        seconds += self.run(1, shared) + self.draws(groups) + self.run(draws, shared, replicates)
        if settings.rounds:
            own = draws * moves
            seconds += settings.rounds * (self.plan(own) + self.run(1, own, replicates, 2.0))
            seconds += self.run(draws, 16, replicates)
        seconds += self.run(1, beside + 3 * settings.pool + min(256, settings.pool), replicates)
        if replicates > 1:
            seconds += self.plan(draws) + self.run(1, draws, 80) + s.executions * self.run(draws, 1, replicates)
        return seconds + self.run(1, s.executions)

    def pushes(self, settings: WorstCaseSettings) -> float:
        """Return the seconds of the response to pushes."""
        tasks = min(16, settings.local_maxima) + 16 + self.sizes.executions
        return self.plan(tasks) + 2 * self.run(18 * self.sizes.states, tasks)

    def intensified(self, settings: WorstCaseSettings) -> float:
        """Return the seconds of two intensified searches."""
        tasks = 2 * settings.intensified(self.sizes.dimension)
        return self.plan(tasks) + self.run(1, tasks)


class Ledger:
    """The budget of one choice: stages are taken while they fit, and what they really take is measured.

    Without a budget, all stages are taken.
    """

    def __init__(self, costs: Costs | None = None) -> None:
        self.costs, self.spent_up = costs, False
        # Seconds that a choice needs in any case: of a prediction with the test of its task, and of the smallest search
        # until one is taken.
        self.reserve, self.owed = 0.0, 0.0
        self.replaced: list[str] = []
        self.missing = 0.0  # seconds of a stage without which there is no evidence
        self.incomplete = 0.0  # seconds of stages of learning that were left out
        self.expected: dict[str, float] = {}
        self.spent: dict[str, float] = {}
        self._kinds: list[str] = []
        self._since = 0.0

    @property
    def is_limited(self) -> bool:
        """Whether there is a budget."""
        return self.costs is not None

    @property
    def left(self) -> float:
        """The seconds that no stage has taken."""
        return np.inf if self.costs is None else self.costs.thinking.seconds - sum(self.expected.values())

    @contextmanager
    def within(self, thinking: Thinking) -> Iterator[None]:
        """Have another budget meanwhile."""
        before = self.costs
        self.costs = None if before is None else replace(before, thinking=thinking)
        try:
            yield
        finally:
            self.costs = before

    def seconds(self, kind: str, of: Callable[[Costs], float]) -> float:
        """Return the expected seconds of a stage of a kind; 0 without a budget."""
        if self.costs is None:
            return 0.0
        return dict(self.costs.thinking.slower).get(kind, 1.0) * of(self.costs)

    def charge(self, kind: str, of: Callable[[Costs], float]) -> None:
        """Take a stage that is needed in any case."""
        self.add(kind, self.seconds(kind, of))

    def add(self, kind: str, seconds: float) -> None:
        """Take a stage of so many seconds."""
        if self.costs is not None:
            self.expected[kind] = self.expected.get(kind, 0.0) + seconds

    def fits(self, kind: str, of: Callable[[Costs], float], reserve: float = 0.0) -> bool:
        """Take a stage of a kind if it fits, and leaves a reserve; return whether it does."""
        seconds = self.seconds(kind, of)
        if seconds + reserve > self.left:
            return False
        self.add(kind, seconds)
        return True

    def learns(self, kind: str, stage: str, of: Callable[[Costs], float]) -> bool:
        """As :meth:`fits`, of a stage of learning: without it, what is learned decides nothing.

        It leaves what the choice of a task needs in any case.
        """
        if self.fits(kind, of, self.reserve + self.owed):
            return True
        self.incomplete += self.seconds(kind, of)
        self.replaced.append(stage)
        return False

    def optional(self, kind: str, stage: str, of: Callable[[Costs], float]) -> bool:
        """As :meth:`fits`, of a stage that tells more, and on which no verdict rests."""
        fits = self.fits(kind, of, self.reserve + self.owed)
        if not fits:
            self.replaced.append(stage)
        return fits

    @contextmanager
    def spending(self, kind: str) -> Iterator[None]:
        """Measure the seconds of a kind of stages; those of another kind within it are its own."""
        self._switch()
        self._kinds.append(kind)
        try:
            yield
        finally:
            self._switch()
            self._kinds.pop()

    def _switch(self) -> None:
        now = time.process_time()
        if self._kinds:
            kind = self._kinds[-1]
            self.spent[kind] = self.spent.get(kind, 0.0) + now - self._since
        self._since = now

    def to_json(self) -> dict[str, Any]:
        """Return what a trial stores of the choice of its task; the next choices need it."""
        if self.costs is None:
            return {}
        spent = {kind: [expected, self.spent.get(kind, 0.0)] for kind, expected in self.expected.items()}
        rounded = {kind: [float(f"{each:.3g}") for each in pair] for kind, pair in spent.items()}
        return {"budget": self.costs.thinking.seconds, "spent": rounded, "replaced": list(dict.fromkeys(self.replaced))}


def speed_to_json(speed: Speed) -> dict[str, Any]:
    """Return a speed as a trial stores it, with three digits."""
    return {name: value if isinstance(value, int) else float(f"{value:.3g}") for name, value in asdict(speed).items()}


def reduced(settings: WorstCaseSettings, share: float) -> WorstCaseSettings:
    """Return the settings of a search of a share of the tasks; the same if it would tell nothing of all of them."""
    if not settings.reducible:
        return settings

    def part(count: int, least: int) -> int:
        return min(count, max(least, round(share * count)))

    return replace(
        settings,
        pool=part(settings.pool, 4),
        evaluations=part(settings.evaluations, 8),
        local_maxima=part(settings.local_maxima, 2),
        shared=part(settings.shared, 4),
    )


def _probe() -> float:
    """Return the seconds of a piece of numerical work, the least of several."""
    rng = np.random.default_rng(0)
    a, z = rng.random((300, 300)), rng.random((100, 200))

    def work() -> None:
        b = a @ a.T
        np.linalg.cholesky(b + 300 * np.eye(300))
        for _ in range(20):
            np.exp(-z)

    with single_threaded():
        return min(_timed(work)[1] for _ in range(5))


def _seconds_of_step(controller: Any, task: Task, closed_loop: Callable[..., Any]) -> float:
    """Return the seconds of one step of closed loops on M."""
    short = _shortened(task, min(3, task.horizon))
    return min(_timed(lambda: closed_loop(controller, short))[1] for _ in range(2)) / short.horizon


def _shortened(task: Task, horizon: int) -> Task:
    short = copy.copy(task)
    short.horizon = horizon
    return short


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    begun = time.process_time()
    return work(), time.process_time() - begun
