"""One run of a cart, and the same run as a file of every kind, written by the libraries that users write them with."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ctxval import Trajectory

DT = 0.05


def run(steps: int = 60, seed: int = 0, friction: float = 0.3, dt: float = DT) -> Trajectory:
    """Return a run of a cart with friction under random forces: the states are its position and its speed."""
    rng = np.random.default_rng(seed)
    states, inputs = np.zeros((steps + 1, 2)), 2 * rng.normal(size=(steps, 1))
    states[0] = rng.normal(size=2)
    for k in range(steps):
        position, speed = states[k]
        states[k + 1] = [position + dt * speed, speed + dt * (inputs[k, 0] - friction * speed)]
    return Trajectory(dt * np.arange(steps + 1), states, inputs)


def write_mcap_json(path: Path, one: Trajectory, *, start: int = 10**18, lost: tuple[int, ...] = ()) -> None:
    """Write the run to MCAP with messages in JSON; some messages of the states may be lost."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("cart", "jsonschema", b'{"type": "object"}')
        topics = {name: writer.register_channel(name, "json", schema) for name in ("/state", "/command")}
        for k, time in enumerate(one.times):
            stamp = start + round(1e9 * time)
            position, speed = one.states[k].tolist()
            sent: dict[str, Any] = {"/state": {"cart": {"position": position, "speed": [speed]}, "name": "cart"}}
            if k in lost:
                sent = {}
            if k < one.horizon:
                sent["/command"] = {"force": one.inputs[k, 0]}
            for name, content in sent.items():
                data = json.dumps(content).encode()
                writer.add_message(topics[name], log_time=stamp, publish_time=stamp - 10**6, data=data)
        writer.finish()


JOINTS = """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def write_mcap_ros2(path: Path, one: Trajectory, *, late: float | np.ndarray = 0.0) -> None:
    """Write the run to MCAP as ROS 2 messages. Log times are late, header stamps are not."""
    from mcap_ros2.writer import Writer

    with path.open("wb") as file, Writer(file) as writer:
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", JOINTS)
        for k, time in enumerate(one.times):
            stamp = 5 * 10**9 + round(1e9 * time)
            effort = one.inputs[k].tolist() if k < one.horizon else [0.0]
            message = {
                "header": {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": "base"},
                "name": ["cart"],
                "position": [one.states[k, 0]],
                "velocity": [one.states[k, 1]],
                "effort": effort,
            }
            logged = stamp + round(1e9 * float(np.broadcast_to(late, len(one.times))[k]))
            writer.write_message("/joints", schema, message, log_time=logged, publish_time=stamp)


def write_bag(path: Path, one: Trajectory, *, storage: str = "sqlite3", late: float | np.ndarray = 0.0) -> None:
    """Write the run as a ROS 2 bag with the library rosbags, which needs no ROS. Log times are late, stamps are not."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    joint, header = store.types["sensor_msgs/msg/JointState"], store.types["std_msgs/msg/Header"]
    clock = store.types["builtin_interfaces/msg/Time"]
    plugin = StoragePlugin.SQLITE3 if storage == "sqlite3" else StoragePlugin.MCAP
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        topic = writer.add_connection("/joints", joint.__msgtype__, typestore=store)
        for k, (time, delay) in enumerate(zip(one.times, np.broadcast_to(late, len(one.times)), strict=True)):
            stamp = 5 * 10**9 + round(1e9 * time)
            head = header(stamp=clock(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="")
            effort = one.inputs[k] if k < one.horizon else np.zeros(1)
            message = joint(head, ["cart"], one.states[k, :1].copy(), one.states[k, 1:].copy(), effort.copy())
            writer.write(topic, stamp + round(1e9 * float(delay)), store.serialize_cdr(message, joint.__msgtype__))


def write_bag1(path: Path, one: Trajectory, *, to_mcap: bool = False) -> None:
    """Write the run as a bag of ROS 1 with the library rosbags, or its messages to MCAP."""
    from mcap.writer import Writer as McapWriter
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    joint, header = store.types["sensor_msgs/msg/JointState"], store.types["std_msgs/msg/Header"]
    clock = store.types["builtin_interfaces/msg/Time"]
    stamps, messages = [], []
    for k, time in enumerate(one.times):
        stamps.append(5 * 10**9 + round(1e9 * time))
        head = header(seq=k, stamp=clock(sec=stamps[-1] // 10**9, nanosec=stamps[-1] % 10**9), frame_id="")
        effort = one.inputs[k] if k < one.horizon else np.zeros(1)
        message = joint(head, ["cart"], one.states[k, :1].copy(), one.states[k, 1:].copy(), effort.copy())
        messages.append(bytes(store.serialize_ros1(message, joint.__msgtype__)))
    if not to_mcap:
        with Writer(path) as bag:
            topic = bag.add_connection("/joints", joint.__msgtype__, typestore=store)
            for stamp, data in zip(stamps, messages, strict=True):
                bag.write(topic, stamp, data)
        return
    definition, _ = store.generate_msgdef(joint.__msgtype__, ros_version=1)
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros1")
        schema = writer.register_schema("sensor_msgs/JointState", "ros1msg", definition.encode())
        channel = writer.register_channel("/joints", "ros1", schema)
        for stamp, data in zip(stamps, messages, strict=True):
            writer.add_message(channel, stamp, data, stamp)
        writer.finish()


def write_mat(path: Path, one: Trajectory, *, version: str) -> None:
    """Write the run as a MATLAB file: a structure ``log`` with columns, and the inputs as a row."""
    padded = np.append(one.inputs[:, 0], 0.0)
    content: Mapping[str, Any] = {
        "log": {"time": one.times[:, None], "state": one.states, "label": "cart"},
        "force": padded[None, :],
    }
    if version == "7.3":
        import hdf5storage

        hdf5storage.savemat(str(path), dict(content), format="7.3", oned_as="column")
    else:
        from scipy.io import savemat

        savemat(path, dict(content))


def write_parquet(path: Path, one: Trajectory) -> None:
    """Write the run as a Parquet file with a column for each state."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {"time": one.times, "position": one.states[:, 0], "speed": one.states[:, 1]}
    columns["force"] = np.append(one.inputs[:, 0], np.nan)
    pq.write_table(pa.table(columns), path)


def write_lerobot(folder: Path, runs: list[Trajectory], *, version: str = "v3.0") -> None:
    """Write runs as the episodes of a LeRobot data set: version 3 has many episodes in one file, version 2 has one."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    fps = round(1 / (runs[0].times[1] - runs[0].times[0]))
    names: Any = ["position", "speed"] if version.startswith("v3") else {"motors": ["position", "speed"]}
    info = {
        "codebase_version": version,
        "fps": fps,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "features": {
            "observation.state": {"dtype": "float32", "shape": [2], "names": names},
            "action": {"dtype": "float32", "shape": [1], "names": ["force"]},
        },
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    chunk = folder / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    tables = [_episode(number, one, fps) for number, one in enumerate(runs)]
    if version.startswith("v3"):
        pq.write_table(pa.concat_tables(tables), chunk / "file-000.parquet")
    else:
        for number, table in enumerate(tables):
            pq.write_table(table, chunk / f"episode_{number:06d}.parquet")


def _episode(number: int, one: Trajectory, fps: int) -> Any:
    import pyarrow as pa

    count = one.horizon  # the state and the action of each frame
    return pa.table(
        {
            "observation.state": pa.array(list(one.states[:count].astype(np.float32)), pa.list_(pa.float32(), 2)),
            "action": pa.array(list(one.inputs.astype(np.float32)), pa.list_(pa.float32(), 1)),
            "timestamp": (np.arange(count) / fps).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, number),
            "index": np.arange(count) + 1000 * number,
            "task_index": np.zeros(count, dtype=np.int64),
        }
    )
