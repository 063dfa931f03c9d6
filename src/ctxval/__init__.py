"""Decide whether a learned model of a robot can be trusted for the control tasks it is meant for.

An implementation of CuSTOM, *Context-Specific Validation of Data-Driven Models* (Bansal, Ghosh,
Sangiovanni-Vincentelli, Seshia and Tomlin).
"""

from ctxval._util.arrays import Array
from ctxval.campaign import Campaign, OpenTrial
from ctxval.certificates.verdict import Verdict
from ctxval.core.experiment import Experiment
from ctxval.core.space import Parameters, TaskSpace
from ctxval.core.task import Task
from ctxval.core.trajectory import Trajectory, Transitions
from ctxval.core.trial import Trial
from ctxval.core.truth import Truth, cached_truth, grid_truth, search_truth
from ctxval.core.validation import Outcome, Plan, Validation
from ctxval.storage.store import Store
from ctxval.version import VERSION

__version__ = VERSION

__all__ = [
    "Array",
    "Campaign",
    "Experiment",
    "OpenTrial",
    "Outcome",
    "Parameters",
    "Plan",
    "Store",
    "Task",
    "TaskSpace",
    "Trajectory",
    "Transitions",
    "Trial",
    "Truth",
    "Validation",
    "Verdict",
    "cached_truth",
    "grid_truth",
    "search_truth",
]
