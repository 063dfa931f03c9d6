"""Distances: ready-made ones."""

from ctxval.distance import Distance, FinalState, GoalError, MeanDeviation, WholeTrajectory

__all__ = ["Distance", "FinalState", "GoalError", "MeanDeviation", "WholeTrajectory"]
