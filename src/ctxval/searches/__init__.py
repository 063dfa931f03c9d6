"""Searches for the largest value over the unit cube, with an ask-and-tell interface."""

from __future__ import annotations

from ctxval._util.registry import Registry
from ctxval.searches.base import BaseSearch, Costs, Note, Prediction, Search, SequentialSearch
from ctxval.searches.bayesian_optimisation import BayesianOptimisation
from ctxval.searches.cma_es import CMAES
from ctxval.searches.gp_ucb import GPUCB
from ctxval.searches.random import Random, SamplingDiscarding
from ctxval.searches.trust_region import Auto, TrustRegion

__all__ = [
    "CMAES",
    "DEFAULT",
    "GPUCB",
    "REGISTRY",
    "Auto",
    "BaseSearch",
    "BayesianOptimisation",
    "Costs",
    "Note",
    "Prediction",
    "Random",
    "SamplingDiscarding",
    "Search",
    "SequentialSearch",
    "TrustRegion",
    "by_name",
]

REGISTRY: Registry[Search] = Registry("search", __name__, method="ask")
"""The searches that are found by name: those of this package, and those that installed packages add."""

DEFAULT = "auto"  #: the default search of a campaign, in Python, in experiment files and on the command line

by_name = REGISTRY.make
