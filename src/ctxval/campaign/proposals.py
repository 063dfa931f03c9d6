"""Points that a search proposes, a test of tasks before they are executed, and independent draws of tasks.

A design that ends by chance, such as one that rounding errors stop, gives nearly equal tasks different controllers. A
search for the largest distance would find such chances, which nobody meets again. So a task is executed only if its
distance is that of the tasks next to it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ctxval._util.arrays import Array, Rows
from ctxval._util.boxes import latin_hypercube
from ctxval._util.progress import stage
from ctxval._util.texts import enumerated, shortened
from ctxval.campaign.choices import Choice
from ctxval.campaign.costs import costs_of
from ctxval.campaign.dynamics import CampaignDynamics
from ctxval.campaign.storage.store import Store
from ctxval.certificates.prediction_tests import TESTS
from ctxval.core.model import Step, run_of
from ctxval.core.rollout import rollout
from ctxval.core.trial import Trial, Trials
from ctxval.core.trial_note import RESERVED, TrialNote
from ctxval.core.validation import Validation
from ctxval.errors import CtxvalError, InputError
from ctxval.searches import BaseSearch, SequentialSearch

if TYPE_CHECKING:
    from ctxval.learning import LoopPlanner

Note = dict[str, Any] | None

_MOVED = 0x6D6F  # identifies the random stream of moves away from tasks that are not steady
_DRAW, _HYPERCUBE = 0x6175, 0x6879  # those of independent draws, and of Latin hypercubes


@dataclass(frozen=True, eq=False)
class DesignContinuity:
    """Tells for one choice which tasks may be executed, and counts the others."""

    planner: LoopPlanner  #: designs controllers; S is never executed
    #: points ``(m, d)`` -> predicted distances ``(m,)``; None if nothing is predicted: then the closed loops of a
    #: slightly disturbed M are compared
    expected: Callable[[Array], Array] | None = None

    _tested: dict[bytes, bool] = field(default_factory=dict, init=False)

    @property
    def rejected(self) -> int:
        """The number of tasks that are not steady."""
        return sum(not steady for steady in self._tested.values())

    def __call__(self, point: Array) -> bool:
        """Return whether rounding a task ``(d,)``, or moving it by 1e-9 of its ranges, hardly changes its distance."""
        key, space = point.tobytes(), self.planner.validation.space
        if space.members is not None:
            return True  # there are no tasks next to it
        if key not in self._tested:
            if len(self._tested) >= 24:
                return False
            rounded = space.rounded(point)
            beside = np.where(rounded > 0.5, rounded - 1e-9, rounded + 1e-9)
            points = np.stack([point, rounded, beside])
            self._tested[key] = True
            # The user's own parts may fail here; this is reported when the task is planned.
            with stage("testing a task", unit="designs"), suppress(Exception, SystemExit):
                if self.expected is None:
                    shares = self._pushed_loops(points)
                else:
                    values = self.expected(points)
                    shares = values[:, None] / max(values[np.isfinite(values)].max(initial=0.0), 1e-300)
                # The tasks have the same distance, or none of them a known one.
                known = np.isfinite(shares).all(axis=1)
                alike = known.all() and (np.ptp(shares, axis=0) <= 0.05).all()
                self._tested[key] = not known.any() or bool(alike)
        return self._tested[key]

    def moved(self, point: Array, rng: np.random.Generator) -> Array:
        """Return a steady task next to a task that is not steady; the task itself if none is found."""
        deviations = 1e-6 * 2.0 ** np.arange(12)
        moves = deviations[:, None] * rng.normal(size=(len(deviations), len(point)))
        steady = next(filter(self, np.clip(point + moves, 0, 1)), None)
        if steady is None:
            self._tested[point.tobytes()] = True  # it is executed, and so not rejected
        return point if steady is None else steady

    def _pushed_loops(self, points: Array) -> Array:
        """Return states ``(m, (H + 1) n)`` of M pushed by 1 % of their ranges a step, as shares of these; else NaN."""
        model, pushed = self.planner.validation.model, list[tuple[Rows, Array]]()
        for planned in self.planner.plan(points):
            ranges = np.ptp(planned.nominal.states.reshape(-1, planned.nominal.states.shape[-1]), axis=0)
            ranges = np.maximum(ranges, 1e-3 * ranges.max())

            run = run_of(model, planned.task.initial_state)

            def step(x: Array, u: Array, push: Array = 0.01 * ranges, run: Step = run) -> Array:
                return np.asarray(run(x, u) + push)

            loops = rollout(step, planned.controller, planned.task)
            pushed.append((planned.rows, (loops.states / ranges).reshape(len(planned.rows), -1)))
        shares = np.full((len(points), max((states.shape[1] for _, states in pushed), default=1)), np.nan)
        for rows, states in pushed:
            shares[rows] = states
        return shares


class Proposals:
    """Asks the search of a campaign for points, and tests points before they are executed."""

    def __init__(self, validation: Validation, search: BaseSearch, dynamics: CampaignDynamics) -> None:
        self._validation, self._search, self._dynamics = validation, search, dynamics
        self.thinking: float | None = None  # seconds that a choice may take, if they are stated

    def next(self, trials: Sequence[Trial], choice: Choice) -> tuple[Array, TrialNote]:
        """Return the search's next point ``(d,)``, tested and rounded unless an earlier trial has it, and its note."""
        search, steady = self._search, DesignContinuity(self._dynamics.study.planner)
        with stage("choosing a task", unit="designs") if search.uses_prediction else nullcontext():
            if search.uses_prediction:
                prediction = self._dynamics.prediction(trials, pending=True)
                if prediction is not None:
                    expected = prediction.expected
                    steady = DesignContinuity(self._dynamics.study.planner, lambda points: expected(points)[0])
                    costs = partial(costs_of, prediction, self._validation, trials)
                    left = remaining_tasks(self._validation, trials)
                    prediction = replace(prediction, costs=costs, steady=steady, candidates=left)
                    prediction = replace(prediction, thinking=self.thinking)
                search.use_prediction(prediction)
            point, attached = self._asked()
            note = replace(choice.note, search=attached)
            repeats = self._validation.space.members is None
            if repeats and any(point.tobytes() == trial.unit_point.tobytes() for trial in trials):
                return point, note
            untested = search.iid or self._dynamics.has_no_time(trials)
            point, note = self._final(point, trials, None if untested else steady, note, choice.rejected or 0)
            if isinstance(search, SequentialSearch):
                search.amend(point)
            return point, note

    def spread(self, trials: Sequence[Trial]) -> Array | None:
        """Return a task far from all that are being executed, a point ``(d,)``, if nothing at all is known yet.

        Guesses of a search that knows nothing are random; far apart, and mostly with parameters at their bounds, they
        teach more. The first task is that of the search, also if others follow at once.
        """
        known, waiting = Trials(trials).completed, Trials(trials).open.points(self._validation.space.dimension)
        if (
            known
            or not len(waiting)
            or not self._search.uses_prediction
            or self._dynamics.prediction(trials) is not None
        ):
            return None
        rng = np.random.default_rng([len(trials), _MOVED])
        tasks = rng.random((512, waiting.shape[1]))
        tasks = np.where(rng.random(tasks.shape) < rng.random((512, 1)), np.round(tasks), tasks)
        gaps = np.linalg.norm(tasks[:, None] - waiting, axis=2).min(axis=1)
        return np.asarray(tasks[gaps.argmax()])

    def tested(self, choice: Choice, trials: Sequence[Trial]) -> tuple[Array, TrialNote]:
        """Return the point ``(d,)`` of a choice that another part has made, rounded and tested, and its note."""
        assert choice.unit_point is not None
        if choice.parameters is not None or choice.origin == "iid":
            return choice.unit_point, choice.note
        steady = DesignContinuity(self._dynamics.study.planner) if choice.rejected is None else None
        return self._final(choice.unit_point, trials, steady, choice.note, choice.rejected or 0)

    def _asked(self) -> tuple[Array, Note | None]:
        """Return the point ``(d,)`` that the search proposes, and its note, which is stored as JSON."""
        asked, dimension = self._search.ask(1), self._validation.space.dimension
        point: Array = np.empty(0)
        with suppress(TypeError, ValueError):
            if np.isrealobj(asked):
                point = np.asarray(asked, dtype=np.float64)
        if point.shape != (1, dimension) or not ((point >= 0) & (point <= 1)).all():
            got = shortened(repr(asked), 200)
            raise InputError(f"a search must return points of the unit cube, shape (1, {dimension}), got {got}.")
        note = self._search.note()
        if isinstance(note, dict) and set(RESERVED) & set(note):
            raise InputError(f"the note of a search must not have the keys {enumerated(RESERVED, 20)}.")
        with suppress(TypeError, ValueError):
            if note is None or (isinstance(note, dict) and json.dumps(note, allow_nan=False)):
                return np.asarray(point[0]), note
        raise InputError(f"the note of a search must be a dictionary of plain values for JSON, got {note!r}.")

    def _final(
        self, point: Array, trials: Sequence[Trial], steady: DesignContinuity | None, note: TrialNote, rejected: int
    ) -> tuple[Array, TrialNote]:
        """Return a steady task (if tested), rounded or left of a suite; its note counts the rejected ones."""
        remaining = remaining_tasks(self._validation, trials)
        if steady is not None:
            # On M itself, no distance depends on how a controller would react to errors of M; a suite has no others.
            if remaining is None and not self._validation.is_on_model and not steady(point):
                point = steady.moved(point, np.random.default_rng([len(trials), _MOVED]))
            rejected += steady.rejected
        if remaining is None:
            point = self._validation.space.rounded(point)
        else:
            point = np.asarray(remaining[np.linalg.norm(remaining - point, axis=1).argmin()])
        return point, replace(note, unsteady=rejected) if rejected else note


class IndependentDraws:
    """The random numbers of the independent draws of one campaign, which depend on the seed and on the model.

    Otherwise, a model that was learned again with the results of an audit would be audited by the same tasks. The store
    keeps the number of the model, so that a campaign continues with the same draws on another machine.
    """

    def __init__(self, store: Store, validation: Validation, seed: int) -> None:
        self._store, self._validation, self._seed = store, validation, seed

    def point(self, trials: Sequence[Trial]) -> Array:
        """Return the next draw from the distribution of tasks, a point of the unit cube ``(d,)``."""
        space = self._validation.space
        return space.rounded(space.unit_draws(1, self._generator(len(trials), _DRAW))[0])

    def many(self, trials: Sequence[Trial], count: int) -> Array:
        """Return independent draws from which the next task is chosen, points of the unit cube ``(count, d)``."""
        space = self._validation.space
        return space.rounded(space.unit_draws(count, self._generator(len(trials), _DRAW, count)))

    def hypercube(self, number: int, candidate: int = 0) -> Array:
        """Return one of the Latin hypercubes for tests of a number ``(TESTS, d)``, whatever the results are."""
        rng = self._generator(number, _HYPERCUBE, *([candidate] if candidate else []))
        return latin_hypercube(TESTS, self._validation.space.dimension, rng)

    def left(self, trials: Sequence[Trial]) -> Array:
        """Return the first task of a suite that is left in an order that was drawn once, ``(d,)``."""
        members, remaining = self._validation.space.members, remaining_tasks(self._validation, trials)
        assert members is not None
        assert remaining is not None
        known = {task.tobytes() for task in remaining}
        order = self._generator(0, _DRAW).permutation(len(members))
        return next(task for task in members[order] if task.tobytes() in known)

    def _generator(self, number: int, stream: int, *further: int) -> np.random.Generator:
        """Return the random numbers of a draw; the streams of searches have smaller numbers."""
        return np.random.default_rng(np.random.SeedSequence([self._seed, number, stream, self.of_model(), *further]))

    def of_model(self) -> int:
        """Return the number of the model, which the store keeps, because another processor rounds differently."""
        if self._store.draws() is None:
            self._store.keep_draws(_number_of_model(self._validation))
        return self._store.draws() or 0


def remaining_tasks(validation: Validation, trials: Sequence[Trial]) -> Array | None:
    """Return the tasks of a suite that no trial has, points ``(r, d)``; None if tasks fill the box."""
    return validation.space.remaining(Trials(trials).points(validation.space.dimension))


def spread_tests(trials: Sequence[Trial]) -> int:
    """Return how many points of the Latin hypercubes of tests were taken."""
    return sum(trial.origin == "spread" for trial in trials)


def _number_of_model(validation: Validation) -> int:
    """Return a number that identifies a model by its closed loops, and by steps from states and inputs around them."""
    space = validation.space
    rows: list[Array] = []
    for point in (space.low, 0.5 * (space.low + space.high), space.high):
        with suppress(CtxvalError):
            loop = validation.plan(point).model_trajectory
            rows.append(np.hstack([loop.states[:-1], loop.inputs]))
    if not rows:
        return 0
    visited, n = np.concatenate(rows), loop.states.shape[-1]
    low, high = visited.min(axis=0), visited.max(axis=0)
    if not validation.outputs.hide_states:
        with suppress(Exception):  # a model may refuse states that its closed loops do not visit
            z = np.random.default_rng(0).uniform(2 * low - high, 2 * high - low, (2000, len(low)))
            rows.append(validation.model.step(z[:, :n], z[:, n:]))
    content = json.dumps([[f"{0.0 if abs(value) < 1e-12 else value:.5g}" for value in row.ravel()] for row in rows])
    return int.from_bytes(hashlib.sha256(content.encode()).digest()[:8], "big")
