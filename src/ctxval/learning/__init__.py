"""Learning from executions: residual dynamics of the system, and predictions of the distance from them."""

from __future__ import annotations

from ctxval.learning.coverage import Coverage
from ctxval.learning.dynamics import (
    CorrectedModel,
    Identity,
    LearnedCovariance,
    Residual,
    ResidualsWithout,
    learn_covariance,
    learn_residual,
)
from ctxval.learning.dynamics_posterior import DynamicsDraws, DynamicsPosterior, learn_posterior
from ctxval.learning.dynamics_study import DynamicsStudy, LearnedDynamics
from ctxval.learning.execution_prediction import ExecutionPrediction, PredictionScore
from ctxval.learning.prediction import DistancePredictor, predict_distance
from ctxval.learning.replays import Replay, replay_executed
from ctxval.learning.vector import predict_composed

__all__ = [
    "CorrectedModel",
    "Coverage",
    "DistancePredictor",
    "DynamicsDraws",
    "DynamicsPosterior",
    "DynamicsStudy",
    "ExecutionPrediction",
    "Identity",
    "LearnedCovariance",
    "LearnedDynamics",
    "PredictionScore",
    "Replay",
    "Residual",
    "ResidualsWithout",
    "learn_covariance",
    "learn_posterior",
    "learn_residual",
    "predict_composed",
    "predict_distance",
    "replay_executed",
]
