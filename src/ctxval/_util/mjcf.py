"""MJCF models of MuJoCo, for systems and for models; needs mujoco (extra ``mujoco``)."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.files import read_bytes
from ctxval._util.refusals import require_extra, reworded
from ctxval.errors import InputError


def is_mjcf_text(mjcf: str | Path) -> bool:
    return isinstance(mjcf, str) and "<" in mjcf


def compile_mjcf(mjcf: str | Path) -> tuple[str, Any]:
    """Return the digest of a model's files, and the compiled ``mujoco.MjModel``."""
    loader = require_extra("mujoco", "mujoco", "models of MuJoCo need").MjModel
    with reworded(f"the MuJoCo model {str(mjcf)!r} cannot be read", InputError):
        is_text = is_mjcf_text(mjcf)
        digest = _digest(str(mjcf).encode(), Path()) if is_text else _digest(read_bytes(mjcf), Path(mjcf).parent)
    with reworded("MuJoCo cannot compile the model", ValueError):
        return digest, loader.from_xml_string(str(mjcf)) if is_text else loader.from_xml_path(str(mjcf))


@contextmanager
def quiet() -> Iterator[None]:
    """Let MuJoCo print no warnings, and write none to a file ``MUJOCO_LOG.TXT``, while its caller counts them."""
    import mujoco

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def warning_of(counts: Any) -> str:
    """Return the name of the first warning of MuJoCo whose count is not 0."""
    from mujoco import mjtWarning

    return str(mjtWarning(int(np.argmax(np.asarray(counts) > 0))).name.removeprefix("mjWARN_"))


def _digest(text: bytes, home: Path) -> str:
    """Return the digest of a model's text and of the files that it names: other models, meshes and height fields."""
    digest, waiting, folders, known = hashlib.sha256(), [text], {home}, set[Path]()
    while waiting:
        text = waiting.pop()
        digest.update(hashlib.sha256(text).digest())
        folders |= {home / os.fsdecode(name) for name in _FOLDERS.findall(text)}
        named = {folder / os.fsdecode(name) for folder in folders for name in _FILES.findall(text)}
        files = sorted(path for path in named - known if path.is_file())
        known |= named
        waiting += map(read_bytes, files)
    return digest.hexdigest()[:16]


_FILES = re.compile(rb"""\bfile\s*=\s*["']([^"'\0]+)""")
_FOLDERS = re.compile(rb"""\b(?:mesh|asset)dir\s*=\s*["']([^"'\0]+)""")
