"""The running example as it would be on a bench: an encoder, noise, and a torque that acts late."""

from __future__ import annotations

from dataclasses import replace

from ctxval import Experiment, systems
from ctxval.paper.cases import pendulum

ENCODER = 1e-3  # rad, about that of an encoder with 6,000 steps
RATE_NOISE = 5e-3  # rad/s, of the measured rate
PROCESS = 2e-3  # rad/s, of the rate in each step of 20 ms
DELAY = 1.0  # steps


def experiment(seed: int = 0) -> Experiment:
    """Return the example; the seed draws the data that the linear model is learned from, and the noise."""
    ideal = pendulum.experiment(seed)
    parts = ideal.validation
    assert isinstance(parts.system, systems.Simulated)
    system = systems.Imperfect(
        parts.system.model,
        process=[0.0, PROCESS],
        measurement=[0.0, RATE_NOISE],
        resolution=[ENCODER, 0.0],
        delay=DELAY,
        seed=seed,
    )
    return replace(ideal, name="pendulum-noisy", validation=parts.with_parts(system=system), truth=None)
