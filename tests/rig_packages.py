"""A distribution that adds parts by entry points, installed where an installer would put it."""

from __future__ import annotations

from pathlib import Path

MODULE = '''
from pathlib import Path

import numpy as np

import ctxval
from ctxval import cases, distances, searches

Path({mark!r}).write_text("imported")


class Speed:
    """Difference of the final speeds.

    More about it.
    """

    def __init__(self, weight=1.0):
        self.weight = weight

    def __call__(self, model_trajectory, system_trajectory, task):
        gap = system_trajectory.final_state - model_trajectory.final_state
        return self.weight * np.abs(gap[..., 1])


class Corners(searches.SequentialSearch):
    """The corners of the cube."""

    def propose(self, rng):
        return rng.integers(0, 2, self.dimension).astype(float)


class Nothing:
    pass


def swing(seed=0, size: int = 1):
    """A pendulum of a size."""
    return cases.by_name("pendulum", seed)


def odd(seed=0):
    return 3
'''

ENTRY_POINTS = """
[ctxval.distances]
Speed = their_parts:Speed
FinalState = their_parts:Nothing
Nothing = their_parts:Nothing
Gone = no_such_module:Gone
Number = math:pi

[ctxval.searches]
corners = their_parts:Corners
auto = their_parts:Nothing

[ctxval.cases]
swing = their_parts:swing
odd = their_parts:odd

[ctxval.certificates]
theirs = their_parts:Nothing
"""


def install(folder: Path, name: str = "their-parts", entry_points: str = ENTRY_POINTS) -> Path:
    """Put a distribution where an installer would: a module, and metadata with entry points."""
    metadata = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(entry_points)
    (folder / "their_parts.py").write_text(MODULE.format(mark=str(folder / "imported.txt")))
    return folder
