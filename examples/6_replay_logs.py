"""From logs to a report: recordings in MCAP, and a model that somebody learned from one of them.

Needs the extras mujoco and logs.
"""

import json
import tempfile
from pathlib import Path

import mujoco
import numpy as np
from mcap.writer import Writer

from ctxval import models
from ctxval.data import LogMapping, read_recordings
from ctxval.studies.replay import replay

PENDULUM = """
<mujoco><option timestep="0.02"/><worldbody><body>
  <joint name="hinge" type="hinge" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.5"/>
</body></worldbody><actuator><motor joint="hinge"/></actuator></mujoco>
"""


def record(path: Path, seed: int) -> None:
    """Record the pendulum under random torques. The motor gets each torque two steps after it is logged."""
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    torques = np.repeat(0.3 * rng.normal(size=60), 5)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("joint", "jsonschema", b"{}")
        topic = writer.register_channel("/joint", "json", schema)
        for k, torque in enumerate(torques):
            message = {"angle": data.qpos[0], "rate": data.qvel[0], "torque": torque}
            writer.add_message(topic, 20_000_000 * k, json.dumps(message).encode(), 20_000_000 * k)
            data.ctrl[0] = torques[max(k - 2, 0)]
            mujoco.mj_step(model, data)
        writer.finish()


with tempfile.TemporaryDirectory() as folder:
    for seed in range(8):
        record(Path(folder, f"run{seed}.mcap"), seed)
    fields = {"states": {"angle": "/joint.angle", "rate": "/joint.rate"}, "inputs": {"torque": "/joint.torque"}}
    recordings = read_recordings([folder], LogMapping.from_table(fields))
    model = models.Linear.fit(recordings.transitions([0])[0])

    first = replay(model, recordings)
    print(f"{first.data.recordings} recordings; the model was learned from {first.data.seen} of them.")
    print(*first.insights, sep="\n")

    corrected = read_recordings([folder], LogMapping.from_table(fields), delay=0.04)
    second = replay(models.Linear.fit(corrected.transitions([0])[0]), corrected)
    rates = [next(e.rms for e in one.errors if e.state == "rate" and e.steps == 1) for one in (first, second)]
    print(f"With the delay, the one-step error of the rate falls from {rates[0]:.3f} to {rates[1]:.3f} rad/s.")
