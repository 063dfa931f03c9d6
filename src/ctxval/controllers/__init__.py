"""Synthesizers: ready-made methods that design a controller on a model."""

from __future__ import annotations

from ctxval._util.registry import Registry
from ctxval.controllers.ilqr import ILQR, ILQRSolution
from ctxval.controllers.lqr import LQR, StationaryLQR
from ctxval.controllers.mpc import MPC, RecedingHorizon
from ctxval.controllers.onnx_policy import OnnxPolicy, RecurrentPolicy
from ctxval.controllers.output_feedback import EstimatedFeedback, OutputFeedback
from ctxval.controllers.pid import PID, PIDFeedback
from ctxval.controllers.policy_contract import Action, PolicyContract, Term
from ctxval.controllers.policy_descriptors import convert_policy
from ctxval.controllers.robot_policy import PolicyController, RobotPolicy
from ctxval.core.controller import (
    AffineFeedback,
    BoundPolicy,
    ControllerRun,
    ControllerWithMemory,
    Limits,
    Policy,
    Synthesizer,
    started,
)
from ctxval.core.exchange import ControllerFile, read_controller, write_controller
from ctxval.core.floating_base import Fall, FloatingBase

__all__ = [
    "ILQR",
    "LQR",
    "MPC",
    "PID",
    "REGISTRY",
    "Action",
    "AffineFeedback",
    "BoundPolicy",
    "ControllerFile",
    "ControllerRun",
    "ControllerWithMemory",
    "EstimatedFeedback",
    "Fall",
    "FloatingBase",
    "ILQRSolution",
    "Limits",
    "OnnxPolicy",
    "OutputFeedback",
    "PIDFeedback",
    "Policy",
    "PolicyContract",
    "PolicyController",
    "RecedingHorizon",
    "RecurrentPolicy",
    "RobotPolicy",
    "StationaryLQR",
    "Synthesizer",
    "Term",
    "by_name",
    "convert_policy",
    "read_controller",
    "started",
    "write_controller",
]

REGISTRY: Registry[Synthesizer] = Registry("synthesizer", __name__, method="design")
"""The synthesizers that are found by name: those of this package, and those that installed packages add."""

by_name = REGISTRY.make
