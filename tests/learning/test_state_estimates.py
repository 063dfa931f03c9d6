"""States of M along recorded outputs, and what is learned of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ctxval import Campaign, TaskSpace, distances
from ctxval.core.system import Outputs
from ctxval.learning import DynamicsStudy
from ctxval.learning.extended import with_states_of_model
from ctxval.learning.replays import replay_executed
from ctxval.learning.state_estimates import smoothed_states
from rig_outputs import Swing, swing, swing_validation
from rig_thorough import more

POINTS = np.array([[-0.8], [-0.2], [0.5], [1.0]])


@pytest.mark.parametrize(("resolution", "noise", "error"), [(0.0, 0.0, 0.01), (0.002, 0.0, 0.03), (0.0, 0.004, 0.1)])
def test_rates_are_estimated_as_well_as_the_records_allow(resolution: float, noise: float, error: float) -> None:
    inputs, states = 2 * np.sin(0.2 * np.arange(150))[:, None], [np.array([0.5, 0.0])]
    for u in inputs:
        states.append(swing(0.4)(states[-1], u))
    truth, rng = np.array(states), np.random.default_rng(0)
    y = truth[:, :1] + noise * rng.normal(size=(len(truth), 1))
    y = np.round(y / resolution) * resolution if resolution else y
    steps = np.diff(truth, axis=0).std(axis=0)
    estimates, errors = smoothed_states(Swing(), Outputs([0]), truth[0], y, inputs, steps, np.logspace(0, -4, 5))
    assert estimates[..., :1] == pytest.approx(np.repeat(y[:, None], len(errors), axis=1), abs=1e-9)
    of_rate = np.sqrt(((estimates[:, :, 1] - truth[:, None, 1]) ** 2).mean(axis=0)) / truth[:, 1].std()
    chosen = int(errors[:, 0].argmin())
    assert of_rate[chosen] < error
    assert of_rate[chosen] < 2 * of_rate.min()


def test_states_that_are_recorded_need_no_estimates() -> None:
    validation = swing_validation(outputs=None)
    assert with_states_of_model(validation) is validation


def executions_of(validation: object) -> list[tuple[np.ndarray, object]]:
    return [(validation.space.to_unit(point), validation.outcome(point).system_trajectory) for point in POINTS]


@pytest.mark.thorough  # a campaign that decides with outputs alone needs these predictions, too
def test_executions_with_outputs_predict_as_well_as_with_states() -> None:
    errors = {}
    for name, validation in {"outputs": swing_validation(), "states": swing_validation(outputs=None)}.items():
        others = np.linspace(-1, 1, 9)[:, None]
        learned = DynamicsStudy(validation).learn(executions_of(validation))
        assert learned is not None
        predicted = learned.expected(validation.space.to_unit(others))
        distances = validation.distances(others)
        errors[name] = np.abs(predicted - distances).max() / distances.max()
        prediction = learned.predict(np.array([0.3]))
        assert prediction is not None
        assert len(prediction.states[0]) == (1 if name == "outputs" else 2)
    assert errors["states"] < 0.02
    assert errors["outputs"] < 0.03


@pytest.mark.slow
@pytest.mark.usefixtures("few_loops")
def test_a_replay_has_the_outputs() -> None:
    validation = swing_validation()
    executed = executions_of(validation)
    (replay,) = replay_executed(validation, DynamicsStudy(validation).learn(executed), [executed[1][0]])
    assert replay is not None
    assert replay.corrected is not None
    assert replay.corrected.states.shape == executed[1][1].states.shape
    assert replay.corrected.states == pytest.approx(executed[1][1].states, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("share", "answer"), [(0.9, "falsified"), *more((1.3, "validated"))])
def test_a_campaign_decides_with_the_angle_alone(share: float, answer: str) -> None:
    validation = swing_validation()
    largest = validation.distances(np.linspace(-1, 1, 41)[:, None]).max()
    campaign = Campaign(validation, seed=0).run(16, threshold=share * largest)
    verdict = campaign.verdict(share * largest)
    assert verdict.answer == answer
    if answer == "validated":
        assert largest <= verdict.bound <= share * largest
        assert "outputs" in str(verdict)


class Fragile:
    """M, which is defined for small rates alone."""

    def step(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        if (np.abs(x[..., 1]) > 1.5).any():
            raise ValueError("too fast")
        return Swing.step(x, u)


def test_states_that_cannot_be_estimated_leave_the_distance_to_be_learned() -> None:
    validation = swing_validation(model=Fragile(), space=TaskSpace(goal=(-0.1, 0.1)), distance=distances.FinalState())
    executed = [(np.array([k / 3]), validation.outcome([0.2 * k / 3 - 0.1]).system_trajectory) for k in range(4)]
    wild = [(point, replace(run, states=run.states + np.linspace(0, 9, 41)[:, None])) for point, run in executed]
    study = DynamicsStudy(validation)
    assert study.learn(executed) is not None
    assert study.learn(wild) is None
    assert study.prediction_of(study.learn(wild), wild) is not None
