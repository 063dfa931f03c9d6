"""What the page serves: a campaign with its experiment, its threshold and its certificate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ctxval.campaign.campaign import Campaign
from ctxval.certificates import CertificateOptions
from ctxval.core.experiment import Experiment


@dataclass(frozen=True, eq=False)
class ServedCampaign:
    """A campaign with what the page needs besides it.

    Attributes:
        experiment: the experiment of the campaign.
        campaign: the campaign; only the thread that opened it may use it.
        threshold: tau; None if there is no verdict.
        certificate: the kind and the options of the certificate.
        budget: the largest number of executions that are chosen for the verdict.
    """

    experiment: Experiment
    campaign: Campaign
    threshold: float | None
    certificate: CertificateOptions
    budget: int


OpenCampaign = Callable[[], ServedCampaign]
"""A function that opens the campaign in the thread or the process in which it is called."""
