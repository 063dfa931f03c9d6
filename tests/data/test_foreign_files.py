"""Files that lead to other files, that are larger than they look, or that write to the terminal."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from ctxval.data import LogMapping, read_logs, read_recordings
from ctxval.data.log import MessageLimits, TopicLog
from ctxval.errors import InputError
from facts import refuses
from rig_logs import run, write_bag1
from rig_thorough import more

SECRET = bytes(range(200, 248)) * 10


def external_storage(file: Any, other: Path) -> None:
    file.create_dataset("t", (60,), "f8", external=[(str(other), 0, 480)])


def soft_link(file: Any, other: Path) -> None:
    file["x"] = np.arange(3.0)
    file["t"] = h5py.SoftLink("/x")


def external_link(file: Any, other: Path) -> None:
    file.create_group("log")["t"] = h5py.ExternalLink(str(other), "/t")


def virtual(file: Any, other: Path) -> None:
    layout = h5py.VirtualLayout((60,), "f8")
    layout[:] = h5py.VirtualSource(str(other), "t", (60,))
    file.create_virtual_dataset("t", layout)


def virtual_without_end(file: Any, other: Path) -> None:
    """A virtual data set whose shape depends on files that are named by a pattern."""
    space = h5py.h5s.create_simple((0,), (h5py.h5s.UNLIMITED,))
    space.select_hyperslab((0,), (h5py.h5s.UNLIMITED,), (60,), (60,))
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_virtual(space, str(other).encode(), b"t%b", h5py.h5s.create_simple((60,)))
    h5py.h5d.create(file.id, b"t", h5py.h5t.IEEE_F64LE, h5py.h5s.create_simple((0,), (h5py.h5s.UNLIMITED,)), plan)


@pytest.mark.parametrize("lead", [external_storage, soft_link, external_link, virtual, virtual_without_end])
def test_a_matlab_file_that_leads_to_another_file_is_refused(lead: Callable[[Any, Path], None], tmp_path: Path) -> None:
    with h5py.File(tmp_path / "other", "w") as other:
        other["t"] = np.frombuffer(SECRET, dtype=np.float64)
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        lead(file, tmp_path / "other")
    with refuses(InputError, "a.mat", "t"):
        read_logs([tmp_path / "a.mat"])


def test_an_object_that_only_a_reference_leads_to_is_not_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.mat", "w") as file:
        hidden = file.create_dataset("hidden", (60,), "f8", external=[(str(tmp_path / "other"), 0, 480)])
        file.create_dataset("cell", (1,), h5py.ref_dtype)[0] = hidden.ref
        file["x"] = np.arange(3.0)
        del file["hidden"]
    assert read_logs([tmp_path / "a.mat"])[0].fields() == ("x",)


@pytest.mark.parametrize("options", [{"chunks": (100, 100)}, {"maxshape": (None, None), "chunks": (2**13, 2**13)}])
def test_a_matlab_file_that_declares_too_much_is_refused(options: dict[str, Any], tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.mat", "w") as file:
        shape = (10, 10) if "maxshape" in options else (10**6, 10**6)
        file.create_dataset("t", shape, "f8", **options)
    with refuses(InputError, "a.mat", 268435456):
        read_logs([tmp_path / "a.mat"])


def test_a_matlab_file_with_a_circle_ends(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.mat", "w") as file:
        file["a/t"] = np.arange(3.0)
        file["a/b"] = file["a"]
    assert "a.t" in read_logs([tmp_path / "a.mat"])[0].fields()


def test_a_filter_that_matlab_does_not_use_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.mat", "w") as file:
        file.create_dataset("t", (10,), "f8", compression="lzf")
    with refuses(InputError, "a.mat", "t"):
        read_logs([tmp_path / "a.mat"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "lies", "most"),
    [*((kind, lies, 2**20) for kind in ("ZSTD", "LZ4") for lies in (False, True)), *more(("ZSTD", True, 2**27))],
)
def test_a_chunk_that_is_much_larger_than_its_file_is_not_decompressed(
    kind: str, lies: bool, most: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mcap.writer import CompressionType, Writer

    if most != 2**27:  # the limit of users, with which one case is enough
        monkeypatch.setattr(TopicLog, "limits", MessageLimits(chunk=most))
    padding = most // 128
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2**32, compression=CompressionType[kind])
        writer.start()
        topic = writer.register_channel("/a", "json", writer.register_schema("c", "jsonschema", b"{}"))
        for k in range(160):
            writer.add_message(topic, log_time=k, publish_time=k, data=b'{"x": 1}' + b" " * padding)
        writer.finish()
    content = path.read_bytes()
    size = next(
        160 * padding + extra for extra in range(2**14) if (160 * padding + extra).to_bytes(8, "little") in content
    )
    if lies:  # what the file declares is less than what is in it
        path.write_bytes(content.replace(size.to_bytes(8, "little"), (1000).to_bytes(8, "little")))
    with refuses(InputError, "a.mcap", most):
        read_recordings([path], LogMapping.from_table({"states": {"/a.x": "/a.x"}}))


def test_messages_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rig_logs import write_mcap_json

    monkeypatch.setattr(TopicLog, "limits", MessageLimits(numbers=10_000))
    write_mcap_json(tmp_path / "a.mcap", run(60))
    with refuses(InputError, "a.mcap", 10000):
        read_recordings(
            [tmp_path / "a.mcap"], LogMapping.from_table({"states": {"/state.cart.position": "/state.cart.position"}})
        )


def test_messages_out_of_order_are_read_in_the_order_of_their_log_times(tmp_path: Path) -> None:
    from mcap.writer import Writer

    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=64)
        writer.start()
        topic = writer.register_channel("/a", "json", writer.register_schema("c", "jsonschema", b"{}"))
        for k in (3, 0, 2, 1, 4):
            writer.add_message(topic, log_time=k * 10**8, publish_time=0, data=b'{"x": %d}' % k)
        writer.finish()
    found = read_recordings([tmp_path / "a.mcap"], LogMapping.from_table({"states": {"/a.x": "/a.x"}}))
    assert found.runs[0].trajectory.states[:, 0].tolist() == [0, 1, 2, 3, 4]


def test_a_compressed_bag_that_is_much_larger_than_it_looks_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rosbags.rosbag1 import Writer

    class Compressing(Writer):
        def __init__(self, path: Path) -> None:
            super().__init__(path)
            self.set_compression(self.CompressionFormat.BZ2)

    monkeypatch.setattr("rosbags.rosbag1.Writer", Compressing)
    write_bag1(tmp_path / "a.bag", run(60))
    mapping = LogMapping.from_table({"states": {"/joints.position[0]": "/joints.position[0]"}})
    assert read_recordings([tmp_path / "a.bag"], mapping).steps == 60
    monkeypatch.setattr(TopicLog, "limits", MessageLimits(chunk=1000))
    with refuses(InputError, 1000, "a.bag"):
        read_recordings([tmp_path / "a.bag"], mapping)


def test_the_definition_of_a_message_is_not_printed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    from mcap.writer import Writer

    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("rig/msg/State", "ros2msg", b"nonsense\x1b]0;owned\x07")
        writer.add_message(writer.register_channel("/a", "cdr", schema), log_time=0, publish_time=0, data=b"")
        writer.finish()
    with refuses(InputError, "a.mcap", 0):
        read_recordings([tmp_path / "a.mcap"], LogMapping.from_table({"states": {"/a.x": "/a.x"}}))
    assert capfd.readouterr() == ("", "")
