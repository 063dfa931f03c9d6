"""The FMU adapter on FMUs built here, of FMI 2 and FMI 3."""

from __future__ import annotations

import builtins
import concurrent.futures
import contextlib
import pickle
import re
import subprocess
import sys
import textwrap
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctxval import Campaign, Task, TaskSpace, Validation, controllers, distances, models, searches, systems, testing
from ctxval.arrays import Array
from ctxval.describe import describe, first_difference
from ctxval.errors import InputError, ShapeError, UnknownNameError
from ctxval.systems import FMU

fmpy = pytest.importorskip("fmpy")

CART_2 = '''
from pythonfmu import Boolean, Fmi2Causality, Fmi2Initial, Fmi2Slave, Fmi2Variability, Integer, Real

class Cart(Fmi2Slave):
    """A cart with friction that grows with the square of its speed; it breaks beyond a speed of 100 m/s."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.position, self.speed, self.force, self.mass, self.teeth = 0.0, 0.0, 0.0, 2.0, 3
        for name in ("position", "speed"):
            self.register_variable(Real(name, causality=Fmi2Causality.output, initial=Fmi2Initial.exact, start=0.0))
        self.register_variable(Real("force", causality=Fmi2Causality.input))
        self.register_variable(Real("mass", causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable))
        self.register_variable(Integer("teeth", causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable))

    def do_step(self, time, dt):
        if abs(self.speed) > 100:
            return False  # pythonfmu lets an exception corrupt the process that loaded it
        self.position += dt * self.speed
        self.speed += dt * (self.force - 0.1 * self.speed * abs(self.speed)) / self.mass
        return True
'''

CART_3 = '''
from pythonfmu3 import Fmi3Causality, Fmi3Initial, Fmi3Slave, Fmi3Variability, Float64

class Cart(Fmi3Slave):
    """The same."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.time, self.position, self.speed, self.force, self.mass = 0.0, 0.0, 0.0, 0.0, 2.0
        self.register_variable(
            Float64("time", causality=Fmi3Causality.independent, variability=Fmi3Variability.continuous)
        )
        for name in ("position", "speed"):
            self.register_variable(Float64(name, causality=Fmi3Causality.output, initial=Fmi3Initial.exact, start=0.0))
        self.register_variable(Float64("force", causality=Fmi3Causality.input, start=0.0))
        self.register_variable(
            Float64("mass", causality=Fmi3Causality.parameter, variability=Fmi3Variability.tunable, start=2.0)
        )

    def do_step(self, time, dt):
        if abs(self.speed) > 100:
            return False  # pythonfmu lets an exception corrupt the process that loaded it
        self.position += dt * self.speed
        self.speed += dt * (self.force - 0.1 * self.speed * abs(self.speed)) / self.mass
        return True
'''

NAMES: dict[str, Any] = {"states": ["position", "speed"], "inputs": ["force"]}
TASK = Task([1.0, -0.5], horizon=25, dt=0.1)


def feedback(t: int, x: Array) -> Array:
    return np.array([-2.0 * x[0] - 1.5 * x[1] + 0.2 * np.sin(t)])


def cart(x: Array, u: Array, dt: float = 0.1, mass: float = 2.0) -> Array:
    position, speed = x[..., 0], x[..., 1]
    pull = u[..., 0] - 0.1 * speed * np.abs(speed)
    return np.stack([position + dt * speed, speed + dt * pull / mass], axis=-1)


def built(folder: Path, tool: str, source: str) -> Path:
    script = folder / f"cart_{tool}.py"
    script.write_text(textwrap.dedent(source))
    command = [sys.executable, "-m", tool, "build", "-f", str(script), "-d", str(folder), "--no-external-tool"]
    subprocess.run(command, check=True, capture_output=True, cwd=folder)
    return (folder / "Cart.fmu").rename(folder / f"{tool}.fmu")


@pytest.fixture(scope="module")
def fmi2(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("pythonfmu")
    return built(tmp_path_factory.mktemp("fmi2"), "pythonfmu", CART_2)


@pytest.fixture(scope="module")
def fmi3(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("pythonfmu3")
    return built(tmp_path_factory.mktemp("fmi3"), "pythonfmu3", CART_3)


@pytest.fixture(params=["fmi2", "fmi3"])
def path(request: pytest.FixtureRequest) -> Path:
    found: Path = request.getfixturevalue(request.param)
    return found


def test_it_moves_as_the_model_in_it_does(path: Path) -> None:
    trajectory = FMU(path, **NAMES).execute(feedback, TASK)
    expected = systems.Simulated(cart, vectorized=True).execute(feedback, TASK)
    np.testing.assert_allclose(trajectory.states, expected.states, rtol=0, atol=1e-12)
    np.testing.assert_allclose(trajectory.inputs, expected.inputs, rtol=0, atol=1e-12)
    assert trajectory.ended == "complete"


def test_it_keeps_the_contract_of_a_system(path: Path) -> None:
    testing.check_system(FMU(path, **NAMES), feedback, TASK, tolerance=0)


def test_a_control_step_may_have_several_communication_steps(path: Path) -> None:
    states = FMU(path, **NAMES, step=0.025).execute(feedback, TASK).states
    for t in range(TASK.horizon):
        x = states[t]
        for _ in range(4):
            x = cart(x, feedback(t, states[t]), 0.025)
        np.testing.assert_allclose(states[t + 1], x, rtol=0, atol=1e-12)


def test_parameters_are_set_before_the_start(path: Path) -> None:
    states = FMU(path, **NAMES, parameters={"mass": 5.0}).execute(feedback, TASK).states
    np.testing.assert_allclose(states[1], cart(states[0], feedback(0, states[0]), mass=5.0), rtol=0, atol=1e-12)


def test_integer_parameters_are_set_as_integers(fmi2: Path) -> None:
    assert FMU(fmi2, **NAMES, parameters={"teeth": 7}).execute(feedback, TASK).finite


def test_a_failure_in_the_middle_ends_the_trajectory_and_frees_the_instance(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    freed = counted_frees(monkeypatch)
    trajectory = FMU(path, **NAMES).execute(lambda t, x: np.array([1e4 if t >= 2 else 0.0]), TASK)
    assert re.fullmatch(r"the FMU failed \(fmi.DoStep failed with status 2 \(discard\)\.\) at step 4", trajectory.ended)
    assert np.isfinite(trajectory.states[:4]).all()
    assert np.isnan(trajectory.states[4:]).all()
    assert len(freed) == 2  # one when it was opened


def test_the_instance_is_freed_when_the_controller_raises(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    freed = counted_frees(monkeypatch)
    system = FMU(path, **NAMES)
    for _ in range(3):
        with contextlib.suppress(ZeroDivisionError):
            system.execute(lambda t, x: np.array([1 / 0]), TASK)
    assert len(freed) == 4


def counted_frees(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    freed: list[object] = []
    for kind in (fmpy.fmi2.FMU2Slave, fmpy.fmi3.FMU3Slave):

        def free(self: Any, original: Any = kind.freeInstance) -> None:
            freed.append(self)
            original(self)

        monkeypatch.setattr(kind, "freeInstance", free)
    return freed


def test_many_executions_and_garbage_collections_leave_the_process_alive(path: Path) -> None:
    # In a process of its own, which may crash.
    code = f"""
import gc
from ctxval import Task
from ctxval.systems import FMU
system = FMU({str(path)!r}, states=["position", "speed"], inputs=["force"])
for _ in range(30):
    system.execute(lambda t, x: -x[:1], Task([1.0, -0.5], horizon=5, dt=0.1))
    system.execute(lambda t, x: -x[:1], Task([1.0, 200.0], horizon=5, dt=0.1))
    gc.collect()
del system
gc.collect()
print("alive")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip().endswith("alive"), done.stderr
    assert done.returncode == 0


def test_the_unpacked_files_go_with_the_system(path: Path) -> None:
    system = FMU(path, **NAMES)
    folder = Path(system._folder)
    assert folder.exists()
    del system
    assert not folder.exists()


def test_it_can_be_sent_to_another_process(path: Path) -> None:
    system = FMU(path, **NAMES)
    other = pickle.loads(pickle.dumps(system))
    np.testing.assert_array_equal(other.execute(feedback, TASK).states, system.execute(feedback, TASK).states)
    assert first_difference(describe(system), describe(other)) is None
    assert first_difference(describe(system), describe(FMU(path, **NAMES, parameters={"mass": 3.0}))) is not None


# What the user may get wrong


def test_names_must_be_those_of_variables(path: Path) -> None:
    with pytest.raises(UnknownNameError, match="no variable of the FMU is called 'velocity'"):
        FMU(path, states=["position", "velocity"], inputs=["force"])
    with pytest.raises(UnknownNameError, match="did you mean 'force'"):
        FMU(path, states=["position"], inputs=["forces"])
    with pytest.raises(UnknownNameError, match="no state is called 'pos'"):
        FMU(path, **NAMES, start={"pos": "position"})
    with pytest.raises(InputError, match="names of different variables, got"):
        FMU(path, states=["position", "position"], inputs=["force"])


def test_states_must_be_real_numbers(fmi2: Path) -> None:
    with pytest.raises(InputError, match="'teeth' must be one real number, it is of type Integer"):
        FMU(fmi2, states=["teeth"], inputs=["force"])


def test_an_initial_state_that_is_not_taken_is_an_error(path: Path) -> None:
    # The start values go to the mass, so that the position stays where it was.
    system = FMU(path, **NAMES, start={"position": "mass"})
    with pytest.raises(InputError, match=r"set to the initial state \[1\.0, -0\.5\], but stands at \[0\.0, -0\.5\]"):
        system.execute(feedback, TASK)


def test_start_values_that_are_refused_are_an_error(fmi2: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Any, references: Any, values: Any) -> None:
        raise RuntimeError("calculated")

    monkeypatch.setattr(fmpy.fmi2.FMU2Slave, "setReal", refuse)
    with pytest.raises(InputError, match="does not let the start values of position, speed be set: calculated"):
        FMU(fmi2, **NAMES).execute(feedback, TASK)


def test_an_fmu_may_end_the_simulation(fmi3: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def step(self: Any, time: float, dt: float) -> tuple[bool, bool, bool, float]:
        return False, time > 0.25, False, time

    monkeypatch.setattr(fmpy.fmi3.FMU3Slave, "doStep", step)
    trajectory = FMU(fmi3, **NAMES).execute(feedback, TASK)
    assert trajectory.ended == "the FMU terminated the simulation at step 4"


def test_threads_do_not_disturb_each_other(path: Path) -> None:
    system = FMU(path, **NAMES)
    alone = system.execute(feedback, TASK).states
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        for trajectory in pool.map(lambda _: system.execute(feedback, TASK), range(12)):
            np.testing.assert_array_equal(trajectory.states, alone)


def test_shapes_and_steps_must_fit(path: Path) -> None:
    system = FMU(path, **NAMES, step=0.04)
    with pytest.raises(InputError, match=r"whole multiple of the step 0\.04 s, got 0\.1 s"):
        system.execute(feedback, TASK)
    with pytest.raises(ShapeError, match="the system's 2 states, got 3"):
        FMU(path, **NAMES).execute(feedback, Task(np.zeros(3), horizon=2, dt=0.1))
    with pytest.raises(ShapeError, match=r"inputs, shape \(1,\), got \(2,\)"):
        FMU(path, **NAMES).execute(lambda t, x: x, TASK)
    with pytest.raises(InputError, match="step must be a positive number of seconds, got 0"):
        FMU(path, **NAMES, step=0)


def test_other_files_are_refused(tmp_path: Path, fmi2: Path) -> None:
    junk = tmp_path / "junk.fmu"
    junk.write_bytes(b"junk")
    for wrong in (junk, tmp_path / "missing.fmu"):
        with pytest.raises(InputError, match="cannot be read as an FMU"):
            FMU(wrong, **NAMES)
    hollow = tmp_path / "hollow.fmu"
    with zipfile.ZipFile(fmi2) as whole, zipfile.ZipFile(hollow, "w") as rest:
        rest.writestr("modelDescription.xml", whole.read("modelDescription.xml"))
    with pytest.raises(InputError, match=r"hollow\.fmu cannot be instantiated: Cannot find shared library"):
        FMU(hollow, **NAMES)


def test_without_fmpy_the_extra_is_named(fmi2: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.partition(".")[0] == "fmpy":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r'pip install "ctxval\[fmu\]"'):
        FMU(fmi2, **NAMES)


def test_a_model_is_validated_on_an_fmu(path: Path) -> None:
    def on(system: systems.System) -> Validation:
        return Validation(
            space=TaskSpace(goal=(0.5, 2.0, "m")),
            task=lambda p: Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=30, dt=0.1),
            system=system,
            model=models.Linear([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.05]]),
            synthesizer=controllers.LQR([10.0, 1.0], [0.1]),
            distance=distances.FinalState(),
        )

    points = np.array([[0.5], [1.0], [2.0]])
    found = on(FMU(path, **NAMES)).distances(points)
    np.testing.assert_allclose(found, on(systems.Simulated(cart, vectorized=True)).distances(points), atol=1e-12)
    assert found.min() > 0
    assert not Campaign(on(FMU(path, **NAMES)), search=searches.Random()).run(3).failed
