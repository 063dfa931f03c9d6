"""The code of an earlier revision beside the present one, measured by the same script.

A benchmark calls :func:`beside_landed` with its own file and arguments. In each repeat the script runs twice, once with
the package of the earlier revision and once with that of this checkout, and prints its figures by :func:`report`. CPU
times of both are compared by :class:`Ratio`, which is stored for ``docs/searches.md`` if that is asked for.
"""

from __future__ import annotations

import argparse
import functools
import io
import json
import os
import statistics
import subprocess
import sys
import tarfile
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from json_lines import JsonLines

LANDED = "85e23b1"
"""The revision before `auto` was made faster."""

_MARK = "figures: "
_ROOT = Path(__file__).resolve().parents[1]

STORED = JsonLines(_ROOT / "benchmarks" / "results" / "speed.jsonl", ("benchmark", "figure"))


@dataclass(frozen=True)
class Ratio:
    """CPU times of the same work in two ways, measured in turns in one run.

    Attributes:
        benchmark: the name of the script, without its ending.
        figure: what was measured.
        slow, fast: CPU seconds of each repeat, in the order in which they were measured: of the earlier and of the
            present code, or of much and of little work.
        least, most: bounds of the ratio that are asked for; None if there are none.
    """

    benchmark: str
    figure: str
    slow: list[float]
    fast: list[float]
    least: float | None = None
    most: float | None = None

    @property
    def value(self) -> float:
        """The ratio of the medians."""
        return statistics.median(self.slow) / statistics.median(self.fast)

    @property
    def each(self) -> list[float]:
        """The ratio in each repeat."""
        return [slow / fast for slow, fast in zip(self.slow, self.fast, strict=True)]

    @property
    def met(self) -> bool:
        """Whether the ratio is within its bounds."""
        return (self.least or 0.0) <= self.value <= (self.most or float("inf"))

    @property
    def asked(self) -> str:
        """The bounds in words; empty if there are none."""
        bounds = [("at least", self.least), ("at most", self.most)]
        return ", ".join(f"{words} {bound:g}" for words, bound in bounds if bound is not None)

    def __str__(self) -> str:
        slow, fast = statistics.median(self.slow), statistics.median(self.fast)
        spread = f", {min(self.each):.1f} to {max(self.each):.1f} in {len(self.slow)} repeats" if self.slow[1:] else ""
        asked = f" (asked: {self.asked})" if self.asked else ""
        return f"{self.figure}: {slow:.3g} and {fast:.3g} CPU s, ratio {self.value:.2f}{spread}{asked}"

    def tell(self, store: bool) -> None:
        """Print the ratio, and store it if it is asked for."""
        print(self, flush=True)
        if store:
            STORED.append(asdict(self))


def add_store_option(parser: argparse.ArgumentParser) -> None:
    """Add the option that stores ratios."""
    parser.add_argument("--store", action="store_true", help="keep the ratios for docs/searches.md")


def beside_landed(
    script: str | Path, *arguments: str, repeats: int = 1, revision: str = LANDED
) -> tuple[list[Any], list[Any]]:
    """Return what a script reports in several repeats with the earlier package, and with the present one."""
    pairs = [(figures(script, *arguments, revision=revision), figures(script, *arguments)) for _ in range(repeats)]
    return [earlier for earlier, _ in pairs], [now for _, now in pairs]


def figures(script: str | Path, *arguments: str, revision: str | None = None) -> Any:
    """Return the figures that a script reports with the package of one revision.

    Args:
        script: the file of the script.
        arguments: its command line.
        revision: the revision; None for this checkout.

    Raises:
        RuntimeError: if the revision is not in this repository, or the script fails; the message has its output.
    """
    return _figures(_ROOT if revision is None else tree_of(revision), script, arguments)


def report(figures: Any) -> None:
    """Print the figures of a script for :func:`beside_landed`: anything that JSON can express."""
    print(_MARK + json.dumps(figures), flush=True)


def tree_of(revision: str) -> Path:
    """Return a folder with the package of a revision, which is kept until the process ends.

    Raises:
        RuntimeError: if the revision is not in this repository.
    """
    return Path(_tree(revision).name)


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
