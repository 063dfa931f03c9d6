"""MuJoCo models as M, and results of ``mujoco.sysid``, written by that library itself."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from ctxval import Campaign, Task, TaskSpace, Trajectory, Validation, controllers, distances, models, systems, testing
from ctxval._util.arrays import Array
from ctxval.cli import app
from ctxval.cli.config.parts import part
from ctxval.core.model import predicted_steps, with_memory
from ctxval.core.trajectory import Transitions
from ctxval.data import recordings_of
from ctxval.data.log import MemoryTable
from ctxval.errors import ExecutionError, InputError, ModelError, ShapeError, UnknownNameError
from ctxval.studies.fitting import fit
from facts import refuses

mujoco = pytest.importorskip("mujoco")

DT = 0.02


def mjcf(damping: float) -> str:
    """A pendulum with a torque motor; the damping is what is to be identified."""
    return f"""<mujoco><option timestep="0.005"/><worldbody><body>
      <joint name="hinge" type="hinge" axis="0 1 0" damping="{damping}"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.5"/>
    </body></worldbody><actuator><motor name="motor" joint="hinge"/></actuator>
    <sensor><jointpos name="angle" joint="hinge"/></sensor></mujoco>"""


def recorded(seed: int = 0, steps: int = 80, damping: float = 0.08) -> Trajectory:
    """Return a run of the true pendulum, recorded every 0.02 s."""
    model = mujoco.MjModel.from_xml_string(mjcf(damping))
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    data.qpos[0] = rng.uniform(-1, 1)
    inputs, states = np.repeat(0.3 * rng.normal(size=(steps // 10, 1)), 10, axis=0), []
    for u in inputs:
        states.append([data.qpos[0], data.qvel[0]])
        data.ctrl[:] = u
        mujoco.mj_step(model, data, 4)
    states.append([data.qpos[0], data.qvel[0]])
    return Trajectory(DT * np.arange(steps + 1), np.array(states), inputs)


def identified(folder: Path, one: Trajectory, start: float = 0.02) -> None:
    """Identify the damping with mujoco.sysid, and let it save its results."""
    pytest.importorskip("absl")
    from mujoco import sysid

    spec = mujoco.MjSpec.from_string(mjcf(start))
    model = spec.compile()

    def modify(spec: Any, parameter: Any) -> None:
        spec.joint("hinge").damping[0] = float(parameter.value[0])

    damping = sysid.Parameter("damping", start, 0.0, 1.0, modifier=modify)
    times = one.times[:-1]
    group = sysid.ModelSequences(
        "pendulum",
        spec,
        "run",
        sysid.create_initial_state(model, one.states[0, :1], one.states[0, 1:]),
        sysid.TimeSeries.from_control_names(times, one.inputs, model),
        sysid.TimeSeries.from_names(times, one.states[:-1, :1], model),
    )
    initial = sysid.ParameterDict({"damping": damping})
    residual = sysid.build_residual_fn(models_sequences=[group])
    found, result = sysid.optimize(initial, residual, optimizer="scipy", verbose=False)
    found["damping"].apply_modifier(group.spec)
    sysid.save_results(folder, [group], initial, found, result, residual)


def test_a_step_is_that_of_mujoco_in_any_batch() -> None:
    model, one = models.MuJoCo(mjcf(0.08), dt=DT), recorded()
    assert model.dt == pytest.approx(DT)
    moves = one.transitions()
    np.testing.assert_allclose(model.step(moves.x, moves.u), moves.x_next, atol=1e-12)
    testing.check_model(model, states=2, inputs=1)
    assert model.step(np.zeros((3, 1, 2)), np.zeros((1, 4, 1))).shape == (3, 4, 2)


def test_a_state_that_is_not_finite_or_at_which_mujoco_warns_has_no_next_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    model = models.MuJoCo(mjcf(0.0), dt=DT)
    states = np.array([[0.1, 0.0], [np.nan, 0.0], [0.0, 1e12]])
    reached = model.step(states, np.zeros((3, 1)))
    assert np.isfinite(reached).all(axis=1).tolist() == [True, False, False]
    # MuJoCo prints no warning, and logs none into the working directory.
    assert (*capfd.readouterr(), *tmp_path.iterdir()) == ("", "")


@pytest.mark.thorough
def test_it_is_the_model_of_a_campaign_and_repeats_itself_in_a_store(tmp_path: Path) -> None:
    validation = Validation(
        space=TaskSpace(goal=(-1.0, 1.0, "rad")),
        task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=10, dt=DT),
        system=systems.MuJoCo(mjcf(0.08), substeps=4),
        model=models.MuJoCo(mjcf(0.02), dt=DT),
        synthesizer=controllers.LQR([1.0, 0.1], [0.1]),
        distance=distances.FinalState(components=[0]),
    )
    assert Campaign(validation, store=tmp_path / "a.sqlite").run(2, explore=True).worst is not None
    assert len(Campaign(validation, store=tmp_path / "a.sqlite").run(3, explore=True).completed) == 3
    exact = validation.with_parts(model=models.MuJoCo(mjcf(0.08), dt=DT))
    assert exact.outcome([0.7]).distance == pytest.approx(0, abs=1e-9)
    again = pickle.loads(pickle.dumps(validation.model))
    np.testing.assert_array_equal(again.step(np.ones(2), np.ones(1)), validation.model.step(np.ones(2), np.ones(1)))


@pytest.mark.parametrize(
    ("given", "options", "facts"),
    [
        ("<mujoco>", {}, ("MuJoCo", "XML_ERROR_MISMATCHED_ELEMENT")),
        (mjcf(0.1), {"dt": 0.0125}, ("dt", 0.005, 0.0125)),
        (mjcf(0.1), {"dt": -1}, ("dt", -1)),
        (("missing.xml",), {}, ("missing.xml",)),
        (mjcf(0.1), {"sites": "tip"}, ("site", "tip")),
    ],
)
def test_what_cannot_be_a_model_is_refused(given: str, options: dict[str, Any], facts: tuple[object, ...]) -> None:
    with refuses((InputError, UnknownNameError), *facts):
        models.MuJoCo(given, **options)


def test_states_and_inputs_have_the_numbers_of_the_model() -> None:
    with refuses(ShapeError, 1, 3):
        models.MuJoCo(mjcf(0.1)).step(np.zeros(3), np.zeros(1))


# One engine as M and as S

# A walker that falls onto the ground, with the solver's settings of fast simulations; its second motor has a filter.
WALKER = """<mujoco><option timestep="0.005" iterations="1" ls_iterations="4"/><worldbody>
  <geom type="plane" size="5 5 0.1"/><body pos="0 0 0.35"><freejoint/><geom type="capsule" fromto="-0.2 0 0 0.2 0 0"
  size="0.05"/><site name="tip" pos="0.2 0 0"/>
  <body pos="-0.2 0 0"><joint name="a" axis="0 1 0" damping="0.05"/><geom type="capsule" fromto="0 0 0 0 0 -0.3"
  size="0.03"/></body>
  <body pos="0.2 0 0"><joint name="b" axis="0 1 0" damping="0.05" frictionloss="0.1" range="-60 60" limited="true"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03"/></body></body></worldbody>
  <actuator><motor joint="a" gear="2"/><general joint="b" dyntype="filterexact" dynprm="0.05" gainprm="3"/></actuator>
</mujoco>"""


def walk(t: int, x: Array) -> Array:
    swing = np.broadcast_to(np.sin(0.2 * t), x.shape[:-1])
    return np.stack([swing - 2 * x[..., 7], -swing - 2 * x[..., 8]], axis=-1)


def walking(**parts: Any) -> Validation:
    system = systems.MuJoCo(WALKER, substeps=2, sites="tip", axes="xz")
    height = np.array([0, 0, 1, 0, 0, 0, 0, 0, 0.0])
    given: dict[str, Any] = {
        "space": TaskSpace(height=(0.3, 0.5, "m")),
        "task": lambda p: Task(
            system.state([0, 0, 0, 1, 0, 0, 0, 0.1, -0.1] + np.asarray(p.height)[..., None] * height),
            horizon=40,
            dt=system.dt,
        ),
        "system": system,
        "model": models.MuJoCo(WALKER, dt=system.dt, sites="tip", axes="xz"),
        "synthesizer": controllers.Policy(lambda t, x, task: walk(t, x)),
        "distance": distances.MaximumDeviation(),
    }
    return Validation(**{**given, **parts})


def test_one_mjcf_as_model_and_as_system_has_the_distance_0() -> None:
    validation, heights = walking(), np.array([[0.3], [0.35], [0.5]])
    assert validation.distances(heights).tolist() == [0.0, 0.0, 0.0]  # in a batch
    assert [validation.outcome(height).distance for height in heights] == [0.0, 0.0, 0.0]
    on_model = validation.on_model(distances.MaximumDeviation())
    assert on_model.distances(heights).tolist() == [0.0, 0.0, 0.0]
    # Steps from recorded states alone lack activations and warm starts.
    x = validation.plan(heights[0]).model_trajectory.states
    alone = validation.model.step(x[:-1], np.stack([walk(t, state) for t, state in enumerate(x[:-1])]))
    assert np.abs(alone - x[1:]).max() > 1e-3


def test_a_controller_with_memory_and_another_model_differ_as_they_should() -> None:
    heavier = models.MuJoCo(WALKER.replace('gear="2"', 'gear="2.2"'), dt=0.01, sites="tip", axes="xz")
    assert walking(model=heavier).outcome([0.35]).distance > 1e-3


def test_recorded_steps_of_the_same_engine_leave_no_residual() -> None:
    validation = walking()
    plan = validation.plan([0.4])
    recorded = with_memory(validation.model, validation.execute(plan))
    assert (predicted_steps(validation.model, recorded) == recorded.x_next).all()
    assert (predicted_steps(validation.model, recorded[10:20]) == recorded.x_next[10:20]).all()
    data = replace(recorded, memory=None)
    both = predicted_steps(validation.model, Transitions.joined([recorded, data]))
    assert (both[: len(recorded)] == recorded.x_next).all()
    np.testing.assert_array_equal(both[len(recorded) :], validation.model.step(data.x, data.u))


def test_an_instability_of_both_is_agreement_and_of_one_a_counterexample(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warnings into the working directory
    unstable = mjcf(0.0).replace("damping", 'stiffness="-1e9" damping')
    parts: dict[str, Any] = {
        "space": TaskSpace(start=(0.1, 0.2)),
        "task": lambda p: Task([p.start, 0.0], horizon=30, dt=0.005),
        "synthesizer": controllers.Policy(lambda t, x, task: 0 * x[..., :1]),
        "distance": distances.MaximumDeviation(),
        "system": systems.MuJoCo(unstable),
    }
    both = Validation(model=models.MuJoCo(unstable), **parts)
    assert both.outcome([0.15]).distance == 0.0
    assert both.plan([0.15]).model_trajectory.horizon < 30
    assert both.distances([[0.1], [0.2]]).tolist() == [0.0, 0.0]
    with refuses(ExecutionError, "MuJoCo", "BADQACC"):
        Validation(model=models.MuJoCo(mjcf(0.0)), **parts).outcome([0.15])


def test_a_step_without_memory_lets_the_solver_converge() -> None:
    model, many = (models.MuJoCo(WALKER.replace('iterations="1" ls_iterations="4"', s)) for s in ("", 'iterations="1"'))
    x = walking().plan([0.4]).model_trajectory.states[30, :17]
    u = np.zeros(2)
    np.testing.assert_allclose(model.step(x, u), many.step(x, u), atol=1e-6)


@pytest.mark.thorough
def test_the_result_of_mujoco_sysid_is_a_model_with_its_held_out_error(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    runs = [recorded(seed) for seed in range(4)]
    identified(tmp_path / "result", runs[0])
    assert (tmp_path / "result" / "params_x_hat.yaml").exists()
    model = models.MuJoCo(tmp_path / "result", dt=DT)
    moves = runs[1].transitions()
    assert np.abs(model.step(moves.x, moves.u) - moves.x_next).max() < 1e-3
    assert np.abs(models.MuJoCo(mjcf(0.02), dt=DT).step(moves.x, moves.u) - moves.x_next).max() > 1e-2
    # The pickles that mujoco.sysid writes beside it are never read.
    (tmp_path / "result" / "results.pkl").write_bytes(b"cos\nsystem\n(S'false'\ntR.")
    logs = [
        MemoryTable(str(k), {"t": one.times, "x": one.states, "u": np.append(one.inputs, [[np.nan]], axis=0)})
        for k, one in enumerate(runs)
    ]
    report = fit(recordings_of(logs), ["linear"], given=model)
    assert [one.kind for one in report.fitted] == ["given", "linear"]
    assert report.fitted[0].relative < 0.01 < report.fitted[1].relative
    for k, one in enumerate(runs):
        one.to_csv(f"run{k}.csv")
    files = [f"run{k}.csv" for k in range(4)]
    done = CliRunner().invoke(app, ["fit", *files, "--kind", "linear", "--given", "result", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["fitted"][0]["kind"] == "given"
    shown = CliRunner().invoke(app, ["replay", *files, "--model", "result", "--json"])
    assert shown.exit_code == 0, shown.output
    assert max(one["relative"] for one in json.loads(shown.stdout)["errors"] if one["steps"] == 1) < 0.01
    assert part("model", {"type": "MuJoCo", "mjcf": "result", "dt": DT}, tmp_path).dt == pytest.approx(DT)


def test_a_given_model_with_another_time_step_or_size_is_refused() -> None:
    one = recorded()
    log = MemoryTable("a", {"t": one.times, "x": one.states, "u": np.append(one.inputs, [[np.nan]], axis=0)})
    with refuses(InputError, 0.005, 0.02):
        fit(recordings_of([log]), ["linear"], given=models.MuJoCo(mjcf(0.1)))
    larger = mjcf(0.1).replace("<body>", '<body><joint type="slide"/>')
    with refuses(ModelError, 2, 1):
        fit(recordings_of([log]), ["linear"], given=models.MuJoCo(larger, dt=DT))


def test_a_folder_must_have_one_identified_model(tmp_path: Path) -> None:
    with refuses(InputError, "mujoco.sysid", "params_x_hat.yaml"):
        models.MuJoCo(tmp_path)
    (tmp_path / "params_x_hat.yaml").write_text("{}")
    for name in ("a.xml", "b.xml"):
        (tmp_path / name).write_text(mjcf(0.1))
    with refuses(InputError, "a.xml", "b.xml"):
        models.MuJoCo(tmp_path)
