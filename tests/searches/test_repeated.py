from __future__ import annotations

import numpy as np
import pytest

from conftest import make_validation
from ctxval import Campaign, Task, Trajectory
from ctxval._util.arrays import Array
from ctxval.certificates import CertificateOptions, DistanceBound
from ctxval.core.controller import Controller
from ctxval.errors import InputError
from ctxval.searches import GPUCB, Auto, BayesianOptimisation, Random, Repeated, by_name
from ctxval.testing import check_search
from facts import refuses


def peak(Z: Array) -> Array:
    return np.exp(-8 * ((Z - 0.7) ** 2).sum(axis=1))


@pytest.mark.parametrize("inner", [Random(), GPUCB(), BayesianOptimisation(), Auto()])
def test_it_is_a_search(inner: object) -> None:
    check_search(Repeated(inner, 2))  # type: ignore[arg-type]


def test_each_point_is_asked_for_some_times_and_the_mean_is_told() -> None:
    told: list[tuple[Array, Array]] = []

    class Watched(GPUCB):
        def tell(self, points: Array, values: Array) -> None:  # type: ignore[override]
            told.append((np.asarray(points), np.asarray(values)))
            super().tell(points, values)

    search = Repeated(Watched(), 3)
    search.reset(2, 4)
    asked = []
    for k in range(9):
        point = search.ask()
        asked.append(point[0])
        search.tell(point, [float(k)])
    assert len({point.tobytes() for point in asked}) == 3
    assert all(np.array_equal(asked[k], asked[3 * (k // 3)]) for k in range(9))
    np.testing.assert_array_equal(told[-1][1], [1.0, 4.0])


def test_repeating_once_is_the_search_itself() -> None:
    plain, repeated = GPUCB(), Repeated(GPUCB(), 1)
    for search in (plain, repeated):
        search.reset(2, 1)
        for _ in range(9):
            point = search.ask()
            search.tell(point, peak(point))
    np.testing.assert_array_equal(plain.points, repeated.points)


def test_a_failure_counts_as_an_evaluation_and_what_failed_always_has_no_mean() -> None:
    search = Repeated(Random(), 2)
    search.reset(1, 0)
    first = search.ask(2)
    search.tell(first, [np.nan, np.nan])
    second = search.ask(2)
    assert np.array_equal(second[0], second[1])
    assert not np.array_equal(first[0], second[0])


def test_it_finds_the_largest_mean_of_a_noisy_function() -> None:
    rng = np.random.default_rng(0)
    search = Repeated(GPUCB(noise=(1e-4, 0.5)), 3)
    search.reset(1, 0)
    for _ in range(60):
        point = search.ask()
        search.tell(point, peak(point) + 0.1 * rng.normal(size=1))
    means = search.values.reshape(-1, 3).mean(axis=1)
    assert peak(search.points[::3][[means.argmax()]])[0] > 0.9


class Shaky:
    """A system whose last state is not the same twice."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)

    def execute(self, controller: Controller, task: Task) -> Trajectory:
        whole = make_validation().system.execute(controller, task)
        states = whole.states + np.where(np.arange(len(whole.states)) > 0, 0.05 * self.rng.normal(), 0.0)[:, None]
        return Trajectory(whole.times, states, whole.inputs)


@pytest.mark.thorough
def test_a_campaign_estimates_the_largest_mean_distance() -> None:
    campaign = Campaign(
        make_validation(system=Shaky()), search=by_name("bayesian-optimisation", repeats=3), seed=2
    ).run(15)
    goals = np.array([trial.unit_point for trial in campaign.trials]).reshape(5, 3)
    assert (goals == goals[:, :1]).all()
    means = np.array([trial.distance for trial in campaign.trials], dtype=float).reshape(5, 3).mean(axis=1)
    assert campaign.estimate == pytest.approx(means.max())
    by_distance = CertificateOptions(DistanceBound(1.0))
    assert campaign.verdict(50.0, certificate=by_distance).answer == "validated"


@pytest.mark.parametrize("times", [0, -1])
def test_never_is_not_often_enough(times: int) -> None:
    with refuses(InputError, "times"):
        Repeated(Random(), times)
