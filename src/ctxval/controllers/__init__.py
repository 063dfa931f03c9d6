"""Synthesizers: ready-made ways to design a controller on a model."""

from ctxval.controller import AffineFeedback, Policy, Synthesizer
from ctxval.controllers.ilqr import ILQR, ILQRSolution
from ctxval.controllers.lqr import LQR

__all__ = ["ILQR", "LQR", "AffineFeedback", "ILQRSolution", "Policy", "Synthesizer"]
