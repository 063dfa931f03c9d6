"""What a campaign's model predicts for a certificate: learned from the trials before a given one alone."""

from __future__ import annotations

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, Labels, Trajectory, searches
from ctxval.certificates import CertificateOptions, Dynamics, Sample, require_learned
from ctxval.errors import CertificateError
from ctxval.learning import DynamicsStudy
from facts import refuses
from rig_thorough import more

POINTS = np.linspace(0.05, 0.95, 7)[:, None]


@pytest.mark.slow
def test_only_earlier_trials_are_learned_from() -> None:
    campaign = Campaign(make_validation(), search=searches.Random(), seed=3).run(8)
    dynamics, trials = campaign.recorder.dynamics, campaign.trials
    executed = [(t.unit_point, campaign.store.trajectory(t.number, "system")) for t in campaign.trials[:4]]
    study = DynamicsStudy(campaign.validation, 3)
    expected = study.prediction_of(study.learn(executed), executed)
    assert expected is not None
    np.testing.assert_array_equal(dynamics.expected(trials, POINTS, 4), expected.expected(POINTS)[0])
    assert not np.array_equal(dynamics.expected(trials, POINTS, 4), dynamics.expected(trials, POINTS, 8))
    truth = campaign.validation.distances(campaign.validation.space.from_unit(POINTS))
    assert np.abs(dynamics.expected(trials, POINTS, 8) - truth).max() < 0.05 * np.ptp(truth)


def test_nothing_is_predicted_without_trajectories_and_data() -> None:
    validation = make_validation()
    validation.model.data = None  # type: ignore[attr-defined]
    campaign = Campaign(validation, search=searches.Random(), seed=3).run(1)
    assert np.isnan(campaign.recorder.dynamics.expected(campaign.trials, POINTS, 0)).all()


def test_a_sample_keeps_the_predictions_and_a_kind_asks_for_them() -> None:
    campaign = Campaign(make_validation(), search=searches.Random(), seed=3).run(3)
    learned = campaign.provenance.learned
    sample = Sample.of(campaign.trials, learned=learned)
    assert require_learned(sample.only("iid").rows([0, 1]), "dynamics") is learned
    with refuses(CertificateError, "dynamics"):
        require_learned(Sample.of(campaign.trials), "dynamics")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("labels", "coordinates"),
    [
        (Labels(("angle [rad]", "rate [rad/s]"), ("torque [N m]",)), ["angle [rad]", "rate [rad/s]", "torque [N m]"]),
        *more((Labels(), ["x[0]", "x[1]", "u[0]"])),
    ],
)
def test_evidence_names_states_and_inputs_as_the_experiment_does(labels: Labels, coordinates: list[str]) -> None:
    campaign = Campaign(make_validation().with_parts(labels=labels), search=searches.Random(), seed=1).run(3)
    learned = campaign.provenance_for(CertificateOptions(Dynamics(), 0.5)).learned
    assert learned is not None
    evidence = learned.evidence
    assert evidence is not None
    assert list(evidence.coverage.resolution) == coordinates
    assert set(evidence.coverage.marginal.coordinates) <= set(coordinates)


def test_a_fault_while_learning_is_named_and_not_taken_for_dynamics_that_cannot_be_learned(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def learn(*_: object) -> None:
        raise ZeroDivisionError("no scale")

    campaign = Campaign(make_validation(), search=searches.Random(), seed=3).run(3)
    monkeypatch.setattr(DynamicsStudy, "learn", learn)
    for _ in range(2):
        learned = campaign.provenance_for(CertificateOptions(Dynamics(), 0.5)).learned
        assert learned is not None
        assert (learned.evidence, learned.failure) == (None, "ZeroDivisionError: no scale")


def test_a_result_that_was_replaced_teaches_what_replaced_it() -> None:
    validation = make_validation()
    campaign = Campaign(validation, search=searches.Random(), seed=3)
    opened = campaign.ask({"goal": 1.0})
    right = validation.execute(opened.plan)
    wrong = Trajectory(right.times, right.states * np.linspace(1, 1.1, len(right.states))[:, None], right.inputs)
    campaign.tell(opened, wrong)
    dynamics = campaign.recorder.dynamics
    before = dynamics.learned(campaign.trials)
    assert dynamics.learned(campaign.trials) is before
    campaign.tell(opened.number, right, replace="wrong file")
    after = dynamics.learned(campaign.trials)
    assert before is not None
    assert after is not None
    x_next = after.posterior.data.transitions.x_next
    assert np.isin(right.states[1:], x_next).all()
    assert not np.isin(right.states[1:], before.posterior.data.transitions.x_next).all()


def test_an_undecided_verdict_says_that_learning_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    campaign = Campaign(make_validation(), search=searches.Random(), seed=3).run(3)
    threshold = 2 * max(trial.distance or 0.0 for trial in campaign.trials)
    assert "failed" not in campaign.verdict(threshold).reason

    def fail(*_: object) -> None:
        raise NameError("undefined_in_a_part")

    monkeypatch.setattr(campaign.validation.model, "step", fail)
    verdict = campaign.verdict(threshold)
    assert verdict.answer == "undecided"
    assert "undefined_in_a_part" in verdict.reason
