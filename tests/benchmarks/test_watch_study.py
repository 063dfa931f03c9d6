"""The study of the watch: its plants are those of other studies, and its page counts rightly."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import watch_page
from watch_systems import DEVELOPMENT, REPORTING


@pytest.mark.parametrize("name", [*DEVELOPMENT, *REPORTING])
def test_the_usual_payload_is_the_plant_and_a_heavier_one_is_another(name: str) -> None:
    watched = {**DEVELOPMENT, **REPORTING}[name]
    rng = np.random.default_rng(0)
    ranges = np.array(watched.plant.ranges)
    plan = watched.experiment("none").validation.plan(watched.experiment("none").validation.space.low)
    x, u = (
        0.3 * ranges * rng.normal(size=(20, len(ranges))),
        rng.normal(size=(20, plan.model_trajectory.inputs.shape[-1])),
    )
    np.testing.assert_allclose(watched.heavier(1.0)(x, u), watched.plant.step(x, u), rtol=1e-9, atol=1e-12)
    assert np.abs(watched.heavier(1.1)(x, u) - watched.plant.step(x, u)).max() > 1e-4


def test_noise_follows_from_the_seed() -> None:
    runs = []
    for seed in (1, 1, 2):
        validation = DEVELOPMENT["cart"].experiment("process 0.1 %", 1.1, seed).validation
        runs.append(validation.execute(validation.plan(validation.space.high)).states)
    np.testing.assert_array_equal(runs[0], runs[1])
    assert np.abs(runs[0] - runs[2]).max() > 1e-4


def test_what_was_not_noticed_counts_as_late() -> None:
    assert watch_page.median_of([2, None, 3]) == 3
    assert math.isinf(watch_page.median_of([2, None, None]))
    assert watch_page.upper_rate(0, 1000) == pytest.approx(1 - 0.05 ** (1 / 1000))


def test_the_page_is_that_of_the_stored_results() -> None:
    text = watch_page.PAGE.read_text()
    assert text.partition(watch_page.MARK)[2].strip() == watch_page.section().strip()
