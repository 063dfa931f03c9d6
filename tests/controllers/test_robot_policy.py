"""A trained policy of a robot on states of MuJoCo: what it observes, and what its actions do."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import Campaign, Task, TaskSpace, Validation, distances, models, systems, testing
from ctxval._util.arrays import Array
from ctxval._util.describe import describe
from ctxval.controllers import Action, PolicyContract, RobotPolicy, Term
from ctxval.controllers.policy_contract import TermName
from ctxval.errors import InputError, ShapeError
from facts import refuses
from go1_robot import START, go1_contract, go1_mjcf

pytest.importorskip("mujoco")

# A body with two legs, whose joints have another order than those of the policy, and actuators have a third one.
MJCF = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="5 5 0.1"/>
<body name="trunk" pos="0 0 0.4"><freejoint/><geom type="box" size="0.2 0.1 0.05" mass="4"/>
  <body pos="0.2 0 0"><joint name="front" axis="0 1 0" damping="0.5" armature="0.01"/>
    <geom type="capsule" fromto="0 0.15 0 0 0.15 -0.3" size="0.03" mass="0.5"/>
    <geom type="capsule" fromto="0 -0.15 0 0 -0.15 -0.3" size="0.03" mass="0.5"/></body>
  <body pos="-0.2 0 0"><joint name="back" axis="0 1 0" damping="0.5" armature="0.01"/>
    <geom type="capsule" fromto="0 0.15 0 0 0.15 -0.3" size="0.03" mass="0.5"/>
    <geom type="capsule" fromto="0 -0.15 0 0 -0.15 -0.3" size="0.03" mass="0.5"/></body>
</body></worldbody><actuator>{actuators}</actuator></mujoco>"""
SERVOS = '<position joint="front" kp="60" kv="2"/><position joint="back" kp="60" kv="2"/>'
MOTORS = '<motor joint="front"/><motor joint="back"/>'
X0 = [0.0, 0.0, 0.34, 1.0, 0.0, 0.0, 0.0, 0.1, -0.1, *[0.0] * 8]
TERMS: tuple[TermName, ...] = (
    "linear_velocity", "angular_velocity", "gravity", "joint_errors", "joint_rates", "last_action", "command",
)  # fmt: skip
WIDTH = 9 + 3 * 2 + 2


def weights(path: Path, inputs: int = WIDTH, outputs: int = 2, seed: int = 0, **texts: str) -> Path:
    rng = np.random.default_rng(seed)
    arrays: dict[str, Any] = {"W0": 0.3 * rng.normal(size=(8, inputs)), "b0": 0.1 * rng.normal(size=8)}
    arrays |= {"W1": 0.3 * rng.normal(size=(outputs, 8)), **{name: np.array(text) for name, text in texts.items()}}
    np.savez(path, **arrays)
    return path


def contract(folder: Path, **changed: Any) -> PolicyContract:
    given: dict[str, Any] = {
        "network": changed.get("network") or weights(folder / "policy.npz"),
        "observation": [Term(name) for name in TERMS],
        "dt": 0.02,
        "joints": ["back", "front"],
        "default": [-0.1, 0.1],
        "action": Action(scale=[0.3, 0.4]),
    }
    return PolicyContract(**{**given, **changed})


def states(count: int) -> Array:
    x = np.random.default_rng(1).normal(size=(count, 17))
    x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
    return x


def task(count: int = 3, horizon: int = 20, dt: float = 0.02) -> Task:
    start = np.array(X0) + 0.02 * np.random.default_rng(2).normal(size=(count, 17))
    return Task(start, horizon=horizon, dt=dt, command=[np.linspace(-1, 1, count), 0.3])


def recorded(policy: RobotPolicy, of: Task, xs: Array) -> tuple[Array, list[Array]]:
    """Return the inputs ``(H, ..., m)`` along states ``(H, ..., n)``, and what the network observed."""
    seen, network = list[Array](), policy.network.outputs

    class Watching:
        widths, width = policy.network.widths, policy.network.width

        def outputs(self, *inputs: Array) -> list[Array]:
            seen.append(inputs[0])
            return network(*inputs)

    policy.network = Watching()  # type: ignore[assignment]
    controller = policy.design(of, None)  # type: ignore[arg-type]
    memory, us = controller.start(of), []
    for t, x in enumerate(xs):
        u, memory = controller.step(t, x, memory)
        us.append(u)
    return np.array(us), seen


def test_observations_have_the_order_of_the_policy_and_actions_that_of_the_actuators(tmp_path: Path) -> None:
    policy = RobotPolicy(contract(tmp_path), mjcf=MJCF.format(actuators=SERVOS))
    xs, of = states(6).reshape(2, 3, 17), task(3)
    us, seen = recorded(policy, of, xs)
    base = policy.base
    a = np.zeros((3, 2))
    for t in range(2):
        x = xs[t]
        errors, rates = x[:, [8, 7]] - [-0.1, 0.1], x[:, [16, 15]]
        parts = [base.linear_velocity(x), base.angular_velocity(x), base.gravity(x), errors, rates, a, of.command]
        assert seen[t] == pytest.approx(np.concatenate(parts, axis=1))
        arrays = np.load(policy.contract.network)
        a = np.tanh(seen[t] @ arrays["W0"].T + arrays["b0"]) @ arrays["W1"].T
        targets = [-0.1, 0.1] + a * [0.3, 0.4]
        assert us[t] == pytest.approx(targets[:, [1, 0]])


def test_terms_are_clipped_moved_and_scaled_and_keep_their_history(tmp_path: Path) -> None:
    terms = [
        Term("joint_rates", scale=0.5, clip=1.0, offset=[0.1, -0.1], history=3),
        Term("clock", period=0.08, phases=[0.0, 0.25], order="cos sin"),
        Term("states", values=[2, 0]),
        Term("constant", values=[4.0]),
        Term("height", scale=2.0),
        Term("quaternion"),
        Term("joint_positions"),
    ]
    width = 6 + 4 + 2 + 1 + 1 + 4 + 2
    network = weights(tmp_path / "terms.npz", width)
    policy = RobotPolicy(contract(tmp_path, network=network, observation=terms))
    xs = states(4)
    of = Task(X0, horizon=4, dt=0.02)
    _, seen = recorded(policy, of, xs)
    rates = 0.5 * (np.clip(xs[:, 15:], -1, 1) - [0.1, -0.1])
    assert seen[0][:6] == pytest.approx(np.tile(rates[0], 3))
    assert seen[3][:6] == pytest.approx(rates[1:].reshape(-1))
    phase = 2 * np.pi * np.array([3 * 0.02 / 0.08, 3 * 0.02 / 0.08 + 0.25])
    assert seen[3][6:10] == pytest.approx(np.concatenate([np.cos(phase), np.sin(phase)]))
    assert seen[2][10:14] == pytest.approx([xs[2, 2], xs[2, 0], 4.0, 2 * xs[2, 2]])
    assert seen[2][14:] == pytest.approx([*xs[2, 3:7], *xs[2, 7:9]])


@pytest.mark.parametrize(("order", "start"), [("oldest first", "zero"), ("newest first", "first")])
def test_whole_observations_are_kept(tmp_path: Path, order: str, start: str) -> None:
    network = weights(tmp_path / "w.npz", 6)
    parts = {"network": network, "observation": [Term("joint_rates")], "history": 3, "clip": 0.5}
    policy = RobotPolicy(contract(tmp_path, history_order=order, history_start=start, **parts))
    xs = states(3)
    _, seen = recorded(policy, Task(X0, horizon=4, dt=0.02), xs)
    rates = np.clip(xs[:, 15:], -0.5, 0.5)
    before = rates[0] if start == "first" else np.zeros(2)
    second = [before, rates[0], rates[1]] if order == "oldest first" else [rates[1], rates[0], before]
    assert seen[1] == pytest.approx(np.concatenate(second))


def test_torques_follow_in_each_step_and_actions_in_some(tmp_path: Path) -> None:
    action = Action(target="torque", scale=0.5, clip=0.2, kp=[30.0, 20.0], kd=0.5, limits=4.0)
    parts = contract(tmp_path, action=action, decimation=2, latency=0.01, observation=[Term("joint_errors")],
                     network=weights(tmp_path / "t.npz", 2))  # fmt: skip
    policy = RobotPolicy(parts, mjcf=MJCF.format(actuators=MOTORS))
    xs, of = states(5), Task(X0, horizon=5, dt=0.01)
    us, seen = recorded(policy, of, xs)
    assert len(seen) == 3
    actions = [np.clip(policy.network.outputs(each)[0], -0.2, 0.2) for each in seen[:3]]
    acting = [np.zeros(2), actions[0], actions[0], actions[1], actions[1]]
    for x, a, u in zip(xs, acting, us, strict=True):
        torques = np.array([30.0, 20.0]) * (np.array([-0.1, 0.1]) + 0.5 * a - x[[8, 7]]) - 0.5 * x[[16, 15]]
        assert u == pytest.approx(np.clip(torques, -4, 4)[[1, 0]])


def test_limits_of_actions_are_those_of_controllers(tmp_path: Path) -> None:
    with refuses(InputError, "limits", "[[low, high], ...]"):
        Action(limits=[4.0, 2.0])
    policy = RobotPolicy(
        contract(tmp_path, action=Action(limits=[[-0.1, 0.2], [0.05, 0.3]])), mjcf=MJCF.format(actuators=SERVOS)
    )
    us, _ = recorded(policy, Task(X0, horizon=5, dt=0.02, command=[0.5, 0.3]), states(5))
    assert ((us[:, [1, 0]] >= [-0.1, 0.05]) & (us[:, [1, 0]] <= [0.2, 0.3])).all()


def test_it_keeps_the_contract_of_a_synthesizer(tmp_path: Path) -> None:
    mjcf = MJCF.format(actuators=SERVOS)
    policy = RobotPolicy(contract(tmp_path), mjcf=mjcf)
    testing.check_synthesizer(policy, task(4, horizon=5), models.MuJoCo(mjcf, dt=0.02))
    whole, system = task(4), systems.MuJoCo(mjcf, substeps=2)
    together = system.execute(policy.design(whole, None), whole)  # type: ignore[arg-type]
    assert together.finite.all()
    for k in range(4):
        alone = system.execute(policy.design(whole, None)[k], whole[k])  # type: ignore[arg-type]
        assert alone.states == pytest.approx(together.states[k], abs=1e-9)
    # Draws are one more axis in front of the batch.
    drawn = whole.starting_at(np.stack([whole.initial_state] * 2))
    assert system.execute(policy.design(whole, None), drawn).states[1] == pytest.approx(together.states, abs=1e-9)  # type: ignore[arg-type]
    again = pickle.loads(pickle.dumps(policy))
    assert describe(again) == describe(policy)


def test_mujoco_as_model_and_as_system_is_validated_with_a_policy(tmp_path: Path) -> None:
    mjcf = MJCF.format(actuators=SERVOS)
    parts = Validation(
        space=TaskSpace(speed=(-1.0, 1.0), turn=(-1.0, 1.0)),
        task=lambda p: Task(X0, horizon=15, dt=0.02, command=[p.speed, p.turn]),
        system=systems.MuJoCo(mjcf.replace('mass="4"', 'mass="5"'), substeps=2),
        model=models.MuJoCo(mjcf, dt=0.02),
        synthesizer=RobotPolicy(contract(tmp_path, fall_height=0.1), mjcf=mjcf),
        distance=distances.BodyVelocity(),
    )
    assert parts.fall is not None
    campaign = Campaign(parts, store=tmp_path / "a.sqlite").run(3, explore=True)
    assert len(campaign.completed) == 3
    assert campaign.trials.largest > 0
    assert parts.with_parts(system=systems.MuJoCo(mjcf, substeps=2)).outcome([0.5, 0.5]).distance < 1e-9


def test_onnx_and_numpy_are_one_network(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    from onnx import TensorProto, helper, numpy_helper

    arrays = np.load(weights(tmp_path / "policy.npz"))
    nodes = [
        helper.make_node("MatMul", ["x", "W0"], ["a"]), helper.make_node("Add", ["a", "b0"], ["b"]),
        helper.make_node("Tanh", ["b"], ["c"]), helper.make_node("MatMul", ["c", "W1"], ["u"]),
    ]  # fmt: skip
    shapes = [helper.make_tensor_value_info(n, TensorProto.DOUBLE, [1, k]) for n, k in (("x", WIDTH), ("u", 2))]
    kept = [numpy_helper.from_array(np.array(arrays[name].T), name) for name in ("W0", "b0", "W1")]
    graph = helper.make_graph(nodes, "policy", shapes[:1], shapes[1:], kept)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), tmp_path / "p.onnx")
    of, xs = task(3), states(6).reshape(2, 3, 17)
    first, second = (
        recorded(RobotPolicy(contract(tmp_path, network=tmp_path / name)), of, xs)[0]
        for name in ("policy.npz", "p.onnx")
    )
    assert first == pytest.approx(second, abs=1e-9)


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    mjcf = MJCF.format(actuators=SERVOS)
    with refuses(InputError, "knee"):
        RobotPolicy(contract(tmp_path, joints=["knee", "front"]), mjcf=mjcf)
    with refuses(InputError, "drives no joint"):
        network = weights(tmp_path / "one.npz", 1, 1)
        terms = [Term("joint_errors")]
        one = contract(tmp_path, joints=["front"], default=[0.0], network=network, observation=terms, action=Action())
        RobotPolicy(one, mjcf=mjcf)
    with refuses(ShapeError, "joint_errors 2"):
        RobotPolicy(contract(tmp_path, observation=[Term("joint_errors")]))
    with refuses(ShapeError, "command 3"):
        RobotPolicy(contract(tmp_path)).design(Task(X0, horizon=3, dt=0.02, command=[1.0, 0, 0]), None)  # type: ignore[arg-type]
    with refuses(InputError, "0.02 s / 1"):
        late = Task(X0, horizon=3, dt=0.01, command=[1.0, 0.0])
        RobotPolicy(contract(tmp_path)).design(late, None).start(late)  # type: ignore[arg-type]
    with refuses(InputError, "latency"):
        now = Task(X0, horizon=3, dt=0.02, command=[1.0, 0.0])
        RobotPolicy(contract(tmp_path, latency=0.015)).design(now, None).start(now)  # type: ignore[arg-type]
    with refuses(ShapeError, "19"):
        wide = Task(np.zeros(19), horizon=3, dt=0.02, command=[1.0, 0.0])
        policy = RobotPolicy(contract(tmp_path)).design(wide, None)  # type: ignore[arg-type]
        policy.step(0, np.ones(19), policy.start(wide))
    with refuses(InputError, "base"):
        RobotPolicy(contract(tmp_path, base="planar", observation=[Term("joint_errors", history=8), Term("clock")]),
                    mjcf=mjcf)  # fmt: skip
    with refuses(InputError, "indices", "MJCF"):
        RobotPolicy(contract(tmp_path, joints=[1, 0]))


def test_go1_walks_as_commanded_and_its_joints_are_found_by_name() -> None:
    mjcf, parts = go1_mjcf(), go1_contract()
    system = systems.MuJoCo(mjcf, substeps=5)
    of = Task(np.tile(START, (2, 1)), horizon=150, dt=0.02, command=[np.array([0.8, 0.0]), 0.0, np.array([0.0, 0.8])])
    policy = RobotPolicy(parts, mjcf=mjcf)
    run = system.execute(policy.design(of, None), of)  # type: ignore[arg-type]
    assert policy.fall is not None
    assert (policy.fall.steps(run) > 150).all()
    error = distances.CommandError(after=1.0, yaw=0.5)
    assert (error(run, run, of) < 0.15).all()
    without = RobotPolicy(parts)
    assert system.execute(without.design(of, None), of).states == pytest.approx(run.states)  # type: ignore[arg-type]
    assert policy.describe()["network"] == without.describe()["network"]
