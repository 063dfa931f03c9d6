"""A set of disturbances ``S(x, u) - M(x, u)`` for robust control, from independent draws of tasks.

Of N independent tasks, let r_i be the largest residual of one step in task i, in units of fixed scales. Discard the k
largest; W is the box of the largest one that is left. By the theorem of sampling and discarding, with a stated
confidence at most a stated share of all tasks has any step whose residual leaves W.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, ArrayLike, as_finite
from ctxval._util.checked import NonNegativeInt, Probability, checked
from ctxval._util.representation import ShortRepr
from ctxval.campaign.campaign import Campaign
from ctxval.campaign.history import executed_trials
from ctxval.certificates.options import CONFIDENCE
from ctxval.certificates.scenario import volume_bound
from ctxval.core.model import Model
from ctxval.core.trajectory import Trajectory
from ctxval.errors import CertificateError, InputError, ShapeError


@dataclass(frozen=True, eq=False)
class Disturbance(ShortRepr):
    """The box W of disturbances ``|S(x, u) - M(x, u)| <= half_widths`` of one step.

    It holds for tasks from the distribution of the draws, under the controllers that executed them: after these have
    changed, other states are visited, and fresh draws are needed.
    """

    half_widths: Array  #: one for each state, ``(n,)``
    volume: float  #: the share of the tasks that may have a step outside of W
    confidence: float  #: the probability of this statement
    draws: int  #: the number N of independent tasks
    discarded: int  #: the number k of those that were discarded
    largest: Array  #: the largest residuals of all draws, ``(n,)``, for comparison

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {**vars(self), "half_widths": self.half_widths.tolist(), "largest": self.largest.tolist()}

    @property
    def statement(self) -> str:
        """What W means, in one sentence."""
        return (
            f"With {100 * self.confidence:g} % confidence, at most {100 * self.volume:.3g} % of the tasks have a step "
            f"with a disturbance outside of W ({self.draws} independent draws, {self.discarded} discarded)."
        )


def largest_residuals(model: Model, runs: Sequence[Trajectory]) -> Array:
    """Return the largest residual of one step of each state in each run, ``(N, n)``; infinity where M is not finite."""
    with np.errstate(all="ignore"):
        residuals = [
            np.abs(run.states[1:] - np.asarray(model.step(run.states[:-1], run.inputs))).max(axis=0) for run in runs
        ]
    return np.asarray(np.nan_to_num(np.array(residuals), nan=np.inf, posinf=np.inf))


@checked
def disturbance_set(
    source: Campaign | Sequence[Trajectory],
    *,
    model: Model | None = None,
    scales: ArrayLike | None = None,
    discarded: NonNegativeInt = 0,
    confidence: Probability = CONFIDENCE,
) -> Disturbance:
    """Return the box of disturbances of one step, from fresh independent tasks.

    Args:
        source: a campaign, whose independent draws count (:meth:`ctxval.Campaign.audit`); or the trajectories of S in
            independent tasks.
        model: M, which must not have been learned from these draws; that of the campaign by default.
        scales: how large a residual of each state counts as 1, ``(n,)``, chosen without these draws; by default, the
            largest residuals of the campaign's other executions.
        discarded: the number k of tasks that are discarded, chosen before the draws are known.
        confidence: the confidence of the statement.
    """
    others: list[Trajectory] = []
    if isinstance(source, Campaign):
        source.validation.require_states("a disturbance set")
        model = source.validation.model if model is None else model
        draws = [trial for trial in source.trials if trial.origin == "iid"]
        executed = executed_trials(source.store, source.trials)
        runs = [run for trial, run in executed if trial.origin == "iid"]
        others = [run for trial, run in executed if trial.origin != "iid"]
        if len(runs) < len(draws):
            raise CertificateError(
                f"{len(draws) - len(runs)} of {len(draws)} draws have no trajectory, so their disturbances are unknown."
            )
    else:
        runs = list(source)
    if model is None:
        raise InputError("the model is needed, because trajectories alone do not tell it.")
    if len(runs) <= discarded:
        raise CertificateError(
            f"a disturbance set needs more than {discarded} independent draws of tasks, got {len(runs)}: run "
            "Campaign.audit."
        )
    residuals = largest_residuals(model, runs)
    if scales is None:
        if not others:
            raise InputError("scales are needed, one for each state: there are no executions besides the draws.")
        known = largest_residuals(model, others).max(axis=0)
        # A state whose residual was never seen must not make all others infinite.
        unit = np.maximum(known, 1e-6 * max(float(known.max()), 1e-300))
    else:
        unit = as_finite("scales", scales)
        if unit.shape != residuals.shape[1:] or not (unit > 0).all():
            raise ShapeError(f"scales must be {residuals.shape[1]} positive numbers, got {unit.tolist()}.")
    ranked = np.sort((residuals / unit).max(axis=1))
    r = ranked[len(ranked) - 1 - discarded]
    if not np.isfinite(r):
        raise CertificateError("the model is not finite in more tasks than are discarded.")
    volume = volume_bound(len(runs), discarded, 1 - confidence)
    return Disturbance(r * unit, volume, confidence, len(runs), discarded, residuals.max(axis=0))
