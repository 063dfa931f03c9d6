"""The default search: it uses the trajectories of the trials if they are recorded, and else only their values."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import NonNegativeFloat, PositiveInt
from ctxval._util.progress import expect
from ctxval._util.registry import part
from ctxval.gp.ascent import usual_effort
from ctxval.searches.base import Costs, Prediction
from ctxval.searches.trust_region import POINTS, TrustRegion

Thinking = Literal["balanced", "fast", "thorough"]

FAST = 0.15
"""Share of the largest number of points that fast thinking predicts."""
_SHARES = (1.0, 0.4, FAST)
"""Shares of the largest number of points that are predicted for one choice, from thorough to fast."""

DESIGNS = "designs"
"""Key in a note: the number of points that are predicted for each choice of the campaign."""


@part("auto")
class Auto(TrustRegion):
    """Trust-region search on the distance that executed trajectories predict; Bayesian optimisation without them.

    Args:
        thinking: how many tasks are predicted for one suggestion; each needs the design of a controller.
            ``"thorough"``: at most 2,000 if controllers are designed in batches and 150 if they are designed one after
            the other, and at most 400 for each task parameter. ``"fast"``: 15 % of that. ``"balanced"``: 15 %, 40 % or
            all of that, whichever is the largest number that takes no longer than one execution or 1 s. This is
            measured once, after the first execution, and stored in a note; so another campaign with the same seed may
            make other choices. A whole number: at most so many, whatever they cost.
        optimism, misses: see :class:`TrustRegion`.
    """

    def __init__(
        self, thinking: Thinking | PositiveInt = "balanced", optimism: NonNegativeFloat = 2.0, misses: PositiveInt = 3
    ) -> None:
        super().__init__(optimism, misses)
        self.thinking = thinking
        self._fixed_now: int | None = None

    def use_prediction(self, prediction: Prediction | None) -> None:
        self._fixed_now = None
        if prediction is not None:
            prediction = replace(prediction, budget=self.designs(prediction))
            expect(usual_effort(self.dimension, prediction.budget).points + self.predicted_besides)
        super().use_prediction(prediction)

    def propose(self, rng: np.random.Generator) -> Array:
        """Return the next point; if the number of designs is fixed at this choice, its note contains the number."""
        point = super().propose(rng)
        if self._fixed_now is not None:
            self._last_note = {**(self._last_note or {}), DESIGNS: self._fixed_now}
        return point

    def designs(self, prediction: Prediction) -> int:
        """Return the number of points that are predicted for the next choice."""
        most = min(prediction.budget, POINTS * self.dimension)
        match self.thinking:
            case "thorough":
                return most
            case "fast":
                return max(1, round(FAST * most))
            case number if number != "balanced":
                return min(int(number), most)
        # The number is fixed once an execution was timed; the note of that choice has it.
        noted = (note.get(DESIGNS) for note in self.notes if note is not None)
        fixed = next((number for number in noted if isinstance(number, int) and number >= 1), None)
        if fixed is not None or prediction.costs is None:
            return min(most, fixed or most)
        # As many designs as take no longer than one evaluation, or one second. An evaluation that was not timed is
        # supposed to take 10 s.
        costs = prediction.costs()
        seconds = max(1.0, 10.0 if costs.evaluation is None else costs.evaluation)
        numbers = [max(1, round(share * most)) for share in _SHARES]
        designs = next((number for number in numbers if self.thinking_seconds(costs, number) <= seconds), numbers[-1])
        self._fixed_now = None if costs.evaluation is None else designs
        return designs

    def thinking_seconds(self, costs: Costs, designs: int) -> float:
        """Return the estimated seconds of CPU time of the predictions of a choice with so many designs."""
        effort = usual_effort(self.dimension, designs)
        rough = costs.prediction if costs.rough is None else costs.rough
        return effort.batches * costs.batch + effort.exact * costs.prediction + effort.rough * rough
