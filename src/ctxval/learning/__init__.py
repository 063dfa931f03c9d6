"""Learning from executions: residual dynamics of the system, and predictions of the distance from them.

Campaigns use the names below, each of which is imported when it is first used: a finished campaign learns nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ctxval.learning import run_statistics as run_statistics
    from ctxval.learning.agreement import AgreementSettings
    from ctxval.learning.closed_loops import LoopPlanner
    from ctxval.learning.coverage import beyond_range, unsampled_corner
    from ctxval.learning.draws import DynamicsDraws
    from ctxval.learning.dynamics_posterior import DynamicsPosterior, PosteriorSettings, learn_posterior
    from ctxval.learning.dynamics_study import DynamicsStudy
    from ctxval.learning.execution_prediction import ExecutionPrediction, PredictionScore
    from ctxval.learning.learned_dynamics import LearnedDynamics
    from ctxval.learning.prediction import Executed, predict_composed
    from ctxval.learning.replays import Replay, replay_executed
    from ctxval.learning.sensitivity import Sensitivity, found_sensitivity
    from ctxval.learning.share_search import ShareSearch
    from ctxval.learning.stage_costs import (
        Costs,
        Ledger,
        Sizes,
        Speed,
        Thinking,
        ThinkingSettings,
        reduced,
        speed_to_json,
    )
    from ctxval.learning.worst_case import WorstCase, WorstCaseSettings, is_kinked

_LAZY = {
    "AgreementSettings": "agreement",
    "Costs": "stage_costs",
    "DynamicsDraws": "draws",
    "DynamicsPosterior": "dynamics_posterior",
    "DynamicsStudy": "dynamics_study",
    "Executed": "prediction",
    "ExecutionPrediction": "execution_prediction",
    "LearnedDynamics": "learned_dynamics",
    "Ledger": "stage_costs",
    "LoopPlanner": "closed_loops",
    "PosteriorSettings": "dynamics_posterior",
    "PredictionScore": "execution_prediction",
    "Replay": "replays",
    "Sensitivity": "sensitivity",
    "ShareSearch": "share_search",
    "Sizes": "stage_costs",
    "Speed": "stage_costs",
    "Thinking": "stage_costs",
    "ThinkingSettings": "stage_costs",
    "WorstCase": "worst_case",
    "WorstCaseSettings": "worst_case",
    "beyond_range": "coverage",
    "found_sensitivity": "sensitivity",
    "is_kinked": "worst_case",
    "learn_posterior": "dynamics_posterior",
    "predict_composed": "prediction",
    "reduced": "stage_costs",
    "replay_executed": "replays",
    "speed_to_json": "stage_costs",
    "unsampled_corner": "coverage",
}

__all__ = [
    "AgreementSettings",
    "Costs",
    "DynamicsDraws",
    "DynamicsPosterior",
    "DynamicsStudy",
    "Executed",
    "ExecutionPrediction",
    "LearnedDynamics",
    "Ledger",
    "LoopPlanner",
    "PosteriorSettings",
    "PredictionScore",
    "Replay",
    "Sensitivity",
    "ShareSearch",
    "Sizes",
    "Speed",
    "Thinking",
    "ThinkingSettings",
    "WorstCase",
    "WorstCaseSettings",
    "beyond_range",
    "found_sensitivity",
    "is_kinked",
    "learn_posterior",
    "predict_composed",
    "reduced",
    "replay_executed",
    "run_statistics",
    "speed_to_json",
    "unsampled_corner",
]


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name == "run_statistics":
            return importlib.import_module(f"{__name__}.{name}")
        if name not in _LAZY:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = globals()[name] = getattr(importlib.import_module(f"{__name__}.{_LAZY[name]}"), name)
        return value
