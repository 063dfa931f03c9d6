"""Refined models of the paper's cases are ten times as near to the system, in truth and within few executions."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import Campaign, TaskSpace, Trajectory, Validation, cases, models, refine, searches, systems
from ctxval.certificates import CertificateOptions, DistanceBound
from ctxval.paper.cases import pendulum
from ctxval.studies.fitting import FittedParameter
from ctxval.studies.refinement import ParameterFit, Records
from rig_thorough import more

CHEAP = CertificateOptions(DistanceBound())
"""The certificate by which tasks are chosen; it costs less than the dynamics bound."""


def campaign(validation: Validation, seed: int) -> Campaign:
    return Campaign(validation, search=searches.by_name("auto", thinking="fast"), seed=seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *more(1, 2)])
@pytest.mark.thorough
def test_a_linear_model_of_the_pendulum_is_brought_to_a_tenth(seed: int) -> None:
    validation = cases.by_name("pendulum", seed=seed).validation
    goals = validation.space.grid(101)
    before = validation.distances(goals).max()
    found = refine(campaign(validation, seed), 0.1 * before, 2, certificate=CHEAP)
    assert (len(found.rounds), found.executions) == (2, 2)
    assert found.last.campaign.validation.distances(goals).max() < 0.1 * before


@pytest.mark.thorough
def test_executions_alone_teach_a_model_without_data() -> None:
    validation = cases.by_name("pendulum", seed=0).validation
    given = validation.model
    assert isinstance(given, models.Linear)
    # On half of the circle: on the other half tasks start at -pi, where executions of this one teach nothing.
    space = TaskSpace(goal=(0.0, np.pi, "rad"))
    bare = validation.with_parts(space=space, model=models.Linear(given.A, given.B, given.c))
    goals = bare.space.grid(101)
    before = bare.distances(goals).max()
    found = refine(campaign(bare, 0), 0.1 * before, 6, certificate=CHEAP)
    assert found.last.campaign.validation.distances(goals).max() < 0.1 * before


def swing(x: np.ndarray, u: np.ndarray, theta: np.ndarray) -> np.ndarray:
    return systems.rk4(pendulum.Pendulum(mass=float(theta[0])).derivative, 0.02)(x, u)


def mass_of(seed: int) -> FittedParameter:
    """Return the mass from three noisy executions of a pendulum of 1 kg, with a model of 1.2 kg."""
    rng = np.random.default_rng(seed)
    executed = []
    for _ in range(3):
        states, inputs = [np.array([np.pi, 0.0])], rng.uniform(-5, 5, (50, 1))
        for u in inputs:
            states.append(swing(states[-1], u, np.array([1.0])) + [0.0, 1e-2] * rng.normal(size=2))
        executed.append(Trajectory(0.02 * np.arange(51), np.array(states), inputs))
    off = models.Parametric(swing, {"mass": 1.2}, vectorized=True)
    return ParameterFit({"mass": (0.5, 2.0)}).learn(off, Records.of(off, executed)).parameters[0]


@pytest.mark.slow
def test_a_mass_that_is_20_per_cent_off_is_found_within_its_interval() -> None:
    found = [mass_of(seed) for seed in range(4)]
    assert sum(one.low < 1.0 < one.high for one in found) >= 3  # 3.8 are expected of 4 intervals of confidence 0.95
    assert all(one.high < 1.2 for one in found)
