"""Systems of the other lists with a model that is rougher than the system: a small network, or few points.

Their certificates learn the system without M, if the data prefer that. They were written down before any certificate
was computed on them, and nothing may be chosen by them. The plants and the data are those of the other lists, in which
every model is linear; the condition that replaces M was chosen with the paper's arm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from ctxval import Experiment, Transitions, models
from ctxval.core.model import Model
from dynamics_development import DEVELOPMENT
from dynamics_reporting import REPORTING
from dynamics_systems import Entry, listed

Fit = Callable[[Transitions, int], Model]


def network(data: Transitions, seed: int) -> Model:
    """Return a network of 2 x 32 ReLU units."""
    return models.FeedforwardReLU.fit(data, (32, 32), seed=seed, restarts=2, iterations=2000)


def few_points(data: Transitions, seed: int) -> Model:
    """Return a Gaussian process of 40 points."""
    return models.GaussianProcessModel.fit(data, 40, seed=seed)


def learned_again(entry: Entry, fit: Fit, seed: int) -> Experiment:
    """Return the experiment of an entry with a model of another kind, learned from the same data."""
    found = entry(seed)
    data = found.validation.model.data  # type: ignore[attr-defined]
    return replace(found, validation=found.validation.with_parts(model=fit(data, seed)))


def _with(entry: Entry, fit: Fit, kind: str) -> Entry:
    name = f"{entry.name}-{kind}"
    return replace(entry, name=name, make=partial(learned_again, entry, fit), without=None, seeds=5)


ROUGH = listed(
    *(
        _with(one, network, "network")
        for one in (
            REPORTING["sliding-tyres"],
            REPORTING["heated-rooms"],
            DEVELOPMENT["hanging-pendulum"],
            DEVELOPMENT["two-tanks"],
            DEVELOPMENT["hard-springs"],
            REPORTING["oblique-wall"],
            REPORTING["full-wheel"],
            REPORTING["dry-sled"],
            REPORTING["icy-corner"],
            DEVELOPMENT["corner-stop"],
            DEVELOPMENT["gust-zone"],
            DEVELOPMENT["hidden-heat"],
            DEVELOPMENT["weak-motor"],
        )
    ),
    *(_with(one, few_points, "points") for one in (REPORTING["heated-rooms"], REPORTING["icy-corner"])),
)
"""Systems with a rough model, by name: six smooth ones, and nine that mislead."""
