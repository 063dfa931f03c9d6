"""MJCF models of MuJoCo."""

from __future__ import annotations

from pathlib import Path

import pytest

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
    with pytest.raises(InputError, match="cannot compile"):
        compile_mjcf("<mujoco>")
