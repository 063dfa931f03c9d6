"""Decide whether a learned model of a robot can be trusted for the control tasks it is meant for.

An implementation of CuSTOM, *Context-Specific Validation of Data-Driven Models* (Bansal, Ghosh,
Sangiovanni-Vincentelli, Seshia and Tomlin).
"""

from ctxval.campaign import Campaign, OpenTrial
from ctxval.experiment import Experiment
from ctxval.space import Parameters, TaskSpace
from ctxval.store import Store
from ctxval.task import Task
from ctxval.trajectory import Trajectory, Transitions
from ctxval.trial import Trial
from ctxval.truth import Truth, cached_truth, grid_truth, search_truth
from ctxval.validation import Outcome, Plan, Validation
from ctxval.verdict import Verdict
from ctxval.version import VERSION

__version__ = VERSION

__all__ = [
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
