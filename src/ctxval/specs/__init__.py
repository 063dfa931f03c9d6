"""Specifications of what a closed loop shall do, and how robustly a trajectory satisfies them."""

from __future__ import annotations

from ctxval._util.registry import Registry
from ctxval.specs.reach_avoid import ReachAvoid, Specification
from ctxval.specs.sets import SETS, Ball, Box, Outside, Polytope, Set, Union
from ctxval.specs.stl import STL

__all__ = [
    "REGISTRY",
    "SETS",
    "STL",
    "Ball",
    "Box",
    "Outside",
    "Polytope",
    "ReachAvoid",
    "Set",
    "Specification",
    "Union",
    "by_name",
]

REGISTRY: Registry[Specification] = Registry("specification", __name__, method="robustness")
"""The specifications that are found by name: those of this package, and those that installed packages add."""

by_name = REGISTRY.make
