"""The envelope of a campaign: executions that enlarge it after a falsification, and what it says of the true set."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import make_validation, make_validation_without_inputs
from ctxval import Campaign, Store, Task, TaskSpace, Validation, certificates, controllers, distances, models, systems
from ctxval.campaign.envelope import EnvelopeSearch
from ctxval.campaign.interval_search import IntervalSearch
from ctxval.certificates import CertificateOptions
from ctxval.core.trial_note import TrialNote
from ctxval.errors import InputError
from facts import assert_names, refuses

TAU, BUDGET = 0.3, 14


def threshold_of(validation) -> float:  # type: ignore[no-untyped-def]
    return float(np.quantile(validation.distances(validation.space.grid(15)), 0.6))


@pytest.fixture(scope="module")
def whole() -> Campaign:
    """A campaign without interruption, which the tests leave as it is."""
    validation = make_validation_without_inputs()
    return Campaign(validation, seed=2).run(BUDGET, threshold_of(validation), envelope=True)


@pytest.fixture(scope="module")
def envelope(whole: Campaign) -> certificates.Envelope:
    """Its envelope at its threshold."""
    return whole.envelope(threshold_of(whole.validation))


@pytest.mark.slow
def test_it_finds_the_true_set_after_a_falsification_and_includes_nothing_else(
    whole: Campaign, envelope: certificates.Envelope
) -> None:
    campaign, validation = whole, whole.validation
    tau = threshold_of(validation)
    assert campaign.verdict(tau).answer == "falsified"
    assert envelope.doubt is None
    assert envelope.tests == 8
    assert envelope.executions == campaign.executions <= BUDGET
    tasks = validation.space.iid(500, np.random.default_rng(9))
    true, trusted = validation.distances(tasks), envelope.trusted(tasks)
    assert trusted[true <= tau].mean() > 0.9
    assert not trusted[true > tau].any()
    assert (envelope.bound(tasks)[trusted] >= true[trusted]).all()
    for trial in campaign.completed:
        known = envelope.trusted(trial.parameters)
        assert not (known and (trial.distance or 0) > tau)


@pytest.mark.slow
@pytest.mark.thorough
def test_a_failure_beyond_the_threshold_is_outside_or_contradicts_it(
    whole: Campaign, envelope: certificates.Envelope, monkeypatch: pytest.MonkeyPatch
) -> None:
    tau, space = threshold_of(whole.validation), whole.validation.space
    tasks = space.iid(200, np.random.default_rng(4))
    above = whole.validation.distances(tasks) > 1.5 * tau
    trusted = envelope.trusted(tasks)

    def with_failure(row: int, least: float) -> certificates.Envelope:
        stopped = replace(
            whole.trials[0], number=len(whole.trials), origin="manual", state="failed", distance=None,
            unit_point=space.to_unit(tasks[row]), note=TrialNote(at_least=least),
        )  # fmt: skip
        monkeypatch.setattr(whole.recorder, "_trials", [*whole.trials, stopped])
        found = EnvelopeSearch(IntervalSearch(whole.recorder, CertificateOptions(), BUDGET, tau)).envelope()
        monkeypatch.undo()
        return found

    outside = with_failure(int(above.argmax()), 1.2 * tau)
    assert outside.doubt is None
    assert outside.trusted(tasks)[trusted].mean() > 0.95
    assert_names(str(with_failure(int(trusted.argmax()), 1.2 * tau).doubt), "failed")
    assert_names(str(with_failure(int(above.argmax()), 0.8 * tau).doubt), "distance")


@pytest.mark.slow
@pytest.mark.thorough
def test_a_resumed_campaign_makes_the_same_choices(whole: Campaign, tmp_path: Path) -> None:
    path = tmp_path / "c.sqlite"
    validation = make_validation_without_inputs()
    tau = threshold_of(validation)
    for _ in range(3):  # budgets below the present number execute nothing more
        Campaign(validation, seed=2, store=path).run(
            BUDGET, tau, envelope=True, until=lambda c: c.executions >= len(Store(path).trials()) + 4
        )
    again = Campaign(validation, seed=2, store=path).run(BUDGET, tau, envelope=True)
    assert [t.parameters for t in again.trials] == [t.parameters for t in whole.trials]


@pytest.mark.slow
def test_without_tests_it_says_what_is_missing() -> None:
    campaign = Campaign(make_validation_without_inputs(), seed=2).run(8)
    envelope = campaign.envelope(TAU)
    assert envelope.share == 0
    assert_names(str(envelope.doubt), "executions")
    assert not envelope.trusted(campaign.validation.space.grid(5)).any()


def test_before_any_execution_nothing_is_stated() -> None:
    envelope = Campaign(make_validation(), seed=1).envelope(TAU)
    assert envelope.doubt is not None
    assert_names(envelope.words, "envelope")


def test_bad_input_is_refused() -> None:
    campaign = Campaign(make_validation(), seed=1)
    with refuses(InputError, "envelope", "explore"):
        campaign.run(5, envelope=True)
    with refuses(InputError, "envelope", "explore"):
        campaign.run(5, TAU, explore=True, envelope=True)
    by = certificates.CertificateOptions(certificates.DistanceBound())
    with refuses(InputError, "posterior", "envelope"):
        campaign.envelope(TAU, certificate=by)
    assert campaign.executions == 0


def make_validation_with_wall() -> Validation:
    """Return a validation of a cart with drag that meets a stiff wall in a part of the tasks."""

    def derivative(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        position, speed = x[..., 0], x[..., 1]
        pushed = u[..., 0] - 0.5 * speed * np.abs(speed) - 300 * np.maximum(position - 0.9, 0)
        return np.stack([speed, pushed], axis=-1)

    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        fine = systems.rk4(derivative, 0.0125)
        return fine(fine(fine(fine(x, u), u), u), u)

    return Validation(
        space=TaskSpace(start=(-1.0, 0.5, "m"), goal=(-1.0, 1.2, "m")),
        task=lambda p: Task(
            np.stack([p.start, 0 * p.start], axis=-1),
            goal=np.stack([p.goal, 0 * p.goal], axis=-1),
            horizon=30,
            dt=0.05,
        ),
        system=systems.Simulated(step, vectorized=True),
        model=models.Linear([[1.0, 0.05], [0.0, 1.0]], [[0.00125], [0.05]]),
        synthesizer=controllers.LQR([20.0, 1.0], [0.1]),
        distance=distances.MaximumDeviation(components=(0,)),
    )


@pytest.mark.thorough  # `make envelope` measures it on more systems
def test_tasks_that_touch_nothing_are_trusted_in_spite_of_a_wall() -> None:
    validation = make_validation_with_wall()
    tasks = validation.space.iid(2000, np.random.default_rng(9))
    true = validation.distances(tasks)
    tau = float(np.quantile(true, 0.7))
    campaign = Campaign(validation, seed=1).run(15, tau, envelope=True)
    assert campaign.verdict(tau).answer == "falsified"
    envelope = campaign.envelope(tau)
    assert envelope.doubt is None
    assert envelope.irregular > 0
    trusted = envelope.trusted(tasks)
    assert trusted[true <= tau].mean() > 0.8
    assert trusted[true > tau].mean() < 0.01
