"""Every reader returns the run that the real library wrote."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ctxval import Trajectory
from ctxval.data import LogMapping, Recordings, read_logs, read_recordings
from ctxval.data.messages import ros_decoder
from ctxval.errors import InputError
from facts import assert_names, refuses
from rig_logs import (
    DT,
    run,
    write_bag,
    write_bag1,
    write_lerobot,
    write_mat,
    write_mcap_json,
    write_mcap_ros2,
    write_parquet,
)

CART = LogMapping.from_table(
    {
        "states": {"position": "/state.cart.position", "speed": "/state.cart.speed[0]"},
        "inputs": {"force": "/command.force"},
    }
)
JOINTS = LogMapping.from_table(
    {
        "states": {"position": "/joints.position[0]", "speed": "/joints.velocity[0]"},
        "inputs": {"force": "/joints.effort"},
    }
)
TABLE = LogMapping.from_table({"states": {"position": "position", "speed": "speed"}, "inputs": {"force": "force"}})
MATLAB = LogMapping.from_table({"states": {"s": "log.state"}, "inputs": {"force": "force"}, "time": "log.time"})


def to_csv(path: Path, one: Trajectory) -> None:
    one.to_csv(path, states=["position [m]", "speed [m/s]"], inputs=["force [N]"])


def to_npz(path: Path, one: Trajectory) -> None:
    path.write_bytes(one.to_npz())


WRITTEN: dict[str, tuple[Callable[[Path, Trajectory], None], LogMapping | None]] = {
    "run.csv": (to_csv, TABLE),
    "run.npz": (to_npz, None),
    "json.mcap": (write_mcap_json, CART),
    "ros2.mcap": (write_mcap_ros2, JOINTS),
    "bag": (write_bag, JOINTS),
    "ros1.bag": (write_bag1, JOINTS),
    "ros1.mcap": (lambda path, one: write_bag1(path, one, to_mcap=True), JOINTS),
    "bag of mcap": (lambda path, one: write_bag(path, one, storage="mcap"), JOINTS),
    "level5.mat": (lambda path, one: write_mat(path, one, version="5"), MATLAB),
    "level73.mat": (lambda path, one: write_mat(path, one, version="7.3"), MATLAB),
    "run.parquet": (write_parquet, TABLE),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_file_of_each_kind_is_read_back(name: str, tmp_path: Path) -> None:
    write, mapping = WRITTEN[name]
    one = run()
    write(tmp_path / name, one)
    found = read_recordings([tmp_path / name], mapping)
    assert (len(found.runs), found.breaks, found.dt) == (1, (), DT)
    assert (len(found.states), len(found.inputs)) == (2, 1)
    np.testing.assert_array_equal(found.runs[0].trajectory.states, one.states)
    np.testing.assert_array_equal(found.runs[0].trajectory.inputs, one.inputs)
    assert found.runs[0].source.startswith(str(tmp_path / name))


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_the_episodes_of_a_lerobot_data_set_are_recordings_with_its_names(version: str, tmp_path: Path) -> None:
    runs = [run(seed=seed) for seed in range(3)]
    write_lerobot(tmp_path / "set", runs, version=version)
    found = read_recordings([tmp_path / "set"])
    assert (len(found.runs), found.dt, found.breaks) == (3, DT, ())
    assert (list(found.states), list(found.inputs)) == (["position", "speed"], ["force"])
    for recording, one in zip(found.runs, runs, strict=True):
        # The last frame has an action and no next state.
        np.testing.assert_allclose(recording.trajectory.states, one.states[:-1], atol=1e-6)
        np.testing.assert_allclose(recording.trajectory.inputs, one.inputs[:-1], atol=1e-6)
    assert "episode 2" in found.runs[2].source


def test_states_and_actions_of_one_name_are_kept_apart(tmp_path: Path) -> None:
    write_lerobot(tmp_path / "set", [run()])
    info = tmp_path / "set" / "meta" / "info.json"
    info.write_text(info.read_text().replace('["force"]', '["position"]'))
    assert list(read_recordings([tmp_path / "set"]).inputs) == ["position command"]


def test_the_storage_file_of_a_bag_is_read_alone(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", run())
    (storage,) = (tmp_path / "bag").glob("*.db3")
    assert read_recordings([storage], JOINTS).steps == 60


def test_the_definition_of_a_message_that_an_old_bag_lacks_is_that_of_ros(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", run())
    (storage,) = (tmp_path / "bag").glob("*.db3")
    with sqlite3.connect(storage) as database:
        database.execute("DELETE FROM message_definitions")
    np.testing.assert_array_equal(read_recordings([storage], JOINTS).runs[0].trajectory.states, run().states)
    with sqlite3.connect(storage) as database:
        database.execute("UPDATE topics SET type = 'my_robot/msg/State'")
    with refuses(InputError, "my_robot", "bag.db3"):
        read_recordings([storage], JOINTS)


def test_messages_have_three_times(tmp_path: Path) -> None:
    one = run(4)
    write_mcap_ros2(tmp_path / "a.mcap", one, late=0.25)
    table = {"states": {"position": "/joints.position"}, "inputs": {"force": "/joints.effort"}}
    log = read_logs([tmp_path / "a.mcap"])[0]
    for stamp in ("log", "publish", "header"):
        clock = LogMapping.from_table({**table, "stamp": stamp}).clock
        times = log.signals(["/joints.position"], clock)["/joints.position"].times
        np.testing.assert_allclose(times, one.times, atol=1e-9)
    write_mcap_json(tmp_path / "b.mcap", one)
    with refuses(InputError, 0, "header.stamp"):
        read_recordings([tmp_path / "b.mcap"], LogMapping(CART.states, stamp="header"))


def test_all_files_of_a_folder_are_read_in_the_order_of_their_names(tmp_path: Path) -> None:
    for seed in (2, 0, 1):
        to_csv(tmp_path / f"{seed}.csv", run(10 + seed, seed))
    (tmp_path / "notes.txt").write_text("no log")
    found = read_recordings([tmp_path], TABLE)
    assert [one.trajectory.horizon for one in found.runs] == [10, 11, 12]
    transitions, sources = found.transitions()
    assert (len(transitions), found.steps) == (33, 33)
    assert sources.tolist() == [0] * 10 + [1] * 11 + [2] * 12


def test_a_batch_of_trajectories_in_one_npz_file_is_several_recordings(tmp_path: Path) -> None:
    states, inputs = (np.stack([getattr(run(seed=seed), name) for seed in range(3)]) for name in ("states", "inputs"))
    (tmp_path / "a.npz").write_bytes(Trajectory(run().times, states, inputs).to_npz())
    found = read_recordings([tmp_path / "a.npz"])
    assert len(found.runs) == 3
    np.testing.assert_array_equal(found.runs[2].trajectory.states, run(seed=2).states)


@pytest.mark.parametrize("shape", [(60, 1), (2, 60, 1)])
def test_states_and_inputs_of_different_batches_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.savez(tmp_path / "a.npz", times=np.arange(61.0), states=np.zeros((61, 2, 1)), inputs=np.zeros(shape))
    with refuses(InputError, "a.npz", (61, 2, 1)):
        read_recordings([tmp_path / "a.npz"])


def test_a_log_without_times_has_one_row_for_each_step(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x0,u0\n1,5\n2,6\n4,7\n")
    found = read_recordings(
        [tmp_path / "a.csv"], LogMapping.from_table({"states": {"x0": "x0"}, "inputs": {"u0": "u0"}, "dt": 0.1})
    )
    np.testing.assert_allclose(found.runs[0].trajectory.times, [0, 0.1, 0.2])
    assert found.runs[0].trajectory.inputs.tolist() == [[5], [6]]
    with refuses(InputError, "a.csv"):
        read_recordings([tmp_path / "a.csv"])


def broken(tmp_path: Path, name: str, content: str | bytes) -> Path:
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(
    ("name", "content", "facts"),
    [
        (
            "a.csv",
            "t,position,speed,force\n0,1,2,3\n0.1,1,fast,3\n",
            ("a.csv", 3, "speed"),
        ),
        ("a.csv", "t,position,speed\n0,1,2\n0.1,1,2\n", ("a.csv", "force")),
        ("a.csv", "t,position,speed,force\n0,1,2,3\nlate,1,2,3\n", ("a.csv", 3, "late")),
        ("a.csv", "t,position,speed,force\n,1,2,3\n0.1,1,2,3\n", ("a.csv", 2, "t")),
        ("a.csv", "t,t,force\n", ("a.csv", "t")),
        ("a.csv", "", ("a.csv",)),
        ("a.csv", b"t,x\n\x81", ("a.csv", "charmap")),
        ("a.csv", "t,position,speed,force\n0,1,2,3\n", ("a.csv",)),
        ("a.npz", b"PK", ("a.npz",)),
        ("a.mat", b"MATLAB", ("a.mat",)),
        ("a.mcap", b"\x89MCAP0\r\n", ("a.mcap", "MCAP")),
        ("a.parquet", b"PAR1", ("a.parquet", 4)),
        ("a.db3", b"SQLite format 3", ("a.db3", "ROS", 2)),
        ("a.rrd", b"", ("a.rrd", "files")),
    ],
)
def test_what_cannot_be_read_is_named_by_file_field_and_row(
    name: str, content: str | bytes, facts: tuple[object, ...], tmp_path: Path
) -> None:
    with refuses(InputError, *facts):
        read_recordings([broken(tmp_path, name, content)], TABLE)


@pytest.mark.parametrize("name", [name for name in WRITTEN if "." in name])
def test_half_a_file_is_refused_or_read_in_part(name: str, tmp_path: Path) -> None:
    write, mapping = WRITTEN[name]
    write(tmp_path / name, run())
    content = (tmp_path / name).read_bytes()
    for share in (0.1, 0.5, 0.9):
        (tmp_path / name).write_bytes(content[: int(share * len(content))])
        try:
            steps, said = read_recordings([tmp_path / name], mapping).steps, name
        except InputError as error:
            steps, said = 0, str(error)
        assert (steps < 60, name in said) == (True, True)


def test_fields_of_messages_are_named_if_one_is_missing_or_is_no_number(tmp_path: Path) -> None:
    write_mcap_json(tmp_path / "a.mcap", run(4))
    path = [tmp_path / "a.mcap"]
    with refuses(InputError, "/speed", "state.cart.position", "state.cart.speed[0]"):
        read_recordings(path, LogMapping.from_table({"states": {"/speed": "/speed"}}))
    with refuses(InputError, 0, "cart.angle"):
        read_recordings(path, LogMapping.from_table({"states": {"/state.cart.angle": "/state.cart.angle"}}))
    with refuses(InputError, 0, "cart"):
        read_recordings(path, LogMapping.from_table({"states": {"/state.name": "/state.name"}}))


def test_a_message_in_another_encoding_is_named(tmp_path: Path) -> None:
    from mcap.writer import Writer

    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("cart", "flatbuffer", b"")
        topic = writer.register_channel("/state", "flatbuffer", schema)
        writer.add_message(topic, log_time=0, publish_time=0, data=b"")
        writer.finish()
    with refuses(InputError, "flatbuffer", "a.mcap"):
        read_recordings([tmp_path / "a.mcap"], LogMapping.from_table({"states": {"/state.x": "/state.x"}}))


def test_components_that_a_vector_lacks_are_named(tmp_path: Path) -> None:
    write_lerobot(tmp_path / "set", [run(5)])
    with refuses(InputError, 2, "observation.state[2]"):
        read_recordings(
            [tmp_path / "set"], LogMapping.from_table({"states": {"observation.state[2]": "observation.state[2]"}})
        )


@pytest.mark.parametrize("content", ["{}", '{"fps": 0}', '{"fps": "fast"}', "[1]", "no json"])
def test_a_data_set_with_an_unusable_description_is_refused(content: str, tmp_path: Path) -> None:
    write_lerobot(tmp_path / "set", [run(5)])
    (tmp_path / "set" / "meta" / "info.json").write_text(content)
    with refuses(InputError, "info.json"):
        read_recordings([tmp_path / "set"])


def test_no_log_at_all_is_refused(tmp_path: Path) -> None:
    with refuses(InputError):
        read_logs([])
    with refuses(InputError, "absent.csv"):
        read_logs([tmp_path / "absent.csv"])
    with refuses(InputError, "files", 2):
        read_logs([tmp_path])


def test_logs_of_different_systems_are_not_read_as_one(tmp_path: Path) -> None:
    write_lerobot(tmp_path / "set", [run(5)])
    np.savez(tmp_path / "other.npz", t=np.arange(3.0), x=np.zeros((3, 3)), u=np.zeros((2, 1)))
    mapping = LogMapping.from_table({"states": {"x": "x"}, "inputs": {"u": "u"}})
    one = read_recordings([tmp_path / "other.npz"], mapping)
    assert isinstance(one, Recordings)
    np.savez(tmp_path / "third.npz", t=np.arange(3.0), x=np.zeros((3, 2)), u=np.zeros((2, 1)))
    with refuses(InputError, "third.npz", "other.npz"):
        read_recordings([tmp_path / "other.npz", tmp_path / "third.npz"], mapping)


def test_a_pickled_array_is_refused_and_its_code_does_not_run(tmp_path: Path) -> None:
    class Hostile:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return (Path.touch, (tmp_path / "ran",))  # type: ignore[return-value]

    np.savez(tmp_path / "a.npz", t=np.arange(2.0), x=np.array([Hostile(), Hostile()], dtype=object))
    with refuses(InputError, "x", "a.npz"):
        read_recordings([tmp_path / "a.npz"])
    assert not (tmp_path / "ran").exists()


@pytest.mark.slow
def test_a_message_definition_with_code_in_it_runs_nothing(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", run(3))
    (storage,) = (tmp_path / "bag").glob("*.db3")
    sentinel = tmp_path / "ran"
    with sqlite3.connect(storage) as database:
        text = f"float64[] position\nfloat64 x = __import__('pathlib').Path({str(sentinel)!r}).touch()\n"
        database.execute("UPDATE message_definitions SET encoded_message_definition = ?", (text,))
    with pytest.raises(InputError):
        read_recordings([storage], JOINTS)
    assert not sentinel.exists()


@pytest.mark.slow
def test_a_missing_library_is_named_with_its_extra(tmp_path: Path) -> None:
    write_parquet(tmp_path / "a.parquet", run(3))
    code = (
        "import sys; sys.modules['pyarrow'] = None; sys.modules['pyarrow.parquet'] = None\n"
        "from ctxval.data import read_logs\n"
        f"try: read_logs([{str(tmp_path / 'a.parquet')!r}])\n"
        "except Exception as error: print(error)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert_names(said.strip(), "ctxval[logs]")


def test_the_stamps_in_messages_of_ros_1_are_times_too(tmp_path: Path) -> None:
    one = run(4)
    write_bag1(tmp_path / "b.bag", one)
    (log,) = read_logs([tmp_path / "b.bag"])
    clock = LogMapping.from_table({"states": {"x": "x"}, "stamp": "header"}).clock
    times = log.signals(["/joints.effort"], clock)["/joints.effort"].times
    np.testing.assert_allclose(times, one.times, atol=1e-9)


def test_the_fields_of_ros_1_are_listed_if_one_is_missing(tmp_path: Path) -> None:
    write_bag1(tmp_path / "b.bag", run(4))
    wrong = LogMapping.from_table({"states": {"/joint.angle": "/joint.angle"}})
    with refuses(InputError, "joints.header.stamp.sec", "joints.position[0]", "joints.velocity"):
        read_recordings([tmp_path / "b.bag"], wrong)


def test_a_damaged_message_is_named(tmp_path: Path) -> None:
    write_bag1(tmp_path / "run.bag", run(4))
    whole = (tmp_path / "run.bag").read_bytes()
    length = b"\x04\x00\x00\x00cart\x01\x00\x00\x00"
    assert whole.count(length) == 5
    (tmp_path / "run.bag").write_bytes(whole.replace(length, length[:-4] + b"\xff\xff\xff\x7f", 1))
    with refuses(InputError, 0, "ValueError"):
        read_recordings([tmp_path / "run.bag"], JOINTS)
    (tmp_path / "cut.bag").write_bytes(whole[: len(whole) // 2])
    with refuses(InputError, "cut.bag", "ROS", 1):
        read_recordings([tmp_path / "cut.bag"], JOINTS)
    (tmp_path / "text.bag").write_text("no bag")
    with refuses(InputError, "text.bag", "ROS", 1):
        read_recordings([tmp_path / "text.bag"], JOINTS)


@pytest.mark.parametrize("version", [1, 2])
def test_every_type_of_ros_is_decoded_as_rosbags_encodes_it(version: int) -> None:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    moments = (
        ("time h", "duration i") if version == 1 else ("builtin_interfaces/Time h", "builtin_interfaces/Duration i")
    )
    of_moments = (
        ""
        if version == 1
        else f"""
{"=" * 80}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
{"=" * 80}
MSG: builtin_interfaces/Duration
int32 sec
uint32 nanosec
"""
    )
    definition = f"""bool a
byte b
char c
int16 d
uint64 e
float32 f
string g
{moments[0]}
{moments[1]}
float64[3] j
string[] k
Part[] l
uint8[] m
int32 CONSTANT=7
{"=" * 80}
MSG: rig/Part
int8 x
float64[] y
{of_moments}"""
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    store.register(
        {name: fields for name, fields in get_types_from_msg(definition, "rig/msg/All").items() if name[:3] == "rig"}
    )
    types = store.types
    clock, lasting = types["builtin_interfaces/msg/Time"], types["builtin_interfaces/msg/Duration"]
    parts = [types["rig/msg/Part"](x=-1, y=np.array([0.5])), types["rig/msg/Part"](x=2, y=np.array([]))]
    message = types["rig/msg/All"](
        *(True, 3 - 6 * (version == 1), 200, -300, 2**63, 0.25, "caf\u00e9", clock(1_000_000_000, 5), lasting(-6, 7)),
        *(np.array([1.0, 2.0, 3.0]), ["a", ""], parts, np.array([1, 2], dtype=np.uint8)),
    )
    encode = store.serialize_ros1 if version == 1 else store.serialize_cdr
    data, decode = (
        bytes(encode(message, "rig/msg/All")),
        ros_decoder("rig/msg/All", definition.encode(), aligned=version == 2),
    )
    found = decode(data)
    plain = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in found.items()}
    parts_found = [{"x": one["x"], "y": one["y"].tolist()} for one in plain.pop("l")]
    assert parts_found == [{"x": -1, "y": [0.5]}, {"x": 2, "y": []}]
    times = {"h": {"sec": 1_000_000_000, "nanosec": 5}, "i": {"sec": -6, "nanosec": 7}}
    numbers = {"a": True, "b": 3 - 6 * (version == 1), "c": 200, "d": -300, "e": 2**63, "f": 0.25, "g": "caf\u00e9"}
    assert plain == {**numbers, **times, "j": [1, 2, 3], "k": ["a", ""], "m": [1, 2]}
    for size in range(len(data)):
        with refuses(ValueError):
            decode(data[:size])
    if version == 2:
        large = bytes(store.serialize_cdr(message, "rig/msg/All", little_endian=False))
        assert large != data
        assert str(decode(large)) == str(found)


def test_a_definition_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    write_bag1(tmp_path / "a.bag", run(4))
    content = (tmp_path / "a.bag").read_bytes()
    (tmp_path / "a.bag").write_bytes(content.replace(b"float64[] position", b"float64[  position"))
    with refuses(InputError, "a.bag", "sensor_msgs/msg/JointState"):
        read_recordings([tmp_path / "a.bag"], JOINTS)


def test_header_stamps_are_the_times_if_they_are_plausible(tmp_path: Path) -> None:
    one = run(20)
    jitter = 0.01 * np.random.default_rng(0).uniform(size=21)
    for name, late in (("late.mcap", jitter), ("wild.mcap", 30 * np.arange(21) % 7)):
        write_mcap_ros2(tmp_path / name, one, late=late)
        found = read_recordings([tmp_path / name], JOINTS, longest_gap=1e9)
        assert any("stamps" in note for note in found.notes) == (name[0] == "l")
    (log,) = read_logs([tmp_path / "late.mcap"])
    times = log.signals(["/joints.effort"], JOINTS.clock)["/joints.effort"].times
    np.testing.assert_allclose(times, one.times, atol=1e-9)


def test_one_clock_is_used_for_all_topics(tmp_path: Path) -> None:
    write_mcap_json(tmp_path / "a.mcap", run(10))  # without stamps
    found = read_recordings(
        [tmp_path / "a.mcap"], LogMapping.from_table({"states": {"/state.cart.position": "/state.cart.position"}})
    )
    assert not any("stamps" in note for note in found.notes)
