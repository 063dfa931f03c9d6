"""The table ``[aspect1]`` of an experiment file: when the model itself counts as completing a task."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from ctxval.aspect1 import TASKS


class Aspect1Table(BaseModel):
    """The table ``[aspect1]``, which ``ctxval check --aspect1`` reads; a campaign does not use it.

    Attributes:
        distance: ``module:attr``, or a table with a type and its arguments: how far a trajectory is from completing its
            task. By default it is derived from the distance of the experiment.
        threshold: the largest error with which a task counts as completed, in the units of the goal.
        tasks: number of simulated tasks.
    """

    model_config = ConfigDict(extra="forbid")

    distance: str | dict[str, Any] | None = None
    threshold: float | None = Field(default=None, gt=0, allow_inf_nan=False, strict=True)
    tasks: int = Field(default=TASKS, ge=2)
