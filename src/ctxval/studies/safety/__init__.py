"""What is safe: in which tasks a system satisfies a specification, because its model does so with a margin."""

from ctxval.studies.safety.assessment import SafetyReport, UnsafeTask, assess, judged_by, require_safe_tasks
from ctxval.studies.safety.draws import DrawnTasks, draw_tasks

__all__ = ["DrawnTasks", "SafetyReport", "UnsafeTask", "assess", "draw_tasks", "judged_by", "require_safe_tasks"]
