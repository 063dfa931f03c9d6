"""What a stored result was computed with: the revision of the sources, and the libraries below them."""

from __future__ import annotations

import functools
import hashlib
import platform
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from threadpoolctl import threadpool_info

from ctxval._util.code_digest import module_digest

SEARCHES = ("gp", "searches")  #: the folders of the package that choose tasks from distances

AUTO = (*SEARCHES, "learning")  #: the folders of the package that choose tasks from trajectories

_PACKAGE = Path(__file__).parents[2]


@functools.cache
def source_digest(*folders: str) -> str:
    """Return a digest of what the modules of some folders of the package compute, whatever their texts and layout."""
    files = [file for folder in folders for file in sorted((_PACKAGE / folder).rglob("*.py"))]
    text = [f"{file.relative_to(_PACKAGE).as_posix()} {module_digest(file.read_text())}" for file in files]
    return hashlib.sha256("\n".join(text).encode()).hexdigest()[:16]


@functools.cache
def libraries() -> str:
    """Return the versions of Python, numpy and scipy, and the linear algebra with the kernels that it chose."""
    pools = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
    blas = {f"{pool['internal_api']} {pool['version']} {pool.get('architecture', '')}".strip() for pool in pools}
    versions = [f"Python {platform.python_version()}", f"numpy {np.__version__}", f"scipy {scipy.__version__}"]
    return ", ".join([*versions, *sorted(blas)])


def provenance(folders: tuple[str, ...] = SEARCHES) -> dict[str, Any]:
    """Return the fields that a stored result keeps of its making: a digest of the sources, and the libraries."""
    return {"sources": source_digest(*folders), "libraries": libraries()}


def measured_with(results: Iterable[Mapping[str, Any]], folders: tuple[str, ...] = SEARCHES) -> str:
    """Return sentences on the revision of the sources and on the libraries that results were measured with."""
    known, present = list(results), source_digest(*folders)
    names = ", ".join(f"`{folder}`" for folder in folders)
    without = sum("sources" not in result for result in known)
    before = sum(result.get("sources", present) != present for result in known)
    counts = {
        f"with the present sources of {names}": len(known) - before - without,
        "before their last change": before,
        "before results named their sources and libraries": without,
    }
    measured = "; ".join(f"{when}: {count:,}" for when, count in counts.items() if count)
    used = sorted({result["libraries"] for result in known if "libraries" in result})
    return f"Results measured {measured}." + (f" Libraries: {'; '.join(used)}." if used else "")
