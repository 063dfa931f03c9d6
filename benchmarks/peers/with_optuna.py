"""Optuna's Gaussian process sampler, with its defaults for functions without noise."""

from __future__ import annotations

import warnings

import numpy as np
import optuna
from optuna.distributions import FloatDistribution

from ctxval._util.arrays import Array
from peers.recorder import Suggest, Suggesting

optuna.logging.set_verbosity(optuna.logging.ERROR)


def start(dimension: int, seed: int) -> Suggest:
    """Return the suggestions of a study, which is told what it does not know yet."""
    names = [f"p{i}" for i in range(dimension)]
    distributions = {name: FloatDistribution(0.0, 1.0) for name in names}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an experimental feature
        sampler = optuna.samplers.GPSampler(seed=seed, deterministic_objective=True)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    trial: optuna.Trial | None = None

    def suggest(points: Array, values: Array) -> Array:
        nonlocal trial
        if trial is None:
            study.add_trials([known(point, value) for point, value in zip(points, values, strict=True)])
        else:
            study.tell(trial, float(values[-1]))
        trial = study.ask(distributions)
        return np.array([trial.params[name] for name in names])

    def known(point: Array, value: float) -> optuna.trial.FrozenTrial:
        params = dict(zip(names, point.tolist(), strict=True))
        return optuna.trial.create_trial(params=params, distributions=distributions, value=float(value))

    return suggest


optuna_gp = Suggesting(start)
