from __future__ import annotations

import concurrent.futures as cf
import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest

from conftest import interrupt_at_once, make_validation
from ctxval import Campaign, Task, TaskSpace, Trajectory, Validation, controllers, distances, models, searches, systems
from ctxval._util.arrays import Array
from ctxval.certificates import RESOLUTION, CertificateOptions, DistanceBound, farthest_task
from ctxval.core.trial import Trial
from ctxval.core.trial_note import NO_NOTE
from ctxval.errors import (
    CampaignError,
    CertificateError,
    CtxvalError,
    DistanceError,
    InputError,
    ModelError,
    StoreAccessError,
    StoreMismatchError,
    UnknownNameError,
)
from facts import refuses
from faulty_rig import FaultyRig

BY_DISTANCE = CertificateOptions(DistanceBound())


class OneCorner(searches.SequentialSearch):
    """Asks for points of the lowest tenth of the cube alone."""

    def propose(self, rng: np.random.Generator) -> Array:
        return 0.1 * rng.random(self.dimension)


def gp_ucb(validation: Validation, **options: Any) -> Campaign:
    """Return a campaign with the paper's search, which chooses fast."""
    return Campaign(validation, search=searches.GPUCB(), **options)


def facts(trials: tuple[Trial, ...]) -> list[tuple[object, ...]]:
    """What a resumed campaign must share with one never stopped, bit for bit."""
    return [(t.number, t.origin, t.state, t.unit_point.tobytes(), t.distance, t.failure) for t in trials]


def test_gp_ucb_finds_the_worst_task(validation: Validation) -> None:
    campaign = gp_ucb(validation, seed=4).run(20)
    grid = validation.space.grid(2001)
    truth = validation.distances(grid).max()
    assert campaign.worst is not None
    assert campaign.worst.distance == pytest.approx(truth, rel=0.01)
    assert [t.origin for t in campaign.trials] == ["initial"] * 5 + ["acquisition"] * 15
    assert campaign.estimate == campaign.worst.distance


def test_a_surrogate_needs_two_distances_and_then_interpolates(validation: Validation) -> None:
    campaign = Campaign(validation, search=searches.Random())
    with refuses(InputError, "surrogate", 1):
        campaign.run(1).surrogate()
    campaign.run(8)
    mean, deviation = campaign.surrogate().predict(np.array([t.unit_point for t in campaign.trials]))
    np.testing.assert_allclose(mean, [t.distance for t in campaign.trials], atol=1e-3)
    assert (deviation < 1e-2).all()


@pytest.mark.parametrize("search", ["gp-ucb", "random", "sampling-discarding"])
def test_running_in_pieces_equals_running_at_once(validation: Validation, tmp_path: Path, search: str) -> None:
    whole = Campaign(validation, search=searches.by_name(search), seed=2).run(12)
    for budget in (3, 4, 9, 12):
        pieces = Campaign(validation, search=searches.by_name(search), seed=2, store=tmp_path / "a.sqlite").run(budget)
        assert pieces.executions == budget
    assert facts(pieces.trials) == facts(whole.trials)


@pytest.mark.slow
def test_the_budget_is_a_total(validation: Validation) -> None:
    campaign = gp_ucb(validation).run(5, explore=True)
    assert len(campaign.run(5, explore=True).trials) == 5
    assert len(campaign.run(3, explore=True).trials) == 5


@pytest.mark.parametrize("draw", [lambda c: c.run(5), lambda c: c.audit(5)])
def test_independent_draws_are_repeatable_but_not_shared_by_another_model(
    validation: Validation, draw: Callable[[Campaign], Campaign], tmp_path: Path
) -> None:
    def drawn(model: object, store: Path | None = None) -> list[list[float]]:
        campaign = Campaign(make_validation(model=model), search=searches.Random(), seed=5, store=store)
        return [trial.unit_point.tolist() for trial in draw(campaign).trials]

    learned = validation.model
    other = models.Linear(learned.A * 1.001, learned.B, learned.c)  # type: ignore[attr-defined]
    assert drawn(learned) == drawn(copy.deepcopy(learned)) == drawn(learned, tmp_path / "a.sqlite")
    assert not np.isclose(drawn(learned), drawn(other)).any()


def test_a_model_whose_weights_are_private_has_draws_of_its_own(validation: Validation) -> None:
    class Private:
        def __init__(self, model: models.Linear, bias: float) -> None:
            self._model, self._bias = model, bias

        def step(self, x: Array, u: Array) -> Array:
            return np.asarray(
                self._model.step(x, u) + self._bias * np.exp(-50 * np.sum((x - [2.0, 0.5]) ** 2, axis=-1))[..., None]
            )

    def drawn(bias: float) -> list[list[float]]:
        private = make_validation(model=Private(validation.model, bias))  # type: ignore[arg-type]
        private.synthesizer = controllers.Policy(lambda t, x, task: -x[..., :1])
        return [trial.unit_point.tolist() for trial in Campaign(private, seed=5).audit(3).trials]

    assert drawn(1e-3) == drawn(1e-3) != drawn(2e-3)


def test_discarding_lowers_the_estimate_but_not_the_facts(validation: Validation) -> None:
    campaign = Campaign(validation, search=searches.SamplingDiscarding(discard=2), seed=1)
    assert campaign.run(2).estimate is None
    distances = sorted(t.distance or 0 for t in campaign.run(10).trials)
    assert campaign.estimate == distances[-3]
    assert campaign.worst is not None
    assert campaign.worst.distance == distances[-1]


def test_failures_are_data(validation: Validation) -> None:
    rig = FaultyRig(validation.system, {1: "raise", 3: "nan", 6: "short", 8: "wrong shape"})
    campaign = gp_ucb(make_validation(system=rig), seed=3).run(15)
    reasons = [t.failure for t in campaign.failed]
    assert campaign.executions == 15
    assert [t.number for t in campaign.failed] == [1, 3, 6, 8]
    for reason, expected in zip(reasons, ["motor cut out", "not finite", "operator", "must have states"], strict=True):
        assert reason is not None
        assert expected in reason
    recorded = campaign.store.trajectories([t.number for t in campaign.failed], "system")
    # Of a step that is missing at the end, the others remain.
    assert {number: trajectory.horizon for number, trajectory in recorded.items()} == {6: 24}
    failed = np.array([t.unit_point for t in campaign.failed])
    others = np.array([t.unit_point for t in campaign.completed])
    assert np.abs(failed[:, None] - others[None]).min() > 0


def test_a_failure_is_told_with_what_was_recorded_before(validation: Validation) -> None:
    campaign = gp_ucb(validation)
    opened = campaign.ask()
    whole = validation.execute(opened.plan)
    states = whole.states.copy()
    states[8:] = np.nan
    ended = campaign.tell(opened, Trajectory(whole.times, states, whole.inputs), failed="stopped early")
    assert (ended.state, ended.failure, ended.distance) == ("failed", "stopped early", None)
    recorded = campaign.store.trajectory(0, "system")
    assert np.array_equal(recorded.states, states[:8])
    assert recorded.ended == "stopped early"
    assert campaign.remeasure(distances.MaximumDeviation()) == []
    opened = campaign.ask()
    for unusable, facts in (
        (Trajectory(whole.times, whole.states + 9.0, whole.inputs), ("start_tolerance",)),
        (Trajectory(0.1 * whole.times, whole.states, whole.inputs), (0.02,)),
        (Trajectory(whole.times, np.where(whole.times[:, None] > 0, np.nan, whole.states), whole.inputs), ()),
        (Trajectory(whole.times, whole.states[:, :1], whole.inputs), (2, 1)),
    ):
        with refuses(InputError, "failed", *facts):
            campaign.tell(opened, unusable, failed="stopped early")


def test_tasks_of_failed_executions_are_executed_again_first(validation: Validation) -> None:
    class Fuse:
        blown = True

        def execute(self, controller: Any, task: Task) -> Trajectory:
            if self.blown and task.goal[0] > 0:
                raise RuntimeError("no current")
            return validation.system.execute(controller, task)

    fuse = Fuse()
    campaign = Campaign(validation.with_parts(system=fuse), search=searches.Random(), seed=1).run(6)
    failed = [trial.parameters for trial in campaign.failed]
    assert 0 < len(failed) < 6
    with refuses(InputError, "again"):
        campaign.run(8, again=" ")
    fuse.blown = False
    campaign.run(7 + len(failed), again="fuse replaced")
    repeated = campaign.trials[6 : 6 + len(failed)]
    assert [trial.parameters for trial in repeated] == failed
    assert {(trial.state, trial.because, trial.origin) for trial in repeated} == {
        ("completed", "fuse replaced", "manual")
    }
    assert campaign.trials[-1].because is None
    assert len(campaign.run(8 + len(failed), again="fuse replaced").trials) == 8 + len(failed)
    assert campaign.trials[-1].because is None  # nothing is left to repeat


def test_what_fails_each_time_for_one_reason_costs_three_executions(validation: Validation) -> None:
    class Broken:
        def execute(self, controller: Any, task: Task) -> Trajectory:
            raise RuntimeError(f"cannot open port {task.goal[0]:g}")

    campaign = Campaign(make_validation(system=Broken()))
    for executions in (3, 4):  # running again tries once more
        with refuses(CampaignError, "--execute", executions):
            campaign.run(20, 0.5)
        assert campaign.executions == executions
    some = gp_ucb(make_validation(system=FaultyRig(validation.system, dict.fromkeys((0, 1, 3, 4, 5), "raise"))))
    assert some.run(8).executions == 8


def test_what_begins_to_fail_for_one_reason_costs_six_executions(validation: Validation) -> None:
    faults = dict.fromkeys([*range(2, 13), *range(14, 30)], "raise")
    campaign = gp_ucb(make_validation(system=FaultyRig(validation.system, faults)))
    for executions in (8, 20):  # running again tries as many more, counted from the last one that did not fail
        with refuses(CampaignError, 6, "--again-failed"):
            campaign.run(30)
        assert campaign.executions == executions


def test_a_run_that_breaks_off_each_time_for_one_reason_costs_six_executions(validation: Validation) -> None:
    def step(x: Array, u: Array) -> Array:
        if abs(x[0] - np.pi) > 0.01:
            raise RuntimeError("the bus died")
        return validation.model.step(x, u)

    campaign = gp_ucb(make_validation(system=systems.Simulated(step)))
    with refuses(CampaignError, 6, "--again-failed"):
        campaign.run(30)
    assert campaign.executions == 6
    assert len(campaign.trajectories(campaign.trials[0])[1].states) > 1  # type: ignore[union-attr]


def test_an_emergency_stop_falsifies_if_the_steps_before_it_exceed_the_threshold(tmp_path: Path) -> None:
    validation = make_validation(distance=distances.MaximumDeviation())
    campaign = Campaign(validation, store=tmp_path / "a.sqlite")
    opened = campaign.ask()
    whole = validation.execute(opened.plan)
    states = whole.states.copy()
    states[5:, 0] += 3.0
    stopped = campaign.tell(opened, Trajectory(whole.times, states, whole.inputs).first(8), failed="emergency stop")
    gap = np.linalg.norm(states[:9] - opened.plan.model_trajectory.states[:9], axis=1).max()
    assert stopped.least == pytest.approx(gap, rel=1e-12)
    assert campaign.verdict(0.9 * gap).answer == "falsified"
    assert campaign.verdict(1.1 * gap).answer == "undecided"
    assert Campaign(validation, store=tmp_path / "a.sqlite").trials[0].least == stopped.least
    assert campaign.run(10, 0.9 * gap).executions == 1
    # Nothing is known of a final state, and with the deviation again the same as before.
    campaign.remeasure(distances.FinalState())
    assert campaign.verdict(0.9 * gap).answer == "undecided"
    campaign.remeasure(distances.MaximumDeviation())
    assert campaign.trials[0].least == stopped.least
    campaign.tell(campaign.ask(opened.trial.parameters, because="the stop was mended"), whole)
    assert campaign.verdict(0.9 * gap).answer != "falsified"


def test_a_replaced_failure_keeps_no_distance_of_the_one_before() -> None:
    validation = make_validation(distance=distances.MaximumDeviation())
    campaign = Campaign(validation, search=searches.Random())  # nothing else is noted with the trial
    opened = campaign.ask({"goal": 1.0})
    whole = validation.execute(opened.plan)
    states = whole.states + np.linspace(0, 9, len(whole.states))[:, None]
    stopped = Trajectory(whole.times, states, whole.inputs).first(8)
    assert campaign.tell(opened, stopped, failed="emergency stop").least > 1
    replaced = campaign.tell(0, failed="it was never started", replace="wrong file")
    assert replaced.least == 0
    assert campaign.verdict(1.0).answer == "undecided"


def test_a_task_that_failed_after_a_success_is_executed_again(validation: Validation) -> None:
    campaign = Campaign(validation)
    first = campaign.ask({"goal": 1.0})
    campaign.tell(first, validation.execute(first.plan))
    campaign.tell(campaign.ask({"goal": 1.0}), failed="the fuse blew")
    assert campaign.run(3, 1e-3, explore=True, again="fuse replaced").trials[2].because == "fuse replaced"


def test_failures_do_not_change_what_a_resumed_campaign_chooses(validation: Validation, tmp_path: Path) -> None:
    def campaign(store: Path | None, done: int) -> Campaign:
        faults = {k - done: "raise" for k in (1, 6) if k >= done}
        return gp_ucb(make_validation(system=FaultyRig(validation.system, faults)), seed=3, store=store)

    # The store describes the rig too, so one rig stands for both: what failed before stays failed.
    whole = campaign(None, 0).run(12)
    shared = FaultyRig(validation.system, {1: "raise", 6: "raise"})
    first = gp_ucb(make_validation(system=shared), seed=3, store=tmp_path / "a.sqlite").run(7)
    second = gp_ucb(make_validation(system=shared), seed=3, store=first.store).run(12)
    assert facts(second.trials) == facts(whole.trials)


def test_an_interrupted_execution_is_repeated_as_the_same_trial(validation: Validation, tmp_path: Path) -> None:
    class Interrupting(FaultyRig):
        def execute(self, controller, task):  # type: ignore[no-untyped-def]
            if self._executions == 6:
                self._executions += 1
                interrupt_at_once()
            return super().execute(controller, task)

    whole = gp_ucb(make_validation(system=FaultyRig(validation.system)), seed=1).run(10)
    stopped = make_validation(system=Interrupting(validation.system))
    store = tmp_path / "a.sqlite"
    with pytest.raises(KeyboardInterrupt):
        gp_ucb(stopped, seed=1, store=store).run(10)
    resumed = gp_ucb(stopped, seed=1, store=store).run(10)
    assert facts(resumed.trials) == facts(whole.trials)
    assert [t.attempts for t in resumed.trials] == [1] * 6 + [2] + [1] * 3


def test_asking_and_telling_by_hand_equals_running(validation: Validation) -> None:
    by_hand = gp_ucb(validation, seed=6)
    for _ in range(9):
        opened = by_hand.ask()
        by_hand.tell(opened, validation.system.execute(opened.plan.controller, opened.plan.task))
    assert facts(by_hand.trials) == facts(gp_ucb(validation, seed=6).run(9).trials)


def test_a_trial_can_be_told_later_by_its_number(validation: Validation, tmp_path: Path) -> None:
    first = Campaign(validation, store=tmp_path / "a.sqlite")
    opened = first.ask()
    trajectory = validation.execute(opened.plan)
    second = Campaign(validation, store=tmp_path / "a.sqlite")
    assert second.trials[0].state == "open"
    assert second.tell(0, trajectory).distance == validation.measure(opened.plan, trajectory)


@pytest.mark.slow
def test_running_leaves_trials_that_were_asked_by_hand_open(validation: Validation) -> None:
    campaign = gp_ucb(validation)
    opened = campaign.ask()
    campaign.run(4, explore=True)
    assert campaign.trials[0].state == "open"
    assert campaign.executions == 4
    campaign.tell(opened, failed="battery empty")
    assert campaign.trials[0].failure == "battery empty"


def test_a_manual_task_is_told_to_the_search_and_is_no_iid_draw(validation: Validation) -> None:
    campaign = Campaign(validation, search=searches.Random())
    opened = campaign.ask({"goal": 1.25})
    assert opened.trial.origin == "manual"
    assert opened.trial.parameters == {"goal": pytest.approx(1.25)}
    with refuses(UnknownNameError, "goal", "gaol"):
        campaign.ask({"gaol": 1.0})


def test_a_short_trajectory_told_by_hand_leaves_the_trial_open(validation: Validation) -> None:
    campaign = Campaign(validation)
    opened = campaign.ask()
    whole = validation.execute(opened.plan)
    short = type(whole)(whole.times[:-1], whole.states[:-1], whole.inputs[:-1])
    with refuses(InputError, 26, 25, 0.02):
        campaign.tell(opened, short)
    assert campaign.tell(opened, whole).state == "completed"


@pytest.mark.parametrize(
    ("told", "facts"),
    [((99,), (99, 1)), ((0,), ("failure",))],
)
def test_telling_nonsense_is_refused(validation: Validation, told: tuple[int, ...], facts: tuple[object, ...]) -> None:
    campaign = gp_ucb(validation)
    campaign.ask()
    with refuses(InputError, *facts):
        campaign.tell(*told)


def test_a_model_that_fails_stops_the_campaign_and_the_next_run_goes_on_behind_it(validation: Validation) -> None:
    class Bad:
        fails = True

        def step(self, x, u):  # type: ignore[no-untyped-def]
            known = validation.model.step(x, u)
            return known * np.nan if self.fails else known

        def jacobian(self, x, u):  # type: ignore[no-untyped-def]
            return validation.model.jacobian(x, u)  # type: ignore[attr-defined]

        def describe(self) -> dict[str, object]:
            return {}

    model = Bad()
    campaign = gp_ucb(make_validation(model=model))
    with refuses(ModelError, "NaN", 0):
        campaign.run(3)
    assert (campaign.executions, len(campaign.failed)) == (0, 1)
    model.fails = False
    assert campaign.run(3).executions == 3
    assert len(campaign.trials) == 4


@pytest.mark.slow
def test_a_distance_of_nan_stops_the_campaign_but_keeps_the_execution(validation: Validation) -> None:
    def broken(model: Trajectory, system: Trajectory, task: Task) -> float:
        return 0.0 if np.array_equal(model.states, system.states) else np.nan  # it works on M itself

    campaign = Campaign(make_validation(distance=broken))
    with refuses(DistanceError, "distance", "goal"):
        campaign.run(3)
    assert campaign.executions == 1
    assert campaign.trajectories(campaign.trials[0])[1] is not None


@pytest.mark.slow
def test_verdicts_are_executed_facts_or_undecided(validation: Validation) -> None:
    campaign = gp_ucb(validation).run(8)
    assert campaign.worst is not None
    worst = campaign.worst.distance or 0
    falsified = campaign.verdict(worst * 0.9)
    assert falsified.answer == "falsified"
    assert falsified.witness is campaign.worst
    assert campaign.verdict(worst).answer == "undecided"
    for threshold in (0.0, -1.0, np.nan, np.inf):
        with refuses(InputError, "threshold"):
            campaign.verdict(threshold)


@pytest.mark.slow
def test_a_store_of_another_experiment_is_refused(validation: Validation, tmp_path: Path) -> None:
    Campaign(validation, store=tmp_path / "a.sqlite").run(2)
    longer = make_validation(horizon=26)
    with refuses(StoreMismatchError, 0, 25, 26):
        Campaign(longer, store=tmp_path / "a.sqlite")
    with refuses(StoreMismatchError, "seed", 0, 1):
        Campaign(validation, store=tmp_path / "a.sqlite", seed=1)
    Campaign(validation, name="rig", store=tmp_path / "b.sqlite")
    with refuses(StoreMismatchError, "rig", "store"):
        Campaign(validation, store=tmp_path / "b.sqlite")
    assert Campaign(validation, store=tmp_path / "a.sqlite").executions == 2


@pytest.mark.parametrize("budget", [0, -3, 2.5, True, None])
def test_a_budget_is_a_positive_integer(validation: Validation, budget: object) -> None:
    with refuses(InputError, "budget"):
        Campaign(validation).run(budget)  # type: ignore[arg-type]


@pytest.mark.parametrize("arguments", [{"seed": -1}, {"seed": 1.5}, {"search": object()}])
def test_bad_arguments_are_named(validation: Validation, arguments: dict[str, object]) -> None:
    with refuses(InputError, *arguments):
        Campaign(validation, **arguments)  # type: ignore[arg-type]


def test_a_search_that_leaves_the_cube_is_told_so(validation: Validation) -> None:
    class Outside(searches.Random):
        def propose(self, rng: np.random.Generator) -> np.ndarray:
            return np.array([1.5])

    with refuses(InputError, "search"):
        Campaign(validation, search=Outside()).run(1)


def test_the_sketch_of_the_readme_runs() -> None:
    validation = make_validation()
    space = TaskSpace(goal=(-3.0, 3.0))
    again = Validation(
        space=space,
        task=validation.task,
        system=validation.system,
        model=validation.model.step,
        synthesizer=validation.synthesizer,
        distance=validation.distance,
    )
    assert Campaign(again, search=searches.GPUCB(beta=2.0), seed=7).run(budget=6).executions == 6


# Audits, and stopping early


def origins(campaign: Campaign) -> list[str]:
    return [trial.origin for trial in campaign.trials]


def test_an_audit_adds_independent_draws_until_there_are_so_many(validation: Validation) -> None:
    campaign = gp_ucb(validation, seed=2).run(7)
    assert origins(campaign.audit(4))[7:] == ["iid"] * 4
    assert len(campaign.audit(4).trials) == 11  # a total, as the budget is
    assert len(campaign.audit(6).trials) == 13
    assert campaign.executions == 13
    points = np.array([trial.unit_point for trial in campaign.trials if trial.origin == "iid"])
    assert ((points >= 0) & (points < 1)).all()
    assert len(np.unique(points)) == 6


def test_an_audit_refuses_trials_that_people_are_executing(validation: Validation, tmp_path: Path) -> None:
    campaign, other = (Campaign(validation, store=tmp_path / "a.sqlite") for _ in range(2))
    opened = [other.ask(), other.ask()]
    with refuses(CertificateError, 0, 1):
        campaign.audit(2)
    assert len(campaign.trials) == 2
    for trial in opened:
        other.tell(trial, failed="stopped")
    assert origins(campaign.audit(2))[2:] == ["iid"] * 2


def test_the_draws_of_a_random_search_are_an_audit_already(validation: Validation) -> None:
    campaign = Campaign(validation, search=searches.Random(), seed=2).run(5)
    assert len(campaign.audit(5).trials) == 5
    assert origins(campaign.audit(8)) == ["iid"] * 8


@pytest.mark.parametrize("search", ["gp-ucb", "random"])
def test_an_audit_draws_what_no_search_draws(validation: Validation, search: str) -> None:
    searched = Campaign(validation, search=searches.by_name(search), seed=2).run(12)
    audited = Campaign(validation, search=searches.by_name(search), seed=2).audit(12)
    others = {trial.unit_point.tobytes() for trial in searched.trials}
    assert not others & {trial.unit_point.tobytes() for trial in audited.trials}


@pytest.mark.parametrize("search", ["gp-ucb", "random"])
def test_what_an_audit_draws_does_not_depend_on_the_search(validation: Validation, search: str) -> None:
    campaign = Campaign(validation, search=searches.by_name(search), seed=2).audit(5)
    plain = Campaign(validation, seed=2).audit(5)
    assert facts(campaign.trials) == facts(plain.trials)
    other = Campaign(validation, seed=3).audit(5)
    assert {t.unit_point.tobytes() for t in plain.trials}.isdisjoint(t.unit_point.tobytes() for t in other.trials)


@pytest.mark.thorough
def test_the_points_of_many_audits_are_uniform() -> None:
    cheap = make_validation(horizon=1)
    points = np.array([t.unit_point[0] for seed in range(25) for t in Campaign(cheap, seed=seed).audit(8).trials])
    assert kstest(points, "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(points[:-1], points[1:])[0, 1]) < 0.25


def test_a_search_goes_on_after_an_audit_and_knows_what_it_showed(validation: Validation, tmp_path: Path) -> None:
    whole = gp_ucb(validation, seed=4).run(6).audit(3).run(12)
    for act in (
        lambda c: c.run(6),
        lambda c: c.audit(1),
        lambda c: c.audit(3),
        lambda c: c.run(10),
        lambda c: c.run(12),
    ):
        pieces = act(gp_ucb(validation, seed=4, store=tmp_path / "a.sqlite"))
    assert facts(pieces.trials) == facts(whole.trials)
    assert origins(whole) == ["initial"] * 5 + ["acquisition"] + ["iid"] * 3 + ["acquisition"] * 3


def test_an_audit_finishes_what_was_interrupted_first(validation: Validation, tmp_path: Path) -> None:
    class Interrupting(FaultyRig):
        def execute(self, controller, task):  # type: ignore[no-untyped-def]
            if self._executions in (5, 9):
                self._executions += 1
                interrupt_at_once()
            return super().execute(controller, task)

    whole = gp_ucb(make_validation(system=FaultyRig(validation.system)), seed=1).run(7).audit(4)
    stopped = make_validation(system=Interrupting(validation.system))
    campaign = gp_ucb(stopped, seed=1, store=tmp_path / "a.sqlite")
    with pytest.raises(KeyboardInterrupt):
        campaign.run(7)
    with pytest.raises(KeyboardInterrupt):
        campaign.run(7).audit(4)
    assert campaign.trials[-1].state == "open"
    resumed = gp_ucb(stopped, seed=1, store=tmp_path / "a.sqlite").audit(4)
    assert facts(resumed.trials) == facts(whole.trials)


def test_a_failed_draw_of_an_audit_counts_as_one(validation: Validation) -> None:
    rig = FaultyRig(validation.system, {1: "raise"})
    seen: list[Trial] = []
    campaign = Campaign(make_validation(system=rig)).audit(4, on_trial=seen.append)
    assert [trial.state for trial in seen] == ["completed", "failed", "completed", "completed"]
    assert origins(campaign) == ["iid"] * 4


@pytest.mark.parametrize("draws", [0, -3, 2.5, True, None])
def test_the_draws_of_an_audit_are_a_positive_integer(validation: Validation, draws: object) -> None:
    with refuses(InputError, "draws"):
        Campaign(validation).audit(draws)  # type: ignore[arg-type]


def test_a_campaign_stops_before_the_execution_that_is_not_needed(validation: Validation) -> None:
    asked: list[int] = []

    def enough(campaign: Campaign) -> bool:
        asked.append(campaign.executions)
        return campaign.executions >= 7

    campaign = gp_ucb(validation, seed=1)
    assert campaign.run(20, until=enough).executions == 7
    assert asked == list(range(8))
    assert campaign.run(20, until=enough).executions == 7
    assert campaign.run(5, until=lambda _: False).executions == 7
    assert facts(campaign.trials) == facts(gp_ucb(validation, seed=1).run(7).trials)


@pytest.mark.thorough
def test_a_campaign_executes_what_nothing_came_near_to_before_it_validates(tmp_path: Path) -> None:
    def campaign(name: str) -> Campaign:
        return Campaign(make_validation(), search=OneCorner(), seed=1, store=tmp_path / name)

    # The search alone would never leave its corner.
    decided = campaign("a").run(20, 1e3, certificate=BY_DISTANCE)
    origins = [trial.origin for trial in decided.trials]
    assert decided.verdict(1e3, certificate=BY_DISTANCE).answer == "validated"
    assert 0 < origins.count("covering") < decided.executions < 20
    points = np.array([trial.unit_point for trial in decided.trials])
    assert farthest_task(points) <= RESOLUTION
    # Interrupted, it goes on as if it had not been, and beyond the verdict nothing is executed.

    stops = [1, origins.index("covering"), decided.executions - 1]

    def interrupt(trial: Trial) -> None:
        if trial.number in stops:
            raise KeyboardInterrupt

    for _ in stops:
        with pytest.raises(KeyboardInterrupt):
            campaign("b").run(20, 1e3, on_trial=interrupt, certificate=BY_DISTANCE)
    assert facts(campaign("b").run(20, 1e3, certificate=BY_DISTANCE).trials) == facts(decided.trials)


def test_a_campaign_ends_at_its_counterexample(validation: Validation) -> None:
    falsified = Campaign(validation, seed=1).run(9, 1e-6)
    assert falsified.executions == 1
    assert falsified.verdict(1e-6).answer == "falsified"


@pytest.mark.slow
@pytest.mark.thorough  # test_controllers_with_memory.py decides with two workers, too
def test_workers_decide_together(validation: Validation) -> None:
    class InOrder(cf.Executor):
        """Executes each task as soon as it is submitted, so that results come in the same order on any machine."""

        def submit(self, function, /, *args, **options):  # type: ignore[no-untyped-def]
            future: cf.Future[Any] = cf.Future()
            future.set_result(function(*args, **options))
            return future

    campaign = Campaign(validation, search=OneCorner(), seed=1)
    decided = campaign.run(40, 1e3, workers=2, executor=InOrder(), certificate=BY_DISTANCE)
    assert decided.verdict(1e3, certificate=BY_DISTANCE).answer == "validated"
    assert decided.executions < 40


# What an attack on the campaign found, and must not find again


def test_an_interrupt_while_planning_leaves_no_ghost_in_the_search(validation: Validation) -> None:
    class Impatient:
        batched = True
        designs = 0

        def design(self, task, model):  # type: ignore[no-untyped-def]
            self.designs += 1
            if self.designs == 7:
                raise KeyboardInterrupt
            return validation.synthesizer.design(task, model)

        def describe(self) -> dict[str, object]:
            return {}

    hasty = make_validation()
    hasty.synthesizer = Impatient()
    campaign = gp_ucb(hasty, seed=2)
    with pytest.raises(KeyboardInterrupt):
        campaign.run(10)
    assert facts(campaign.run(10).trials) == facts(gp_ucb(validation, seed=2).run(10).trials)


def test_an_interrupted_trial_that_cannot_be_planned_any_more_is_passed_over(tmp_path: Path) -> None:
    class Stopped(FaultyRig):
        def execute(self, controller, task):  # type: ignore[no-untyped-def]
            interrupt_at_once()

    plain = make_validation()
    with pytest.raises(KeyboardInterrupt):
        gp_ucb(make_validation(system=Stopped(plain.system)), store=tmp_path / "a.sqlite").run(3)
    again = make_validation(system=Stopped(plain.system))
    campaign = gp_ucb(again, store=tmp_path / "a.sqlite")
    whole, again.synthesizer.design = again.synthesizer.design, None  # type: ignore[attr-defined, method-assign]
    with pytest.raises(CtxvalError):
        campaign.run(3)
    again.synthesizer.design = whole  # type: ignore[method-assign]
    again.system = plain.system
    assert campaign.run(3).executions == 3
    assert (campaign.trials[0].state, campaign.trials[0].executed) == ("failed", False)


def test_a_failure_with_undecodable_text_is_stored(validation: Validation) -> None:
    class Serial(FaultyRig):
        def execute(self, controller, task):  # type: ignore[no-untyped-def]
            raise RuntimeError("serial said \udcff")

    campaign = Campaign(make_validation(system=Serial(validation.system))).run(1)
    assert campaign.executions == 1
    assert "serial said" in (campaign.trials[0].failure or "")


def test_two_processes_do_not_run_one_store(validation: Validation, tmp_path: Path) -> None:
    first, second = (Campaign(validation, store=tmp_path / "a.sqlite") for _ in range(2))
    with first.store.sole_writer(), refuses(StoreAccessError, "a.sqlite"):
        second.run(1)
    assert second.run(1).executions == 1


def test_an_open_trial_of_another_campaign_is_refused(validation: Validation) -> None:
    here, there = gp_ucb(validation, seed=1), gp_ucb(validation, seed=2)
    here.ask()
    opened = there.ask()
    with refuses(InputError, 0):
        here.tell(opened, validation.execute(opened.plan))


def test_independent_draws_know_how_many_there_were_to_be(validation: Validation) -> None:
    campaign = Campaign(validation, search=searches.GPUCB(initial=2)).run(3)
    campaign.audit(2)
    campaign.audit(3)
    assert [trial.note.draws for trial in campaign.trials[3:]] == [2, 2, 3]
    assert all(trial.note == NO_NOTE for trial in campaign.trials[:3])
    campaign.tell(campaign.ask(draw=True), distance=0.1)
    assert campaign.trials[-1].note == NO_NOTE
    drawn = Campaign(validation, search=searches.Random()).run(2).run(4, 90.0, resolution=1.0)
    assert [trial.note.draws for trial in drawn.trials] == [2, 2, 0, 0]
    assert Campaign(validation, search=searches.Random()).run(2, until=lambda _: False).trials[0].note.draws == 0


def test_a_resumed_random_search_keeps_its_plan(validation: Validation, tmp_path: Path) -> None:
    stopped = Campaign(validation, search=searches.Random(), store=tmp_path / "a.sqlite")
    with pytest.raises(KeyboardInterrupt):
        stopped.run(3, on_trial=lambda _: interrupt_at_once())
    stopped.store.close()
    trials = Campaign(validation, search=searches.Random(), store=tmp_path / "a.sqlite").run(3).trials
    assert [trial.note.draws for trial in trials] == [3] * 3


@pytest.mark.slow
def test_options_beside_a_certificate_are_refused() -> None:
    campaign = Campaign(make_validation(), seed=1).run(3, explore=True)
    by = CertificateOptions(confidence=0.9)
    for options in ({"confidence": 0.99}, {"resolution": 0.5}):
        with refuses(InputError, "certificate"):
            campaign.verdict(9.0, certificate=by, **options)  # type: ignore[arg-type]
    with refuses(InputError, "certificate", "CertificateOptions", "audit"):
        campaign.verdict(9.0, certificate="audit")  # type: ignore[arg-type]


class Odd(searches.BaseSearch):
    """A search that returns odd things."""

    def __init__(self, points: object, note: object = None) -> None:
        self.points, self.noted = points, note

    def reset(self, dimension: int, seed: int) -> None:
        pass

    def ask(self, n: int = 1) -> Any:
        return self.points

    def tell(self, points: object, values: object) -> None:
        pass

    def note(self) -> Any:
        return self.noted


@pytest.mark.parametrize("points", [[[1.0], [2.0, 3.0]], "left", [[1j]], [["a"]], None, [[1.5]]])
def test_points_of_an_own_search_that_are_none_are_named(points: object) -> None:
    with refuses(InputError, "search", "points"):
        Campaign(make_validation(), search=Odd(points)).run(1)


@pytest.mark.parametrize("note", [[1], {"a": np.array([1])}, {"b": np.bool_(True)}, {"c": float("nan")}, "text"])
def test_a_note_that_cannot_be_stored_is_named(note: object) -> None:
    campaign = Campaign(make_validation(), search=Odd([[0.5]], note))
    with refuses(InputError, "search", "note"):
        campaign.run(1)
    assert not campaign.trials
