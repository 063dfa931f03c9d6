"""Campaigns on systems that M agrees with: ports, rewrites, simulators in single precision or with a small error."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import rig_outputs
import rig_suites
from ctxval import Campaign, Task, TaskSpace, Validation, controllers, distances, systems

DT, TAU = 0.05, 0.1
Step = Callable[[np.ndarray, np.ndarray], np.ndarray]


def pendulum(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    pushed = 9.81 * np.sin(x[..., 0]) - 0.1 * x[..., 1] + 3 * u[..., 0]
    return np.stack([x[..., 0] + DT * x[..., 1], x[..., 1] + DT * pushed], axis=-1)


def gain(error: float) -> Callable[[Step], Step]:
    return lambda step: lambda x, u: step(x, u * (1 + error))


def single(step: Step) -> Step:
    return lambda x, u: step(x.astype(np.float32), u.astype(np.float32)).astype(np.float32).astype(np.float64)


def other_order(step: Step) -> Step:
    """A last bit is other in every second step."""
    return lambda x, u: step(x, u) * (1 + 2.2e-16 * (np.abs(x[..., :1]) * 1e6 % 2 > 1))


def rough(step: Step) -> Step:
    """An error like that of another solver: no smooth function of the state."""
    return lambda x, u: step(x, u) + 1e-6 * np.sin(1e7 * x)


KINDS: dict[str, Callable[[Step], Step]] = {
    "the model": lambda step: step,
    "another order of sums": other_order,
    "single precision": single,
    **{f"a gain off by {error:g}": gain(error) for error in (1e-15, 1e-12, 1e-9, 1e-6)},
}


class Model:
    def __init__(self, step: Step) -> None:
        self.step = step


def validation(system: Step, parameters: int = 1, synthesizer: Any = None) -> Validation:
    bounds = {"goal": (-1.0, 1.0), "rate": (-0.2, 0.2), "start": (-0.3, 0.3), "speed": (-0.2, 0.2)}

    def task(p: Any) -> Task:
        start, speed, rate = (getattr(p, name, 0 * p.goal) for name in ("start", "speed", "rate"))
        return Task([start, speed], goal=[p.goal, rate], horizon=30, dt=DT)

    return Validation(
        space=TaskSpace(**dict(list(bounds.items())[:parameters])),
        task=task,
        system=systems.Simulated(system, vectorized=True),
        model=Model(pendulum),
        synthesizer=synthesizer or controllers.LQR([10, 1], [0.1]),
        distance=distances.MaximumDeviation(components=[0]),
    )


def bound_of(case: Validation, threshold: float | None, executions: int = 13) -> float:
    """Return the bound of a campaign that must validate, by its dynamics, after so few executions."""
    campaign = Campaign(case, seed=0).run(20, threshold=threshold)
    verdict = campaign.verdict(threshold or TAU)
    assert (verdict.answer, verdict.certificate and verdict.certificate.kind) == ("validated", "dynamics")
    assert len(campaign.trials) <= executions
    assert verdict.certificate is not None
    assert verdict.certificate.details["tests"]["drawn"] >= 8
    assert campaign.trials.largest <= verdict.certificate.upper_bound
    return verdict.certificate.upper_bound


@pytest.mark.parametrize(
    ("kind", "threshold"), [("the model", TAU), ("single precision", None), ("a gain off by 1e-09", None)]
)
def test_a_system_that_agrees_is_validated_after_the_tests(kind: str, threshold: float | None) -> None:
    assert 0 < bound_of(validation(KINDS[kind](pendulum)), threshold) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["another order of sums", "a gain off by 1e-15", "a gain off by 1e-06"])
def test_so_it_is_with_four_parameters(kind: str) -> None:
    assert 0 < bound_of(validation(KINDS[kind](pendulum), 4), TAU, 14) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "threshold"), [("single precision", None), ("a gain off by 1e-12", TAU)])
def test_so_are_outputs(kind: str, threshold: float | None) -> None:
    swing = systems.Simulated(KINDS[kind](rig_outputs.swing(0.0)), vectorized=True)
    bound_of(rig_outputs.swing_validation(system=systems.WithOutputs(swing, (0,))), threshold)


@pytest.mark.parametrize(("kind", "threshold"), [("single precision", TAU), ("a gain off by 1e-09", None)])
def test_so_are_suites(kind: str, threshold: float | None) -> None:
    cart = systems.Simulated(KINDS[kind](rig_suites.step), vectorized=True)
    case = rig_suites.validation(rig_suites.FINE, lambda p: p.goal, cart).with_parts(model=Model(rig_suites.step))
    bound_of(case, threshold)


def test_a_rough_error_far_below_the_threshold_is_bounded_and_not_learned() -> None:
    assert 1e-6 < bound_of(validation(rough(pendulum)), TAU) < 0.01 * TAU


def test_a_threshold_that_rounding_may_exceed_is_not_validated() -> None:
    campaign = Campaign(validation(single(pendulum)), seed=0).run(5, threshold=2e-7)
    assert campaign.verdict(2e-7).answer == "undecided"


@pytest.mark.parametrize("seed", range(3))
def test_a_system_that_agrees_except_in_a_region_is_falsified(seed: int) -> None:
    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        slowed = np.where(x[..., 0] > 0.7, 0.1, 0.0)
        return pendulum(x, u) - np.stack([0 * slowed, slowed], axis=-1)

    campaign = Campaign(validation(step), seed=seed).run(20, threshold=0.05)
    assert campaign.verdict(0.05).answer == "falsified"


def test_a_distance_that_compares_nothing_is_not_validated() -> None:
    case = validation(pendulum).with_parts(distance=lambda model, system, task: 0 * system.states[..., 0, 0])
    verdict = Campaign(case, seed=0).run(4, threshold=TAU).verdict(TAU)
    assert verdict.answer == "undecided"
