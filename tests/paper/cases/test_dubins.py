from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ctxval import Task, Trajectory, cases, systems
from ctxval.errors import UnknownNameError
from ctxval.paper.cases import dubins
from ctxval.testing import check_model, check_synthesizer, check_system
from facts import refuses

STEP = systems.rk4(dubins.Dubins().derivative, 0.1)


def driven(inputs: list[float], steps: int, start: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the states of the car under constant inputs, shape ``(steps + 1, 3)``."""
    states = [np.array(start)]
    for _ in range(steps):
        states.append(STEP(states[-1], np.array(inputs)))
    return np.array(states)


def arc(v: float, w: float, t: np.ndarray, start: tuple[float, float, float]) -> np.ndarray:
    """Return the exact motion under constant inputs: a circle of radius v / w."""
    y, z, phi = start
    return np.stack(
        [y + v / w * (np.sin(phi + w * t) - np.sin(phi)), z - v / w * (np.cos(phi + w * t) - np.cos(phi)), phi + w * t],
        axis=-1,
    )


# The car


@pytest.mark.parametrize(("v", "w"), [(1.0, 0.5), (2.0, -1.0), (-0.7, 3.0)])
def test_constant_inputs_drive_a_circle(v: float, w: float) -> None:
    start = (0.3, -1.0, 0.8)
    expected = arc(v, w, 0.1 * np.arange(101), start)
    # Runge-Kutta's error, of order (w dt)^4.
    np.testing.assert_allclose(driven([v, w], 100, start), expected, atol=1e-8 + abs(v) * (0.1 * w) ** 4 / 100)


def test_without_turning_it_drives_straight_ahead() -> None:
    states = driven([1.5, 0.0], 20, (0.0, 0.0, np.pi / 6))
    np.testing.assert_allclose(states[-1], [3 * np.cos(np.pi / 6), 1.5, np.pi / 6], rtol=1e-12)


def test_it_turns_on_the_spot_and_cannot_slip_sideways() -> None:
    states = driven([0.0, 0.4], 10, (1.0, 2.0, 0.0))
    np.testing.assert_allclose(states[-1], [1.0, 2.0, 0.4])
    rates = dubins.Dubins().derivative(np.array([0.0, 0.0, 0.9]), np.array([2.0, 1.0]))
    assert rates[0] * np.sin(0.9) - rates[1] * np.cos(0.9) == pytest.approx(0, abs=1e-15)


def test_a_batch_moves_as_its_cars_one_by_one() -> None:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(4, 5, 3)), rng.normal(size=(4, 5, 2))
    batch = STEP(x, u)
    for i in np.ndindex(4, 5):
        np.testing.assert_allclose(batch[i], STEP(x[i], u[i]), rtol=1e-14)
    np.testing.assert_allclose(STEP(x, u[0, 0])[2, 3], STEP(x[2, 3], u[0, 0]), rtol=1e-14)


# The task


def test_the_reference_is_the_papers_formula() -> None:
    rng = np.random.default_rng(1)
    a0, a = 1.3, rng.random(10)
    states = dubins.reference(np.array(a0), a, 100)
    for t in (0, 1, 37, 100):
        y = t * a0 / 100
        z = sum(a[j - 1] * np.sin(2 * np.pi * j * y / a0) for j in range(1, 11))
        np.testing.assert_allclose(states[t], [y, z, 0.0], atol=1e-12)


def test_a_car_that_is_to_stay_at_the_start_has_waves_all_the_same() -> None:
    states = dubins.reference(np.array([0.0, 1e-9]), np.ones((2, 10)), 100)
    assert np.isfinite(states).all()
    assert (states[0, :, 0] == 0).all()
    np.testing.assert_allclose(states[0], states[1], atol=1e-8)


@pytest.mark.parametrize("variant", dubins.VARIANTS)
def test_the_task_space_is_the_papers(variant: str) -> None:
    validation = dubins.experiment(variant=variant).validation
    assert validation.space.dimension == 11
    np.testing.assert_array_equal(validation.space.low, np.zeros(11))
    np.testing.assert_array_equal(validation.space.high, [2.0, *np.ones(10)])
    plan = validation.plan(validation.space.high)
    assert plan.task.horizon == 100
    np.testing.assert_array_equal(plan.task.initial_state, np.zeros(3))
    np.testing.assert_allclose(plan.task.goal, [2.0, 0.0, 0.0], atol=1e-12)


# The model


def test_the_recorded_steps_are_the_cars() -> None:
    settings = dubins.Settings()
    data = dubins.record(dubins.Dubins(), settings, seed=3)
    assert len(data) == settings.samples
    i = 17
    v, w = data.u[i]
    expected = arc(v, w, np.array(settings.dt), tuple(data.x[i]))
    np.testing.assert_allclose(data.x_next[i], expected, atol=1e-8)


def test_the_recorded_states_and_inputs_fill_their_ranges() -> None:
    settings = dubins.Settings(samples=2000)
    data = dubins.record(dubins.Dubins(), settings, seed=0)
    low = np.array([-settings.position, -settings.position, -settings.heading, 0.0, -settings.turn_rate])
    high = np.array([settings.position, settings.position, settings.heading, settings.speed, settings.turn_rate])
    rows = np.concatenate([data.x, data.u], axis=1)
    assert ((rows >= low) & (rows <= high)).all()
    assert (np.ptp(rows, axis=0) > 0.99 * (high - low)).all()


def test_with_many_data_the_model_is_the_least_squares_line_through_the_car() -> None:
    validation = dubins.experiment(settings=dubins.Settings(samples=40_000, turn_rate=1e-6, speed=2.0)).validation
    A, B = validation.model.jacobian(np.zeros(3), np.zeros(2))  # type: ignore[attr-defined]
    # For phi uniform in +-pi/2 and v in [0, 2]: E cos = 2/pi, and E[phi sin phi] / E[phi^2] = (2/pi) / (pi^2/12).
    expected = np.eye(3)
    expected[1, 2] = 0.1 * 24 / np.pi**3
    np.testing.assert_allclose(A, expected, atol=3e-3)
    np.testing.assert_allclose(B[:, 0], [0.1 * 2 / np.pi, 0.0, 0.0], atol=3e-3)


def test_the_seed_draws_the_data_and_so_the_model() -> None:
    data = dubins.experiment(0).validation.model.data
    first, again, other = (dubins.experiment(seed).validation.model.step(data.x, data.u) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other)


# The variants


@pytest.mark.parametrize("variant", dubins.VARIANTS)
def test_every_part_keeps_its_contract(variant: str) -> None:
    validation = dubins.experiment(variant=variant).validation
    batch = validation.task(validation.space.parameters(validation.space.iid(4, np.random.default_rng(0))))
    check_model(validation.model, states=3, inputs=2)
    check_synthesizer(validation.synthesizer, batch, validation.model)
    check_system(validation.system, validation.synthesizer.design(batch[0], validation.model), batch[0])


@pytest.mark.parametrize("variant", dubins.VARIANTS)
def test_a_batch_of_distances_is_the_distances_one_by_one(variant: str) -> None:
    validation = dubins.experiment(variant=variant).validation
    points = validation.space.iid(4, np.random.default_rng(1))
    singles = [validation.outcome(point).distance for point in points]
    np.testing.assert_allclose(validation.distances(points), singles, rtol=1e-6)


def test_the_model_itself_follows_the_slow_waves() -> None:
    # Aspect-1 of the paper's Remark 1: a validation says little where the model cannot do the tasks.
    validation = dubins.experiment().validation
    space = validation.space
    slow = space.point({"end": 1.0, "amplitudes": [1.0] + [0.0] * 9})
    plan = validation.plan(slow)
    gap = np.linalg.norm((plan.model_trajectory.states - plan.task.reference)[:, :2], axis=-1)
    assert gap.mean() < 0.2


def test_the_distances_are_what_their_names_say() -> None:
    rng = np.random.default_rng(2)
    model, system = (Trajectory(np.arange(6.0), rng.normal(size=(6, 3)), np.zeros((5, 2))) for _ in range(2))
    task = Task([0.0, 0.0, 0.0], horizon=5, dt=1.0)
    gap = system.states - model.states
    expected = {
        "printed": np.linalg.norm(gap) / 5,
        "root-mean-square": np.linalg.norm(gap) / np.sqrt(5),
        "mean-deviation": np.linalg.norm(gap[1:, :2], axis=1).mean(),
    }
    assert set(expected) == set(dubins.DISTANCES)
    for name, distance in dubins.DISTANCES.items():
        assert distance(model, system, task) == pytest.approx(expected[name])


def test_the_distance_can_be_chosen_and_then_has_no_threshold() -> None:
    printed, averaged = (dubins.experiment(distance=name) for name in ("printed", "root-mean-square"))
    point = printed.validation.space.high
    assert averaged.validation.outcome(point).distance == pytest.approx(10 * printed.validation.outcome(point).distance)
    assert printed.threshold == dubins.Settings().threshold
    assert averaged.threshold is None


def test_the_papers_threshold_lies_between_what_random_tasks_show_and_what_there_is() -> None:
    experiment = dubins.experiment(distance="root-mean-square")
    space = experiment.validation.space
    random = experiment.validation.distances(space.iid(500, np.random.default_rng(0)))
    worse = space.point({"end": 1.85, "amplitudes": [1, 1, 1, 1, 0.758, 1, 1, 1, 1, 1]})
    assert random.max() < 2 < 3 < experiment.validation.outcome(worse).distance


def test_the_basin_is_worth_70_percent_of_a_better_task_and_no_small_step_leads_out_of_it() -> None:
    validation = dubins.experiment(variant="basin").validation
    space = validation.space
    bottom = space.point({"end": 0.0, "amplitudes": [1, 1, 1, 0, 0, 1, 0, 0, 0, 0.2876]})
    better = space.point({"end": 1.6328, "amplitudes": [1, 1, 1, 0.5761, 1, 1, 1, 1, 1, 1]})
    caught, best = validation.distances(np.stack([bottom, better]))
    assert best == pytest.approx(0.2732, abs=1e-4)
    assert caught / best == pytest.approx(0.70, abs=0.01)
    moves = np.random.default_rng(0).uniform(-0.03, 0.03, (500, 11)) * (space.high - space.low)
    around = np.clip(bottom + moves, space.low, space.high)
    assert validation.distances(around).max() < caught


def test_in_the_heavy_tail_few_tasks_are_far_worse_than_most_and_rounding_decides_none() -> None:
    validation = dubins.experiment(seed=4, variant="heavy-tail").validation
    points = validation.space.iid(3000, np.random.default_rng(0))
    d = validation.distances(points)
    assert 0 < (d > 3 * np.median(d)).mean() < 0.03
    assert 50 * np.median(d) < d.max() < 200 * np.median(d)
    worst = int(d.argmax())
    assert validation.distances(points[worst : worst + 1])[0] == pytest.approx(d[worst], rel=1e-9)


def test_names_nobody_knows_are_refused() -> None:
    with refuses(UnknownNameError, "heavy-tail", "variant"):
        dubins.experiment(variant="heavytail")
    with refuses(UnknownNameError, "distance", "dubins", "furthest"):
        dubins.experiment(distance="furthest")


# As an experiment


def test_it_is_a_case_by_name() -> None:
    experiment = cases.by_name("dubins", seed=1, variant="basin")
    assert experiment.name == "dubins"
    assert experiment.budget == 100
    assert experiment.units == "m"
    assert "dubins" in cases.NAMES


@pytest.mark.slow
@pytest.mark.thorough
def test_its_truth_is_a_best_known_value_kept_in_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    experiment = dubins.experiment(settings=dubins.Settings(horizon=3))
    assert experiment.truth is not None
    truth = experiment.truth()
    random = experiment.validation.distances(experiment.validation.space.iid(500, np.random.default_rng(0)))
    assert truth.distance >= random.max()
    assert len(list((tmp_path / "runs" / "truth").iterdir())) == 1
    assert experiment.truth().distance == truth.distance
