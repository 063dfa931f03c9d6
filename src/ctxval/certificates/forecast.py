"""Forecast of the executions until a verdict."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Forecast:
    """Forecast of further executions, from the learned dynamics."""

    executions: int  #: the fewest that can decide
    validated: float  #: share of the posterior samples of the dynamics that validate the threshold

    def __str__(self) -> str:
        plural = "execution is" if self.executions == 1 else "executions are"
        share = f"{100 * self.validated:.0f} % of the posterior samples of the dynamics stay below the threshold"
        if self.validated < 0.05:
            return f"the learned dynamics expect a distance above the threshold: {share}"
        return f"at least {self.executions} more {plural} needed to validate it; so far, {share}"
