"""Distances between the trajectories of M and S under the same controller."""

from ctxval.core.distance import ComposedDistance, Distance
from ctxval.distances.final_state import FinalState
from ctxval.distances.goal_error import GoalError
from ctxval.distances.mean_deviation import MeanDeviation
from ctxval.distances.whole_trajectory import WholeTrajectory

__all__ = ["ComposedDistance", "Distance", "FinalState", "GoalError", "MeanDeviation", "WholeTrajectory"]
