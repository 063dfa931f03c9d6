"""The crane: a network in single precision, on which rounding stops iLQR before it has converged."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from rig_thorough import more

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
pytest.importorskip("sklearn")

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from crane import experiment
from ctxval import Campaign, searches
from ctxval.certificates import CertificateOptions, DistanceBound
from ctxval.core.controller import converged_of
from study_crane import truth, typed


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *more(1)])
@pytest.mark.thorough
def test_designs_that_rounding_stops_are_like_those_next_to_them(seed: int) -> None:
    validation = experiment(seed).validation
    points = validation.space.iid(30, np.random.default_rng(3))
    beside = points + 1e-10 * np.where(points > 0.9, -1, 1)
    plans, near = validation.plans(points), validation.plans(beside)
    assert 5 < sum(not converged_of(plan.controller) for plan in plans) < 25
    gains = np.array([np.abs(plan.controller.gains).max() for plan in plans])  # type: ignore[attr-defined]
    assert gains.min() > 0.8 * gains.max()  # with those of damped steps the least one is a thousandth
    for one, other in zip(plans, near, strict=True):
        distance = validation.measure(one, validation.execute(one))
        assert validation.measure(other, validation.execute(other)) == pytest.approx(distance, rel=0.02, abs=1e-4)


@pytest.mark.thorough
def test_verdicts_on_the_crane_are_true_and_its_worst_task_can_be_typed_again() -> None:
    validation = experiment(0).validation
    largest = truth(validation, 600)
    campaign = Campaign(validation, search=searches.Auto(50), seed=0).run(8, explore=True)
    options = CertificateOptions(DistanceBound())
    assert campaign.verdict(0.9 * largest, certificate=options).answer == "falsified"
    above = campaign.verdict(1.1 * largest, certificate=options)
    assert above.answer != "falsified"
    worst = campaign.worst
    assert worst is not None
    assert worst.distance is not None
    assert typed(validation, worst.parameters) == worst.distance
    for moved in (1e-10, -1e-10):
        assert typed(validation, worst.parameters, moved) == pytest.approx(worst.distance, rel=1e-3)
    asked = campaign.ask({name: float(f"{value:.9g}") for name, value in worst.parameters.items()})
    np.testing.assert_array_equal(asked.trial.unit_point, worst.unit_point)
