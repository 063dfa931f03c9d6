"""The gymnasium adapter on gymnasium's own environments."""

from __future__ import annotations

import concurrent.futures
import pickle
import sys
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

from ctxval import Campaign, Task, TaskSpace, Transitions, Validation, controllers, distances, models, searches, testing
from ctxval._util.arrays import Array
from ctxval._util.describe import describe, first_difference
from ctxval.errors import InputError, ShapeError
from ctxval.systems import Gymnasium
from facts import assert_names, refuses

REACHER = Task([0.5, 0.2, 0.1, 0.1, 0, 0, 0, 0], horizon=20, dt=0.02)
PENDULUM = Task([0.0, 0.1, 0.0, 0.0], horizon=20, dt=0.04)
BALANCE = np.array([0.6, 4.0, 0.7, 0.9])  # a gain that keeps the pendulum up


def damp(t: int, x: Array) -> Array:
    return -0.2 * x[4:6] + 0.1 * np.sin(0.3 * t)


def balance(t: int, x: Array) -> Array:
    return np.array([BALANCE @ x])


def idle(t: int, x: Array) -> Array:
    return np.zeros(1)


def test_an_object_that_is_no_environment_is_refused() -> None:
    class Robot:
        def reset(self) -> None: ...

        def step(self, u: Array) -> None: ...

    with refuses(InputError, "action_space"):
        Gymnasium(Robot())


def test_reacher_moves_as_its_mujoco_model_does() -> None:
    states = Gymnasium("Reacher-v5").execute(damp, REACHER).states
    environment = gymnasium.make("Reacher-v5").unwrapped
    model, data = environment.model, mujoco.MjData(environment.model)
    data.qpos[:], data.qvel[:] = REACHER.initial_state[:4], 0
    for t in range(REACHER.horizon):
        data.ctrl[:] = damp(t, states[t]).astype(np.float32)
        mujoco.mj_step(model, data, environment.frame_skip)
        np.testing.assert_allclose(states[t + 1], np.concatenate([data.qpos, data.qvel]), rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("name", "controller", "task"), [("Reacher-v5", damp, REACHER), ("InvertedPendulum-v5", balance, PENDULUM)]
)
def test_mujoco_environments_keep_the_contract_of_a_system(name: str, controller: Any, task: Task) -> None:
    testing.check_system(Gymnasium(name), controller, task, tolerance=0)


def test_an_environment_is_used_itself_and_copied_for_another_execution_at_the_same_time() -> None:
    environment = gymnasium.make("Reacher-v5")
    system, made = Gymnasium(environment), Gymnasium("Reacher-v5")
    expected = made.execute(damp, REACHER).states
    inner = [np.empty(0)]

    def busy(t: int, x: Array) -> Array:
        if t == 3:
            inner[0] = system.execute(damp, REACHER).states
        return damp(t, x)

    np.testing.assert_array_equal(system.execute(busy, REACHER).states, expected)
    np.testing.assert_array_equal(inner[0], expected)
    described = describe(system)["environment"]
    assert described["id"] == "Reacher-v5"
    assert "ReacherEnv" in str(described["class"])
    with refuses(InputError, "width"):
        Gymnasium(environment, width=100)
    with refuses(InputError, "environment", "SyncVectorEnv"):
        Gymnasium(gymnasium.make_vec("Reacher-v5", num_envs=2))


def test_a_terminated_episode_ends_the_trajectory() -> None:
    trajectory = Gymnasium("InvertedPendulum-v5").execute(idle, PENDULUM)
    assert_names(trajectory.ended, "ended", 7)
    assert np.isfinite(trajectory.states[:8]).all()
    assert abs(trajectory.states[7, 1]) > 0.2  # what the environment calls fallen
    assert np.isnan(trajectory.states[8:]).all()
    assert np.isnan(trajectory.inputs[7:]).all()


def test_termination_can_be_ignored() -> None:
    trajectory = Gymnasium("InvertedPendulum-v5", ignore_termination=True).execute(idle, PENDULUM)
    assert trajectory.ended == "complete"
    assert trajectory.finite


def test_a_time_limit_ends_the_trajectory_only_before_the_horizon() -> None:
    def ended(horizon: int, **options: Any) -> str:
        task = Task(REACHER.initial_state, horizon=horizon, dt=0.02)
        return Gymnasium("Reacher-v5", **options).execute(damp, task).ended

    assert ended(50) == "complete"
    assert_names(ended(51), 50)
    assert ended(51, max_episode_steps=-1) == "complete"


def test_a_simulation_that_mujoco_resets_has_failed(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warnings into the working directory
    task = Task([0.5, 0.2, 0.1, 0.1, 1e12, 0, 0, 0], horizon=20, dt=0.02)
    trajectory = Gymnasium("Reacher-v5").execute(damp, task)
    assert "MuJoCo warned of BADQ" in trajectory.ended
    assert np.isnan(trajectory.states[-1]).all()


# Environments that are not MuJoCo's


def swing_state(environment: Any) -> Any:
    return environment.state


def set_swing_state(environment: Any, x: Array) -> None:
    environment.state = x


def swing(**options: Any) -> Gymnasium:
    return Gymnasium("Pendulum-v1", get_state=swing_state, set_state=set_swing_state, **options)


def test_any_environment_with_a_getter_and_a_setter_will_do() -> None:
    task = Task([2.0, 0.5], horizon=30, dt=0.05)
    system = swing()
    testing.check_system(system, lambda t, x: -x[1:], task, tolerance=0)
    states = system.execute(idle, task).states
    speed = states[:-1, 1] + 0.05 * 15.0 * np.sin(states[:-1, 0])
    np.testing.assert_allclose(states[1:, 1], speed, atol=1e-12)
    np.testing.assert_allclose(states[1:, 0], states[:-1, 0] + 0.05 * speed, atol=1e-12)


def test_a_controller_with_memory_begins_anew_in_every_execution() -> None:
    task = Task([0.3, 0.0], horizon=30, dt=0.05)
    controller = controllers.PID(8.0, 4.0, 1.0, limits=2.0).design(task, models.Linear(np.eye(2), np.ones((2, 1))))
    testing.check_system(swing(), controller, task, tolerance=0)
    executed = swing().execute(controller, task)
    pi = controllers.started(controller, task)
    np.testing.assert_array_equal(executed.inputs, [pi(t, x) for t, x in enumerate(executed.states[:-1])])


def test_the_trajectory_keeps_what_was_asked_for_where_the_environment_clips() -> None:
    task = Task([2.0, 0.5], horizon=3, dt=0.05)
    beyond = swing().execute(lambda t, x: np.array([50.0]), task)
    at_limit = swing().execute(lambda t, x: np.array([2.0]), task)
    assert (beyond.inputs == 50).all()
    np.testing.assert_array_equal(beyond.states, at_limit.states)


def test_a_state_may_hold_more_than_positions_and_velocities() -> None:
    def with_tip(environment: Any) -> Array:
        tip = environment.get_body_com("fingertip")[:2]
        return np.concatenate([environment.data.qpos, environment.data.qvel, tip])

    system = Gymnasium("Reacher-v5", get_state=with_tip)
    assert system.state().shape == (10,)
    start = [0.0, 0.0, 0.1, 0.1, 0, 0, 0, 0]
    assert system.execute(damp, Task([*start, 0.21, 0.0], horizon=5, dt=0.02)).states.shape == (6, 10)
    with refuses(InputError, 0.1):
        system.execute(damp, Task([*start, 0.0, 0.0], horizon=5, dt=0.02))


# What the user may get wrong


def test_the_time_step_must_be_that_of_the_environment() -> None:
    with refuses(InputError, 0.02, 0.05):
        Gymnasium("Reacher-v5").execute(damp, Task(REACHER.initial_state, horizon=3, dt=0.05))
    with refuses(InputError, 0.05, 0.1):
        swing(dt=0.1)
    with refuses(InputError, "None", "dt"):
        Gymnasium("MountainCarContinuous-v0", get_state=swing_state, set_state=set_swing_state)


@pytest.mark.parametrize(
    ("name", "facts"),
    [
        ("Reacher-v99", ("Reacher-v99",)),
        ("no environment", ("no environment", "IDs")),
        ("CartPole-v1", ("Discrete", 2)),
        ("Pendulum-v1", ("get_state", "set_state")),
    ],
)
def test_environments_that_cannot_be_used_are_refused(name: str, facts: tuple[object, ...]) -> None:
    with refuses(InputError, *facts):
        Gymnasium(name)


def test_shapes_must_fit() -> None:
    system = Gymnasium("Reacher-v5")
    with refuses(ShapeError, 8, 4):
        system.execute(damp, Task(np.zeros(4), horizon=3, dt=0.02))
    with refuses(ShapeError, 8, 9):
        system.execute(damp, Task(np.zeros(9), horizon=3, dt=0.02))
    with refuses(ShapeError, 2, (2,), (1,)):
        system.execute(idle, REACHER)
    with refuses(ShapeError, (2,)):
        system.execute(damp, Task(np.zeros((2, 8)), horizon=3, dt=0.02))


def test_an_input_that_is_not_finite_ends_the_trajectory() -> None:
    trajectory = Gymnasium("InvertedPendulum-v5").execute(lambda t, x: np.full(1, np.nan if t == 3 else 0.0), PENDULUM)
    assert_names(trajectory.ended, 4)


def test_without_gymnasium_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with refuses(InputError, "ctxval[mujoco]"):
        Gymnasium("Reacher-v5")


# What a store and other workers see


def test_it_serves_threads_and_other_processes() -> None:
    system = Gymnasium("Reacher-v5")
    alone = system.execute(damp, REACHER).states
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        for trajectory in pool.map(lambda _: system.execute(damp, REACHER), range(12)):
            np.testing.assert_array_equal(trajectory.states, alone)
    other = pickle.loads(pickle.dumps(system))
    np.testing.assert_array_equal(other.execute(damp, REACHER).states, alone)
    system.close()
    np.testing.assert_array_equal(system.execute(damp, REACHER).states, alone)


def test_the_description_tells_environments_apart() -> None:
    assert first_difference(describe(Gymnasium("Reacher-v5")), describe(Gymnasium("Reacher-v5"))) is None
    for other in (Gymnasium("Reacher-v5", seed=1), Gymnasium("InvertedPendulum-v5"), swing()):
        assert first_difference(describe(Gymnasium("Reacher-v5")), describe(other)) is not None


# Validated


def recorded(system: Gymnasium, start: Array, reach: float, runs: int) -> Transitions:
    """Return transitions under random inputs from random states near ``start``."""
    rng = np.random.default_rng(0)
    parts = []
    for _ in range(runs):
        task = Task(start + reach * rng.normal(size=len(start)), horizon=4, dt=system.dt)
        parts.append(system.execute(lambda t, x: 0.3 * rng.normal(size=system.inputs), task).transitions())
    return Transitions.joined(parts)


@pytest.mark.parametrize(
    ("name", "Q", "first"),
    [("InvertedPendulum-v5", [1.0, 10.0, 0.1, 0.1], 0), ("Reacher-v5", [10.0, 10.0, 0, 0, 0.1, 0.1, 0, 0], 0)],
)
def test_a_model_learned_from_an_environment_is_validated_on_it(name: str, Q: list[float], first: int) -> None:
    system = Gymnasium(name, ignore_termination=True)
    n = len(Q)
    reach = 0.03 if n == 4 else 0.1
    model = models.Linear.fit(recorded(system, np.zeros(n), reach, 40))
    offset = np.eye(n)[first]
    validation = Validation(
        space=TaskSpace(goal=(-0.1, 0.1)),
        task=lambda p: Task(0.0 * offset, goal=offset * np.asarray(p.goal)[..., None], horizon=25, dt=system.dt),
        system=system,
        model=model,
        synthesizer=controllers.LQR(Q, [1.0] * system.inputs),
        distance=distances.FinalState(),
    )
    campaign = Campaign(validation, search=searches.Random()).run(4)
    assert not campaign.failed
    assert 0 < max(trial.distance for trial in campaign.trials) < 1.5


def test_a_model_file_is_found_from_every_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asset = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "inverted_pendulum.xml"
    (tmp_path / "mine.xml").write_text(asset.read_text())
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    system = Gymnasium("InvertedPendulum-v5", xml_file="./mine.xml", ignore_termination=True)
    monkeypatch.chdir(tmp_path / "elsewhere")
    task = Task([0.0, 0.01, 0.0, 0.0], horizon=3, dt=system.dt)
    with pytest.raises(ZeroDivisionError):
        system.execute(lambda t, x: 1 / 0, task)  # the environment is not used again
    assert system.execute(lambda t, x: np.zeros(1), task).ended == "complete"
    assert pickle.loads(pickle.dumps(system)).execute(lambda t, x: np.zeros(1), task).ended == "complete"
    assert describe(system)["options"] == {"xml_file": "./mine.xml"}


def test_an_environment_that_cannot_be_closed_hides_no_reason() -> None:
    class Stuck(gymnasium.Env[Any, Any]):
        action_space = gymnasium.spaces.Box(-1, 1, (1,))
        dt = 0.1

        def reset(self, **options: Any) -> Any:
            raise RuntimeError("the motor is off")

        def close(self) -> None:
            raise OSError("the port is gone")

    system = Gymnasium(Stuck, get_state=lambda environment: [0.0], set_state=lambda environment, x: None)
    with refuses(RuntimeError, "motor"):
        system.execute(lambda t, x: np.zeros(1), Task([0.0], horizon=1, dt=0.1))
