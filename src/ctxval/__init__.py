"""Decide whether a learned model of a robot can be trusted for the control tasks it is meant for.

An implementation of CuSTOM, *Context-Specific Validation of Data-Driven Models* (Bansal, Ghosh,
Sangiovanni-Vincentelli, Seshia and Tomlin).

All names, and the part packages, such as ``ctxval.controllers``, are imported when they are first used.
"""

import importlib
from typing import TYPE_CHECKING, Any

from ctxval._util.version import VERSION

if TYPE_CHECKING:
    from ctxval import certificates as certificates
    from ctxval import controllers as controllers
    from ctxval import data as data
    from ctxval import distances as distances
    from ctxval import errors as errors
    from ctxval import gp as gp
    from ctxval import models as models
    from ctxval import report as report
    from ctxval import searches as searches
    from ctxval import specs as specs
    from ctxval import systems as systems
    from ctxval import testing as testing
    from ctxval._util.arrays import Array
    from ctxval._util.registry import part
    from ctxval.campaign.campaign import Campaign, OpenTrial
    from ctxval.campaign.storage.store import Store
    from ctxval.campaign.watching import Watch
    from ctxval.certificates.verdict import Verdict
    from ctxval.cli.config.settings import load_experiment
    from ctxval.core.experiment import Experiment
    from ctxval.core.labels import Labels
    from ctxval.core.plan import Outcome, Plan
    from ctxval.core.rollout import rollout
    from ctxval.core.space import Parameters, TaskSpace
    from ctxval.core.task import Task
    from ctxval.core.task_distribution import Normal
    from ctxval.core.task_suite import TaskSuite
    from ctxval.core.trajectory import Trajectory, Transitions
    from ctxval.core.trial import Trial
    from ctxval.core.truth import Truth, cached_truth, grid_truth, search_truth
    from ctxval.core.validation import Validation
    from ctxval.paper import cases as cases
    from ctxval.studies import aspect1 as aspect1
    from ctxval.studies import comparison as comparison
    from ctxval.studies import fitting as fitting
    from ctxval.studies import refinement as refinement
    from ctxval.studies import replay as replay
    from ctxval.studies import safety as safety
    from ctxval.studies.comparison.compare import compare
    from ctxval.studies.comparison.result import Comparison
    from ctxval.studies.refinement.refine import refine

__version__ = VERSION

__all__ = [
    "Array",
    "Campaign",
    "Comparison",
    "Experiment",
    "Labels",
    "Normal",
    "OpenTrial",
    "Outcome",
    "Parameters",
    "Plan",
    "Store",
    "Task",
    "TaskSpace",
    "TaskSuite",
    "Trajectory",
    "Transitions",
    "Trial",
    "Truth",
    "Validation",
    "Verdict",
    "Watch",
    "cached_truth",
    "compare",
    "grid_truth",
    "load_experiment",
    "part",
    "refine",
    "rollout",
    "search_truth",
]

_MODULES = {
    **{name: name for name in ("certificates", "controllers", "data", "distances", "errors", "gp", "models", "report")},
    **{name: name for name in ("searches", "specs", "systems", "testing")},
    **{name: f"studies.{name}" for name in ("aspect1", "comparison", "fitting", "refinement", "replay", "safety")},
    "cases": "paper.cases",
}
"""The public modules, which ``import ctxval`` alone makes usable: each is imported when it is first used."""

_LAZY = {
    "Array": "_util.arrays",
    "Campaign": "campaign.campaign",
    "Comparison": "studies.comparison.result",
    "Experiment": "core.experiment",
    "Labels": "core.labels",
    "Normal": "core.task_distribution",
    "OpenTrial": "campaign.campaign",
    "Outcome": "core.plan",
    "Parameters": "core.space",
    "Plan": "core.plan",
    "Store": "campaign.storage.store",
    "Task": "core.task",
    "TaskSpace": "core.space",
    "TaskSuite": "core.task_suite",
    "Trajectory": "core.trajectory",
    "Transitions": "core.trajectory",
    "Trial": "core.trial",
    "Truth": "core.truth",
    "Validation": "core.validation",
    "Verdict": "certificates.verdict",
    "Watch": "campaign.watching",
    "cached_truth": "core.truth",
    "compare": "studies.comparison.compare",
    "grid_truth": "core.truth",
    "load_experiment": "cli.config.settings",
    "part": "_util.registry",
    "refine": "studies.refinement.refine",
    "rollout": "core.rollout",
    "search_truth": "core.truth",
}
"""The public names, and the modules that have them: each module is imported when its name is first used."""


if not TYPE_CHECKING:  # a type checker, which reads the imports above, would take any name for granted

    def __getattr__(name: str) -> Any:
        if name in _MODULES:
            return importlib.import_module(f"{__name__}.{_MODULES[name]}")
        if name in _LAZY:
            value = globals()[name] = getattr(importlib.import_module(f"{__name__}.{_LAZY[name]}"), name)
            return value
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *_MODULES, "__version__"})
