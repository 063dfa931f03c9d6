"""The case of the linear systems: exact steps, tame closed loops, and a truth that enumeration confirms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov
from scipy.signal import cont2discrete

from ctxval import Campaign, TaskSpace, Truth, cases, systems
from ctxval.errors import InputError, UnknownNameError
from ctxval.paper.cases import linear
from facts import refuses

ALL = list(linear.DIMENSIONS)


def true_worst(seed: int, dim: int) -> Truth:
    truth = linear.experiment(seed, dim).truth
    assert truth is not None
    return truth()


def random_system(seed: int, n: int = 4, m: int = 3) -> linear.LinearSystem:
    rng = np.random.default_rng(seed)
    return linear.LinearSystem(rng.normal(size=(n, n)), rng.normal(size=(n, m)))


def test_the_step_is_that_of_a_held_input() -> None:
    system = random_system(0)
    step = system.discretised(0.3)
    A, B, *_ = cont2discrete((system.A, system.B, np.eye(4), np.zeros((4, 3))), 0.3)
    np.testing.assert_allclose(step.A, A, atol=1e-13)
    np.testing.assert_allclose(step.B, B, atol=1e-13)


def test_the_step_is_the_limit_of_many_small_ones() -> None:
    system = random_system(1)
    small = systems.rk4(lambda x, u: x @ system.A.T + u @ system.B.T, 0.2 / 200)
    x, u = np.ones((5, 4)), np.arange(15.0).reshape(5, 3)
    expected = x
    for _ in range(200):
        expected = small(expected, u)
    np.testing.assert_allclose(system.discretised(0.2).step(x, u), expected, rtol=1e-10)


@pytest.mark.parametrize("dim", ALL)
def test_both_closed_loops_decay(dim: int) -> None:
    for seed in range(10):
        validation = linear.experiment(seed, dim).validation
        gain = validation.synthesizer.policy.gain
        for step in (validation.system.model, validation.model):
            assert np.abs(np.linalg.eigvals(step.A + step.B @ gain)).max() < 0.99


@pytest.mark.parametrize("seed", range(5))
def test_a_drawn_system_decays_at_least_as_fast_as_asked(seed: int) -> None:
    rng, settings = np.random.default_rng(seed), linear.Settings(decay=0.7)
    gain = rng.normal(size=(3, 3))
    system = linear.draw(rng, gain, settings)
    closed = system.A + system.B @ gain + 0.6 * np.eye(3)
    # A Lyapunov function exists exactly if the shifted loop is still stable.
    assert np.linalg.eigvalsh(solve_continuous_lyapunov(closed.T, -np.eye(3))).min() > 0


def test_a_draw_that_decays_by_itself_is_left_alone() -> None:
    gain = -100 * np.eye(1)
    settings = linear.Settings()
    drawn = [linear.draw(np.random.default_rng(seed), gain, settings) for seed in range(20)]
    raw = [np.random.default_rng(seed).normal(size=2) for seed in range(20)]
    stable = [i for i, (a, b) in enumerate(raw) if a - 100 * b < -settings.decay]
    assert 0 < len(stable) < 20
    assert all(drawn[i].A.item() == raw[i][0] for i in stable)
    assert all(drawn[i].A.item() < raw[i][0] for i in set(range(20)) - set(stable))


@pytest.mark.parametrize("dim", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_closed_form_is_the_largest_distance_of_all_vertices(dim: int, seed: int) -> None:
    validation = linear.experiment(seed, dim).validation
    vertices = validation.space.grid(2)
    assert len(vertices) == 4**dim
    assert true_worst(seed, dim).distance == pytest.approx(validation.distances(vertices).max(), abs=1e-10)


@pytest.mark.parametrize("dim", ALL)
def test_the_closed_form_is_attained_and_never_exceeded(dim: int) -> None:
    validation, truth = linear.experiment(2, dim).validation, true_worst(2, dim)
    attained = validation.distances(truth.parameters.points[None])
    assert attained[0] == pytest.approx(truth.distance, abs=1e-10)
    assert validation.distances(validation.space.iid(500, np.random.default_rng(0))).max() < truth.distance
    assert f"{2**dim} sign vectors" in truth.method


@pytest.mark.parametrize("seed", range(5))
def test_the_closed_form_holds_on_any_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.normal(size=6)
    space = TaskSpace(p=(low, low + rng.uniform(0.1, 2, size=6)))
    C = rng.normal(size=(3, 6))
    truth = linear.largest_norm(C, space)
    assert truth.distance == pytest.approx(np.abs(space.grid(2) @ C.T).sum(axis=1).max(), rel=1e-12)
    assert truth.distance == pytest.approx(np.abs(C @ truth.parameters.points).sum(), rel=1e-12)


def test_the_final_state_map_is_the_closed_loop() -> None:
    validation = linear.experiment(3, 3).validation
    points = validation.space.iid(7, np.random.default_rng(0))
    C = linear.final_state_map(validation.model, validation.synthesizer.policy.gain, linear.Settings().horizon)
    finals = [validation.plan(point).model_trajectory.final_state for point in points]
    np.testing.assert_allclose(points @ C.T, finals, atol=1e-12)


def test_a_batch_of_distances_is_the_loop_over_tasks() -> None:
    validation = linear.experiment(0, 4).validation
    points = validation.space.iid(9, np.random.default_rng(1))
    loop = [validation.outcome(point).distance for point in points]
    np.testing.assert_allclose(validation.distances(points), loop, rtol=1e-12)


def test_the_seed_draws_everything() -> None:
    first, again, other = (linear.experiment(seed, 3).validation for seed in (0, 0, 1))
    assert first.describe() == again.describe()
    np.testing.assert_raises(AssertionError, np.testing.assert_allclose, first.model.A, other.model.A)
    np.testing.assert_raises(AssertionError, np.testing.assert_allclose, first.model.A, first.system.model.A)


@pytest.mark.parametrize("dim", ALL)
def test_the_task_space_has_the_initial_and_the_final_state(dim: int) -> None:
    space = cases.by_name("linear", dim=dim).validation.space
    assert space.dimension == 2 * dim
    p = space.parameters(np.arange(2.0 * dim))
    assert p.x_init.tolist() == list(range(dim))
    assert p.x_final.tolist() == list(range(dim, 2 * dim))


@pytest.mark.parametrize("dim", [0, 11, -1, 2.0, True, "4", None])
def test_a_dimension_that_the_paper_has_not_is_refused(dim: object) -> None:
    with refuses(InputError, 1, 10):
        linear.experiment(0, dim)  # type: ignore[arg-type]


def test_an_unknown_option_is_refused_with_the_nearest() -> None:
    with refuses(UnknownNameError, "dim", "linear"):
        cases.by_name("linear", dims=3)


@pytest.mark.slow
def test_a_campaign_finds_the_worst_task_and_falsifies() -> None:
    case = linear.experiment(0, 2)
    campaign = Campaign(case.validation).run(6, explore=True)
    assert campaign.estimate is not None
    assert 0.95 * true_worst(0, 2).distance <= campaign.estimate <= true_worst(0, 2).distance + 1e-10
    assert case.threshold == 0.5
    assert campaign.verdict(case.threshold).answer == "falsified"
