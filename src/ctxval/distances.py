"""Distances: ready-made ones."""

from ctxval.distance import ComposedDistance, Distance, FinalState, GoalError, MeanDeviation, WholeTrajectory

__all__ = ["ComposedDistance", "Distance", "FinalState", "GoalError", "MeanDeviation", "WholeTrajectory"]
