"""PSY-TaLiRo: its two optimisers."""

from __future__ import annotations

import numpy as np
from staliro import Sample, TestOptions, costfunc, test
from staliro.optimizers import DualAnnealing, UniformRandom

from peers.recorder import Recorder


def falsify(optimizer: DualAnnealing | UniformRandom, values: Recorder, dimension: int, budget: int, seed: int) -> None:
    """Maximise as a search for the least cost."""
    names = [f"p{i}" for i in range(dimension)]

    @costfunc
    def cost(sample: Sample) -> float:
        return -values(np.array([sample.static[name] for name in names]))

    inputs = dict.fromkeys(names, (0.0, 1.0))
    test(cost, optimizer, TestOptions(static_inputs=inputs, runs=1, iterations=budget, seed=seed + 1))  # not 0


def annealing(values: Recorder, dimension: int, budget: int, seed: int) -> None:
    """Maximise by dual annealing without local searches, its default."""
    falsify(DualAnnealing(), values, dimension, budget, seed)


def uniform(values: Recorder, dimension: int, budget: int, seed: int) -> None:
    """Maximise by uniform draws."""
    falsify(UniformRandom(), values, dimension, budget, seed)
