"""Which files a command may write."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ctxval import models
from ctxval._util.files import MADE_BY, write_text, written_whole
from ctxval.cli.base import require_folder, require_outputs
from ctxval.core.trajectory import Transitions
from ctxval.errors import InputError
from ctxval.studies.fitting.model_file import write_model_file
from facts import assert_names, refuses
from rig_cli import calling
from rig_logs import run

MODEL = models.Linear([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]])


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.npz", lambda path: write_model_file(path, MODEL)),
        ("a.onnx", lambda path: write_model_file(path, MODEL)),
        ("a.data.npz", lambda path: models.write_transitions(path, run(5).transitions())),
    ],
)
def test_what_was_written_may_be_replaced(name: str, write: Callable[[Path], None], tmp_path: Path) -> None:
    if name == "a.onnx":
        pytest.importorskip("onnx")
    for _ in range(2):
        require_outputs({"--out": tmp_path / name}, [], force=False)
        write(tmp_path / name)
    assert MADE_BY.encode() in (tmp_path / name).read_bytes()


def test_a_model_with_the_mark_is_read_back(tmp_path: Path) -> None:
    write_model_file(tmp_path / "a.npz", MODEL)
    np.testing.assert_array_equal(models.read_model(tmp_path / "a.npz").A, MODEL.A)  # type: ignore[union-attr]
    data = Transitions(np.zeros((2, 2)), np.zeros((2, 1)), np.ones((2, 2)))
    models.write_transitions(tmp_path / "b.npz", data)
    with np.load(tmp_path / "b.npz") as found:
        assert sorted(found.files) == ["u", "x", "x_next"]


@pytest.mark.parametrize("content", [b"", b"t,x0\n0,1\n", run(5).to_npz()])
def test_the_work_of_others_is_not_replaced(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    with refuses(InputError, "a.npz", "--force"):
        require_outputs({"--out": path}, [], force=False)
    require_outputs({"--out": path}, [], force=True)


def test_an_input_is_not_replaced_under_any_of_its_names(tmp_path: Path) -> None:
    write_model_file(tmp_path / "a.npz", MODEL)
    (tmp_path / "link.npz").symlink_to(tmp_path / "a.npz")
    (tmp_path / "hard.npz").hardlink_to(tmp_path / "a.npz")
    for name in ("a.npz", "link.npz", "hard.npz"):
        with refuses(InputError, "--force"):
            require_outputs({"--out": tmp_path / name}, [None, "module:attr", str(tmp_path / "a.npz")], force=False)
        require_outputs({"--out": tmp_path / name}, [str(tmp_path / "a.npz")], force=True)


def test_two_outputs_are_two_files_with_the_right_names(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path)
    both = {"--junit .xml": tmp_path / "a.xml", "--other .xml": tmp_path / "link" / "a.xml", "--more .md": None}
    with refuses(InputError, "--junit", "--other", "a.xml"):
        require_outputs(both, [], force=True)
    with refuses(InputError, "--out", "a.toml"):
        require_outputs({"--out .html": Path("a.toml")}, [], force=True)
    with refuses(InputError, tmp_path):
        require_outputs({"--out": tmp_path}, [], force=True)


def test_a_folder_with_files_of_others_is_refused(tmp_path: Path) -> None:
    names = ("task.json", "model.csv")
    require_folder(tmp_path / "new", names, "ctxval task", force=False)
    require_folder(tmp_path, names, "ctxval task", force=False)
    (tmp_path / "model.csv").write_text("mine")
    with refuses(InputError, "model.csv", "--force"):
        require_folder(tmp_path, names, "ctxval task", force=False)
    (tmp_path / "task.json").write_text("{}")
    with refuses(InputError, "task.json", "--force"):
        require_folder(tmp_path, names, "ctxval task", force=False)
    (tmp_path / "task.json").write_text('{"format": "ctxval task"}')
    require_folder(tmp_path, names, "ctxval task", force=False)


def test_a_store_is_never_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.html"
    path.write_bytes(b"SQLite format 3\0" + bytes(100))
    for write in (lambda: write_text(path, "a"), lambda: run(5).to_csv(path)):
        with refuses(InputError, "a.html"):
            write()
    assert len(path.read_bytes()) == 116


def test_what_cannot_be_written_completely_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    run(5).to_csv(path)
    before = path.read_bytes()
    with pytest.raises(TypeError), written_whole(path, text=True) as file:
        file.write(b"half")
    assert (path.read_bytes(), sorted(tmp_path.iterdir())) == (before, [path])


def test_fit_does_not_replace_a_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for seed in range(3):
        Path(f"run{seed}.npz").write_bytes(run(30, seed).to_npz())
    before = Path("run0.npz").read_bytes()
    logs = ("run0.npz", "run1.npz", "run2.npz", "--kind", "linear", "--out")
    refused = calling("fit")(*logs, "run0.npz")
    assert refused.exit_code == 2
    assert_names(refused.stderr, "run0.npz")
    assert Path("run0.npz").read_bytes() == before
    assert [calling("fit")(*logs, "model.npz").exit_code for _ in range(2)] == [0, 0]
    assert calling("fit")(*logs, "run0.npz", "--force").exit_code == 0


def test_a_link_in_the_place_of_an_output_is_refused_unread(tmp_path: Path) -> None:
    (tmp_path / "secret.csv").write_text("mine")
    (tmp_path / "link.html").symlink_to("secret.csv")
    with refuses(InputError, "link.html", "--force"):
        require_outputs({"--out .html": tmp_path / "link.html"}, [], force=False)
    require_outputs({"--out .html": tmp_path / "link.html"}, [], force=True)
