"""Recordings by others, which are no part of this repository."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def shared_data(name: str) -> Path:
    """Return a folder or file of the shared data; skip the test, with the reason, if it is not there.

    The data lie in the folder that CTXVAL_DATA names, or in ``../shared/data`` from the repository.
    """
    path = Path(os.environ.get("CTXVAL_DATA") or Path(__file__).parents[2] / "shared" / "data") / name
    if not path.exists():
        pytest.skip(f"needs the recordings {name}: {path} does not exist; CTXVAL_DATA names their folder")
    return path
