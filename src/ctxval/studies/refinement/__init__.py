"""Better models from executions: a model is learned again from what falsified it, and validated again."""

from ctxval.studies.refinement.held_out import (
    HeldOut,
    MeasuredResidual,
    Records,
    ResidualRegion,
    held_out,
    measure_residual,
)
from ctxval.studies.refinement.methods import (
    CauseRepair,
    Learned,
    Method,
    ParameterFit,
    Refit,
    ResidualCorrection,
    UserFit,
)
from ctxval.studies.refinement.refine import refine
from ctxval.studies.refinement.rounds import Refinement, Round

__all__ = [
    "CauseRepair",
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
