"""The robustness of M in many tasks, which costs no execution."""

from __future__ import annotations

import numpy as np

from ctxval._util.arrays import Array, single_threaded
from ctxval.core.validation import Validation
from ctxval.distances import UnsafeMargin
from ctxval.errors import InputError
from ctxval.learning.closed_loops import LoopPlanner
from ctxval.specs import Specification


def spec_distance(validation: Validation) -> UnsafeMargin:
    """Return the distance of a validation, which must be the margin of unsafe tasks."""
    if not isinstance(validation.distance, UnsafeMargin):
        raise InputError(
            f"the distance must be an UnsafeMargin of a specification, got {validation.distance!r}: see "
            "ctxval.studies.safety.judged_by."
        )
    return validation.distance


def on_model(planner: LoopPlanner, spec: Specification, unit: Array) -> Array:
    """Return rho_M at points ``(N, d)`` of the unit cube, ``(N,)``; minus infinity if a task cannot be planned."""
    rho = np.full(len(unit), -np.inf)
    with single_threaded():
        for one in planner.plan(unit):
            with np.errstate(all="ignore"):
                of_tasks = spec.robustness(one.promised, one.task)
            rho[one.rows] = np.where(one.promised.finite, of_tasks, -np.inf)
    return rho
