from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Experiment, Parameters, Task, TaskSpace, cases
from ctxval.cli.config.check import check_experiment
from rig_thorough import more

CASES: list[tuple[str, dict[str, Any]]] = [
    ("pendulum", {}),
    *more(("dubins", {}), ("arm", {"model": "linear"})),
    *more(("pendulum", {"variant": "biased"}), ("dubins", {"variant": "basin"}), ("dubins", {"variant": "heavy-tail"})),
    *more(("arm", {"model": "gp"}), ("arm", {"model": "fnn"})),
    ("linear", {"dim": 1}),
    *more(("linear", {"dim": 10})),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options"),
    CASES,
    ids=str,
)
def test_no_case_of_the_paper_fails_a_check(name: str, options: dict[str, Any]) -> None:
    found = check_experiment(cases.by_name(name, **options), execute=True)
    assert [finding for finding in found if finding.state == "failed"] == []


def test_every_case_is_checked() -> None:
    names = {getattr(case, "values", case)[0] for case in CASES}
    assert names == set(cases.NAMES) - {"pendulum-noisy"}  # its executions differ, as they should


@pytest.mark.usefixtures("without_costs")
@pytest.mark.parametrize(("error", "state"), [(1e-15, "ok"), (1e-9, "failed")])
def test_a_task_of_a_batch_may_differ_by_rounding_alone(error: float, state: str) -> None:
    validation = make_validation()

    def task(p: Parameters) -> Task:
        goal = np.asarray(p.goal) * (1 + error * np.ndim(p.goal))
        return Task([np.pi, 0.0], goal=np.stack([goal, 0 * goal], axis=-1), horizon=5, dt=0.02)

    validation.task = task
    found = check_experiment(Experiment("x", validation))
    assert [finding.state for finding in found if finding.check == "batches"] == [state]


@pytest.mark.usefixtures("without_costs")
@pytest.mark.parametrize(("unit", "expected"), [((), True), (("m",), False)])
def test_it_says_what_a_unit_of_length_is_good_for(unit: tuple[str, ...], expected: bool) -> None:
    validation = make_validation(horizon=5)
    validation.space = TaskSpace(goal=(-3.0, 3.0, *unit), side=(0.0, 1.0, *unit))
    (finding,) = [each for each in check_experiment(Experiment("x", validation)) if each.check == "space"]
    assert (finding.state == "noted") == ("places of positions are tested" in finding.text) == expected
