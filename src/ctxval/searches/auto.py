"""The default search: it uses the trajectories of the trials if they are recorded, and else only their values."""

from __future__ import annotations

from dataclasses import replace

from ctxval._util.registry import part
from ctxval.errors import InputError
from ctxval.searches.base import Prediction
from ctxval.searches.trust_region import TrustRegion


@part("auto")
class Auto(TrustRegion):
    """Trust-region search on the distance that executed trajectories predict; Bayesian optimisation without them.

    Args:
        designs: largest number of controllers that are designed for one suggestion; by default 2,000 if they are
            designed in batches, and 150 if they are designed one after the other.
        optimism, misses: see :class:`TrustRegion`.

    Raises:
        InputError: if designs or misses is below 1, or the optimism is negative or infinite.
    """

    def __init__(self, designs: int | None = None, optimism: float = 2.0, misses: int = 3) -> None:
        super().__init__(optimism, misses)
        if designs is not None and designs < 1:
            raise InputError(f"designs must be at least 1, got {designs}.")
        self.designs = designs

    def use_prediction(self, prediction: Prediction | None) -> None:
        """Take the prediction for the point that is asked for next; None if there is none."""
        super().use_prediction(prediction if prediction is None else self._afforded(prediction))

    def _afforded(self, prediction: Prediction) -> Prediction:
        if self.designs is None:
            return prediction
        return replace(prediction, budget=min(self.designs, prediction.budget))
