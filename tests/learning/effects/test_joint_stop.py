"""Stops of joints."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ctxval import Array, models
from ctxval.learning import effects
from ctxval.learning.effects import Joint, ModelWithEffects
from ctxval.learning.effects.joint_stop import seen_stops

DT = 0.02
JOINT = Joint(rate=1, position=0, share=1.0, input=0)
SERVO = models.Linear([[1 - 50 * DT**2, DT * (1 - 15 * DT)], [-50 * DT, 1 - 15 * DT]], [[50 * DT**2], [50 * DT]])
STOP: dict[str, Any] = {"joint": JOINT, "dt": DT}


def run(model: Any, commands: Array) -> Array:
    """Return the states ``(H + 1, 2)`` under commanded positions ``(H,)``."""
    states = [np.zeros(2)]
    for command in commands:
        states.append(model.step(states[-1], np.array([command])))
    return np.stack(states)


COMMANDS = 1.5 * np.sin(1.3 * DT * np.arange(500))


@pytest.mark.parametrize("upper", [True, False])
def test_a_joint_does_not_go_beyond_its_stop_and_leaves_it_at_once(upper: bool) -> None:
    sign = 1.0 if upper else -1.0
    stopped = ModelWithEffects(SERVO, (effects.JointStop((sign * 0.8,), upper=upper, **STOP),))
    free, held = (sign * run(model, sign * COMMANDS) for model in (SERVO, stopped))
    assert free[:, 0].max() > 1.1
    assert held[:, 0].max() == 0.8
    at = held[:, 0] == 0.8
    assert at.sum() > 20
    np.testing.assert_allclose(held[1:][at[1:] & at[:-1], 1], 0.0, atol=1e-12)
    assert (held[:, 0] < -1.1).any()


def test_a_soft_stop_lies_between_none_and_a_hard_one() -> None:
    ends = []
    for stiffness in (0.0, 50.0, 1e3, 1e9):
        soft = effects.JointStop((0.8, stiffness), soft=True, **STOP)
        ends.append(run(ModelWithEffects(SERVO, (soft,)), COMMANDS)[:, 0].max())
    hard = run(ModelWithEffects(SERVO, (effects.JointStop((0.8,), **STOP),)), COMMANDS)[:, 0].max()
    assert ends[0] == pytest.approx(run(SERVO, COMMANDS)[:, 0].max())
    assert ends[0] > ends[1] > ends[2] > hard
    assert ends[3] == pytest.approx(hard, abs=1e-6)
    # At rest under a held command, the servo's stiffness of 50 and the stop's share what the stop keeps it from.
    resting = run(ModelWithEffects(SERVO, (effects.JointStop((0.8, 150.0), soft=True, **STOP),)), np.full(2000, 1.2))
    assert resting[-1, 0] == pytest.approx(0.8 + 0.4 * 50 / 200, rel=1e-3)


def test_recordings_show_a_stop_and_no_friction() -> None:
    stopped = ModelWithEffects(SERVO, (effects.JointStop((-0.8,), upper=False, **STOP),))
    sticking = ModelWithEffects(SERVO, (effects.Coulomb((0.3,), JOINT, 0.1, DT),))
    rng = np.random.default_rng(0)
    for system, count in ((stopped, 1), (sticking, 0), (SERVO, 0)):
        x = [run(system, scale * COMMANDS) + 1e-4 * rng.normal(size=(501, 2)) for scale in (0.4, 1.0)]
        given = [scale * COMMANDS[:, None] for scale in (0.4, 1.0)]
        following = [SERVO.step(run[:-1], u) for run, u in zip(x, given, strict=True)]
        found = list(seen_stops([JOINT], x, following, DT))
        assert len(found) == count
    (stop,) = seen_stops([JOINT], *_of(stopped), DT)
    assert stop.effect.sizes == pytest.approx((-0.8,))
    assert not stop.effect.upper  # type: ignore[attr-defined]


def _of(system: Any) -> tuple[list[Array], list[Array]]:
    x = run(system, COMMANDS)
    return [x], [SERVO.step(x[:-1], COMMANDS[:, None])]
