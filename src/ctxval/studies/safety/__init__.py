"""What is safe: in which tasks a system satisfies a specification, because its model does so with a margin."""

from ctxval.studies.safety.assessment import SafetyReport, UnsafeTask, assess, judged_by, require_safe_tasks
from ctxval.studies.safety.draws import (
    Disturbance,
    DrawnTasks,
    Tube,
    disturbance_set,
    draw_tasks,
    largest_residuals,
    tube,
    tube_of,
)

__all__ = [
    "Disturbance",
    "DrawnTasks",
    "SafetyReport",
    "Tube",
    "UnsafeTask",
    "assess",
    "disturbance_set",
    "draw_tasks",
    "judged_by",
    "largest_residuals",
    "require_safe_tasks",
    "tube",
    "tube_of",
]
