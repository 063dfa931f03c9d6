"""Independent draws from the task space (the paper's Sec. IV-A)."""

from __future__ import annotations

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.checked import NonNegativeInt
from ctxval._util.registry import part
from ctxval.searches.base import SequentialSearch


@part("random")
class Random(SequentialSearch):
    """Independent uniform points: scenario optimisation, SC. The estimate of d* is the largest distance."""

    iid = True

    def propose(self, rng: np.random.Generator) -> Array:
        return rng.random(self.dimension)


@part("sampling-discarding")
class SamplingDiscarding(Random):
    """Independent uniform points; the estimate of d* leaves out the largest distances: sampling and discarding, SD.

    Args:
        discard: number of the largest distances that the estimate of d* leaves out, the paper's k.
    """

    def __init__(self, discard: NonNegativeInt = 5) -> None:
        self.discard = discard
