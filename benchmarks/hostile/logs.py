"""Hostile logs of every kind that is read, and hostile models: damaged, or with ways out of their file."""

from __future__ import annotations

import functools
import io
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hostile import archives, clothes
from hostile.cage import Case
from hostile.oracles import OUTSIDE
from hostile.values import ESCAPES, Rng, mutated, nested, number, pick, text

Made = tuple[str, tuple[str, ...]]
"""The name of a log in its folder, and the fields of its states and of its input."""
_CART = ("/joints.position[0]", "/joints.velocity[0]", "/joints.effort[0]")
_COLUMNS = ("position", "speed", "force")


def _outside(rng: Rng, folder: Path, name: str) -> str:
    """Return a path to a decoy: relative, absolute, or in the user's home."""
    beside = folder.parent / OUTSIDE / name
    (beside.parent).mkdir(exist_ok=True)
    if not beside.exists():
        beside.write_bytes(b"")
    options = (f"../{OUTSIDE}/{name}", str(beside), str(folder / "home" / ".aws" / "credentials"), f"file://{beside}")
    return str(pick(rng, (*options[:2], *options)))


@functools.cache
def _sound(kind: str) -> dict[str, bytes]:
    """Return the files of a sound log of a kind, by their paths."""
    one = clothes.run(0)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        match kind:
            case "mat" | "mat73":
                clothes.rig_logs.write_mat(folder / "run.mat", one, version="7.3" if kind == "mat73" else "5")
            case "parquet":
                clothes.rig_logs.write_parquet(folder / "run.parquet", one)
            case "mcap json":
                clothes.rig_logs.write_mcap_json(folder / "run.mcap", one)
            case "mcap ros1":
                clothes.rig_logs.write_bag1(folder / "run.mcap", one, to_mcap=True)
            case "mcap ros2":
                clothes.rig_logs.write_mcap_ros2(folder / "run.mcap", one)
            case "bag1":
                clothes.rig_logs.write_bag1(folder / "run.bag", one)
            case "bag2":
                clothes.rig_logs.write_bag(folder / "bag", one)
            case "lerobot":
                clothes.rig_logs.write_lerobot(folder / "set", [one, clothes.run(1)])
        return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


_KINDS: dict[str, Made] = {
    "mat": ("run.mat", ("log.state[0]", "log.state[1]", "force")),
    "mat73": ("run.mat", ("log.state[0]", "log.state[1]", "force")),
    "parquet": ("run.parquet", _COLUMNS),
    "mcap json": ("run.mcap", ("/state.cart.position", "/state.cart.speed[0]", "/command.force")),
    "mcap ros1": ("run.mcap", _CART),
    "mcap ros2": ("run.mcap", _CART),
    "bag1": ("run.bag", _CART),
    "bag2": ("bag", _CART),
    "lerobot": ("set", ("observation.state[0]", "observation.state[1]", "action")),
}


def _damaged(rng: Rng, folder: Path) -> Made:
    """Write a log of which some bytes are others."""
    kind = str(pick(rng, tuple(_KINDS)))
    files = _sound(kind)
    broken = str(pick(rng, sorted(files)))
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(mutated(rng, content) if name == broken else content)
    return _KINDS[kind]


def _linked_hdf5(rng: Rng, folder: Path) -> Made:
    """Write a MATLAB file of version 7.3 whose arrays are in other files, or lead to themselves."""
    import h5py

    path = folder / "run.mat"
    one = clothes.run(0)
    name = str(pick(rng, ("t", *_COLUMNS, "more")))
    with h5py.File(path, "w", userblock_size=512) as file:
        values = {"t": one.times, "position": one.states[:, 0], "speed": one.states[:, 1]}
        values |= {"force": np.append(one.inputs[:, 0], 0.0), "more": one.times}
        for key, column in values.items():
            if key != name:
                file.create_dataset(key, data=column[None, :]).attrs["MATLAB_class"] = np.bytes_("double")
        match int(rng.integers(7)):
            case 0 | 1:
                outside = [(_outside(rng, folder, "secret.bin"), 0, 61 * 8)]
                made = file.create_dataset(name, shape=(1, 61), dtype="<f8", external=outside)
                made.attrs["MATLAB_class"] = np.bytes_("double")
            case 2:
                file[name] = h5py.ExternalLink(_outside(rng, folder, "secret.h5"), "/d")
            case 3:
                file[name] = h5py.SoftLink(str(pick(rng, (f"/{name}", "/", "/none", "/position", "/group/a"))))
                file.create_group("group")["a"] = h5py.SoftLink("/group")
            case 4:
                layout = h5py.VirtualLayout(shape=(1, 61), dtype="<f8")
                layout[...] = h5py.VirtualSource(_outside(rng, folder, "secret.h5"), "d", shape=(1, 61))
                file.create_virtual_dataset(name, layout).attrs["MATLAB_class"] = np.bytes_("double")
            case 5:
                shape = pick(rng, ((1, 10**9), (10**5, 10**5), (1, 10**12)))
                file.create_dataset(name, shape=shape, dtype="<f8", chunks=(1, 1000)).attrs["MATLAB_class"] = np.bytes_(
                    "double"
                )
            case 6:
                file[name] = file["/"]
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: x HDF5 schema 1.00 ."
    with path.open("r+b") as raw:
        raw.write(head.ljust(124) + b"\x00\x02IM")
    return path.name, _COLUMNS


def _odd_parquet(rng: Rng, folder: Path) -> Made:
    import pyarrow as pa
    import pyarrow.parquet as pq

    one = clothes.run(0)
    columns: dict[str, Any] = {"t": one.times, "position": one.states[:, 0], "speed": one.states[:, 1]}
    columns["force"] = np.append(one.inputs[:, 0], np.nan)
    odd = (
        *(pa.array([str(pick(rng, ESCAPES))] * 61), pa.array([None] * 61), pa.array([b"\xff"] * 61)),
        *(pa.array([[float(number(rng))]] * 61), pa.array([{"a": 1}] * 61), pa.array([[[1.0]]] * 61)),
        *(pa.array(["1.5"] * 61).dictionary_encode(), pa.array([True] * 61), pa.array([2**62] * 61)),
        *(pa.array([0] * 61).cast(pa.timestamp("ns")), pa.array([number(rng)] * 61, from_pandas=False)),
    )
    columns[str(pick(rng, tuple(columns)))] = pick(rng, odd)
    columns[text(rng, 100)] = one.times
    table = pa.table(columns).replace_schema_metadata({text(rng, 50): text(rng, 50).encode("utf-8", "replace")})
    pq.write_table(table, folder / "run.parquet")
    return "run.parquet", _COLUMNS


def _odd_mcap(rng: Rng, folder: Path) -> Made:
    """Write an MCAP file whose definitions, names or messages are hostile."""
    from mcap.writer import CompressionType, Writer

    path = folder / "run.mcap"
    definition = pick(
        rng,
        (
            *(
                "float64[] position",
                "float64 position\x1b[2J",
                f"{pick(rng, ESCAPES)} position",
                "float64[999999999] p",
            ),
            *("Header header", "string<=5 a\n" * 2000, "=" * 80 + "\nMSG: a/B\na/B b", "a/B b\n" + "=" * 80),
            *("float64[<=3] position", "int8 X=1\x1b]0;x\x07", text(rng, 500), "float64 " + "p" * 50_000),
        ),
    )
    encoding = pick(rng, (("cdr", "ros2msg"), ("cdr", "ros2msg"), ("ros1", "ros1msg"), ("json", "jsonschema")))
    topic = str(pick(rng, ("/joints", "/joints", text(rng, 50))))
    data = pick(
        rng,
        (
            b"\0\1\0\0" + rng.bytes(80),
            b"\0\1\0\0" + b"\xff\xff\xff\x7f" + rng.bytes(20),
            json.dumps({"position": [number(rng)], "velocity": [1.0], "effort": [0.0]}).encode(),
            nested(rng).encode(),
            json.dumps({"position": text(rng, 100)}).encode(),
            b"\xff" * 8,
            b"\0" * int(pick(rng, (10, 3_000_000))),
        ),
    )
    with path.open("wb") as file:
        writer = Writer(file, compression=pick(rng, tuple(CompressionType)))
        writer.start(profile=text(rng, 20), library=text(rng, 20))
        schema = writer.register_schema(text(rng, 50), encoding[1], definition.encode("utf-8", "replace"))
        channel = writer.register_channel(topic, encoding[0], schema)
        for k in range(1 if len(data) > 10**5 else int(rng.integers(1, 70))):
            stamp = int(pick(rng, (k * 50_000_000, k * 50_000_000, 2**63, 0)))
            writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    return path.name, _CART


def _odd_bag(rng: Rng, folder: Path) -> Made:
    """Write a bag whose description names files elsewhere, or is hostile YAML."""
    for name, content in _sound("bag2").items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    path = folder / "bag" / "metadata.yaml"
    content = path.read_text()
    match int(rng.integers(5)):
        case 0 | 1:
            content = content.replace("bag.db3", _outside(rng, folder, "secret.db3"))
        case 2:
            aliases = "\n".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12))
            content = f"a0: &a0 [x, x]\n{aliases}\n{content}"
        case 3:
            content = f"!!python/object/apply:os.system ['touch PWNED']\n{content}"
        case 4:
            content = content.replace("MSG", text(rng, 30)).replace(
                "storage_identifier: sqlite3", f"x: {text(rng, 99)}"
            )
    path.write_text(content, errors="replace")
    return "bag", _CART


def _odd_lerobot(rng: Rng, folder: Path) -> Made:
    for name, content in _sound("lerobot").items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    path = folder / "set" / "meta" / "info.json"
    info = json.loads(path.read_text())
    key = str(pick(rng, ("data_path", "data_path", "data_path", "fps", "features", "codebase_version")))
    (folder.parent / OUTSIDE).mkdir(exist_ok=True)
    shutil.copy(folder / "set" / "data" / "chunk-000" / "file-000.parquet", folder.parent / OUTSIDE / "secret.parquet")
    places = (
        *(f"../../{OUTSIDE}/secret.parquet", f"data/../../../{OUTSIDE}/secret.parquet", "{chunk_index.__class__}"),
        *(str(folder.parent / OUTSIDE / "secret.parquet"), "{0}", "{", "/dev/zero", "*", f"../../{OUTSIDE}/*.parquet"),
    )
    info[key] = str(pick(rng, places)) if key == "data_path" else pick(rng, (number(rng), text(rng, 50), None, [], {}))
    if rng.random() < 0.3:
        info["features"] = {"observation.state": {"names": [text(rng, 50)] * 2}, text(rng, 20): number(rng)}
    path.write_text(json.dumps(info))
    return "set", _KINDS["lerobot"][1]


def _plain(rng: Rng, folder: Path) -> Made:
    if rng.random() < 0.5:
        archives.placed(rng, folder / "run.csv", archives.recording_csv(rng))
        return "run.csv", _COLUMNS
    archives.placed(rng, folder / "run.npz", archives.npz(rng))
    return "run.npz", ("states[0]", "states[1]", "inputs")


def _anything(rng: Rng, folder: Path) -> Made:
    """Write something that is not what its suffix says."""
    name = f"run{pick(rng, ('.mat', '.parquet', '.mcap', '.db3', '.bag', '.npz', '.csv'))}"
    head = pick(rng, (b"", b"\x89HDF\r\n\x1a\n", b"PAR1", b"\x89MCAP0\r\n", b"SQLite format 3\0", b"#ROSBAG V2.0\n"))
    archives.placed(rng, folder / name, head + rng.bytes(int(rng.integers(3000))))
    return name, _COLUMNS


MAKERS: tuple[Callable[[Rng, Path], Made], ...] = (
    *(_damaged, _damaged, _damaged, _linked_hdf5, _linked_hdf5, _odd_parquet, _odd_mcap, _odd_mcap, _odd_bag),
    *(_odd_lerobot, _plain, _anything),
)


def _model(rng: Rng, folder: Path, base: Path) -> str:
    """Write a model, which is sometimes hostile, and return its name."""
    kind = int(rng.integers(12))
    if kind == 0:
        (folder / "model.onnx").write_bytes(_external(_outside(rng, folder, "secret.bin")))
        return "model.onnx"
    if kind == 1:
        (folder / "model.onnx").write_bytes(mutated(rng, (base / "network.onnx").read_bytes()))
        return "model.onnx"
    if kind == 2:
        buffer = io.BytesIO()
        np.savez(buffer, A=[[1.0, 0.05], [0.0, 1.0]], B=[[0.0], [0.05]])
        (folder / "model.npz").write_bytes(mutated(rng, buffer.getvalue()))
        return "model.npz"
    clothes._write_model(folder)
    return "model.npz"


def _external(place: str) -> bytes:
    """Return a network whose weights are in another file."""
    from onnx import TensorProto, helper

    weights = TensorProto(name="W", data_type=TensorProto.FLOAT, dims=[3, 2], data_location=TensorProto.EXTERNAL)
    for key, value in (("location", place), ("offset", "0"), ("length", "24")):
        weights.external_data.add(key=key, value=value)
    nodes = [helper.make_node("Concat", ["x", "u"], ["z"], axis=-1), helper.make_node("MatMul", ["z", "W"], ["y"])]
    sides = [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["b", k]) for n, k in (("x", 2), ("u", 1), ("y", 2))]
    graph = helper.make_graph(nodes, "cart", sides[:2], sides[2:], [weights])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    return bytes(model.SerializeToString())


def case(rng: Rng, folder: Path, base: Path) -> Case:
    """Make an input: one command that reads a hostile log."""
    name, fields = pick(rng, MAKERS)(rng, folder)
    json_ = ("--json",) if rng.random() < 0.5 else ()
    # The first two start a process for such files, which takes a second.
    kind = str(pick(rng, (pick(rng, ("tell", "import")), *["replay"] * 6, "fit", "usual")))
    if kind in ("tell", "import"):
        store = clothes.TABLE
        shutil.copy(base / store, folder / store)
        tolerant = ("--start-tolerance", "1e9", *pick(rng, ((), ("--resample",))), *json_)
        if kind == "tell":
            return Case(("tell", store, "2", "--trajectory", name, *tolerant))
        return Case(("import", store, name, "--set", "goal=1.0", "--set", "load=0.1", *tolerant))
    states = (f"--state=position={fields[0]}", f"--state=speed={fields[1]}", f"--input=force={fields[2]}")
    mapped = () if kind == "usual" else states
    if kind == "fit":
        return Case(("fit", name, *mapped, "--kind", "linear", *pick(rng, ((), ("--out", "fitted.npz"))), *json_))
    return Case(("replay", name, "--model", _model(rng, folder, base), *mapped, *json_))
