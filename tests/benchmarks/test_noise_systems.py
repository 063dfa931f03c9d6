from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facts import assert_names

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import calibrate_noise
from calibrate_noise import ALL, HALVES, imperfections
from noise_systems import IMPERFECTIONS


@pytest.mark.parametrize("name", ALL)
def test_every_plant_executes_its_tasks_alone_and_together(name: str) -> None:
    plant = ALL[name]
    validation = plant("none").validation
    points = validation.space.iid(3, np.random.default_rng(0))
    assert np.isfinite(validation.distances(points)).all()
    plan = validation.plan(points[0])
    executed = validation.system.execute(plan.controller, plan.task)
    assert validation.accept(plan, executed) >= 0
    assert executed.states.shape[-1] == len(plant.ranges)
    assert imperfections(plant) == (["none"] if name in HALVES["misleading"] else list(IMPERFECTIONS))


def test_noise_is_a_share_of_the_ranges() -> None:
    plant = HALVES["development"]["cart"]
    system: Any = plant("measurement 0.5 %").validation.system
    assert system.measurement == pytest.approx(0.005 * np.array(plant.ranges))
    assert plant("delay 1.5").validation.system.delay == 1.5


def test_an_imperfection_changes_executions_and_none_does_not() -> None:
    plant = HALVES["development"]["cart"]
    points = plant("none").validation.space.iid(2, np.random.default_rng(1))
    ideal, noisy = (plant(name).validation.distances(points) for name in ("none", "process 1 %"))
    assert not np.allclose(ideal, noisy)
    assert plant("none", seed=3).validation.distances(points) == pytest.approx(ideal)


def test_the_table_counts_answers_by_imperfection(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = {0.95: ("validated", 9), 1.25: ("validated", 13), 1.1: ("undecided", 25)}
    results = [
        {"plant": "cart", "imperfection": "lag 2", "share": share, "answer": answer, "executions": executions}
        for share, (answer, executions) in answers.items()
    ]
    monkeypatch.setattr(calibrate_noise.STORED, "select", lambda **_: results)
    counts = ["1, 0, 0", "1 of 1", "13", "0 of 1"]
    assert calibrate_noise.rows("development") == [["lag 2", *counts], ["all", *counts]]


def test_the_readme_has_the_numbers_of_the_stored_campaigns() -> None:
    def counts(share: float) -> str:
        lines = calibrate_noise.STORED.select(rule=calibrate_noise.RULE, share=share)
        answers = [line["answer"] for line in lines if line["plant"] in HALVES["reporting"]]
        return f"{answers.count('validated')} of {len(answers)}"

    page = " ".join((Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8").split())
    assert_names(page, "validated", 5, counts(0.95))
    assert_names(page, "validated", 25, counts(1.25))
