"""The searches of ctxval."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctxval import Campaign, searches
from ctxval._util.arrays import Array
from ctxval.core.plan import Outcome
from ctxval.distances import ComposedDistance
from ctxval.learning.prediction import predict_composed
from peers.recorder import Recorder, Suggest, Suggesting


def auto(values: Recorder, dimension: int, budget: int, seed: int) -> None:
    """Maximise with whole trajectories, the model and its data: a campaign as a user has it."""
    validation = values.function.validation
    campaign = Campaign(validation, search=searches.Auto("thorough"), seed=seed)
    for known in values.outcomes:
        named = validation.space.describe_point(known.plan.parameters.points)
        campaign.add(named, trajectory=known.system_trajectory)
    while len(values.points) < budget:
        opened = campaign.ask()
        campaign.tell(opened, values.execute(opened.trial.unit_point).system_trajectory)


def auto_without_data(values: Recorder, dimension: int, budget: int, seed: int) -> None:
    """Maximise as :func:`auto` does, where nothing is left of the data that the model was learned from."""
    model: Any = values.function.validation.model
    data, model.data = model.data, None
    try:
        auto(values, dimension, budget, seed)
    finally:
        model.data = data  # other methods are given the same function


def vector(values: Recorder, dimension: int, budget: int, seed: int) -> None:
    """Maximise with the vectors that the distances are composed of."""
    search, distance = searches.TrustRegion(), values.function.validation.distance
    assert isinstance(distance, ComposedDistance), "this distance is not composed of a vector"
    search.reset(dimension, seed)
    vectors: list[Array] = []
    while len(values.points) < budget:
        new = slice(len(vectors), None)
        search.tell(np.array(values.points[new]).reshape(-1, dimension), values.values[new])
        vectors += [error_of(distance, outcome) for outcome in values.outcomes[new]]
        if len(vectors) > 1:
            search.use_prediction(predict_composed(np.array(values.points), np.array(vectors), distance.compose))
        values(search.ask(1)[0])


def error_of(distance: ComposedDistance, outcome: Outcome) -> Array:
    """Return the vector that a distance is composed of, shape ``(k,)``."""
    return distance.error(outcome.plan.model_trajectory, outcome.system_trajectory, outcome.plan.task)


def suggest_by(name: str, dimension: int, seed: int) -> Suggest:
    """Return the suggestions of one of our searches that see values alone."""
    search = searches.by_name(name)
    search.reset(dimension, seed)
    told = 0

    def suggest(points: Array, values: Array) -> Array:
        nonlocal told
        if len(points) > told:
            search.tell(points[told:], values[told:])
            told = len(points)
        return np.asarray(search.ask(1)[0])

    return suggest


scalar = Suggesting(lambda dimension, seed: suggest_by("bayesian-optimisation", dimension, seed))
gp_ucb = Suggesting(lambda dimension, seed: suggest_by("gp-ucb", dimension, seed))
cma_es = Suggesting(lambda dimension, seed: suggest_by("cma-es", dimension, seed))
random = Suggesting(lambda dimension, seed: suggest_by("random", dimension, seed))
