"""The functions that all methods maximise: the distance of a case over its task space, as points of the unit cube."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ctxval import Validation
from ctxval._util.arrays import Array
from ctxval.core.plan import Outcome
from study_auto import ROOT, experiment, truth

TRUTHS = ROOT / "runs" / "truth"
SEEDS = range(10)


@dataclass(frozen=True)
class Case:
    """A function for each seed.

    Attributes:
        title: what the page calls it.
        dimension: d of the unit cube.
        budget: executions.
        vector: whether the distance is composed of a vector.
        data: whether M was learned from data, and brings them.
    """

    title: str
    dimension: int
    budget: int
    vector: bool
    data: bool = True


# Names of ``study_auto.CASES``, which has their options; cheap and telling ones first.
CASES: dict[str, Case] = {
    "pendulum": Case("pendulum", 1, 30, vector=True),
    "linear-5": Case("linear, 5 states", 10, 60, vector=True, data=False),
    "dubins-basin": Case("Dubins car, basin", 11, 100, vector=False),
    "arm-fnn": Case("arm, network", 2, 60, vector=True),
    "linear-10": Case("linear, 10 states", 20, 60, vector=True, data=False),
    "dubins": Case("Dubins car, paper", 11, 60, vector=False),
}


@dataclass(frozen=True, eq=False)
class Function:
    """The distance of one case and seed, whose model and data are drawn anew for each seed.

    Attributes:
        validation: the map p -> d(p).
        maximum: d*.
    """

    validation: Validation
    maximum: float

    @property
    def dimension(self) -> int:
        """Return d."""
        return self.validation.space.dimension

    def execute(self, point: Array) -> Outcome:
        """Return what an execution at a point of the unit cube ``(d,)`` shows, all of it."""
        return self.validation.outcome(self.validation.space.from_unit(point))

    def values(self, points: Array) -> Array:
        """Return the distances at points of the unit cube ``(n, d)``, shape ``(n,)``."""
        return self.validation.distances(self.validation.space.from_unit(points))


def function(case: str, seed: int, truths: Path = TRUTHS, maximum: float | None = None) -> Function:
    """Return the function of a case and a seed.

    Args:
        case, seed: which.
        truths: folder of maxima; one that is missing may take minutes to find, and is stored there.
        maximum: d* if it is known already.
    """
    found = experiment(case, seed)
    return Function(found.validation, truth(case, found, truths) if maximum is None else maximum)
