"""MJCF models of MuJoCo."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ctxval._util.describe import describe, first_difference
from ctxval._util.mjcf import compile_mjcf, identity_of_mjcf, is_mjcf_text
from ctxval.errors import InputError

pytest.importorskip("mujoco")

MJCF = "<mujoco><worldbody><body><joint type='slide'/><geom size='0.1' mass='2'/></body></worldbody></mujoco>"


def test_a_text_and_its_file_are_one_model(tmp_path: Path) -> None:
    path = tmp_path / "model.xml"
    path.write_text(MJCF)
    assert is_mjcf_text(MJCF)
    assert not is_mjcf_text(path)
    first, second = identity_of_mjcf(*compile_mjcf(MJCF)), identity_of_mjcf(*compile_mjcf(path))
    assert first == second
    assert first["mass"] == [0.0, 2.0]


def test_what_is_no_model_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        compile_mjcf(tmp_path / "missing.xml")
    with pytest.raises(InputError, match="cannot compile") as refused:
        compile_mjcf("<mujoco>")
    assert len(str(refused.value).splitlines()) == 1


TETRAHEDRON = "v 0 0 0\nv {size} 0 0\nv 0 {size} 0\nv 0 0 {size}\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
WITH_MESH = """<mujoco><asset><mesh name="m" file="{mesh}"/></asset><worldbody><body><joint type="slide"/>
<geom type="mesh" mesh="m" mass="2"/></body></worldbody></mujoco>"""


def identity(path: Path) -> Any:
    return json.loads(json.dumps(describe(identity_of_mjcf(*compile_mjcf(path)))))


def test_a_file_that_the_text_names_is_part_of_the_model(tmp_path: Path) -> None:
    path, mesh = tmp_path / "model.xml", tmp_path / "m.obj"
    path.write_text(WITH_MESH.format(mesh=mesh))
    mesh.write_text(TETRAHEDRON.format(size=1))
    first = identity(path)
    assert first_difference(first, identity(path)) is None
    mesh.write_text(TETRAHEDRON.format(size=2))  # of the same mass
    os.utime(mesh, (2e9, 2e9))  # a process of MuJoCo reads a file again only if its time differs, in whole seconds
    assert first["mass"] == identity(path)["mass"]
    assert "compiled.body_inertia" in str(first_difference(first, identity(path)))


def identities_including(folder: Path, *contents: str) -> list[Any]:
    """Return the identities of one model with each of some contents of a file that it includes."""
    path, included, found = folder / "model.xml", folder / "included.xml", []
    path.write_text(MJCF.replace("<worldbody>", '<include file="included.xml"/><worldbody>'))
    for content in contents:
        included.write_text(f"<mujoco>{content}</mujoco>")
        found.append(identity(path))
    return found


def test_an_included_file_is_part_of_the_model(tmp_path: Path) -> None:
    earth, moon = ('<option gravity="0 0 -9.81"/>', '<option gravity="0 0 -1.62"/>')
    assert "compiled.gravity" in str(first_difference(*identities_including(tmp_path, earth, moon)))


def test_the_identity_is_the_same_in_another_process(tmp_path: Path) -> None:
    path, mesh = tmp_path / "model.xml", tmp_path / "m.obj"
    path.write_text(WITH_MESH.format(mesh=mesh))
    mesh.write_text(TETRAHEDRON.format(size=1))
    code = (
        "import json, sys; from ctxval._util.describe import describe; from ctxval._util.mjcf import *; "
        "print(json.dumps(describe(identity_of_mjcf(*compile_mjcf(sys.argv[1])))))"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == identity(path)


def test_drawings_are_not_part_of_the_dynamics(tmp_path: Path) -> None:
    red, green = (f'<default><geom rgba="{colour} 0 1"/></default>' for colour in ("1 0", "0 1"))
    assert first_difference(*identities_including(tmp_path, red, green)) is None
