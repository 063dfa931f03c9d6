"""Learning from executions: residual dynamics of the system, and predictions of the distance from them."""

from __future__ import annotations

from ctxval.learning.draws import DynamicsDraws
from ctxval.learning.dynamics_posterior import DynamicsPosterior, PosteriorSettings, learn_posterior
from ctxval.learning.dynamics_study import DynamicsStudy
from ctxval.learning.execution_prediction import ExecutionPrediction, PredictionScore
from ctxval.learning.learned_dynamics import LearnedDynamics
from ctxval.learning.prediction import predict_composed
from ctxval.learning.replays import Replay, replay_executed

__all__ = [
    "DynamicsDraws",
    "DynamicsPosterior",
    "DynamicsStudy",
    "ExecutionPrediction",
    "LearnedDynamics",
    "PosteriorSettings",
    "PredictionScore",
    "Replay",
    "learn_posterior",
    "predict_composed",
    "replay_executed",
]
