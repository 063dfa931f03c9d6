"""Every experiment of the paper, from the systems' equations to its eight figures and the table of its claims."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ctxval.errors import InputError, UnknownNameError
from ctxval.reproduce.arm import ArmModels, ArmSamples
from ctxval.reproduce.dubins import DubinsMedians
from ctxval.reproduce.jobs import Job, Results
from ctxval.reproduce.linear import LinearComplexity
from ctxval.reproduce.pendulum import ConvergedGP, FourFrameworks, Techniques, Trajectories
from ctxval.reproduce.study import FULL, QUICK, Scale, Study
from ctxval.reproduce.table import table_text

__all__ = ["FULL", "QUICK", "STUDIES", "Scale", "Study", "reproduce", "studies_named"]

STUDIES: tuple[Study, ...] = (
    FourFrameworks(),
    Trajectories(),
    Techniques(),
    ConvergedGP(),
    DubinsMedians(),
    ArmSamples(),
    ArmModels(),
    LinearComplexity(),
)
"""The studies behind the paper's figures, in the order of the paper."""


def studies_named(name: str) -> list[Study]:
    """Return the study with this name, or all studies for ``all``."""
    if name == "all":
        return list(STUDIES)
    studies = [study for study in STUDIES if study.name == name]
    if not studies:
        raise UnknownNameError.among("study", name, ["all", *(study.name for study in STUDIES)])
    return studies


def reproduce(
    name: str,
    out: Path,
    *,
    stored: Path | None = None,
    scale: Scale = FULL,
    workers: int = 2,
    on_start: Callable[[int], None] = lambda missing: None,
    on_done: Callable[[Job], None] = lambda job: None,
) -> Path:
    """Run the jobs that are not stored yet, draw the figures, and write the table of claims; return the table's path.

    The table has every study whose runs are all stored, not only the requested one.

    Args:
        name: one study, or ``all``.
        out: folder of the figures (PNG) and their data (CSV); the table is written beside it, ``<out>.md``.
        stored: folder of the runs' results; ``<out>/results`` by default.
        scale: the scale: full, or quick with fewer trials and coarser grids.
        workers: number of processes.
        on_start: function that is called with the number of missing runs.
        on_done: function that is called after each run, with its job.
    """
    if workers < 1:
        raise InputError(f"workers must be at least 1, got {workers}.")
    chosen = studies_named(name)
    results = Results(out / "results" if stored is None else stored)
    jobs = [job for study in chosen for job in study.jobs(scale)]
    on_start(len([job for job in dict.fromkeys(jobs) if job not in results]))
    out.mkdir(parents=True, exist_ok=True)
    results.fill(jobs, workers, on_done)
    for study in chosen:
        study.draw(results, scale).savefig(out / f"{study.name}.png", dpi=150)
        study.data(results, scale).write(out / f"{study.name}.csv")
    complete = [study for study in STUDIES if all(job in results for job in study.jobs(scale))]
    table = out.with_name(f"{out.name}.md")
    table.write_text(table_text(out, complete, results, scale))
    return table
