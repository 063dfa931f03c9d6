"""The loop: choose a task, execute it, measure the distance, store the trial."""

from ctxval.campaign.campaign import Campaign, OpenTrial

__all__ = ["Campaign", "OpenTrial"]
