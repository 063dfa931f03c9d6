from __future__ import annotations

import numpy as np
import pytest

from ctxval import cases
from ctxval.errors import UnknownNameError
from ctxval.paper.cases import pendulum
from facts import refuses


@pytest.mark.parametrize(("goal", "start"), [(-3.0, -np.pi), (-0.1, -np.pi), (0.0, np.pi), (0.1, np.pi), (3.0, np.pi)])
def test_a_task_starts_at_the_bottom_that_is_nearer_on_the_circle(goal: float, start: float) -> None:
    validation = cases.by_name("pendulum").validation
    task = validation.task(validation.space.parameters([goal]))
    np.testing.assert_array_equal(task.initial_state, [start, 0.0])


def test_biased_data_are_of_one_half_of_the_circle() -> None:
    angles = pendulum.record(pendulum.Pendulum(), pendulum.VARIANTS["biased"], 0).x[:, 0]
    assert -np.pi <= angles.min() < -3.0
    assert -0.1 < angles.max() <= 0.0
    symmetric = pendulum.record(pendulum.Pendulum(), pendulum.VARIANTS["symmetric"], 0)
    assert len(symmetric) == 20 * 20


def test_a_biased_model_is_worst_where_that_of_the_paper_is() -> None:
    truth = cases.by_name("pendulum", variant="biased").truth
    assert truth is not None
    found = truth()
    assert found.distance == pytest.approx(0.3, abs=0.03)
    assert abs(found.parameters.points[0]) == pytest.approx(2.0, abs=0.1)


def test_an_unknown_variant_is_refused() -> None:
    with refuses(UnknownNameError, "biased", "variant"):
        cases.by_name("pendulum", variant="biassed")
