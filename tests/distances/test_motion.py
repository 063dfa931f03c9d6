"""Distances between motions of robots with a floating base."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval import Task, distances, testing
from ctxval._util.arrays import Array
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError, ShapeError
from facts import refuses

H, DT = 20, 0.05
TIMES = DT * np.arange(H + 1)
TASK = Task(np.zeros(13), horizon=H, dt=DT, command=[1.0, 0.0, 0.5])


def turning(speed: float, rate: float, height: float = 0.5) -> Trajectory:
    """Return a base that drives forward with a speed while it turns with a rate."""
    x, yaw = np.zeros((H + 1, 13)), rate * TIMES
    x[:, 2], x[:, 3], x[:, 6] = height, np.cos(yaw / 2), np.sin(yaw / 2)
    x[:, 7], x[:, 8], x[:, 12] = speed * np.cos(yaw), speed * np.sin(yaw), rate
    return Trajectory(TIMES, x, np.zeros((H, 1)))


@pytest.mark.parametrize("over", ["average", "mean", "maximum"])
def test_the_velocity_is_that_of_the_body(over: distances.motion.Over) -> None:
    distance = distances.BodyVelocity(over)
    assert distance(turning(1.0, 0.5), turning(0.8, -2.0), TASK) == pytest.approx(0.2)
    with_yaw = distances.BodyVelocity(over, yaw=0.1)
    assert with_yaw(turning(1.0, 0.5), turning(1.0, -2.0), TASK) == pytest.approx(0.25)


def test_the_average_forgets_what_cancels_and_the_start() -> None:
    model, system = turning(1.0, 0.0), turning(1.0, 0.0)
    system.states[1::2, 7] += 0.3
    system.states[2::2, 7] -= 0.3
    assert distances.BodyVelocity()(model, system, TASK) == pytest.approx(0.0)
    assert distances.BodyVelocity("mean")(model, system, TASK) == pytest.approx(0.3)
    system.states[:11, 7] = 5.0
    assert distances.BodyVelocity(after=0.55)(model, system, TASK) == pytest.approx(0.0)


def test_the_error_is_that_of_the_command() -> None:
    distance = distances.CommandError(yaw=0.2)
    assert distance.to_task
    assert distance(turning(9.0, 9.0), turning(0.7, 0.5), TASK) == pytest.approx(0.3)
    assert distance(turning(9.0, 9.0), turning(1.0, 1.0), TASK) == pytest.approx(0.1)
    with refuses(ShapeError, "2 numbers"):
        distance(turning(1, 1), turning(1, 1), Task(np.zeros(13), horizon=H, dt=DT, command=[1.0, 0.0]))
    with refuses(InputError, "command"):
        distance(turning(1, 1), turning(1, 1), Task(np.zeros(13), horizon=H, dt=DT))


def test_the_angle_is_geodesic() -> None:
    distance = distances.Orientation()
    assert distance(turning(1.0, 0.5), turning(1.0, -0.5), TASK) == pytest.approx(1.0)
    opposite = turning(1.0, 0.5)
    opposite.states[:, 3:7] *= -1
    assert distance(turning(1.0, 0.5), opposite, TASK) == pytest.approx(0.0, abs=1e-12)
    assert distance(turning(1.0, 0.0), turning(1.0, 1e-9), TASK) == pytest.approx(1e-9)
    assert distance(turning(1.0, 0.0), turning(1.0, 1.5 * np.pi), TASK) == pytest.approx(np.pi, rel=0.03)


def test_the_times_of_falls_differ() -> None:
    low = turning(1.0, 0.0)
    low.states[8:, 2] = 0.1
    distance = distances.FallTime(height=0.3)
    assert distance(turning(1.0, 0.0), low, TASK) == pytest.approx((H - 8) * DT)
    assert distance(low, low, TASK) == 0


def test_contacts_last_for_different_times() -> None:
    model, system = turning(1.0, 0.0), turning(1.0, 0.0)
    model.states[5:9, 0], model.states[:, 1] = -1.0, 1.0
    system.states[5:7, 0], system.states[:, 1] = -1.0, 1.0
    system.states[10:16, 1] = -1.0
    model.states[:5, 0] = model.states[9:, 0] = system.states[:5, 0] = system.states[7:, 0] = 1.0
    distance = distances.ContactTime(["left", 1], height=0.02).with_states(("left", *"abcdefghijkl"))
    assert distance(model, system, TASK) == pytest.approx(6 * DT)
    assert distances.ContactTime([0], height=0.02)(model, system, TASK) == pytest.approx(2 * DT)


@pytest.mark.parametrize(
    "distance",
    [
        distances.BodyVelocity(),
        distances.CommandError("mean"),
        distances.ContactTime([7], 0.5),
        distances.Orientation(),
        distances.FallTime(tilt=0.4),
    ],
)
def test_they_keep_the_contract(distance: distances.Distance) -> None:
    def batch(shift: float) -> Trajectory:
        runs = [turning(1.0 + shift, rate, 0.5) for rate in (0.1, 0.5, -0.4)]
        states: Array = np.stack([run.states for run in runs])
        return Trajectory(TIMES, states, np.zeros((3, H, 1)))

    tasks = Task(np.zeros((3, 13)), horizon=H, dt=DT, command=[0.5, 0.0, 0.1])
    testing.check_distance(distance, batch(0.0), batch(0.1), tasks)
