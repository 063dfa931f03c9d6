"""From a folder of recordings to a report: `ctxval replay` in a fresh process, on recordings of three kinds.

MuJoCo's pendulum is recorded to MCAP, to a MATLAB file of version 7.3 and to a LeRobot data set, each written by the
library that users write it with. The times are those of whole processes, with all imports, on the processor and on the
clock. With ``--install`` the wheel of this package with its extra ``logs`` is first installed into a new virtual
environment, from the package index and without a cache, and the command runs there, from install to report. The results
are kept in ``benchmarks/results/replay.json``, and docs/how-to/replay.md states them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import hdf5storage
import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from mcap.writer import Writer

from ctxval import Transitions, models

RUNS, STEPS, DT = 8, 300, 0.02
ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "replay.json"

PENDULUM = """
<mujoco><option timestep="0.002"/><worldbody><body>
  <joint name="hinge" type="hinge" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.5"/>
</body></worldbody><actuator><motor joint="hinge"/></actuator></mujoco>
"""


def record(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the times, states and inputs of one run under random torques."""
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    data.qpos[0] = rng.uniform(-0.5, 0.5)
    states, inputs = [], np.repeat(0.3 * rng.normal(size=STEPS // 10), 10)
    for torque in inputs:
        states.append([data.qpos[0], data.qvel[0]])
        data.ctrl[0] = torque
        for _ in range(round(DT / model.opt.timestep)):
            mujoco.mj_step(model, data)
    return DT * np.arange(STEPS), np.array(states), inputs[:, None]


def to_mcap(folder: Path, number: int, times: np.ndarray, states: np.ndarray, inputs: np.ndarray) -> None:
    """Write a run as messages in JSON on two topics."""
    with (folder / f"run{number}.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("joint", "jsonschema", b"{}")
        topics = [writer.register_channel(name, "json", schema) for name in ("/joint", "/torque")]
        for t, (angle, rate), u in zip(times, states.tolist(), inputs[:, 0].tolist(), strict=True):
            for topic, content in zip(topics, ({"angle": angle, "rate": rate}, {"value": u}), strict=True):
                stamp = round(1e9 * t)
                writer.add_message(topic, log_time=stamp, publish_time=stamp, data=json.dumps(content).encode())
        writer.finish()


def to_mat(folder: Path, number: int, times: np.ndarray, states: np.ndarray, inputs: np.ndarray) -> None:
    """Write a run as a structure in a MATLAB file of version 7.3."""
    content = {"log": {"t": times[:, None], "x": states, "u": inputs}}
    hdf5storage.savemat(str(folder / f"run{number}.mat"), content, format="7.3")


def to_lerobot(folder: Path, runs: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> None:
    """Write runs as the episodes of a LeRobot data set of version 3."""
    features = {"observation.state": {"names": ["angle", "rate"]}, "action": {"names": ["torque"]}}
    (folder / "meta").mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps({"fps": 50, "codebase_version": "v3.0", "features": features}))
    (folder / "data/chunk-000").mkdir(parents=True)
    columns = {
        "observation.state": [row.astype(np.float32) for _, states, _ in runs for row in states],
        "action": [row.astype(np.float32) for _, _, inputs in runs for row in inputs],
        "timestamp": np.concatenate([times for times, _, _ in runs]).astype(np.float32),
        "episode_index": np.repeat(np.arange(len(runs)), STEPS),
    }
    pq.write_table(pa.table(columns), folder / "data/chunk-000/file-000.parquet")


def arguments(folder: Path, kind: str) -> list[str]:
    """Return the options that name the fields of a data set."""
    if kind == "mcap":
        return ["--state", "angle=/joint.angle", "--state", "rate=/joint.rate", "--input", "torque=/torque.value"]
    if kind == "mat":
        return ["--time", "log.t", "--state", "x=log.x", "--input", "torque=log.u"]
    return []


def timed(command: list[str], folder: Path) -> tuple[str, dict[str, float]]:
    """Run a command; return what it printed, and its seconds on the processor and on the clock."""
    before = os.times()
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    after = os.times()
    assert done.returncode == 0, done.stderr
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return done.stdout, {"cpu": round(cpu, 2), "wall": round(after.elapsed - before.elapsed, 2)}


def installed(folder: Path) -> tuple[list[str], dict[str, float]]:
    """Install this package into a new virtual environment; return its command line, and what this took."""
    wheels, environment = folder / "wheels", folder / "environment"
    timed([sys.executable, "-m", "pip", "wheel", "--no-deps", "--wheel-dir", str(wheels), str(ROOT)], folder)
    (wheel,) = wheels.glob("*.whl")
    _, made = timed([sys.executable, "-m", "venv", str(environment)], folder)
    pip = [str(environment / "bin" / "pip"), "install", "--quiet", "--no-cache-dir", f"{wheel}[logs]"]
    _, taken = timed(pip, folder)
    return [str(environment / "bin" / "ctxval")], {key: round(made[key] + taken[key], 2) for key in made}


def write_data_sets(folder: Path) -> None:
    """Write the three data sets, and the linear model that is learned from the first run."""
    runs = [record(seed) for seed in range(RUNS)]
    first = runs[0]
    learned = models.Linear.fit(Transitions(first[1][:-1], first[2][:-1], first[1][1:]))
    np.savez(folder / "model.npz", A=learned.A, B=learned.B)
    for kind, write in (("mcap", to_mcap), ("mat", to_mat)):
        (folder / kind).mkdir()
        for number, one in enumerate(runs):
            write(folder / kind, number, *one)
    to_lerobot(folder / "lerobot", runs)


def main() -> None:
    """Write the three data sets, and replay each in a process of its own."""
    if "--install" in sys.argv:
        os.environ.pop("PYTHONPATH", None)  # the new environment must have everything itself
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_data_sets(folder)
        program, found = [sys.executable, "-m", "ctxval"], {}
        if "--install" in sys.argv:
            program, found["install"] = installed(folder)
        for kind in ("mcap", "mat", "lerobot"):
            command = [*program, "replay", kind, "--model", "model.npz", *arguments(folder, kind)]
            printed, times = timed([*command, "--json"], folder)
            report = json.loads(printed)
            data = report["data"]
            found[kind] = {**times, "recordings": data["recordings"], "steps": data["steps"]}
            error = max(one["relative"] for one in report["errors"] if one["steps"] == 1)
            print(
                f"{kind}: {data['recordings']} recordings, {data['steps']} steps, {times['cpu']} s of processor time,"
            )
            print(f"  {times['wall']} s in all; one-step error at most {100 * error:.2g} %")
        if "install" in found:
            whole = {key: sum(one[key] for one in found.values()) for key in ("cpu", "wall")}
            print(f"install: {found['install']}; from install to three reports: {whole}")
            RESULTS.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
