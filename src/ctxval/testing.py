"""Conformance checks for your own parts.

Each check raises :class:`ctxval.errors.ConformanceError` with one sentence if the part breaks its contract.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import numpy as np

from ctxval._util.arrays import Array
from ctxval.certificates import Certificate, CertificateKind, Sample
from ctxval.core.controller import Controller, Synthesizer, converged_of, each_alone
from ctxval.core.distance import Distance
from ctxval.core.model import Model, ModelWithMemory, advanced, central_differences, linearize, memory_in
from ctxval.core.rollout import rollout
from ctxval.core.system import OutputsLike, System, as_outputs
from ctxval.core.task import Task
from ctxval.core.trajectory import COMPLETE, Trajectory
from ctxval.core.trial import Origin, State
from ctxval.errors import CertificateError, ConformanceError, InputError
from ctxval.searches import Search

_TOLERANCE = 1e-10


def check_model(
    model: Model, *, states: int, inputs: int, seed: int = 0, scale: float = 1.0, tolerance: float = _TOLERANCE
) -> None:
    """Check that a model gives the same steps again, and for a batch as one by one, and that its Jacobian is right.

    Args:
        states, inputs: the numbers of states n and of inputs m.
        scale: standard deviation of the random states and inputs.
        tolerance: largest relative difference between a batch and single steps; use 1e-6 for single precision.
    """
    rng = np.random.default_rng(seed)
    x, u = scale * rng.normal(size=(7, states)), scale * rng.normal(size=(7, inputs))
    batch = np.asarray(model.step(x, u))
    _require(batch.shape == x.shape, f"step of states {x.shape} must return the same shape, got {batch.shape}")
    _require(bool(np.isfinite(batch).all()), "step returns values that are not finite")
    single = np.array([model.step(xi, ui) for xi, ui in zip(x, u, strict=True)])
    _require_close("step of a batch", batch, "the steps one by one", single, tolerance)
    _require_close("a second step of a batch", np.asarray(model.step(x, u)), "the first", batch, tolerance)
    if isinstance(model, ModelWithMemory):
        memories = [memory_in(model, x), *(memory_in(model, row) for row in x)]
        together, each = advanced(model, x, u, memories[0]), [*map(partial(advanced, model), x, u, memories[1:])]
        for name, part, alone in zip(("advance", "memory"), together, zip(*each, strict=True), strict=True):
            _require_close(f"{name} of a batch", np.asarray(part), "those one by one", np.stack(alone), tolerance)
    if hasattr(model, "jacobian"):
        A, B = linearize(model, x, u)
        A_numeric, B_numeric = central_differences(model.step, x, u)
        # Central differences with steps of about 6e-6 magnify rounding errors by this factor.
        allowed = max(1e-5, 2e5 * tolerance)
        for name, given, numeric in (("A", A, A_numeric), ("B", B, B_numeric)):
            _require_close(
                f"{name} of jacobian", np.broadcast_to(given, numeric.shape), "differences", numeric, allowed
            )


def check_system(
    system: System,
    controller: Controller,
    task: Task,
    *,
    tolerance: float = _TOLERANCE,
    outputs: OutputsLike | None = None,
) -> None:
    """Check that a system starts in the task's initial state, runs to the horizon, and repeats itself.

    The check executes the system twice, and once more if it is ``batched``; with ``exact_batches``, the executions in a
    batch must be exactly those alone.

    The controller is for this task, which is no batch. The tolerance is the largest difference between two executions,
    relative to the larger of 1 and the state; set it to the noise that you expect. Outputs are those of the
    :class:`ctxval.Validation`, if it has any.
    """
    expected_start = as_outputs(outputs)(task.initial_state)
    first, second = system.execute(controller, task), system.execute(controller, task)
    for trajectory in (first, second):
        _require(isinstance(trajectory, Trajectory), f"execute must return a Trajectory, got {type(trajectory)}")
        expected = (task.horizon + 1, len(expected_start))
        got = trajectory.states.shape
        _require(got == expected, f"states must have shape {expected} for this task, got {got}")
        _require(trajectory.ended == COMPLETE, f"the execution ended early: {trajectory.ended}")
        start = np.abs(trajectory.states[0] - expected_start).max()
        _require(start <= tolerance, f"the execution starts {start:g} away from the task's initial state")
    _require_close("the first execution", first.states, "the second", second.states, tolerance)
    if getattr(system, "batched", False):
        exact = getattr(system, "exact_batches", False)
        both = each_alone([controller, controller], [task, task]) if exact else controller
        batch = system.execute(both, Task.stacked([task, task]))
        allowed = 0.0 if exact else tolerance
        _require_close("an execution in a batch", batch.states[1], "the same alone", first.states, allowed)


def check_synthesizer(synthesizer: Synthesizer, task: Task, model: Model) -> None:
    """Check that a synthesizer designs the same controller for a batch of tasks ``(N,)`` as task by task.

    If the controllers have the attribute ``converged``, it must be a boolean of each task, the same in a batch. Each
    run must repeat itself.
    """
    singles, converged = [], []
    for index in range(task.batch_shape[0]):
        controller = synthesizer.design(task[index], model)
        with _conforming():
            converged.append(converged_of(controller))
            singles.append(rollout(model, controller, task[index]))
            _require(bool(singles[-1].finite), f"the closed loop on the model is not finite for task {index}")
            again = rollout(model, controller, task[index])
            run = "the closed loop of a second run"
            _require_close(run, again.states, "that of the first", singles[-1].states, _TOLERANCE)
    if getattr(synthesizer, "batched", False):
        controller = synthesizer.design(task, model)
        with _conforming():
            together = converged_of(controller, task.batch_shape)
            batch = rollout(model, controller, task)
        alone = [each for each in converged if each is not None]
        same = not alone if together is None else np.array_equal(together, alone)
        _require(same, f"converged of a batch is {together}, and one by one it is {converged}")
        states = np.stack([single.states for single in singles])
        _require_close("the closed loops of a batch", batch.states, "those one by one", states, 1e-8)


@contextmanager
def _conforming() -> Iterator[None]:
    try:
        yield
    except InputError as error:  # the controller returned something else
        raise ConformanceError(str(error)) from error


def check_distance(distance: Distance, model_trajectory: Trajectory, system_trajectory: Trajectory, task: Task) -> None:
    """Check that a distance is finite and not negative, and the same for a batch as one by one.

    The trajectories and tasks to compare are batches ``(N,)``.
    """
    d = np.asarray(distance(model_trajectory, system_trajectory, task), dtype=np.float64)
    _require(d.shape == task.batch_shape, f"the distance of a batch {task.batch_shape} has shape {d.shape}")
    _require(bool(np.isfinite(d).all() and (d >= 0).all()), f"the distance must be finite and >= 0, got {d}")
    pairs = [(model_trajectory[i], system_trajectory[i], task[i]) for i in range(len(d))]
    singles = np.array([distance(*pair) for pair in pairs], dtype=np.float64)
    _require_close("the distances of a batch", d, "those one by one", singles, _TOLERANCE)


def check_search(search: Search, *, dimension: int = 2, seed: int = 3, budget: int = 12) -> None:
    """Check that a search stays in the unit cube, resumes from its history, and never repeats a failed point.

    The test run has so many points of a unit cube of this dimension; every fourth evaluation fails.
    """
    history = _trial_run(search, dimension, seed, budget)
    again = _trial_run(search, dimension, seed, budget)
    _require(np.array_equal(history[0], again[0]), "the same seed and values must give the same points")
    for count in range(1, budget):
        search.reset(dimension, seed)
        search.tell(history[0][:count], history[1][:count])
        resumed, point = search.ask(1)[0], history[0][count]
        same = f"ask must return the same next point, {point}, got {resumed}"
        _require(np.array_equal(resumed, point), f"after tell of the first {count} trials, {same}")


def _trial_run(search: Search, dimension: int, seed: int, budget: int) -> tuple[Array, Array]:
    search.reset(dimension, seed)
    points, values = np.empty((0, dimension)), np.empty(0)
    for number in range(budget):
        point = np.asarray(search.ask(1), dtype=np.float64)
        _require(point.shape == (1, dimension), f"ask(1) must return shape (1, {dimension}), got {point.shape}")
        _require(bool(((point >= 0) & (point <= 1)).all()), f"a point must be in the unit cube, got {point[0]}")
        # Every fourth evaluation fails.
        value = np.nan if number % 4 == 3 else float(np.sin(3 * point).sum())
        failed = points[np.isnan(values)]
        _require(not (failed == point).all(axis=1).any(), f"ask must not return a failed point again, got {point[0]}")
        search.tell(point, [value])
        points, values = np.concatenate([points, point]), np.append(values, value)
    return points, values


def _require(condition: bool, sentence: str) -> None:
    if not condition:
        raise ConformanceError(f"{sentence}.")


def _require_close(name: str, value: Array, other_name: str, other: Array, tolerance: float) -> None:
    _require(value.shape == other.shape, f"{name} has shape {value.shape}, {other_name} {other.shape}")
    gap = float((np.abs(value - other) / np.maximum(1.0, np.abs(other))).max(initial=0.0))
    _require(gap <= tolerance, f"{name} differs from {other_name} by {gap:.2g}, more than {tolerance:g}")


def check_certificate(
    kind: CertificateKind, sample: Sample | None = None, threshold: float = 1.0, confidence: float = 0.9
) -> None:
    """Check that a kind of certificate counts only independent draws whose number did not depend on their distances.

    The same trials, by default 20 of two parameters with distances from 0 to 0.9, are certified as trials of a search,
    and as independent draws of two decisions: the first half was to end with the verdict. The statement on the latter
    must not be stronger than with the second half of the draws alone. Only a kind that is valid whenever its draws end,
    such as ``anytime``, may fail this check.

    A statement that leaves out a share of the tasks is then computed for 400 simulated campaigns, whose distance is
    1.25 times the threshold times the first parameter. It must be false in a share of about ``1 - confidence`` of them
    at most: for 20 draws, for 20 draws and 20 trials of a search, for these trials alone, and if the worst tasks fail.
    """
    if sample is None:
        points = np.random.default_rng(0).random((20, 2))
        sample = Sample(points, 0.45 * points.sum(axis=1), ["initial"] * 20, ["completed"] * 20)
    count, half = len(sample), len(sample) // 2
    _require(half > 0, "the check needs at least two trials")
    draws = replace(sample, origins=["iid"] * count, planned=[count] * count)
    drawn = replace(draws, planned=[0] * half + [count] * (count - half))
    allowed = _certified(kind, drawn.with_countable_draws(), threshold, confidence)
    claimed = _certified(kind, drawn, threshold, confidence)
    given = [allowed, claimed]
    if all(isinstance(each, CertificateError) for each in given):  # it may take nothing but draws, or no draws
        given = [_certified(kind, each, threshold, confidence) for each in (sample, draws)]
    refusals = [each for each in given if isinstance(each, CertificateError)]
    if len(refusals) == len(given):
        raise ConformanceError(
            f"the kind {kind.name} refuses the trials of the check, so that nothing was checked; give the kind its "
            f"options, or the check a sample: {refusals[-1]}"
        )
    if isinstance(claimed, Certificate) and claimed.doubt is None:
        volume, bound = _claim(allowed)
        sentence = (
            f"the kind {kind.name} bounds the distance by {claimed.upper_bound:.3g} on all but {claimed.volume:.3g} of "
            f"the tasks by draws that ended with the verdict, and by {bound:.3g} on all but {volume:.3g} without them: "
            "count the draws sample.rows(sample.countable) alone"
        )
        stronger = claimed.volume < volume - _TOLERANCE or claimed.upper_bound < bound - _TOLERANCE * abs(bound)
        _require(not stronger, sentence)
    if not any(0 < _claim(each)[0] < 1 for each in given):
        return  # a bound on d* itself rests on other assumptions than draws
    of_search = "trials of a search are no draws"
    for campaigns, draws_of_each, chosen, failing, advice in (
        ("20 independent draws", 20, 0, False, "state a larger share or a larger bound"),
        ("20 independent draws and 20 trials of a search", 20, 20, False, of_search),
        ("20 trials of a search", 0, 20, False, of_search),
        ("20 independent draws of which the worst tasks fail", 20, 0, True, "a failed draw exceeds any bound"),
    ):
        false = _false_statements(kind, draws_of_each, chosen, failing, threshold, confidence)
        expected = _CAMPAIGNS * (1 - confidence)
        sentence = (
            f"of {_CAMPAIGNS} statements of the kind {kind.name} by {campaigns}, {false} are false, and at most about "
            f"{expected:.3g} may be: {advice}"
        )
        _require(false <= expected + 4 * np.sqrt(expected * confidence), sentence)


_CAMPAIGNS = 100
"""Simulated campaigns of each sort; by four standard deviations, a sound kind is named once in 30,000 checks."""


def _certified(
    kind: CertificateKind, sample: Sample, threshold: float, confidence: float
) -> Certificate | CertificateError:
    try:
        certificate = kind.certify(replace(sample, threshold=threshold), confidence)
    except CertificateError as refusal:
        return refusal
    _require(isinstance(certificate, Certificate), f"certify must return a Certificate, got {certificate!r}")
    _require(certificate.kind == kind.name, f"the certificate is of the kind {certificate.kind!r}, not {kind.name!r}")
    return certificate


def _claim(certificate: Certificate | CertificateError) -> tuple[float, float]:
    """Return the share that is left out and the bound; a refusal and a withdrawn statement claim nothing."""
    if isinstance(certificate, CertificateError) or certificate.doubt is not None:
        return 1.0, np.inf
    return certificate.volume, certificate.upper_bound


def _false_statements(
    kind: CertificateKind, draws: int, chosen: int, failing: bool, threshold: float, confidence: float
) -> int:
    """Return how many statements on a share of the tasks are false, of campaigns whose distance is known."""
    count, false = draws + chosen, 0
    searched: list[Origin] = ["acquisition"] * chosen
    drawn: list[Origin] = ["iid"] * draws
    for seed in range(_CAMPAIGNS):
        points = np.random.default_rng(seed).random((count, 2))
        points[:chosen] *= 0.3  # a search that looked only where the distance is small
        failed = points[:, 0] > (0.7 if failing else 1.0)
        distances = np.where(failed, np.nan, 1.25 * threshold * points[:, 0])
        states: list[State] = ["failed" if each else "completed" for each in failed]
        sample = Sample(points, distances, [*searched, *drawn], states, planned=[draws or None] * count)
        volume, bound = _claim(_certified(kind, sample, threshold, confidence))
        above = float(np.clip(1 - bound / (1.25 * threshold), 0.3 if failing else 0.0, 1.0))
        false += 0 < volume < above
    return int(false)
