"""Learning from executions: residual dynamics of the system, and predictions of the distance from them."""

from __future__ import annotations

from ctxval.learning.dynamics import CorrectedModel, Identity, Residual, learn_corrected, learn_residual
from ctxval.learning.prediction import predict_distance
from ctxval.learning.vector import predict_composed

__all__ = [
    "CorrectedModel",
    "Identity",
    "Residual",
    "learn_corrected",
    "learn_residual",
    "predict_composed",
    "predict_distance",
]
