"""Reports of people on trials, for every skin over a campaign."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, Experiment, Store, Trajectory, Validation, searches
from ctxval._util.representation import counted
from ctxval.campaign.by_hand import parameters_of_trial, result_sentence, tell_result
from ctxval.campaign.telling import SuppliedResult
from ctxval.core.trial import Trial
from ctxval.data import LogMapping
from ctxval.errors import InputError
from ctxval.learning.effects.transport import SeeingLate
from facts import assert_names, refuses


@pytest.fixture
def campaign(validation: Validation) -> Campaign:
    return Campaign(validation, search=searches.Random())


def test_a_report_of_each_kind_is_stored(campaign: Campaign, tmp_path: Path) -> None:
    made = Experiment("pendulum", campaign.validation, units="rad")
    by_file, by_distance, failed = (campaign.ask() for _ in range(3))
    run = campaign.validation.system.execute(by_file.plan.controller, by_file.plan.task)
    run.to_csv(tmp_path / "run.csv")
    told = tell_result(campaign, made, by_file.number, SuppliedResult(tmp_path / "run.csv"))
    assert told.distance == pytest.approx(campaign.validation.accept(by_file.plan, run))
    assert tell_result(campaign, made, by_distance, SuppliedResult(distance=0.25)).distance == 0.25
    assert tell_result(campaign, made, failed.number, SuppliedResult(failed="cut out")).failure == "cut out"
    assert_names(result_sentence(campaign.trials[1], "rad"), 1, "distance", 0.25, "rad")
    assert_names(result_sentence(campaign.trials[2]), 2, "failed")


def test_a_failure_needs_no_controller(tmp_path: Path) -> None:
    store = Store(tmp_path / "a.sqlite")
    opened = Campaign(make_validation(), search=searches.Random(), store=store).ask()
    campaign = Campaign(make_validation(), store=store)

    def refuse(*_: object) -> None:
        raise AssertionError("a controller was designed")

    campaign.validation.synthesizer.design = refuse  # type: ignore[method-assign]
    made = Experiment("pendulum", campaign.validation)
    assert tell_result(campaign, made, opened.number, SuppliedResult(failed="cut out")).state == "failed"
    store.close()


def test_an_unmeasured_trial_says_why() -> None:
    trial = Trial(3, "initial", "unmeasured", np.zeros(1), {"goal": 0.0}, executed=True, failure="it is NaN.")
    assert_names(result_sentence(trial), "trial", 3, "NaN")
    assert_names(result_sentence(replace(trial, state="failed")), "trial", 3, "failed", "NaN")


def test_parameters_of_a_trial(campaign: Campaign) -> None:
    asked = campaign.ask({"goal": 1.5})
    assert parameters_of_trial(campaign, asked.number) == {"goal": pytest.approx(1.5)}
    with refuses(InputError, 7, 1, 0):
        parameters_of_trial(campaign, 7)


def test_a_campaign_sees_what_another_process_has_stored(tmp_path: Path) -> None:
    one, other = (Campaign(make_validation(), search=searches.Random(), store=tmp_path / "a.sqlite") for _ in range(2))
    one.tell(one.ask(), distance=0.5)
    assert not other.trials
    other.refresh()
    assert [trial.distance for trial in other.trials] == [0.5]
    for campaign in (one, other):
        campaign.store.close()


@pytest.mark.parametrize("told", [{"distance": 0.1}, {"failed": "motor stalled"}, {}])
def test_a_wrong_result_is_replaced_and_the_history_keeps_it(tmp_path: Path, told: dict[str, Any]) -> None:
    campaign = Campaign(make_validation(), search=searches.Random(), store=tmp_path / "a.sqlite")
    opened = campaign.ask()
    first = campaign.validation.execute(opened.plan)
    wrong = campaign.tell(
        opened, Trajectory(first.times, first.states + np.linspace(0, 1, len(first.states))[:, None], first.inputs)
    )
    right = told or {"trajectory": first}
    with refuses(InputError, "told", 0):
        campaign.tell(0, **right)
    with refuses(InputError, "replace"):
        campaign.tell(0, **right, replace=" ")
    replaced = campaign.tell(0, **right, replace="wrong file")
    assert (replaced.number, replaced.executed) == (0, True)
    assert replaced.distance == (campaign.validation.measure(opened.plan, first) if not told else told.get("distance"))
    executed = campaign.store.trajectory(0, "system")
    assert (executed is None) == bool(told)
    assert executed is None or np.array_equal(executed.states, first.states)
    [change] = campaign.store.history()
    assert (change.what, change.why) == ("replaced", "wrong file")
    assert change.content["before"]["0"]["distance"] == wrong.distance
    kept = Trajectory.from_npz(base64.b64decode(change.content["before"]["0"]["npz"]))
    assert not np.array_equal(kept.states, first.states)
    assert "wrong file" in " ".join(campaign.provenance.remarks)
    again = Campaign(make_validation(), search=searches.Random(), store=tmp_path / "a.sqlite")
    assert again.trials[0].distance == replaced.distance
    assert campaign.ask().number == 1


def test_only_results_that_people_told_can_be_replaced() -> None:
    campaign = Campaign(make_validation(), search=searches.Random()).run(1)
    campaign.ask()
    for number in (0, 1, 2):
        with refuses(InputError, number):
            campaign.tell(number, distance=0.1, replace="wrong file")


def test_the_offset_of_a_start_is_stated_and_compared_with_the_threshold() -> None:
    campaign = Campaign(make_validation(), search=searches.Random())
    opened = campaign.ask()
    executed = campaign.validation.execute(opened.plan)
    offset = np.zeros_like(executed.states)
    offset[0, 0] = 0.02
    ended = campaign.tell(opened, Trajectory(executed.times, executed.states + offset, executed.inputs))
    start = campaign.start_offset(ended)
    assert start is not None
    assert start.size == pytest.approx(0.02)
    assert_names(result_sentence(ended, "rad", start), "start", 0.02)
    assert_names(campaign.verdict(0.01).reason, "x0", 0.02, 0.01)
    assert "x0" not in campaign.verdict(0.03).reason


def test_the_trajectories_are_read_together_for_the_largest_offset_of_a_start(monkeypatch: pytest.MonkeyPatch) -> None:
    campaign = Campaign(make_validation(), search=searches.Random()).run(3)
    campaign.add({"goal": 0.3}, distance=0.1)
    offsets = [(campaign.start_offset(trial), trial.number) for trial in campaign.completed]
    known = [(offset.size, f"{offset.text} (trial {number})") for offset, number in offsets if offset is not None]
    assert len(known) == 3
    reads, read = list[list[int]](), campaign.store.trajectories

    def counted(numbers: Iterable[int], side: Literal["model", "system"]) -> dict[int, Trajectory]:
        reads.append(list(numbers))
        return read(reads[-1], side)

    monkeypatch.setattr(campaign.store, "trajectories", counted)
    assert campaign.provenance.start == max(known)
    assert reads == [[0, 1, 2, 3]]


def test_a_result_is_not_estimated_by_an_observer(campaign: Campaign, tmp_path: Path) -> None:
    mapping = LogMapping({"x": "x"}, observer=lambda y, u, dt: y)
    trial, made = campaign.ask(), Experiment("pendulum", campaign.validation)
    with refuses(InputError, "observer", "mapping"):
        tell_result(campaign, made, trial.number, SuppliedResult(tmp_path / "run.csv", mapping=mapping))


def test_a_recording_of_another_run_with_the_same_start_is_remarked() -> None:
    campaign = Campaign(make_validation(), search=searches.Random(), seed=0)
    validation, trials = campaign.validation, [campaign.ask({"goal": goal}) for goal in (2.5, -1.0, 2.0)]
    executed = [validation.execute(opened.plan) for opened in trials]
    late = Trajectory(
        executed[2].times,
        np.concatenate([executed[2].states[:1].repeat(8, axis=0), executed[2].states[:-8]]),
        np.concatenate([np.zeros((8, 1)), executed[2].inputs[:-8]]),
    )
    right, other, waited = (
        campaign.tell(opened, run) for opened, run in zip(trials, (executed[0], executed[0], late), strict=True)
    )
    assert campaign.input_difference(right) is None
    assert "u0 is" in str(campaign.input_difference(other))
    assert "u0 is 0 at " in str(campaign.input_difference(waited))
    result_sentence(other, "rad", inputs=campaign.input_difference(other))
    assert campaign.input_difference(campaign.tell(campaign.ask(), distance=0.1)) is None


@pytest.mark.parametrize("steps", [1, 3])
def test_inputs_at_old_states_are_remarked_with_their_age(steps: int) -> None:
    campaign = Campaign(make_validation(), search=searches.Random(), seed=0)
    opened = campaign.ask({"goal": 2.5})
    controller, validation = SeeingLate(opened.plan.controller, steps), campaign.validation
    told = campaign.tell(opened, validation.system.execute(controller, opened.plan.task))
    assert_names(str(campaign.input_difference(told)), counted(steps, "step"))


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        (lambda t, x: (t, x * [180 / np.pi, 1]), ("run.csv", 57.41)),
        (lambda t, x: (t, x * [1, -1]), ("run.csv", -1.002)),
        (lambda t, x: (1e3 * t, x), ("run.csv", "--time")),  # and those of the task
        (lambda t, x: (t, x), ()),
    ],
)
def test_a_recording_whose_times_units_or_signs_contradict_each_other_is_refused(
    change: Any, facts: tuple[object, ...], tmp_path: Path
) -> None:
    t = 0.02 * np.arange(301)
    x = np.stack([np.sin(3 * t) + 0.2 * np.sin(11 * t), 3 * np.cos(3 * t) + 2.2 * np.cos(11 * t)], axis=-1)
    times, states = change(t, x)
    path = tmp_path / "run.csv"
    Trajectory(times, states, np.zeros((300, 1))).to_csv(path, states=["angle", "speed"], inputs=["torque"])
    read = (path, {"angle": "rad", "speed": "rad/s"}, {"torque": "N m"}, times)
    if not facts:
        assert SuppliedResult(path).read_file(*read).horizon == 300
        return
    with refuses(InputError, *facts):
        SuppliedResult(path).read_file(*read)
    failed = SuppliedResult(path, failed="it fell")  # whatever a failed execution has recorded is kept
    assert failed.read_file(*read).horizon == 300
