from __future__ import annotations

import numpy as np
import pytest

from ctxval import Task, models, rollout, systems
from ctxval._util.arrays import Array
from ctxval._util.describe import describe
from ctxval.cli.config.parts import part
from ctxval.errors import InputError
from facts import refuses


def step(x: Array, u: Array) -> Array:
    return np.asarray(x + 0.1 * np.concatenate([x[..., 1:], u], axis=-1))


def pi(t: int, x: Array) -> Array:
    return np.asarray(-x[..., :1] - x[..., 1:] + 0.1 * t)


TASK = Task([1.0, 0.0], horizon=20, dt=0.1)


def test_without_imperfections_it_is_the_simulation() -> None:
    run = systems.Imperfect(step, vectorized=True).execute(pi, TASK)
    assert run.states == pytest.approx(rollout(step, pi, TASK).states)


def test_the_controller_acts_on_records_of_an_encoder() -> None:
    run = systems.Imperfect(step, vectorized=True, resolution=[0.25, 0.0]).execute(pi, TASK)
    assert (run.states[:, 0] % 0.25 == 0).all()
    assert run.inputs == pytest.approx(np.stack([pi(t, x) for t, x in enumerate(run.states[:-1])]))


@pytest.mark.parametrize(("delay", "weights"), [(1.0, (0.0, 1.0)), (1.5, (0.0, 0.5, 0.5)), (2.0, (0.0, 0.0, 1.0))])
def test_inputs_act_late(delay: float, weights: tuple[float, ...]) -> None:
    run = systems.Imperfect(step, vectorized=True, delay=delay).execute(pi, TASK)
    padded = np.concatenate([np.zeros((len(weights) - 1, 1)), run.inputs])
    late = sum(w * padded[len(weights) - 1 - k : len(padded) - k] for k, w in enumerate(weights))
    assert run.states[1:] == pytest.approx(step(run.states[:-1], np.asarray(late)))


def test_an_actuator_follows_with_its_time_constant() -> None:
    constant = np.ones(1)
    run = systems.Imperfect(step, vectorized=True, lag=4.0).execute(
        lambda t, x: constant, Task([0.0, 0.0], horizon=9, dt=0.1)
    )
    ends = np.arange(10)  # the mean over each step of what approaches 1
    assert np.diff(run.states[:, 1]) == pytest.approx(0.1 * (1 + 4.0 * np.diff(np.exp(-ends / 4.0))))


def test_noise_has_its_size_and_follows_from_the_seed() -> None:
    noisy = {"process": [0.0, 0.02], "measurement": 0.01, "vectorized": True}
    task = Task(np.zeros((400, 2)), horizon=2, dt=0.1)
    run = systems.Imperfect(step, seed=3, **noisy).execute(lambda t, x: np.zeros((400, 1)), task)
    assert run.states[:, 0].std(axis=0) == pytest.approx([0.01, 0.01], rel=0.2)
    assert run.states[:, 1, 1].std() == pytest.approx(np.hypot(0.02, 0.01), rel=0.2)
    one = systems.Imperfect(step, seed=3, **noisy)
    first, second = (one.execute(pi, TASK).states for _ in range(2))
    assert np.abs(first - second).max() > 1e-3
    assert systems.Imperfect(step, seed=3, **noisy).execute(pi, TASK).states == pytest.approx(first)


def test_executions_start_around_the_initial_state_of_their_task() -> None:
    task = Task(np.full((400, 2), 0.5), horizon=2, dt=0.1)
    run = systems.Imperfect(step, seed=3, start=[0.02, 0.0], vectorized=True).execute(
        lambda t, x: np.zeros((400, 1)), task
    )
    assert run.states[:, 0].mean(axis=0) == pytest.approx([0.5, 0.5], abs=0.005)
    assert run.states[:, 0].std(axis=0) == pytest.approx([0.02, 0.0], rel=0.2)
    assert run.states[:, 1] == pytest.approx(step(run.states[:, 0], np.zeros((400, 1))))


def test_bad_numbers_are_named() -> None:
    with refuses(InputError, "process", [0.1, -1.0]):
        systems.Imperfect(step, process=[0.1, -1.0])
    with refuses(InputError, "delay", -1.0):
        systems.Imperfect(step, delay=-1.0)


def test_weak_motors_and_a_push_change_the_loop() -> None:
    weak = systems.Imperfect(step, vectorized=True, strength=0.5).execute(pi, TASK)
    assert weak.states[1:] == pytest.approx(step(weak.states[:-1], 0.5 * weak.inputs))
    pushed = systems.Imperfect(step, vectorized=True, push={"1": 0.4}, push_time=0.52).execute(pi, TASK)
    moved = pushed.states[:-1] + np.where(np.arange(20) == 5, 0.4, 0.0)[:, None] * [0.0, 1.0]
    assert pushed.states[1:] == pytest.approx(step(moved, pushed.inputs))
    held = systems.Imperfect(step, vectorized=True, delay=1.0, before=0.3).execute(pi, TASK)
    late = np.concatenate([[[0.3]], held.inputs[:-1]])
    assert held.states[1:] == pytest.approx(step(held.states[:-1], late))
    plain = describe(systems.Imperfect(step, vectorized=True))
    assert {"before", "strength", "push", "push_time"} & set(plain) == set()
    assert describe(systems.Imperfect(step, push={0: 1.0}))["push"] == {"0": 1.0}
    with refuses(InputError, "indices"):
        systems.Imperfect(step, push={"speed": 1.0})


def test_a_simulator_is_a_system_with_latency() -> None:
    pytest.importorskip("mujoco")
    mjcf = """<mujoco><option timestep="0.01"/><worldbody><body><joint name="a" damping="0.1"/>
    <geom size="0.1" mass="1" pos="0 0 -0.5"/></body></worldbody><actuator><motor joint="a"/></actuator></mujoco>"""
    system = part("system", {"type": "Imperfect", "step": {"type": "MuJoCo", "mjcf": mjcf, "dt": 0.02}, "delay": 1.0})
    task = Task([1.0, 0.0], horizon=20, dt=0.02)
    run = system.execute(pi, task)
    again = iter([np.zeros(1), *run.inputs])
    assert systems.MuJoCo(mjcf, substeps=2).execute(lambda t, x: next(again), task).states == pytest.approx(run.states)


def test_payload_friction_and_weak_servos_are_changes_of_the_mjcf() -> None:
    pytest.importorskip("mujoco")
    text = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="9 9 1" friction="{mu}"/>
    <body name="sledge" pos="0 0 0.1"><joint name="x" type="slide" axis="1 0 0"/>
    <joint name="z" type="slide" axis="0 0 1"/>
    <geom type="box" size=".1 .1 .1" mass="{mass}" friction="{mu}"/></body></worldbody><actuator>
    <position joint="x" kp="{kp}"/></actuator></mujoco>"""
    usual, other = text.format(mu=0.4, mass=2, kp=50), text.format(mu=0.2, mass=3, kp=40)
    task = Task([0.0, 0.0, 0.3, 0.0], horizon=30, dt=0.02)

    def push(t: int, x: Array) -> Array:
        return np.array([0.5])

    changed = systems.Imperfect(models.MuJoCo(usual, dt=0.02), payload={"sledge": 1.0}, friction=0.5, strength=0.8)
    run = changed.execute(push, task)
    assert run.states == pytest.approx(systems.MuJoCo(other, substeps=2).execute(push, task).states, abs=1e-3)
    plain = systems.MuJoCo(usual, substeps=2).execute(push, task)
    assert np.abs(plain.states - run.states).max() > 0.03
    assert describe(changed)["payload"] == {"sledge": 1.0}
    with refuses(InputError, "wing"):
        systems.Imperfect(models.MuJoCo(usual), payload={"wing": 1.0})
    with refuses(InputError, "MJCF"):
        systems.Imperfect(step, friction=0.5)
