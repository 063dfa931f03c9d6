from __future__ import annotations

from typing import Any

import pytest

from ctxval import Task, systems
from ctxval.errors import ExecutionError, InputError
from facts import refuses

CART: dict[str, Any] = {"states": {"position": "m", "speed": "m/s"}, "inputs": {"force": "N"}, "dt": 0.1}


def test_executing_says_what_to_do_instead() -> None:
    system = systems.Manual(**CART)
    assert isinstance(system, systems.System)
    assert system.manual
    with refuses(ExecutionError, "campaign.ask", "campaign.tell"):
        system.execute(lambda t, x: x, Task([0.0, 0.0], horizon=3, dt=0.1))


def test_it_carries_what_files_need() -> None:
    system = systems.Manual(**CART)
    assert list(system.states) == ["position", "speed"]
    assert system.inputs == {"force": "N"}
    assert system.dt == 0.1


@pytest.mark.parametrize("change", [{"states": {}}, {"inputs": {"force": 3}}, {"dt": 0}, {"dt": None}])
def test_what_makes_no_sense_is_refused(change: dict[str, Any]) -> None:
    with refuses(InputError, *change):
        systems.Manual(**{**CART, **change})
