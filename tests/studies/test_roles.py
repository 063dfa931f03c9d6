"""Which fields are states and which are inputs: by their records first, then by units and names."""

from __future__ import annotations

import numpy as np
import pytest

from ctxval._util.arrays import Array
from ctxval.data import Signal
from ctxval.studies.roles import Evidence, leading, roles

N = 400
RNG = np.random.default_rng(0)
STEPS = np.repeat(RNG.uniform(0, 100, N // 20), 20)  # a command that is held
NOISE = RNG.normal(size=N)  # a command that changes in each step


def plant(u: Array, rate: float = 0.1, start: float = 20.0) -> Array:
    x = np.full(N, start)
    for k in range(N - 1):
        x[k + 1] = x[k] + rate * (start - x[k] + u[k])
    return x


def chosen(**columns: Array) -> tuple[list[str], list[str]]:
    t = np.arange(N) * 1.0
    fields = []
    for label, column in columns.items():
        name, _, unit = label.partition("|")
        fields.append(Evidence(name, unit, [Signal(t, np.asarray(column, dtype=np.float64)[:, None], unit=unit)]))
    return roles(fields)


@pytest.mark.parametrize(
    ("state", "command"),
    [
        ("temperature", "heater"),
        ("T", "valve"),
        ("T1", "Q1"),
        ("foo", "bar"),
        ("level", "pump_speed"),
        ("Druck", "Ventil"),
    ],
)
def test_what_is_held_and_jumps_is_the_input(state: str, command: str) -> None:
    assert chosen(**{state: plant(STEPS), command: STEPS}) == ([state], [command])
    rounded = 0.3 * np.round(plant(STEPS) / 0.3)  # a sensor that repeats its value is none
    assert chosen(**{state: rounded, command: STEPS}) == ([state], [command])


def test_what_leads_the_others_is_the_input_if_nothing_else_tells() -> None:
    x, y = plant(NOISE, 0.3, 0.0), plant(plant(NOISE, 0.3, 0.0), 0.2, 0.0)
    assert chosen(foo=x, bar=NOISE, baz=y) == (["foo", "baz"], ["bar"])
    fields = [Evidence(name, "", [Signal(np.arange(N), column[:, None])]) for name, column in (("a", x), ("b", NOISE))]
    assert leading(fields) == ["b"]
    alone = [Evidence("a", "", [Signal(np.arange(N), NOISE[:, None])])]
    assert leading(alone) == []


def test_a_unit_says_more_than_a_letter() -> None:
    rudder, surge = plant(NOISE, 0.5, 0.0), plant(NOISE, 0.05, 2.0)
    assert chosen(**{"u|m/s": surge, "rudder|deg": STEPS, "r|rad/s": plant(STEPS)}) == (["u|m/s"[:1], "r"], ["rudder"])
    assert chosen(**{"a|N m": rudder, "angle": surge}) == (["angle"], ["a"])
    assert chosen(**{"speed_ref|rad/s": surge, "speed|rad/s": plant(surge)}) == (["speed"], ["speed_ref"])


SLOW, FAST = plant(STEPS, 0.05), plant(RNG.normal(size=N), 0.5, 0.0)
LOGS = {
    "noisy heaters": ({"T1": SLOW + 0.2 * NOISE, "T2": plant(SLOW - 20, 0.05), "Q1": STEPS, "Q2": STEPS[::-1]}, 2),
    "tank": ({"h1|cm": SLOW, "q_in|L/min": STEPS}, 1),
    "ship": ({"u|m/s": SLOW, "v|m/s": plant(STEPS), "r|rad/s": SLOW, "rudder|rad": FAST}, 3),
    "car": ({"speed|m/s": SLOW, "yaw_rate|rad/s": SLOW, "steering_angle|rad": FAST, "throttle|%": STEPS}, 2),
    "drone": ({**dict.fromkeys(("roll", "pitch", "yaw", "p", "q", "r"), SLOW), "m1": STEPS, "m2": STEPS}, 6),
    "arm": ({**dict.fromkeys(("q1", "q2", "dq1", "dq2"), SLOW), "tau1": NOISE, "tau2": NOISE}, 4),
    "reactor": ({"Ca": plant(STEPS), "T": SLOW, "Tc": STEPS}, 2),
    "cooled": ({"T|K": SLOW, "T_cool|K": STEPS}, 1),
    "room": ({"T_room|degC": SLOW, "T_out|degC": np.sin(np.arange(N) / 50), "heating_power|W": STEPS}, 2),
    "commanded speed": ({"position|m": SLOW, "speed|m/s": plant(STEPS), "speed_cmd|m/s": STEPS}, 2),
}


@pytest.mark.parametrize("kind", LOGS)
def test_usual_logs_of_plants_and_robots(kind: str) -> None:
    columns, count = LOGS[kind]
    names = [name.partition("|")[0] for name in columns]
    assert chosen(**columns) == (names[:count], names[count:])


def test_an_index_and_a_second_clock_are_neither_and_a_temperature_beside_motion_is_not_used() -> None:
    k = np.arange(N)
    found = chosen(n=k, Zeit=0.5 * k + 7.0, position=plant(NOISE, 0.05), force=NOISE, temp=plant(STEPS))
    assert found == (["position"], ["force"])
    assert chosen(temp=plant(STEPS), fan=STEPS, k=k) == (["temp"], ["fan"])
