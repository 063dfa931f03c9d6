"""What a plant is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ctxval import Experiment

DEVELOPMENT, REPORTING = "development", "reporting"


@dataclass(frozen=True)
class Plant:
    """A system, its model and its task space, for each seed.

    Attributes:
        name: of the plant, in files and tables.
        kind: whether searches may be developed on it, or only reported.
        make: the experiment of a seed, which draws the data of M.
        dimension: of its task space.
        samples: how many random tasks each repeat of the search for its maximum begins with.
        budget: executions of a campaign.
    """

    name: str
    kind: str
    make: Callable[[int], Experiment]
    dimension: int
    samples: int
    budget: int = 25

    def __call__(self, seed: int) -> Experiment:
        """Return the experiment of a seed."""
        return self.make(seed)


def listed(*plants: Plant) -> dict[str, Plant]:
    """Return plants by name.

    Raises:
        ValueError: if two have one name, or a kind is unknown.
    """
    by_name = {plant.name: plant for plant in plants}
    if len(by_name) < len(plants):
        raise ValueError("each plant needs a name of its own.")
    unknown = {plant.kind for plant in plants} - {DEVELOPMENT, REPORTING}
    if unknown:
        raise ValueError(f"the kinds are {DEVELOPMENT} and {REPORTING}, got {', '.join(sorted(unknown))}.")
    return by_name
