"""The richest search that the trials allow."""

from __future__ import annotations

from dataclasses import replace

from ctxval._util.registry import part
from ctxval.errors import InputError
from ctxval.searches.base import Prediction
from ctxval.searches.trust_region import Climbs


@part("auto")
class Auto(Climbs):
    """Climbs on the distance that executed trajectories predict; the scalar search where there are none.

    Args:
        designs: controllers that one choice may design at most, where they take long; by default 2,000 where they are
            designed in batches, and 150 where one after the other.
        optimism, misses: as of :class:`Climbs`.

    Raises:
        InputError: a value cannot be used.
    """

    def __init__(self, designs: int | None = None, optimism: float = 2.0, misses: int = 3) -> None:
        super().__init__(optimism, misses)
        if designs is not None and designs < 1:
            raise InputError(f"a choice must be allowed at least one design, got {designs}.")
        self.designs = designs

    def use_prediction(self, prediction: Prediction | None) -> None:
        """Take what is expected before the next question; None where nothing is."""
        super().use_prediction(prediction if prediction is None else self._afforded(prediction))

    def _afforded(self, prediction: Prediction) -> Prediction:
        if self.designs is None:
            return prediction
        return replace(prediction, budget=min(self.designs, prediction.budget))
