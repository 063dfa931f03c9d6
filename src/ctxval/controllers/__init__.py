"""Synthesizers: ready-made ways to design a controller on a model."""

from ctxval.controllers.ilqr import ILQR, ILQRSolution
from ctxval.controllers.lqr import LQR, StationaryLQR
from ctxval.controllers.mpc import MPC, RecedingHorizon
from ctxval.controllers.onnx_policy import BoundOnnxPolicy, OnnxPolicy
from ctxval.core.controller import AffineFeedback, Limits, Policy, Synthesizer
from ctxval.core.exchange import ControllerFile, read_controller, write_controller

__all__ = [
    "ILQR",
    "LQR",
    "MPC",
    "AffineFeedback",
    "BoundOnnxPolicy",
    "ControllerFile",
    "ILQRSolution",
    "Limits",
    "OnnxPolicy",
    "Policy",
    "RecedingHorizon",
    "StationaryLQR",
    "Synthesizer",
    "read_controller",
    "write_controller",
]
