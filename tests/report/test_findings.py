"""What a report says of campaigns whose answer is known."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
from rig_pages import pendulum, plane

from ctxval import Campaign, Task, TaskSpace, Trajectory, Validation, controllers, distances, models, searches, systems
from ctxval._util.arrays import Array
from ctxval.certificates import CertificateOptions, DistanceBound
from ctxval.core.trial_note import NO_NOTE
from ctxval.report import ReportContext, context_of_campaign
from ctxval.report.distance_model import DistanceModel
from ctxval.report.findings import Answer, Finding, Question, findings_of, share_far_from_trials, smooth
from ctxval.report.insights import (
    components,
    converged,
    explained,
    flips,
    goals,
    saturation,
    weak_region,
    weak_states,
)
from facts import assert_names


def found_by(question: Question, context: ReportContext) -> Finding | None:
    return next(iter(findings_of(context, {"": question})), None)


@pytest.fixture(scope="module")
def swing() -> ReportContext:
    return context_of_campaign(pendulum(), threshold=0.2, certificate=CertificateOptions(DistanceBound()))


@pytest.fixture(scope="module")
def flat() -> ReportContext:
    return context_of_campaign(plane(2, 24), threshold=0.02, certificate=CertificateOptions(DistanceBound()))


@pytest.fixture(scope="module")
def weak_motor() -> ReportContext:
    validation = pendulum(executions=1).validation
    hasty = controllers.ILQR([1.0, 0.1], [1e-4], [10.0, 1.0], iterations=1, tolerance=1e-12, limits=0.5)
    parts = ("space", "task", "system", "model", "distance")
    other = Validation(**{part: getattr(validation, part) for part in parts}, synthesizer=hasty)
    return context_of_campaign(Campaign(other, search=searches.Random(), seed=0).run(4))


def named(findings: list[Finding]) -> dict[str, Finding]:
    return {one.name: one for one in findings}


def test_the_lights_of_a_campaign_with_a_failure(flat: ReportContext) -> None:
    found = named(flat.diagnostics)
    assert found["Executions"].light == "bad"
    assert found["Executions"].numbers["failed"] == [1]
    assert set(found) <= {"Executions", "Predictions made beforehand"}  # a counterexample rests on nothing else
    assert any("trial 1" in sentence for sentence in flat.not_tested)


def test_a_campaign_without_a_threshold_has_no_verdict() -> None:
    context = context_of_campaign(pendulum(executions=3))
    assert "Certificate" not in named(context.diagnostics)
    assert found_by(weak_region, context) is None


def test_an_empty_campaign_has_findings_too() -> None:
    campaign = Campaign(pendulum(executions=1).validation)
    context = context_of_campaign(campaign, threshold=0.5)
    assert named(context.diagnostics)["Executions"].light == "unknown"
    assert {one.light for one in context.insights} <= {"unknown", "good"}


def test_the_share_far_from_trials_is_that_of_a_line() -> None:
    # One trial in the middle of a line: tasks beyond an eighth of it on either side are far.
    assert share_far_from_trials(np.array([[0.5]])) == pytest.approx(0.75, abs=0.02)


def test_where_m_is_weak_counts_executed_and_predicted_tasks(swing: ReportContext) -> None:
    found = found_by(weak_region, swing)
    assert found is not None
    assert found.light == "bad"
    assert found.numbers["executed_above"] == int((swing.distances > 0.2).sum())
    model = swing.distance_model
    assert model is not None
    assert found.numbers["predicted_share_above"] == pytest.approx(float((model.over_tasks.median > 0.2).mean()))


def test_the_region_of_weak_tasks_is_described_by_its_parameters() -> None:
    space = TaskSpace(goal=(0.0, 2.0, "m"), load=(0.0, 1.0))
    # The distance is |goal - 1|, and the load does not matter.
    campaign = Campaign(distance_of_goal(space), search=searches.Random(), seed=0).run(30)
    context = context_of_campaign(campaign, threshold=0.8, certificate=CertificateOptions(DistanceBound()))
    found = found_by(weak_region, context)
    assert found is not None
    model = context.distance_model
    assert model is not None
    assert model.sensitivity[0] > 0.9
    assert model.sensitivity[1] < 0.1


class _FromMiddle:
    to_task = True

    def __call__(self, model: Trajectory, system: Trajectory, task: Task) -> Array:
        return np.abs(task.initial_state[..., 0] - 1.0)


def distance_of_goal(space: TaskSpace) -> Validation:
    return Validation(
        space=space,
        task=lambda p: Task([p.goal], horizon=1, dt=0.1),
        system=systems.Simulated(models.Linear([[1.0]], [[0.0]])),
        model=models.Linear([[1.0]], [[0.0]], [0.0]),
        synthesizer=controllers.Policy(lambda t, x, task: np.zeros_like(x)),
        distance=_FromMiddle(),
    )


def test_bands_are_never_below_zero(swing: ReportContext) -> None:
    model = swing.distance_model
    assert model is not None
    for band in (model.over_tasks, model.left_out):
        assert (band.low >= 0).all()
        assert (band.low <= band.median).all()
        assert (band.median <= band.high).all()


def test_the_distance_model_needs_two_distances() -> None:
    campaign = pendulum(executions=1)
    assert DistanceModel.of(campaign.trials, campaign.validation.space) is None


def test_inputs_at_the_limits_of_the_synthesizer_are_counted(flat: ReportContext) -> None:
    found = found_by(saturation, flat)
    assert found is not None
    executed = np.concatenate([one.system.inputs for one in flat.recordings.values()])
    share = (np.abs(executed) >= 0.2 * (1 - 1e-6)).mean(axis=0).max()
    assert found.numbers["share_of_steps"] == pytest.approx(share)
    assert found.numbers["limits_known"]
    assert found.light == ("attention" if share >= 0.01 else "good")


def test_limits_that_nobody_states_are_seen_in_the_records() -> None:
    validation = pendulum(executions=1).validation
    limited = controllers.LQR([1.0, 0.1], [1e-2], [10.0, 1.0], limits=1.0)
    parts = ("space", "task", "system", "model", "distance")
    other = Validation(**{part: getattr(validation, part) for part in parts}, synthesizer=limited)
    context = context_of_campaign(Campaign(other, search=searches.Random(), seed=0).run(4))
    found, known = (
        found_by(saturation, replace(context, validation=None, missing="not loaded")),
        found_by(saturation, context),
    )
    assert found is not None
    assert known is not None
    assert not found.numbers["limits_known"]
    assert found.light == "attention"
    assert found.numbers["share_of_steps"] == pytest.approx(known.numbers["share_of_steps"], rel=0.05)


def test_the_corrected_model_explains_a_linear_residual(flat: ReportContext) -> None:
    found = found_by(explained, flat)
    assert found is not None
    assert found.light == "good"
    assert found.numbers["share_explained"] > 0.95


def test_without_the_experiment_two_questions_are_open(flat: ReportContext) -> None:
    data = replace(flat, validation=None, missing="not loaded")
    for question in (explained, goals):
        found = found_by(question, data)
        assert found is not None
        assert found.light == "unknown"
        assert "not loaded" in found.text


def test_the_goals_of_m_are_those_of_weighted_states(swing: ReportContext) -> None:
    found = found_by(goals, swing)
    assert found is not None
    assert found.numbers["trials"] == len(swing.recordings)


def test_the_state_that_errs_most_is_named_with_its_unit(swing: ReportContext) -> None:
    found = found_by(components, swing)
    assert found is not None
    assert found.numbers["state"] in ("angle [rad]", "rate [rad/s]")
    assert sum(found.numbers["shares"].values()) == pytest.approx(1.0)
    worst = next(iter(swing.recordings.values()))
    assert 0 <= found.numbers["time"] <= worst.system.times[-1]


def test_an_angle_that_jumps_in_one_of_both_loops_is_said(swing: ReportContext) -> None:
    found = found_by(components, swing)
    assert found is not None
    assert "whole turn" not in found.text

    def wrapped(run: Trajectory) -> Trajectory:
        climbing = np.linspace(0, 9, len(run.states))[:, None] + [0.0, 0.0]
        return replace(run, states=(climbing + np.pi) % (2 * np.pi) - np.pi)

    jumping = {k: pair._replace(system=wrapped(pair.system)) for k, pair in swing.recordings.items()}
    other = replace(swing)
    vars(other)["recordings"] = jumping  # in the place of those of the store
    found = found_by(components, other)
    assert found is not None


class Jumping:
    """A synthesizer whose input has the sign of the goal, so neighbours on both sides of 0 differ."""

    batched = False

    def design(self, task: Task, model: object):  # type: ignore[no-untyped-def]
        sign = 1.0 if task.goal[0] >= 0 else -1.0
        return lambda t, x: np.array([sign])


def test_a_planner_that_jumps_is_found() -> None:
    validation = Validation(
        space=TaskSpace(goal=(-1.0, 1.0)),
        task=lambda p: Task([0.0], goal=[p.goal], horizon=4, dt=0.1),
        system=systems.Simulated(models.Linear([[1.0]], [[0.1]])),
        model=models.Linear([[1.0]], [[0.09]]),
        synthesizer=Jumping(),
        distance=distances.FinalState(),
    )
    campaign = Campaign(validation, search=searches.Random(), seed=0).run(40)
    found = found_by(flips, context_of_campaign(campaign))
    assert found is not None
    assert found.light == "attention"
    assert found.numbers["flipped"] > 0
    assert found.numbers["largest_change"] == pytest.approx(1.0)


def test_designs_that_stop_early_are_counted(weak_motor: ReportContext) -> None:
    found = found_by(converged, weak_motor)
    assert found is not None
    assert found.light == "attention"
    assert_names(found.text, 4)


def test_nothing_is_said_of_states_that_all_trials_visit(swing: ReportContext) -> None:
    assert found_by(weak_states, swing) is None


def test_every_finding_is_one_text_with_a_light_and_json(swing: ReportContext, flat: ReportContext) -> None:
    for context in (swing, flat):
        for found in context.diagnostics + context.insights:
            assert found.light in ("good", "note", "attention", "bad", "unknown")
            assert asdict(found)["name"] == found.name
            assert "nan" not in found.text.lower().split()


def test_a_question_that_fails_is_a_finding_that_is_not_known(swing: ReportContext) -> None:
    def failing(context: ReportContext) -> Answer:
        raise ValueError("odd data")

    (found,) = findings_of(swing, {"odd": failing})
    assert (found.name, found.light) == ("odd", "unknown")
    assert "odd data" in found.text


def test_neither_smooth_nor_alike_is_good_if_designs_did_not_converge(
    weak_motor: ReportContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert weak_motor.designs is not None
    assert_names(weak_motor.designs, 4)
    monkeypatch.setattr(DistanceModel, "calibration", 1.0)
    sure = found_by(
        smooth, replace(weak_motor, trials=tuple(replace(trial, note=NO_NOTE) for trial in weak_motor.trials))
    )
    doubted = found_by(smooth, weak_motor)
    assert sure is not None
    assert doubted is not None
    assert (sure.light, doubted.light) == ("good", "attention")
    assert_names(doubted.text, 4)
    for finding in [*weak_motor.diagnostics, *weak_motor.insights]:
        if finding.name in ("Distance is smooth over the tasks", "Controllers of neighbouring tasks"):
            assert finding.light != "good"
