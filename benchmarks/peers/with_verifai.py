"""VerifAI: its samplers that work."""

from __future__ import annotations

import random
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from dotmap import DotMap
from verifai.features import Box, Feature, FeatureSpace
from verifai.samplers import FeatureSampler

from peers.recorder import Maximise, Recorder

LEVEL = 0.5
"""Share of d* above which a task counts as a counterexample."""

Start = Callable[[FeatureSpace], Any]


def sampling(start: Start) -> Maximise:
    """Return a method that tells a sampler after each point by how much the distance stays below a level.

    Two of the samplers learn from counterexamples alone, so they need a level that is neither always nor never
    exceeded. They are given one that nobody has who does not know d*.
    """

    def maximise(values: Recorder, dimension: int, budget: int, seed: int) -> None:
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002 - VerifAI draws from there
        sampler = start(FeatureSpace({"p": Feature(Box(*[(0.0, 1.0)] * dimension))}))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for _ in range(budget):
                sample, info = sampler.getSample()
                sampler.update(sample, info, LEVEL * values.function.maximum - values(np.array(sample.p)))

    return maximise


def counterexamples() -> DotMap:
    """Return the defaults of the samplers that learn from counterexamples."""
    return DotMap(alpha=0.9, thres=0.0, cont=DotMap(buckets=5, dist=None), disc=DotMap(dist=None))


halton = sampling(FeatureSampler.haltonSamplerFor)
cross_entropy = sampling(lambda space: FeatureSampler.crossEntropySamplerFor(space, counterexamples()))
bandit = sampling(lambda space: FeatureSampler.multiArmedBanditSamplerFor(space, counterexamples()))
bayesian = sampling(FeatureSampler.bayesianOptimizationSamplerFor)
