"""MJCF models of MuJoCo."""

from __future__ import annotations

from pathlib import Path

import pytest

from ctxval._util.mjcf import compile_mjcf, is_mjcf_text
from ctxval.errors import InputError
from facts import refuses

pytest.importorskip("mujoco")

MJCF = "<mujoco><worldbody><body><joint type='slide'/><geom size='0.1' mass='2'/></body></worldbody></mujoco>"


def digest(path: Path) -> str:
    return compile_mjcf(path)[0]


def test_a_text_and_its_file_are_one_model(tmp_path: Path) -> None:
    path = tmp_path / "model.xml"
    path.write_text(MJCF)
    assert is_mjcf_text(MJCF)
    assert not is_mjcf_text(path)
    assert compile_mjcf(MJCF)[0] == digest(path) != compile_mjcf(MJCF.replace("2", "3"))[0]


def test_what_is_no_model_is_named(tmp_path: Path) -> None:
    with refuses(InputError, "missing.xml"):
        compile_mjcf(tmp_path / "missing.xml")
    with refuses(InputError, "XML_ERROR_MISMATCHED_ELEMENT", 14) as refused:
        compile_mjcf("<mujoco>")
    assert len(str(refused.value).splitlines()) == 1


TETRAHEDRON = "v 0 0 0\nv {size} 0 0\nv 0 {size} 0\nv 0 0 {size}\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
WITH_MESH = """<mujoco><asset><mesh name="m" file="{mesh}"/></asset><worldbody><body><joint type="slide"/>
<geom type="mesh" mesh="m" mass="2"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("place", ["m.obj", "{folder}/m.obj", "meshes/m.obj"])
def test_a_file_that_the_text_names_is_part_of_the_model(tmp_path: Path, place: str) -> None:
    path, mesh = tmp_path / "model.xml", tmp_path / place.format(folder=tmp_path)
    mesh.parent.mkdir(exist_ok=True)
    text = WITH_MESH.format(mesh=mesh.name if "meshes" in place else place.format(folder=tmp_path))
    path.write_text(text.replace("<asset>", '<compiler meshdir="meshes"/><asset>') if "meshes" in place else text)
    mesh.write_text(TETRAHEDRON.format(size=1))
    first = digest(path)
    assert first == digest(path)
    mesh.write_text(TETRAHEDRON.format(size=2))
    assert first != digest(path)


def test_an_included_file_is_part_of_the_model(tmp_path: Path) -> None:
    path, found = tmp_path / "model.xml", []
    path.write_text(MJCF.replace("<worldbody>", '<include file="included.xml"/><worldbody>'))
    for gravity in ("0 0 -9.81", "0 0 -1.62"):
        (tmp_path / "included.xml").write_text(f'<mujoco><option gravity="{gravity}"/></mujoco>')
        found.append(digest(path))
    assert found[0] != found[1]
