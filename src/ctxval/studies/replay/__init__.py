"""Replay of recordings on a model: errors, their causes, and what the recordings predict of the tasks."""

from ctxval.studies.replay.accuracy import RegionalError, StepError
from ctxval.studies.replay.causes import ResidualShare, Suggestion
from ctxval.studies.replay.report import PredictedTask, PredictedTasks, RecordedData, ReplayReport, replay

__all__ = [
    "PredictedTask",
    "PredictedTasks",
    "RecordedData",
    "RegionalError",
    "ReplayReport",
    "ResidualShare",
    "StepError",
    "Suggestion",
    "replay",
]
