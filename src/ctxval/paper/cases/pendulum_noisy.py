"""The running example as it would be on a bench: an encoder, noise, and a torque that acts late."""

from __future__ import annotations

from dataclasses import replace

from ctxval import Experiment, systems
from ctxval.paper.cases import pendulum


def experiment(seed: int = 0) -> Experiment:
    """Return the example; the seed draws the data that the linear model is learned from, and the noise."""
    ideal = pendulum.experiment(seed)
    parts = ideal.validation
    assert isinstance(parts.system, systems.Simulated)
    system = systems.Imperfect(
        parts.system.model,
        process=[0.0, 2e-3],  # rad/s, of the rate in each step of 20 ms
        measurement=[0.0, 5e-3],  # rad/s, of the measured rate
        resolution=[1e-3, 0.0],  # rad, about that of an encoder with 6,000 steps
        delay=1.0,  # steps
        seed=seed,
    )
    return replace(ideal, name="pendulum-noisy", validation=parts.with_system(system), truth=None)
