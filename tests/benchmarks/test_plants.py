"""The plants of the falsification literature and of robotics: they behave as published, and their maxima hold."""

from __future__ import annotations

import functools
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq, fsolve
from threadpoolctl import threadpool_info

from ctxval import Task, rollout
from ctxval.testing import check_system
from facts import refuses

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import plants  # noqa: E402
import search_plants_part  # noqa: E402
from dynamics_systems import repeated  # noqa: E402
from dynamics_truths import belongs, digest  # noqa: E402
from json_lines import JsonLines  # noqa: E402
from plants import (  # noqa: E402
    DEVELOPMENT,
    PLANTS,
    REPORTING,
    Plant,
    automatic_transmission,
    cart_pole,
    f16,
    fuel_control,
    magnetic_levitation,
    quadrotor,
    six_joint_arm,
    wind_turbine,
)
from plants.base import listed  # noqa: E402
from plants.tables import bilinear, linear  # noqa: E402
from plants.truths import TRUTHS, truth  # noqa: E402
from study_auto import first_within  # noqa: E402
from study_plants import STORED, run, version_of  # noqa: E402

SLOW = ("automatic-transmission", "f16-pull-up", "fuel-control", "magnetic-levitation", "wind-turbine")
EACH = [pytest.param(name, marks=[pytest.mark.thorough] * (name in SLOW)) for name in PLANTS]
"""All plants; those whose executions are slow are executed often by `make thorough` alone."""

experiment = functools.cache(lambda name, seed: PLANTS[name](seed))


def test_at_least_half_of_the_plants_are_only_for_reporting() -> None:
    kinds = [plant.kind for plant in PLANTS.values()]
    assert kinds.count(REPORTING) >= kinds.count(DEVELOPMENT) >= 3


def test_the_declared_table_is_that_of_the_plants() -> None:
    assert plants.__doc__ is not None
    rows = [[cell.strip() for cell in row.split("|")[1:-1]] for row in plants.__doc__.splitlines() if "-D |" in row]
    assert {row[0]: (row[2], row[-1]) for row in rows} == {
        name: (f"{plant.dimension}-D", plant.kind) for name, plant in PLANTS.items()
    }


def test_names_are_unique_and_kinds_known() -> None:
    plant = PLANTS["cart-pole"]
    with refuses(ValueError, "plant"):
        listed(plant, plant)
    with refuses(ValueError, "both"):
        listed(Plant("mist", "both", plant.make, 2, 10))


@pytest.mark.parametrize("name", EACH)
def test_batches_agree_with_single_executions(name: str) -> None:
    validation = experiment(name, 0).validation
    assert validation.batched
    points = validation.space.iid(3, np.random.default_rng(0))
    alone = [validation.outcome(point).distance for point in points]
    assert np.all(np.isfinite(alone))
    np.testing.assert_allclose(validation.distances(points), alone, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("name", EACH)
def test_the_systems_conform_and_the_model_carries_its_data(name: str) -> None:
    found = experiment(name, 0)
    assert found.name == name
    assert found.validation.space.dimension == PLANTS[name].dimension
    plan = found.validation.plan(0.5 * (found.validation.space.low + found.validation.space.high))
    check_system(found.validation.system, plan.controller, plan.task)
    assert len(found.validation.model.data) > 100  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", EACH)
def test_executions_end_well_and_seeds_differ(name: str) -> None:
    first, other = experiment(name, 0).validation, experiment(name, 1).validation
    points = first.space.iid(100, np.random.default_rng(0))
    values = first.distances(points)
    assert np.isfinite(values).all()
    assert values.max() > 1.3 * np.median(values)
    assert np.abs(other.distances(points) - values).max() > 1e-4 * values.max()


# Published behaviour


def test_tables_are_linear_between_and_beyond_their_points() -> None:
    grid, rows = np.array([0.0, 1.0, 3.0]), np.array([0.0, 2.0])
    np.testing.assert_allclose(linear(np.array([0.5, 2.0, 4.0, -1.0]), grid, 3 * grid - 1), [0.5, 5.0, 11.0, -4.0])
    table = rows[:, None] + 10 * grid
    np.testing.assert_allclose(bilinear(np.array([1.0, 3.0]), np.array([2.0, 4.0]), rows, grid, table), [21.0, 43.0])


def test_the_transmission_shifts_at_its_published_speeds_and_reaches_120_mph_in_20_s() -> None:
    x, shifts = np.array([0.0, 1000.0, 1.0]), []
    for _ in range(100):
        after = automatic_transmission.step(x, np.array([100.0, 0.0]))
        shifts += [(x[0], after[0])] * int(after[2] > x[2])
        x = after
    for (low, high), published in zip(shifts, (40, 70, 100), strict=True):
        assert low - 1 < published < high
    # AT1 of the ARCH competition, "below 120 mph for 20 s", is falsified by full throttle, and only just.
    assert 120 < x[0] < 121
    assert automatic_transmission.shifted(np.array([49.0, 2000.0, 3.0]), np.array(100.0)) == 2


def test_fuel_control_rests_at_the_stoichiometric_ratio() -> None:
    def residual(rest: np.ndarray, angle: float, speed: float) -> np.ndarray:
        x = np.array([angle, rest[0], rest[1], rest[2], rest[3], speed])
        return fuel_control.derivative(x, np.array([angle, float(fuel_control.fuel_command(x))]))[1:5]

    for angle in (8.8, 20.0, 45.0):
        for rpm in (900, 1100):
            speed = rpm * fuel_control.RPM
            rest = fsolve(residual, [0.9, 14.7, 0.8, 0.0], args=(angle, speed))
            assert np.abs(residual(rest, angle, speed)).max() < 1e-8
            assert rest[1] == pytest.approx(14.7)
            # The polynomial of the exhaust is that of air over fuel: the integral has nearly nothing to correct.
            assert abs(rest[3]) < 0.02


def test_the_throttle_polynomial_is_that_of_the_published_flow() -> None:
    pressure = np.linspace(0.55, 0.95, 9)
    flow = fuel_control.throttle_flow(np.array(20.0), pressure) / fuel_control.throttle_area(np.array(20.0))
    np.testing.assert_allclose(flow, 2 * np.sqrt(pressure - pressure**2), atol=0.05)


def test_the_aircraft_is_in_trim_where_stevens_and_lewis_say() -> None:
    rates = f16.derivative(np.array(f16.TRIM), np.array(f16.TRIM_INPUT))
    assert np.abs(rates[[0, 1, 3, 4, 5]]).max() < 2e-3

    def residual(z: np.ndarray) -> np.ndarray:
        x = np.array([502.0, z[0], z[0], 0.0, 0.0, 64.94 * z[1]])
        return f16.derivative(x, np.array([z[1], z[2]]))[[0, 1, 3]]

    np.testing.assert_allclose(fsolve(residual, [0.03, 0.2, -1.0]), [0.03691, 0.1385, -0.7588], rtol=4e-3)


def test_the_engine_of_the_aircraft_takes_its_published_time() -> None:
    # From military power upwards and downwards it is fast, 5 /s; below it depends on the gap.
    np.testing.assert_allclose(f16.power_rate(np.array([60.0, 60.0]), np.array([1.0, 0.0])), [5 * 40.0, 5 * -20.0])
    np.testing.assert_allclose(f16.power_rate(np.array([0.0, 40.0]), np.array([1.0, 1.0])), [0.1 * 60.0, 1.0 * 20.0])
    assert f16.thrust(np.array(0.0), np.array(0.0), np.array(0.0)) == 1060
    assert f16.thrust(np.array(50.0), np.array(10000.0), np.array(0.4)) == 6610 + (9312 - 6610)
    assert f16.thrust(np.array(100.0), np.array(0.0), np.array(1.0)) == 28886


def test_the_turbine_holds_its_rated_power_at_the_published_pitch_angles() -> None:
    area = 0.5 * wind_turbine.DENSITY * np.pi * wind_turbine.ROTOR**2
    for wind, published in ((13, 6.60), (15, 10.45), (17, 13.54), (20, 17.47)):
        ratio = np.array(wind_turbine.RATED_SPEED * wind_turbine.ROTOR / wind)

        def surplus(angle: float, wind: float = wind, ratio: np.ndarray = ratio) -> float:
            share = float(wind_turbine.power_coefficient(ratio, np.array(angle)))
            return share * area * wind**3 - wind_turbine.RATED_POWER

        assert np.rad2deg(brentq(surplus, 0.02, 0.45)) == pytest.approx(published, abs=0.15)
        assert np.rad2deg(wind_turbine.steady_pitch(np.array(float(wind)))) == pytest.approx(published)


def test_the_turbine_keeps_its_rated_speed_in_steady_wind() -> None:
    validation = experiment("wind-turbine", 0).validation
    trial = validation.outcome(np.array([15.0, 0.0, 0.0, 10.0, 10.0]))
    speeds = trial.system_trajectory.states[-20:, 0]
    np.testing.assert_allclose(speeds, wind_turbine.RATED_SPEED, rtol=0.01)


def test_the_magnet_floats_where_gravity_and_current_agree() -> None:
    for position in (0.5, 2.0, 4.0):
        current = magnetic_levitation.holding_current(position)
        rates = magnetic_levitation.derivative(np.array([position, 0.0]), np.array([current]))
        np.testing.assert_allclose(rates, 0.0, atol=1e-12)
    # The range of references of the source, 0.5 to 4, needs currents within the limits of the source, 0 to 4.
    assert magnetic_levitation.holding_current(4.0) < magnetic_levitation.LIMIT


def test_the_inversion_follows_where_the_model_is_the_system() -> None:
    validation = experiment("magnetic-levitation", 0).validation
    system = validation.system
    task = magnetic_levitation.lift(validation.space.parameters(np.array([1.0, 0.0, 1.5, 2.5])))
    controller = magnetic_levitation.Inversion().design(task, system.model)
    assert system.execute(controller, task).final_state[0] == pytest.approx(2.5, abs=0.05)


def test_the_quadrotor_meets_the_specification_of_the_competition() -> None:
    # From 0 to a height of 1 m: always below 1.4, above 0.9 after 1 s, and within 0.98 to 1.02 after 5 s.
    step = repeated(experiment("quadrotor-3d", 0).validation.system.model.step, 1)
    task = Task(np.zeros(12), horizon=100, dt=quadrotor.DT)
    heights = rollout(step, lambda t, x: quadrotor.published_control(x, 1.0), task).states[:, 2]
    assert heights.max() < 1.4
    assert heights[20:].min() > 0.9
    assert 0.98 < heights[-1] < 1.02
    assert pytest.approx((1.4, 0.054, 0.104)) == (quadrotor.MASS, quadrotor.ROLL_INERTIA, quadrotor.YAW_INERTIA)


def test_the_cart_pole_obeys_newton() -> None:
    x, u, friction = np.array([0.2, 0.7, -0.4, 1.3]), np.array([3.0]), 0.15
    _, _, moved, turned = cart_pole.derivative(x, u, friction)
    total, moment = cart_pole.CART + cart_pole.POLE, cart_pole.POLE * cart_pole.HALF
    sine, cosine = np.sin(x[1]), np.cos(x[1])
    normal = total * cart_pole.GRAVITY - moment * (turned * sine + x[3] ** 2 * cosine)
    forces = u[0] + moment * (x[3] ** 2 * sine - turned * cosine) - friction * normal * np.tanh(x[2] / 0.01)
    assert total * moved == pytest.approx(forces)
    torque = cart_pole.GRAVITY * sine - moved * cosine - cart_pole.POLE_FRICTION * x[3] / moment
    assert 4 / 3 * cart_pole.HALF * turned == pytest.approx(torque)


def test_the_arm_has_the_published_mass_and_reach() -> None:
    import mujoco

    model = mujoco.MjModel.from_xml_string(six_joint_arm.MJCF)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.body_mass.sum() == pytest.approx(20.6, abs=0.5)
    shoulder, wrist = data.body("upper_arm").xpos, data.body("wrist_1").xpos
    assert (wrist - shoulder)[1] == pytest.approx(0.425 + 0.392)


# Maxima


KERNELS = {one.get("architecture") for one in threadpool_info()}
ROUNDED = set() if {"Haswell", "Zen"} >= KERNELS else {"automatic-transmission", "magnetic-levitation"}
"""Plants whose models are others than with the kernels of the records, because learning amplifies rounding."""


@pytest.mark.parametrize("name", EACH)
def test_the_stored_maximum_belongs_to_the_plant_as_it_is(name: str) -> None:
    found = experiment(name, 0)
    record = TRUTHS[name, 0, digest(PLANTS[name].make)]
    if not belongs(record, found):
        assert name in ROUNDED
        pytest.skip("the model that is learned on this processor is another one than that of the record")
    sample = found.validation.space.iid(100, np.random.default_rng(5))
    assert found.validation.distances(sample).max() <= record["distance"]
    assert truth(PLANTS[name], 0, found) == record


# The study


def test_stored_campaigns_end_within_one_per_cent_or_with_their_budget() -> None:
    assert STORED
    for (case, seed, _, _), result in STORED.items():
        ended = len(result["distances"])
        assert ended <= result["budget"] == PLANTS[case].budget
        assert ended == result["budget"] or first_within(result, 1.0) == ended
        assert result["truth"] in [record["distance"] for record in TRUTHS.select(plant=case, seed=seed)]


@pytest.mark.thorough
def test_a_campaign_is_run_once_and_only_auto_has_versions(tmp_path: Path) -> None:
    results, truths = JsonLines(tmp_path / "plants.jsonl", STORED.key), JsonLines(tmp_path / "truths.jsonl", TRUTHS.key)
    record = TRUTHS["cart-pole", 0, digest(PLANTS["cart-pole"].make)]
    truths.append({**record, "repeats": [0.01]})
    first = run("before", "cart-pole", 0, "random", results, truths)
    assert first["truth"] == record["distance"]
    assert run("after", "cart-pole", 0, "random", results, truths) == first
    assert list(results) == [("cart-pole", 0, "random", "unchanged")]
    assert version_of("auto", "after") == "after"


def test_the_page_lists_every_plant_and_every_seed() -> None:
    text, tables = search_plants_part.part()
    head, rows = search_plants_part.auto_table()
    assert [row[0] for row in rows] == list(PLANTS)
    assert head[2] == "5 %, before"
    assert all(name in text for name in PLANTS)
    assert len(tables["searches-plants-others"][1]) == 3 * len(PLANTS)
    assert search_plants_part.executions({}, 5.0, 25) == "-"
    one = {
        0: {"truth": 1.0, "distances": [0.5, 0.96], "budget": 25},
        2: {"truth": 1.0, "distances": [0.5], "budget": 25},
    }
    assert search_plants_part.executions(one, 5.0, 25) == "> 25 (2, -, > 25, -, -)"
