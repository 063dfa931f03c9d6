r"""The envelope: the tasks on which d stays below a threshold, with a confidence for all of them at once.

Draws r_s of the learned dynamics have distances ``d_s(p)`` at some tasks, with a mean and a spread at each of them. The
largest standardised excess of a draw is ``max_p (d_s(p) - mean(p)) / spread(p)``; its order statistic k of rank
``ceil((S + 1) * confidence)`` holds for a draw that was left out, so for the system, at all tasks together. The
envelope is ``{p : mean(p) + k spread(p) <= tau}``. It is the simultaneous band of a Gaussian process (French and
Hoeting 2016; compare the excursion sets of Bolin and Lindgren 2015), with draws in closed loop in the place of values.

Draws that are learned from few executions are overconfident. So k is at least the largest standardised excess of the
executions that were predicted beforehand at drawn tasks, and the largest standardised error of the draws at tasks that
they were learned from. A task is no part of the envelope if its closed loop leaves the records, or if it was executed
with a larger distance. Without tests the envelope is withdrawn, as the bound on d* is, and if a test exceeds the
threshold although the learned dynamics have it below.

If a few recorded transitions are no smooth function of what is recorded, as those of contacts, and the others are, then
the draws are learned from the others alone (:mod:`ctxval.learning.regular`), and a task is no part of the envelope if
its run comes to states like those of the few. The tests are predicted from the executions of all other tasks.

Whether another task is trusted is known by its closed loops on the draws. Where these would take too long (boxes,
pictures, and functions for planners), ``mean + k spread`` is interpolated between the tasks whose loops were run
(:mod:`ctxval.certificates.envelope_shape`). The largest error of the nearest tasks, if each of them is interpolated
from all others, is added. Further tasks of the set check this: errors are multiplied until hardly any of these tasks
has ``mean + k spread`` above the threshold.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_floats, require_shape
from ctxval._util.boxes import separated_rows
from ctxval._util.files import write_text
from ctxval._util.representation import ShortRepr
from ctxval._util.texts import enumerated
from ctxval.certificates.checks import CHECKS
from ctxval.certificates.drawn_distances import FLOOR, LARGEST, DrawnDistances
from ctxval.certificates.envelope_shape import (
    SHAPE,
    Surfaces,
    TrustedRegion,
    exported,
    regions_inside,
)
from ctxval.certificates.evidence import Evidence
from ctxval.certificates.prediction_tests import DRAWN
from ctxval.certificates.predictions import CheckedPrediction, agrees, latest_tests, missing_tests
from ctxval.certificates.sentences.statements import IRREGULAR, dynamics_assumptions, envelope_statement
from ctxval.core.space import TaskSpace
from ctxval.core.target import LARGEST_DISTANCE, Target
from ctxval.core.task_suite import TaskSuite
from ctxval.errors import InputError


@dataclass(frozen=True)
class EnvelopeSettings:
    """How an envelope is computed and counted."""

    counted: int = 4096  #: tasks of which the share in the envelope is counted
    exceeded: float = 1.02  #: an executed distance above the threshold counts as at least this multiple of it
    others: int = 32  #: tasks outside of the interpolated set that are counted if nothing checks this
    block: int = 256  #: tasks whose closed loops are run together
    worth: float = 0.8  #: share of the tasks predicted below the threshold that tests may leave in the envelope


ENVELOPE = EnvelopeSettings()
"""The settings in use."""


_SAME = 1e-9
_SAME_TASK = 1e-6


@dataclass(frozen=True, eq=False)
class Envelope(ShortRepr):
    """The set of tasks on which d stays below a threshold, with a confidence for all of them at once."""

    space: TaskSpace  #: the task space
    #: threshold, confidence: tau and the confidence
    threshold: float
    confidence: float
    statement: str  #: what it says, in one sentence
    #: share, interpolated: the share of the tasks that are trusted, and that boxes, pictures and saved functions trust
    share: float = 0.0
    interpolated: float = 0.0
    #: the largest boxes and half-spaces inside it, the largest first; not for a suite
    regions: tuple[TrustedRegion, ...] = ()
    tasks: tuple[str, ...] | None = None  #: the names of the trusted tasks of a suite; None if it is no suite
    factor: float | None = None  #: k, by how many spreads the mean must stay below the threshold
    raised_by: int | None = None  #: the trial that raised k, as predictions or draws miss its distance; else None
    margin: float = 0.0  #: the median of what the interpolation adds near evaluated tasks, as a share of the threshold
    evaluated: int = 0  #: the number of tasks at which closed loops were run
    checks: int = 0  #: the number of further tasks that checked the interpolation between these
    uncovered: float = 0.0  #: the share of the tasks that are not trusted only because predicted runs leave the records
    #: executions, tests: numbers of executions, and of those that were predicted beforehand at drawn tasks
    executions: int = 0
    tests: int = 0
    #: what stays below the threshold on each task: the distance, or its quantile under noise
    target: Target = LARGEST_DISTANCE
    assumptions: tuple[str, ...] = ()  #: what it assumes
    #: the number of recorded steps, such as contacts, that are no part of what is learned; a task is not trusted if its
    #: run comes to states like theirs
    irregular: int = 0
    doubt: str | None = None  #: why it is withdrawn; then no task is trusted
    #: the stages that were replaced by cheaper ones for lack of time, and the seconds that are missing; else None
    thinking: Mapping[str, Any] | None = None
    units: str = ""  #: the units of the distance
    _surfaces: Surfaces | None = None
    _bounds: Array | None = None
    _by_loops: Callable[[Array], Array] | None = None  # bounds of points (N, d), as shares of the threshold

    def trusted(self, task: Mapping[str, Any] | ArrayLike, *, interpolated: bool = False) -> Any:
        """Return whether tasks are trusted: of a mapping by name a bool, of points ``(..., d)`` of the space ``(...)``.

        Tasks outside of the task space are not trusted. Closed loops of the tasks are run on the draws. If
        ``interpolated``, none are, which takes microseconds and trusts fewer tasks.
        """
        return np.isfinite(self.bound(task, interpolated=interpolated))

    def bound(self, task: Mapping[str, Any] | ArrayLike, *, interpolated: bool = False) -> Any:
        """Return bounds on the distances of trusted tasks, at most tau; infinity if a task is not trusted."""
        if isinstance(task, Mapping):
            points = self.space.point(task)
        else:
            points = require_shape("task", as_floats("task", task), (self.space.dimension,))
        unit = self.space.to_unit(points)
        inside = np.asarray(((unit >= -_SAME) & (unit <= 1 + _SAME)).all(axis=-1))
        if interpolated or self._by_loops is None:
            return np.where(inside, self.bound_at(np.clip(unit, 0, 1)), np.inf)[()]
        bounds = np.full(inside.shape, np.inf)
        bounds[inside] = self.threshold * self._by_loops(np.clip(unit[inside], 0, 1))
        return bounds[()]

    def bound_at(self, unit: Array) -> Array:
        """Return the interpolated :meth:`bound` at points ``(..., d)`` of the unit cube."""
        if self._bounds is not None and isinstance(self.space, TaskSuite):
            rows = self.space.rows_at(unit)
            same = np.abs(self.space.members[rows] - unit).max(axis=-1) <= _SAME
            return np.where(same, self._bounds[rows], np.inf)
        if self._surfaces is None:
            return np.full(unit.shape[:-1], np.inf)
        upper = self._surfaces(unit)
        return np.where((upper <= 1).all(axis=-1), self.threshold * np.maximum(upper[..., 0], 0), np.inf)

    @property
    def words(self) -> str:
        """The envelope in words: the largest boxes and half-spaces inside it, or the tasks of a suite."""
        if self.doubt is not None:
            return f"No envelope is stated: {self.doubt}."
        if self.tasks is not None:
            return f"Trusted: {enumerated(self.tasks, 40)}." if self.tasks else "No task is trusted."
        if not self.regions:
            return "No task is trusted." if not self.share else "It holds no box of more than 2 % of the tasks."
        each = "; or ".join(f"{region.text} ({100 * region.share:.0f} % of the tasks)" for region in self.regions)
        whole = len(self.regions) == 1 and self.regions[0].share > self.share - 0.005
        return f"Trusted: {each}." if whole else f"The largest boxes of trusted tasks: {each}."

    def to_json(self) -> dict[str, Any]:
        """Return the statement and its numbers, ready for JSON."""
        first = "threshold confidence units statement words share interpolated regions tasks factor raised_by margin"
        names = f"{first} evaluated checks uncovered executions tests assumptions irregular doubt thinking".split()
        plain = {name: getattr(self, name) for name in names} | {"quantile": self.target.to_json()["quantile"]}
        lists = {name: list(value) for name, value in plain.items() if isinstance(value, tuple)}
        lists["regions"] = [region.to_json() for region in self.regions]
        return {
            "raised_by_trial" if name == "raised_by" else name: lists.get(name, value) for name, value in plain.items()
        }

    def save(self, path: str | Path) -> Path:
        """Write the interpolated function ``trusted(task) -> bool, bound`` to a file ``.py``, which needs NumPy alone.

        Raises:
            InputError: if the path has another suffix, nothing is trusted, or the task space is a suite.
        """
        if Path(path).suffix != ".py":
            raise InputError(f"the envelope is written to a file such as envelope.py, got {str(path)!r}.")
        if self._surfaces is None:
            reason = "the tasks of a suite are a list" if self.tasks is not None else "no task is trusted"
            raise InputError(f"there is no function to write: {reason}.")
        return write_text(path, exported(self._surfaces, self.space, self.statement, self.threshold, self.confidence))


def withdrawn(space: TaskSpace, threshold: float, confidence: float, doubt: str) -> Envelope:
    """Return an envelope that is not stated, for a reason."""
    return Envelope(space, threshold, confidence, "No envelope is stated.", doubt=doubt.rstrip("."))


def doubt_of_envelope(evidence: Evidence, threshold: float) -> str | None:
    """Return why no envelope can be stated, and what would help; None if one can."""
    known = replace(evidence, unplanned=0.0)  # tasks that cannot be planned are no part of the envelope
    needed = (check for check in CHECKS if check.stage == "learning" or check.code == "unsampled_parameter")
    if (opened := next(filter(None, (check.opened(known) for check in needed)), None)) is not None:
        return str(opened)
    for test in evidence.predictions:
        explained = test.explained  # smaller differences raise the factor of the envelope
        if explained is None or test.is_noisy or agrees(test.distance, explained, threshold):
            continue
        if explained <= threshold < test.distance:
            return (
                f"trial {test.trial} has the distance {test.distance:.4g}, and {explained:.4g} on the learned "
                "dynamics, which is below the threshold: the next state is no function of what is recorded, or the "
                "dynamics depend on the task; record more states"
            )
    missing = missing_tests(evidence.predictions, evidence.tests)
    if missing:
        return (
            f"{missing} more {'execution' if missing == 1 else 'executions'} must be predicted beforehand, at tasks "
            "drawn over the whole task space (`ctxval run --envelope` executes them)"
        )
    return None


def boundary_tasks(
    drawn: DrawnDistances, evidence: Evidence, threshold: float, confidence: float, tasks: Array, count: int
) -> Array:
    """Return at most so many of other tasks ``(N, d)``: those that are nearest to the boundary of the envelope."""
    surfaces = _interpolated(drawn, evidence, threshold, _raised(drawn, evidence, threshold, confidence)[0], ())
    largest = surfaces.with_errors(0.0)(tasks).max(axis=1)
    near = np.argsort(np.abs(largest - 1), kind="stable")[: 3 * count]
    reach = 0.25 * count ** (-1 / tasks.shape[1])
    return np.asarray(tasks[near][separated_rows(tasks[near], reach, count)])


def _raised(drawn: DrawnDistances, evidence: Evidence, threshold: float, confidence: float) -> tuple[float, int | None]:
    """Return k, and the trial that raised it; None if it is that of the draws.

    Contacts and hidden states are missed in both directions, so a distance that is too small counts as well.
    """
    factor, rises = drawn.factor(threshold, confidence), rises_of(evidence, threshold)
    if not evidence.target.is_noisy:  # else noise explains the differences
        mean, spread = drawn.mean, drawn.spread(threshold)
        for each in (each for each in evidence.predictions if each.point):
            apart = np.abs(drawn.points - np.array(each.point)).max(axis=1)
            row = int(apart.argmin())
            if apart[row] <= _SAME_TASK and mean[row] <= threshold:
                rises.append((float(abs(each.distance - mean[row]) / spread[row]), each))
    largest, which = max(rises, key=lambda rise: rise[0], default=(0.0, None))
    return (factor, None) if which is None or largest <= factor else (largest, which.trial)


def rises_of(evidence: Evidence, threshold: float) -> list[tuple[float, CheckedPrediction]]:
    """Return the standardised excesses of tests that count and of the last other predictions, with the predictions."""
    tests = latest_tests(evidence.predictions, evidence.tests)
    last = {
        each.trial: each for each in [*tests, *evidence.counted(threshold)[-evidence.limits.predictions :]]
    }.values()
    rises = []
    for each in last:
        if min(each.distance, each.median) <= threshold:
            spread = (each.upper - each.median) / 1.645  # the 0.95 quantile of a normal distribution
            # An error that is large for the test's own distance may be as large a share of one near the threshold.
            scale = (
                1.0
                if evidence.holds(each, threshold)
                else threshold / max(each.median, evidence.limits.small * threshold)
            )
            rise = max(scale, 1.0) * each.excess / max(spread, 2 * FLOOR * threshold)
            rises.append((rise if np.isfinite(each.upper) else 0.0, each))
    return rises


def must_outlive_a_test(drawn: DrawnDistances, evidence: Evidence, threshold: float) -> bool:
    """Return whether a drawn test raises k by so much that the tests of another hypercube are worth while."""
    largest = max((rise for rise, test in rises_of(evidence, threshold) if test.origin in DRAWN), default=0.0)
    kept = drawn.mean + largest * drawn.spread(threshold) <= threshold
    return bool(kept.sum() < ENVELOPE.worth * (drawn.mean <= threshold).sum())


def _interpolated(
    drawn: DrawnDistances,
    evidence: Evidence,
    threshold: float,
    factor: float,
    executed: Sequence[tuple[Array, float]],
) -> Surfaces:
    """Return the surfaces of the bounds, and of the departures of loops of tasks whose bounds keep the threshold."""
    departures = drawn.departures(evidence.most_beyond)
    points, values = drawn.points, np.column_stack([drawn.upper(factor, threshold), departures])
    for point, distance in executed:
        if distance > threshold:
            far = np.abs(points - point).max(axis=1) > _SAME_TASK
            ratio = float(np.clip(distance / threshold, ENVELOPE.exceeded, LARGEST))
            points = np.concatenate([points[far], point[None]])
            values = np.concatenate([values[far], [[ratio, 0.0, 0.0, 0.0]]])
    _, rows = np.unique(points.round(9), axis=0, return_index=True)
    points, values = points[np.sort(rows)], values[np.sort(rows)]
    matters = (values > 1) & (values[:, :1] <= 1)
    matters[:, 0] = True
    return Surfaces.through(points, values[:, matters.any(axis=0)])


def envelope_of(
    space: TaskSpace,
    drawn: DrawnDistances,
    evidence: Evidence,
    executed: Sequence[tuple[Array, float]],
    threshold: float,
    confidence: float,
    evaluate: Callable[[Array], DrawnDistances] | None = None,
    checks: int = 0,
    units: str = "",
    irregular: int = 0,
) -> Envelope:
    """Return the envelope from drawn distances and evidence of the same executions, which nothing withdraws.

    Args:
        executed: points of the unit cube ``(d,)`` with their distances.
        evaluate: returns the distances of further tasks on the same draws; None if all other tasks are interpolated.
        checks: the number of further tasks that check the interpolation.
        irregular: the number of recorded steps that the draws are not learned from.
    """
    factor, raised_by = _raised(drawn, evidence, threshold, confidence)
    executed = () if evidence.target.is_noisy else executed  # one execution tells little of a quantile
    envelope = Envelope(
        space,
        threshold,
        confidence,
        "",
        factor=factor,
        raised_by=raised_by,
        evaluated=len(drawn.points),
        executions=evidence.executions,
        tests=sum(each.is_test for each in evidence.predictions),
        target=evidence.target,
        assumptions=(*dynamics_assumptions(evidence), *([IRREGULAR] if irregular else [])),
        irregular=irregular,
        units=units,
    )
    if isinstance(space, TaskSuite):
        envelope = _of_suite(envelope, space, drawn, evidence.most_beyond, executed)
    else:
        surfaces = _interpolated(drawn, evidence, threshold, factor, executed)
        tasks, least = space.unit_draws(ENVELOPE.counted, np.random.default_rng(2)), surfaces
        if checks >= SHAPE.many:
            least = surfaces.with_errors(SHAPE.multiples[0])
        tasks = tasks[(least(tasks) <= 1).all(axis=1)][:checks]
        if evaluate is not None and len(tasks):
            checked = evaluate(tasks)
            outside = (checked.upper(factor, threshold) > 1) | (checked.leaving(evidence.most_beyond) > 1)
            surfaces = surfaces.without(tasks[outside], len(tasks))
            envelope = replace(envelope, checks=len(tasks))
        envelope = replace(envelope, margin=float(np.median(surfaces.errors[:, 0])), _surfaces=surfaces)
        tasks = space.unit_draws(ENVELOPE.counted, np.random.default_rng(0))
        inside = np.isfinite(envelope.bound_at(tasks))
        regions = regions_inside(space, tasks, inside, lambda unit: np.isfinite(envelope.bound_at(unit)))
        share = float(inside.mean())
        uncovered = float(((surfaces(tasks)[:, 0] <= 1) & ~inside).mean())
        envelope = replace(envelope, share=share, interpolated=share, regions=regions, uncovered=uncovered)
        if evaluate is not None:
            others = tasks[~inside][: checks // 2 or ENVELOPE.others]
            envelope = _with_loops(envelope, evaluate, evidence.most_beyond, executed, others)
    return replace(envelope, statement=envelope_statement(envelope))


def _with_loops(
    envelope: Envelope,
    evaluate: Callable[[Array], DrawnDistances],
    most: float,
    executed: Sequence[tuple[Array, float]],
    others: Array,
) -> Envelope:
    """Return the envelope that runs the closed loops of tasks, with the shares of others ``(N, d)`` that it adds."""
    factor, threshold = envelope.factor or 0.0, envelope.threshold
    exceeding = [point for point, distance in executed if distance > threshold]

    def by_loops(points: Array) -> Array:
        blocks = [np.zeros(0)]
        for first in range(0, len(points), ENVELOPE.block):
            drawn = evaluate(points[first : first + ENVELOPE.block])
            upper = drawn.upper(factor, threshold)
            blocks.append(np.where((upper <= 1) & (drawn.leaving(most) <= 1), np.maximum(upper, 0), np.inf))
        return np.concatenate(blocks)

    if exceeding and np.isfinite(by_loops(np.array(exceeding))).any():
        return envelope  # the draws contradict an execution, and the interpolation keeps away from it
    envelope = replace(envelope, _by_loops=by_loops)
    if not len(others):
        return envelope
    drawn, left = evaluate(others), 1 - envelope.interpolated
    below, covered = drawn.upper(factor, threshold) <= 1, drawn.leaving(most) <= 1
    share = envelope.interpolated + left * float((below & covered).mean())
    return replace(envelope, share=share, uncovered=left * float((below & ~covered).mean()))


def _of_suite(
    envelope: Envelope, suite: TaskSuite, drawn: DrawnDistances, most: float, executed: Sequence[tuple[Array, float]]
) -> Envelope:
    threshold, bounds = envelope.threshold, np.full(len(suite), np.inf)
    uncovered = np.zeros(len(suite), dtype=np.bool_)
    upper = threshold * drawn.upper(envelope.factor or 0.0, threshold)
    rows = suite.rows_at(drawn.points)
    leaving = drawn.leaving(most) > 1
    bounds[rows] = np.where((upper <= threshold) & ~leaving, upper, np.inf)
    uncovered[rows] = (upper <= threshold) & leaving
    for point, distance in executed:
        row = int(suite.rows_at(point))
        bounds[row], uncovered[row] = distance if distance <= threshold else np.inf, False
    names = tuple(name for name, bound in zip(suite.task_names, bounds, strict=True) if np.isfinite(bound))
    share = len(names) / len(suite)
    return replace(envelope, tasks=names, share=share, uncovered=float(uncovered.mean()), _bounds=bounds)
