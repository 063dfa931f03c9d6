"""Better models from executions: a model is learned again from what falsified it, and validated again."""

from __future__ import annotations

from ctxval.refinement.disturbance import MeasuredResidual, ResidualRegion, measure_residual
from ctxval.refinement.methods import Learned, Method, ParameterFit, Refit, ResidualCorrection, UserFit
from ctxval.refinement.records import HeldOut, Records, held_out
from ctxval.refinement.refine import refine
from ctxval.refinement.rounds import Refinement, Round

__all__ = [
    "HeldOut",
    "Learned",
    "MeasuredResidual",
    "Method",
    "ParameterFit",
    "Records",
    "Refinement",
    "Refit",
    "ResidualCorrection",
    "ResidualRegion",
    "Round",
    "UserFit",
    "held_out",
    "measure_residual",
    "refine",
]
