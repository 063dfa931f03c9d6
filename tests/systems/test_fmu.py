"""The FMU adapter on FMUs built here, of FMI 2 and FMI 3."""

from __future__ import annotations

import concurrent.futures
import contextlib
import io
import json
import os
import pickle
import shutil
import subprocess
import sys
import textwrap
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from ctxval import (
    Campaign,
    Store,
    Task,
    TaskSpace,
    Validation,
    controllers,
    distances,
    models,
    searches,
    systems,
    testing,
)
from ctxval._util.arrays import Array
from ctxval._util.describe import describe, first_difference
from ctxval.cli import app
from ctxval.errors import InputError, ShapeError, UnknownNameError
from ctxval.systems import FMU, fmu_process
from facts import assert_names, refuses
from rig_thorough import more

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

FAILING = "return False  # pythonfmu lets an exception corrupt the process that loaded it"
NAMES: dict[str, Any] = {"states": {"position": "m", "speed": "m/s"}, "inputs": {"force": "N"}}
TASK = Task([1.0, -0.5], horizon=25, dt=0.1)


def feedback(t: int, x: Array) -> Array:
    return np.array([-2.0 * x[0] - 1.5 * x[1] + 0.2 * np.sin(t)])


def cart(x: Array, u: Array, dt: float = 0.1, mass: float = 2.0) -> Array:
    position, speed = x[..., 0], x[..., 1]
    pull = u[..., 0] - 0.1 * speed * np.abs(speed)
    return np.stack([position + dt * speed, speed + dt * pull / mass], axis=-1)


def built(folder: Path, tool: str, source: str) -> Path:
    """Return the FMU of a class Cart."""
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


@pytest.mark.parametrize("path", ["fmi2", *more("fmi3")], indirect=True)
def test_it_keeps_the_contract_of_a_system(path: Path) -> None:
    testing.check_system(FMU(path, **NAMES), feedback, TASK, tolerance=0)


@pytest.mark.parametrize("path", ["fmi2", *more("fmi3")], indirect=True)
def test_a_control_step_may_have_several_communication_steps(path: Path) -> None:
    states = FMU(path, **NAMES, substeps=4).execute(feedback, TASK).states
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


def test_a_failure_in_the_middle_ends_the_trajectory(path: Path) -> None:
    system = FMU(path, **NAMES)
    trajectory = system.execute(lambda t, x: np.array([1e4 if t >= 2 else 0.0]), TASK)
    assert_names(trajectory.ended, "FMU", 2, 4)
    assert np.isfinite(trajectory.states[:4]).all()
    assert np.isnan(trajectory.states[4:]).all()
    assert system.execute(feedback, TASK).ended == "complete"


@pytest.mark.slow
@pytest.mark.parametrize("path", ["fmi2", *more("fmi3")], indirect=True)
def test_a_process_is_kept_until_something_goes_wrong(path: Path) -> None:
    system = FMU(path, **NAMES)
    (first,) = processes(system)
    system.execute(feedback, TASK)
    assert processes(system) == [first]
    for _ in range(2):
        with contextlib.suppress(ZeroDivisionError):
            system.execute(lambda t, x: np.array([1 / 0]), TASK)
        assert not processes(system)
    assert not alive(first)
    system.execute(feedback, TASK)
    (second,) = processes(system)
    del system
    assert not alive(second)


def processes(system: FMU) -> list[int]:
    """Return the processes that wait for an execution."""
    return [process._process.pid for process in system._idle[os.getpid()]]


def alive(pid: int) -> bool:
    """Return whether a process runs; one that has ended and that nobody has collected does not."""
    status = Path(f"/proc/{pid}/stat")
    return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"


# An FMU that crashes


@pytest.fixture(scope="module")
def deadly(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an FMU that kills its process beyond a speed, as a fault in machine code does."""
    pytest.importorskip("pythonfmu")
    crash = "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)"
    return built(tmp_path_factory.mktemp("deadly"), "pythonfmu", CART_2.replace(FAILING, crash))


def test_a_crash_ends_the_trajectory_and_not_the_process(deadly: Path) -> None:
    system = FMU(deadly, **NAMES)
    trajectory = system.execute(lambda t, x: np.array([1e4 if t >= 2 else 0.0]), TASK)
    assert_names(trajectory.ended, "FMU", 4)
    assert np.isfinite(trajectory.states[:4]).all()
    np.testing.assert_array_equal(
        system.execute(feedback, TASK).states, FMU(deadly, **NAMES).execute(feedback, TASK).states
    )


@pytest.mark.slow
@pytest.mark.parametrize("options", [*more({}), {"workers": 2}])
@pytest.mark.thorough
def test_a_crash_is_a_failed_trial_of_a_campaign(deadly: Path, options: dict[str, int]) -> None:
    validation = Validation(
        space=TaskSpace(speed=(50.0, 150.0, "m/s")),
        task=lambda p: Task([0.0, p.speed], horizon=5, dt=0.1),
        system=FMU(deadly, **NAMES),
        model=models.Linear([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.05]]),
        synthesizer=controllers.LQR([10.0, 1.0], [0.1], limits=1.0),
        distance=distances.FinalState(),
    )
    campaign = Campaign(validation, search=searches.Random(), seed=0).run(8, **options)  # type: ignore[arg-type]
    for trial in campaign.trials:
        crashed = trial.parameters["speed"] > 101
        assert (trial.state == "failed") is crashed
        if crashed:
            assert_names(str(trial.failure), "SIGSEGV", 1)
    assert 0 < len(campaign.failed) < 8


@pytest.mark.slow
@pytest.mark.parametrize("how", ["raise RuntimeError('broken')", *more("import os; os._exit(7)")])
def test_an_exception_in_a_step_of_pythonfmu_is_survived(tmp_path: Path, how: str) -> None:
    pytest.importorskip("pythonfmu")
    system = FMU(built(tmp_path, "pythonfmu", CART_2.replace(FAILING, how)), **NAMES)
    first, second = (
        system.execute(lambda t, x: -x[:1], Task([1.0, speed], horizon=5, dt=0.1)).ended for speed in (200.0, 0.0)
    )
    assert first.startswith("the FMU ")
    assert first.endswith(" at step 1")
    assert second == "complete"


def test_an_fmu_that_crashes_at_the_start_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("pythonfmu")
    crash = "    def exit_initialization_mode(self):\n        import os; os._exit(7)\n\n    def do_step"
    source = CART_2.replace("    def do_step", crash)
    with refuses(InputError, "pythonfmu.fmu", "FMU"):
        FMU(built(tmp_path, "pythonfmu", source), **NAMES)


@pytest.mark.slow
def test_a_step_that_does_not_end_goes_with_its_execution(tmp_path: Path) -> None:
    pytest.importorskip("pythonfmu")
    mark = f"pathlib.Path({str(tmp_path / 'pid')!r}).write_text(str(os.getpid()))"
    hang = f"import os, pathlib, time; {mark}; time.sleep(600)"
    validation = Validation(
        space=TaskSpace(speed=(150.0, 160.0, "m/s")),
        task=lambda p: Task([0.0, p.speed], horizon=5, dt=0.1),
        system=FMU(built(tmp_path, "pythonfmu", CART_2.replace(FAILING, hang)), **NAMES),
        model=models.Linear([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.05]]),
        synthesizer=controllers.LQR([10.0, 1.0], [0.1]),
        distance=distances.FinalState(),
    )
    for timeout in (1.0, 5.0, 25.0, 125.0):  # on a busy machine, the process of the FMU starts late
        campaign = Campaign(validation, search=searches.Random()).run(1, timeout=timeout)
        assert_names([trial.failure for trial in campaign.trials], f"{timeout:g}")
        if (tmp_path / "pid").exists():
            break
    pid, deadline = int((tmp_path / "pid").read_text()), time.monotonic() + 30
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not alive(pid)


@pytest.mark.slow
def test_a_step_that_does_not_end_goes_with_a_campaign_that_is_killed(tmp_path: Path) -> None:
    pytest.importorskip("pythonfmu")
    mark = tmp_path / "pid"
    hang = f"import os, pathlib, time; pathlib.Path({str(mark)!r}).write_text(str(os.getpid())); time.sleep(600)"
    code = f"""
from ctxval import Task
from ctxval.systems import FMU
system = FMU({str(built(tmp_path, "pythonfmu", CART_2.replace(FAILING, hang)))!r},
             states={{"position": "", "speed": ""}}, inputs={{"force": ""}})
system.execute(lambda t, x: -x[:1], Task([1.0, 200.0], horizon=5, dt=0.1))
"""
    campaign = subprocess.Popen([sys.executable, "-c", code])
    deadline = time.monotonic() + 30
    while not (mark.exists() and mark.read_text()) and time.monotonic() < deadline:
        time.sleep(0.01)
    campaign.kill()
    campaign.wait()
    pid = int(mark.read_text())
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not alive(pid)


def test_what_an_fmu_prints_and_reads_does_not_disturb(tmp_path: Path) -> None:
    pytest.importorskip("pythonfmu")
    talking = "    def do_step(self, time, dt):\n        import os, sys; print('hello', flush=True); sys.stdin.read()\n"
    system = FMU(built(tmp_path, "pythonfmu", CART_2.replace("    def do_step(self, time, dt):\n", talking)), **NAMES)
    assert system.execute(feedback, TASK).ended == "complete"


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.parametrize("path", ["fmi2", *more("fmi3")], indirect=True)
def test_many_executions_and_garbage_collections_leave_the_process_alive(path: Path) -> None:
    # In a process of its own, which may crash.
    code = f"""
import gc
from ctxval import Task
from ctxval.systems import FMU
system = FMU({str(path)!r}, states={{"position": "", "speed": ""}}, inputs={{"force": ""}})
for _ in range(4):
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


@pytest.mark.parametrize("path", ["fmi2", *more("fmi3")], indirect=True)
def test_the_unpacked_files_go_with_the_system(path: Path) -> None:
    system = FMU(path, **NAMES)
    folder = Path(system._unpacked)
    assert folder.exists()
    del system
    assert not folder.exists()


@pytest.mark.thorough
@pytest.mark.parametrize("path", ["fmi2", *more("fmi3")], indirect=True)
def test_it_can_be_sent_to_another_process(path: Path) -> None:
    system = FMU(path, **NAMES)
    other = pickle.loads(pickle.dumps(system))
    np.testing.assert_array_equal(other.execute(feedback, TASK).states, system.execute(feedback, TASK).states)
    assert first_difference(describe(system), describe(other)) is None
    assert first_difference(describe(system), describe(FMU(path, **NAMES, parameters={"mass": 3.0}))) is not None


# What the user may get wrong


@pytest.mark.parametrize("path", ["fmi2", *more("fmi3")], indirect=True)
def test_names_must_be_those_of_variables(path: Path) -> None:
    with refuses(UnknownNameError, "FMU", "velocity"):
        FMU(path, states={"position": "", "velocity": ""}, inputs={"force": ""})
    with refuses(UnknownNameError, "force"):
        FMU(path, states={"position": ""}, inputs={"forces": ""})
    with refuses(UnknownNameError, "pos"):
        FMU(path, **NAMES, start={"pos": "position"})
    with refuses(InputError, "{ position = ... }", ["position"]):
        FMU(path, states=["position"], inputs={"force": ""})


def test_states_must_be_real_numbers(fmi2: Path) -> None:
    with refuses(InputError, "teeth"):
        FMU(fmi2, states={"teeth": ""}, inputs={"force": ""})


# What may be set at the start

ROOM_2 = '''
from pythonfmu import Fmi2Causality, Fmi2Initial, Fmi2Slave, Fmi2Variability, Real

class Cart(Fmi2Slave):
    """A room whose temperature is calculated in the first step, from a parameter, with its deviation from 20."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.T, self.above, self.heat, self.T_start, self.gain, self.begun = 20.0, 0.0, 0.0, 20.0, 0.05, False
        for name in ("T", "above"):
            self.register_variable(Real(name, causality=Fmi2Causality.output, initial=Fmi2Initial.calculated))
        self.register_variable(Real("heat", causality=Fmi2Causality.input, start=0.0))
        for name in ("T_start", "gain"):
            self.register_variable(Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.fixed))

    def do_step(self, time, dt):
        if not self.begun:
            self.T, self.begun = self.T_start, True
        self.T += dt * (0.01 * (10 - self.T) + self.gain * self.heat)
        self.above = self.T - 20
        return True
'''
ROOM_3 = (
    ROOM_2.replace("Fmi2", "Fmi3").replace("pythonfmu", "pythonfmu3").replace("Real", "Float64")
    .replace("initial=Fmi3Initial.calculated", "initial=Fmi3Initial.calculated, variability=Fmi3Variability.continuous")
    .replace("self.T, self.above", "self.time, self.T, self.above").replace("= 20.0, 0.0, 0.0", "= 0.0, 20.0, 0.0, 0.0")
    .replace("        for name in (\"T\"", """        self.register_variable(
            Float64("time", causality=Fmi3Causality.independent, variability=Fmi3Variability.continuous))
        for name in (\"T\"""", 1)
    .replace("variability=Fmi3Variability.fixed", "variability=Fmi3Variability.fixed, start=getattr(self, name)")
)  # fmt: skip


@pytest.fixture(params=["pythonfmu", *more("pythonfmu3")], scope="module")
def room(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip(request.param)
    source = ROOM_2 if request.param == "pythonfmu" else ROOM_3
    return built(tmp_path_factory.mktemp("room"), request.param, source)


def heated(system: FMU, *start: float) -> list[float]:
    task = Task(list(start), horizon=2, dt=1.0)
    return [round(x, 9) for x in system.execute(lambda t, x: np.array([2.0]), task).states[:, 0]]


@pytest.mark.parametrize("options", [{"start": {"T": "T_start"}}, {"parameters": {"T_start": 15.0}}])
def test_a_parameter_sets_a_state_that_is_calculated(room: Path, options: dict[str, Any]) -> None:
    system = FMU(room, states={"T": ""}, inputs={"heat": ""}, **options)
    assert heated(system, 15.0) == heated(system, 15.0) == [15.0, 15.05, 15.0995]
    with refuses(ShapeError, "task", 1, 2):
        heated(system, 15.0, 0.0)


def test_a_calculated_state_without_its_parameter_is_refused_unless_it_starts_there(room: Path) -> None:
    system = FMU(room, states={"T": ""}, inputs={"heat": ""})
    with refuses(InputError, "T", "T_start", "gain"):
        heated(system, 15.0)
    assert heated(system, 20.0) == [20.0, 20.0, 20.0]
    with refuses(InputError, "T_start", "gain"):
        heated(FMU(room, states={"T": ""}, inputs={"heat": ""}, start={"T": "gain"}), 15.0)


def test_a_state_that_follows_from_others_must_be_so_in_the_task(room: Path) -> None:
    system = FMU(room, states={"T": "", "above": ""}, inputs={"heat": ""}, start={"T": "T_start"})
    assert heated(system, 15.0, -5.0) == [15.0, 15.05, 15.0995]
    with refuses(InputError, "T_start", "gain"):
        heated(system, 15.0, 0.0)


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        ({"start": {"T": "above"}}, ("start", "above")),
        ({"parameters": {"above": 1.0}}, ("parameters", "above")),
        ({"inputs": {"T_start": "K"}}, ("FMU", "T_start")),
    ],
)
def test_what_the_description_does_not_allow_is_refused(
    room: Path, options: dict[str, Any], facts: tuple[object, ...]
) -> None:
    with refuses(InputError, *facts):
        FMU(room, **{"states": {"T": "K"}, "inputs": {"heat": "W"}, **options})


@pytest.mark.parametrize("path", ["fmi2", *more("fmi3")], indirect=True)
def test_an_initial_state_that_is_not_taken_is_an_error(path: Path) -> None:
    # The start values go to the mass, so that the position stays where it was.
    system = FMU(path, **NAMES, start={"position": "mass"})
    with refuses(InputError, [1.0, -0.5], [0.0, -0.5]):
        system.execute(feedback, TASK)


def test_start_values_that_are_refused_are_an_error(fmi2: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # In this process, and with an FMU that refuses everything: those that are built here refuse no start value.
    unit = fmu_process.Unit(str(unpacked(fmi2)), "a.fmu", [0, 1], [2], ["position", "speed"], {})

    class Refusing:
        def refuse(self, *arguments: object, **options: object) -> None:
            raise RuntimeError("calculated")

        setReal = getReal = setupExperiment = refuse  # noqa: N815

    monkeypatch.setattr("fmpy.simulation.instantiate_fmu", lambda *arguments, **options: Refusing())
    with refuses(fmu_process.Refused, "position", "speed", "calculated") as caught:
        unit.begin([1.0, 2.0], 0.1, 1)
    assert caught.value.args[1]
    with refuses(fmu_process.Refused, "a.fmu", "calculated"):
        unit.begin([None, None], 0.1, 1)


def unpacked(path: Path) -> Path:
    folder = path.with_suffix(".unpacked")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder)
    return folder


def test_an_fmu_may_end_the_simulation(fmi3: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def step(self: Any, time: float, dt: float) -> tuple[bool, bool, bool, float]:
        return False, time > 0.25, False, time

    monkeypatch.setattr(fmpy.fmi3.FMU3Slave, "doStep", step)
    unit = fmu_process.Unit(str(unpacked(fmi3)), "a.fmu", [1, 2], [3], ["position", "speed"], {"mass": 3.0})
    assert unit.begin([1.0, 2.0], 0.1, 1) == [1.0, 2.0]
    answers = [unit.advance([0.0]) for _ in range(4)]
    assert_names([reason for _, reason in answers], "FMU")
    assert answers[-1][0] is None
    unit.free()


def test_the_process_serves_line_by_line(fmi2: Path) -> None:
    setup = {"folder": str(unpacked(fmi2)), "name": "a.fmu", "states": [0, 1], "inputs": [2]}
    lines: list[Any] = [{**setup, "start": ["position", "speed"], "parameters": {"teeth": 4}}]
    lines += [["begin", [1.0, 2.0], 0.1, 1], ["advance", [0.0]], ["free"], ["begin", [1.0], 0.1, 1], ["free"]]
    answers = io.StringIO()
    fmu_process.serve(io.StringIO("".join(json.dumps(line) + "\n" for line in lines)), answers)
    values = [json.loads(line)["value"] for line in answers.getvalue().splitlines()]
    assert values[0] == [1.0, 2.0]
    assert values[1][0] == [1.2, pytest.approx(1.98)]
    assert values[2:] == [None, [0.0, 0.0], None]


@pytest.mark.slow
@pytest.mark.parametrize("path", ["fmi2", *more("fmi3")], indirect=True)
def test_threads_do_not_disturb_each_other(path: Path) -> None:
    system = FMU(path, **NAMES)
    alone = system.execute(feedback, TASK).states
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        for trajectory in pool.map(lambda _: system.execute(feedback, TASK), range(12)):
            np.testing.assert_array_equal(trajectory.states, alone)


@pytest.mark.slow
@pytest.mark.parametrize("path", ["fmi2", *more("fmi3")], indirect=True)
def test_shapes_and_steps_must_fit(path: Path) -> None:
    with refuses(ShapeError, 2, 3):
        FMU(path, **NAMES).execute(feedback, Task(np.zeros(3), horizon=2, dt=0.1))
    with refuses(ShapeError, (1,), (2,)):
        FMU(path, **NAMES).execute(lambda t, x: x, TASK)
    with refuses(InputError, "substeps", 0):
        FMU(path, **NAMES, substeps=0)


def test_other_files_are_refused(tmp_path: Path, fmi2: Path) -> None:
    junk = tmp_path / "junk.fmu"
    junk.write_bytes(b"junk")
    for wrong in (junk, tmp_path / "missing.fmu"):
        with refuses(InputError, "FMU"):
            FMU(wrong, **NAMES)
    hollow = tmp_path / "hollow.fmu"
    with zipfile.ZipFile(fmi2) as whole, zipfile.ZipFile(hollow, "w") as rest:
        rest.writestr("modelDescription.xml", whole.read("modelDescription.xml"))
    with refuses(InputError, "hollow.fmu", "Cart.so"):
        FMU(hollow, **NAMES)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs FIFOs")
def test_a_fifo_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.fmu")
    with refuses(InputError, "a.fmu", "FMU", "FIFO"):
        FMU(tmp_path / "a.fmu", **NAMES)


def test_an_archive_that_cannot_be_unpacked_is_refused(tmp_path: Path, fmi2: Path) -> None:
    path = tmp_path / "odd.fmu"
    with zipfile.ZipFile(fmi2) as whole, zipfile.ZipFile(path, "w") as odd:
        odd.writestr("modelDescription.xml", whole.read("modelDescription.xml"))
        odd.writestr("C:/driver.dll", b"")
    with refuses(InputError, "odd.fmu", "C", "driver.dll"):
        FMU(path, **NAMES)


def test_without_fmpy_the_extra_is_named(fmi2: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with refuses(InputError, "ctxval[fmu]"):
        FMU(fmi2, **NAMES)


@pytest.mark.parametrize("path", ["fmi2", *more("fmi3")], indirect=True)
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


WHOLE = """
name = "cart"
budget = 4
threshold = 5.0
store = "cart.sqlite"

[space]
goal = [0.5, 2.0, "m"]

[task]
initial_state = [0, 0]
goal = ["goal", 0]
horizon = 15
dt = 0.1

[system]
type = "FMU"
source = "unit.fmu"
states = { position = "m", speed = "m/s" }
inputs = { force = "N" }
parameters = { mass = 2.0 }

[model]
type = "Linear"
data = { logs = ["run1.csv", "run2.csv"] }

[synthesizer]
type = "LQR"
Q = [10, 1]
R = [0.1]
limits = 5.0

[distance]
type = "FinalState"

[search]
type = "gp-ucb"
"""


@pytest.mark.parametrize("path", ["fmi2", *more("fmi3")], indirect=True)
def test_one_fmu_as_model_and_as_system_has_the_distance_0(path: Path) -> None:
    one, system = FMU(path, **NAMES), FMU(path, **NAMES)
    validation = Validation(
        space=TaskSpace(start=(0.5, 1.0)),
        task=lambda p: Task([p.start, -0.5], horizon=10, dt=0.1),
        system=system,
        model=lambda x, u: one.execute(lambda t, _: u, Task(x, horizon=1, dt=0.1)).final_state,
        synthesizer=controllers.Policy(lambda t, x, task: feedback(t, x), vectorized=False),
        distance=distances.MaximumDeviation(),
    )
    assert validation.distances([[0.5], [1.0]]).tolist() == [0.0, 0.0]


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.usefixtures("without_costs")
@pytest.mark.parametrize("path", ["fmi2", *more("fmi3")], indirect=True)
def test_an_experiment_file_validates_a_learned_model_on_an_fmu(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(path, "unit.fmu")
    Path("experiment.toml").write_text(WHOLE)
    rng = np.random.default_rng(0)
    for name in ("run1.csv", "run2.csv"):
        FMU("unit.fmu", **NAMES).execute(lambda t, x: rng.normal(size=1), TASK).to_csv(name)

    def report(*arguments: str) -> dict[str, Any]:
        result = CliRunner().invoke(app, [*arguments, "--json"])
        assert result.exit_code == 0, result.stderr
        found: dict[str, Any] = json.loads(result.stdout)
        return found

    assert report("check", "experiment.toml", "--execute")["ok"]
    ran = report("run", "experiment.toml", "--no-report")
    assert (ran["executions"], ran["failed"], ran["threshold"]) == (4, 0, 5.0)
    assert ran["worst"]["distance"] > 0
    assert report("status", "cart.sqlite")["executions"] == 4
    again = report("run", "experiment.toml", "--budget", "5", "--no-report")
    assert again["executions"] == 5
    assert len(Store("cart.sqlite").trials()) == 5
    status = CliRunner().invoke(
        app, ["run", "experiment.toml", "--budget", "5", "--threshold", "1e-9", "--no-report", "--json"]
    )
    assert (status.exit_code, json.loads(status.stdout)["verdict"]) == (1, "falsified")
