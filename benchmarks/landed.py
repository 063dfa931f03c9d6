"""The code of an earlier revision beside the present one, measured by the same script.

A benchmark calls :func:`beside_landed` with its own file and arguments. The script then runs twice, once with the
package of the earlier revision and once with that of this checkout, and prints its figures by :func:`report`. CPU
times of both are compared as ratios; nothing is stored.
"""

from __future__ import annotations

import functools
import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

LANDED = "85e23b1"
"""The revision before `auto` was made faster."""

_MARK = "figures: "
_ROOT = Path(__file__).resolve().parents[1]


def beside_landed(script: str | Path, *arguments: str, revision: str = LANDED) -> tuple[Any, Any]:
    """Return the figures that a script reports with the earlier package, and with the present one."""
    return figures(script, *arguments, revision=revision), figures(script, *arguments)


def figures(script: str | Path, *arguments: str, revision: str | None = None) -> Any:
    """Return the figures that a script reports with the package of one revision.

    Args:
        script: the file of the script.
        arguments: its command line.
        revision: the revision; None for this checkout.

    Raises:
        RuntimeError: if the revision is not in this repository, or the script fails; the message has its output.
    """
    return _figures(_ROOT if revision is None else Path(_tree(revision).name), script, arguments)


def report(figures: Any) -> None:
    """Print the figures of a script for :func:`beside_landed`: anything that JSON can express."""
    print(_MARK + json.dumps(figures), flush=True)


@functools.cache
def _tree(revision: str) -> tempfile.TemporaryDirectory[str]:
    """Return a temporary folder with the package of a revision; it is removed at the end of the process."""
    packed = subprocess.run(
        ["git", "archive", "--format=tar", revision, "src"], cwd=_ROOT, capture_output=True, check=False
    )
    if packed.returncode:
        raise RuntimeError(f"revision {revision} is not in this repository: {packed.stderr.decode().strip()}")
    folder = tempfile.TemporaryDirectory(prefix="landed-")
    with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as archive:
        archive.extractall(folder.name, filter="data")
    return folder


def _figures(tree: Path, script: str | Path, arguments: tuple[str, ...]) -> Any:
    environment = {**os.environ, "PYTHONPATH": str(tree / "src"), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, str(script), *arguments], env=environment, capture_output=True, text=True, check=False
    )
    lines = [line.removeprefix(_MARK) for line in done.stdout.splitlines() if line.startswith(_MARK)]
    if done.returncode or not lines:
        raise RuntimeError(f"{Path(script).name} {' '.join(arguments)} failed:\n{done.stdout}{done.stderr}")
    return json.loads(lines[-1])
