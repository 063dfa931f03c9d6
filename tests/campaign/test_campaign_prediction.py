"""Campaigns whose search learns from trajectories: they find the worst task soon, and resume bit for bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from conftest import interrupt_at_once, make_validation
from ctxval import Campaign, Validation, cases, searches
from ctxval.errors import CtxvalError
from faulty_rig import FaultyRig
from rig_thorough import more


def facts(campaign: Campaign) -> list[tuple[object, ...]]:
    return [(t.number, t.state, t.unit_point.tobytes(), t.distance, t.failure, t.note) for t in campaign.trials]


def no_data(validation: Validation) -> Validation:
    """Return a validation whose model does not bring what it was learned from."""
    validation.model.data = None  # type: ignore[attr-defined]
    return validation


@pytest.mark.slow
@pytest.mark.in_full
@pytest.mark.parametrize(("with_data", "budget"), [(True, 3), *more((False, 5))])
@pytest.mark.thorough
def test_the_worst_task_is_found_in_a_handful_of_executions(with_data: bool, budget: int) -> None:
    case = cases.by_name("pendulum", 0)
    if not with_data:
        no_data(case.validation)
    campaign = Campaign(case.validation, search=searches.Auto(), seed=0).run(budget)
    assert case.truth is not None
    assert campaign.worst is not None
    assert campaign.worst.distance == pytest.approx(case.truth().distance, rel=0.01)


@pytest.mark.parametrize("seed", [0, *more(1, 2)])
def test_linear_systems_take_two_executions_more_than_they_have_states(seed: int) -> None:
    case = cases.by_name("linear", seed, dim=3)
    campaign = Campaign(case.validation, search=searches.Auto(), seed=seed).run(5, explore=True)
    assert case.truth is not None
    assert campaign.worst is not None
    assert campaign.worst.distance == pytest.approx(case.truth().distance, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("with_data", [True, *more(False)])
@pytest.mark.thorough
def test_running_in_pieces_equals_running_at_once(tmp_path: Path, with_data: bool) -> None:
    def validation() -> Validation:
        return make_validation() if with_data else no_data(make_validation())

    whole = Campaign(validation(), search=searches.Auto("thorough"), seed=2).run(5, explore=True)
    for budget in (1, 3, 5):
        pieces = Campaign(validation(), search=searches.Auto("thorough"), seed=2, store=tmp_path / "a.sqlite").run(
            budget, explore=True
        )
    assert facts(pieces) == facts(whole)
    assert any(t.note.search is not None and t.note.search["engine"] == "climb" for t in whole.trials)


@pytest.mark.slow
def test_an_interrupted_execution_and_failures_change_nothing_that_is_chosen(tmp_path: Path) -> None:
    class Rig(FaultyRig):
        interrupt = False

        def execute(self, controller, task):  # type: ignore[no-untyped-def]
            if self.interrupt and self._executions == 4:
                self.interrupt = False
                interrupt_at_once()
            return super().execute(controller, task)

        def describe(self) -> dict[str, object]:
            return {}

    whole = Campaign(
        make_validation(system=Rig(make_validation().system, {2: "raise"})), search=searches.Auto("thorough")
    ).run(6, explore=True)
    rig = Rig(make_validation().system, {2: "raise"})
    rig.interrupt = True
    with pytest.raises(KeyboardInterrupt):
        Campaign(make_validation(system=rig), search=searches.Auto("thorough"), store=tmp_path / "a.sqlite").run(
            6, explore=True
        )
    resumed = Campaign(make_validation(system=rig), search=searches.Auto("thorough"), store=tmp_path / "a.sqlite").run(
        6, explore=True
    )
    assert facts(resumed) == facts(whole)
    assert [t.attempts for t in resumed.trials] == [1] * 4 + [2] + [1]


@pytest.mark.slow
def test_a_note_of_a_task_that_could_not_be_planned_is_kept(tmp_path: Path) -> None:
    class Fussy:
        batched = True
        refuses = True

        def design(self, task, model):  # type: ignore[no-untyped-def]
            if self.refuses and not task.batch_shape:
                raise RuntimeError("not this one")
            return plain.design(task, model)

        def describe(self) -> dict[str, object]:
            return {}

    validation = make_validation()
    plain, validation.synthesizer = validation.synthesizer, Fussy()
    campaign = Campaign(validation, search=searches.Auto(), store=tmp_path / "a.sqlite")
    with pytest.raises(CtxvalError):
        campaign.run(2)
    Fussy.refuses = False
    reopened = Campaign(validation, search=searches.Auto(), store=tmp_path / "a.sqlite")
    assert reopened.trials[0].note == campaign.trials[0].note
    assert reopened.trials[0].note.prediction is not None
    assert reopened.run(2).executions == 2


@pytest.mark.thorough
@pytest.mark.in_full
def test_a_hidden_state_that_misleads_the_prediction_does_not_keep_the_worst_task_hidden() -> None:
    class Sticky:
        """Executions whose friction grows with the time: no function of state and input."""

        batched = True

        def execute(self, controller, task):  # type: ignore[no-untyped-def]
            whole = plain.system.execute(controller, task)
            drift = 0.3 * np.sin(5 * task.goal[..., None, 0]) * whole.times
            states = whole.states.copy()
            states[..., 0] += drift
            return type(whole)(whole.times, states, whole.inputs)

    plain = make_validation()
    validation = no_data(make_validation(system=Sticky()))
    truth = validation.distances(validation.space.grid(401)).max()
    found = [Campaign(validation, search=searches.Auto(), seed=seed).run(12).worst for seed in range(2)]
    assert all(worst is not None and (worst.distance or 0) > 0.97 * truth for worst in found)
