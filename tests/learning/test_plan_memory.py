from __future__ import annotations

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Task, controllers, models
from ctxval._util.arrays import Array
from ctxval._util.progress import Progress, listening, stage
from ctxval.learning import plan_memory
from ctxval.learning.plan_memory import PlanMemory

POINTS = np.linspace(0.1, 0.9, 5)[:, None]


class Counting(controllers.LQR):
    """An LQR that counts the tasks for which it designs controllers."""

    designed = 0

    def design(self, task: Task, model: models.Model) -> controllers.AffineFeedback:
        self.designed += int(np.prod(task.batch_shape))
        return super().design(task, model)


def memory(batched: bool) -> tuple[PlanMemory, Counting]:
    synthesizer = Counting([1.0, 0.1], [1e-2], [10.0, 1.0])
    synthesizer.batched = batched  # type: ignore[misc]
    validation = make_validation()
    validation.synthesizer = synthesizer
    return PlanMemory(validation), synthesizer


def final_states(plans: PlanMemory, points: Array) -> Array:
    found = np.full((len(points), 2), np.nan)
    for one in plans.plan(points):
        found[one.rows] = one.promised.final_state
    return found


@pytest.mark.parametrize("batched", [True, False])
def test_tasks_that_were_planned_are_not_planned_again(batched: bool) -> None:
    plans, synthesizer = memory(batched)
    first = final_states(plans, POINTS)
    designed = synthesizer.designed
    np.testing.assert_array_equal(final_states(plans, POINTS), first)
    assert synthesizer.designed == designed
    if not batched:
        np.testing.assert_array_equal(final_states(plans, POINTS[::-1]), first[::-1])
        assert synthesizer.designed == designed
        assert plans.has(POINTS[0])


def test_the_oldest_plans_make_room_for_new_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    plans, synthesizer = memory(False)
    plans.plan(POINTS[:1])
    monkeypatch.setattr(plan_memory, "_LARGEST", 0)
    plans.plan(POINTS[1:])
    assert not plans.has(POINTS[0])
    assert synthesizer.designed >= len(POINTS)


@pytest.mark.parametrize("batched", [True, False])
def test_each_task_is_counted_once_whether_it_is_planned_or_kept(batched: bool) -> None:
    plans, _ = memory(batched)
    assert plans.planner.batched is batched  # found out before the count, with tasks of its own
    heard: list[Progress] = []
    with listening(heard.append), stage("choosing a task", unit="designs"):
        plans.plan(POINTS)
        plans.plan(POINTS)
    assert heard[-1].done == 2 * len(POINTS)
