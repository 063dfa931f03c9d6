from __future__ import annotations

import numpy as np
import pytest

from ctxval import models
from ctxval._util.arrays import Array
from ctxval.learning.histories import History, Record, Structure, jacobian
from ctxval.learning.innovations import FilterFit, LaggedFit, fit_filter, fit_lagged
from ctxval.learning.noise_study import fit_structures

MODEL = models.Linear([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]])
LIVE = np.array([True, True])


def true_step(x: Array, u: Array) -> Array:
    return np.asarray(
        MODEL.step(x, u) + np.stack([0.0 * x[..., 0], -0.03 * x[..., 1] ** 2 + 0.02 * u[..., 0]], axis=-1)
    )


def recorded(
    count: int = 6, *, process: float = 0.0, measurement: float = 0.0, delay: int = 0, steps: int = 30, seed: int = 0
) -> list[Record]:
    rng, records = np.random.default_rng(seed), []
    for _ in range(count):
        x = start = rng.uniform(-1, 1, 2)
        read = x + measurement * rng.standard_normal(2)
        goal, late = rng.uniform(-1, 1), [np.zeros(1)] * delay
        states, inputs = [read], []
        for _ in range(steps):
            u = np.array([-4.0 * (read[0] - goal) - 2.0 * read[1]])
            late.append(u)
            x = true_step(x, late.pop(0)) + process * rng.standard_normal(2)
            read = x + measurement * rng.standard_normal(2)
            states.append(read)
            inputs.append(u)
        records.append(Record(np.array(states), np.array(inputs), start))
    return records


def pairs(records: list[Record]) -> Array:
    return np.concatenate([np.concatenate([each.states[:-1], each.inputs], axis=1) for each in records])


def test_without_lags_the_regressors_are_state_and_input() -> None:
    records = recorded(2)
    Z, E, innovations = History(MODEL, Structure(), np.eye(2)).along(records)
    assert Z.reshape(30, 2, 3)[:, 0] == pytest.approx(
        np.concatenate([records[0].states[:-1], records[0].inputs], axis=1)
    )
    assert innovations == pytest.approx(E)
    assert E.reshape(30, 2, 2)[:, 1] == pytest.approx(
        records[1].states[1:] - MODEL.step(records[1].states[:-1], records[1].inputs)
    )


def test_lags_are_earlier_errors_of_the_model_and_changes_of_the_input() -> None:
    (record,) = recorded(1)
    Z, E, _ = History(MODEL, Structure(2), np.eye(2)).along([record])
    t = 7
    expected = [*record.states[t], *record.inputs[t], *E[t - 1], *(record.inputs[t - 1] - record.inputs[t])]
    expected += [*E[t - 2], *(record.inputs[t - 2] - record.inputs[t - 1])]
    assert Z[t] == pytest.approx(np.array(expected))
    assert Z[0, 3:6] == pytest.approx([0.0, 0.0, -record.inputs[0, 0]])  # at rest before the start


def test_records_of_other_horizons_may_be_mixed() -> None:
    long, short = recorded(2), recorded(1, steps=10)
    Z = History(MODEL, Structure(1), np.eye(2)).along([long[0], *short, long[1]])[0]
    assert len(Z) == 70
    assert Z[:10] == pytest.approx(History(MODEL, Structure(1), np.eye(2)).along(short)[0])


def test_the_gain_is_that_of_a_steady_kalman_filter() -> None:
    ratio, scales = 3.0, np.array([0.1, 0.2])
    K = History.of(MODEL, Structure(0, ratio), scales, (np.zeros(2), np.zeros(1))).gain
    A, Q = np.array([[1.0, 0.1], [0.0, 0.9]]), np.diag(scales**2)
    from scipy.linalg import solve_discrete_are

    P = solve_discrete_are(A.T, np.eye(2), Q, ratio * Q)
    assert pytest.approx(P @ np.linalg.inv(P + ratio * Q), abs=1e-6) == K


def test_noise_is_learned_with_its_size() -> None:
    records = recorded(12, process=0.01, seed=3)
    fit = fit_lagged(History(MODEL, Structure(), np.eye(2)), records, pairs(records), None, LIVE)
    assert fit.noise == pytest.approx([0.01, 0.01], rel=0.15)
    assert (fit.innovations**2).mean(axis=0) == pytest.approx([1.0, 1.0])


def test_the_residual_is_learned_as_a_regression_learns_it() -> None:
    records = recorded(8, process=1e-3, seed=4)
    fit = fit_lagged(History(MODEL, Structure(), np.eye(2)), records, pairs(records), None, LIVE)
    others = recorded(3, seed=5)
    x, u = np.concatenate([each.states[:-1] for each in others]), np.concatenate([each.inputs for each in others])
    truth = true_step(x, u) - MODEL.step(x, u)
    error = fit.residual(np.concatenate([x, u], axis=1)) - truth
    assert (error[:, 1] ** 2).mean() < 0.05 * (truth[:, 1] ** 2).mean()


def test_draws_vary_as_much_as_the_posterior_says() -> None:
    records = recorded(8, process=5e-3, seed=6)
    fit = fit_lagged(History(MODEL, Structure(), np.eye(2)), records, pairs(records), None, LIVE)
    drawn = fit.draw(5, 20, np.random.default_rng(0))
    z = fit.scaled.Z[::5]
    values = np.concatenate([np.stack([features(z) @ w for w in weights]) for features, weights, _ in drawn])
    at = z * fit.scaled.scale + fit.scaled.shift
    truth = true_step(at[:, :2], at[:, 2:]) - MODEL.step(at[:, :2], at[:, 2:])
    z2 = ((values.mean(axis=0) - truth) ** 2).mean(axis=0) / values.var(axis=0).mean(axis=0)
    assert z2[0] < 4  # a state that has no residual
    assert 0.05 < z2[1] < 4


def test_a_delay_is_found_as_lags_that_leave_no_noise() -> None:
    records = recorded(8, delay=1)
    fit, chosen = fit_structures(MODEL, records, pairs(records), np.array([False, True]))
    assert isinstance(fit, LaggedFit)
    assert chosen.structure.lags >= 1
    assert fit.share < 1e-3


def test_measurement_noise_is_found_as_a_filter() -> None:
    records = recorded(10, measurement=0.02, seed=1)
    fit, chosen = fit_structures(MODEL, records, pairs(records), LIVE)
    assert isinstance(fit, FilterFit)
    assert chosen.structure.ratio > 0
    again, same = fit_structures(MODEL, records, pairs(records), LIVE, chosen)
    assert same is chosen
    assert again.weights == pytest.approx(fit.weights)


def test_the_sensitivities_of_a_filter_are_derivatives() -> None:
    from ctxval.learning.innovations import _sensitivities

    records = recorded(2, measurement=0.02, steps=12)
    plain = fit_lagged(History(MODEL, Structure(), np.eye(2)), records, pairs(records), None, LIVE)
    history = History.of(MODEL, Structure(0, 3.0), plain.noise, (np.zeros(2), np.zeros(1)))
    fit = fit_filter(history, records, pairs(records), plain)
    _, G = _sensitivities(history, records, fit.features, fit.scaled, fit.weights)
    for k in (0, 7, fit.weights.size - 1):
        moved = []
        for sign in (1, -1):
            weights = fit.weights.copy()
            weights.flat[k] += sign * 1e-5
            moved.append(_sensitivities(history, records, fit.features, fit.scaled, weights)[0])
        derivative = -(moved[0] - moved[1]) / 2e-5  # the innovation falls as the prediction rises
        assert G[:, :, k] == pytest.approx(derivative, rel=1e-3, abs=1e-5)


def test_noise_beyond_an_edge_has_its_size_there_and_is_none_elsewhere() -> None:
    records = list[Record]()
    for k in range(10):
        rng = np.random.default_rng([2, k])
        states, inputs, goal = [rng.uniform(-1, 1, 2)], [], rng.uniform(-1, 1)
        for _ in range(60):
            x = states[-1]
            inputs.append(np.array([-4.0 * (x[0] - goal) - 2.0 * x[1]]))
            noise = 0.1 if x[0] > 0.5 else 0.0
            states.append(true_step(x, inputs[-1]) + noise * np.array([0.0, rng.standard_normal()]))
        records.append(Record(np.array(states), np.array(inputs), states[0]))
    live = np.array([False, True])
    fit = fit_lagged(History(MODEL, Structure(), np.eye(2)), records, pairs(records), None, live)
    assert fit.local is not None
    drawn = fit.noise[1] * fit.local(fit.scaled.Z[:, :3])
    beyond = fit.scaled.Z[:, 0] * fit.scaled.scale[0] + fit.scaled.shift[0] > 0.5
    # One pass alone gives 0.05 beyond: the few innovations there are then among many that are nearly 0.
    assert np.sqrt((drawn[beyond] ** 2).mean()) == pytest.approx(0.1, rel=0.15)
    assert np.median(drawn[~beyond]) < 0.01
    assert (fit.innovations[beyond, 1] ** 2).mean() == pytest.approx(1.0, rel=0.3)


def test_a_jacobian_is_the_derivative() -> None:
    x = np.array([[0.3, -0.2], [1.0, 0.5]])
    J = jacobian(lambda y: np.stack([y[..., 0] * y[..., 1], np.sin(y[..., 1])], axis=-1), x, np.full(2, 1e-5))
    assert J[0] == pytest.approx(np.array([[-0.2, 0.3], [0.0, np.cos(-0.2)]]), abs=1e-8)
