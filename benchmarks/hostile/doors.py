"""Command lines whose outputs lie on inputs, and systems that touch secrets, through every command."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from hostile import clothes, experiments, stores
from hostile.cage import Case
from hostile.oracles import ROTATED
from hostile.values import Rng, pick

_FILES = ("run0.csv", "run1.npz", "experiment.toml", "experiment_system.py", "mapping.toml", "model.npz", "notes.md")


def _furnished(folder: Path, base: Path) -> None:
    """Write recordings, a model, an experiment and its store, and notes: nothing that a command may replace."""
    experiments.write(folder, base)
    shutil.copy(base / "a.sqlite", folder / stores.NAME)
    shutil.copy(base / "table.sqlite", folder / clothes.TABLE)
    for number, suffix in enumerate((".csv", ".npz", ".csv", ".csv")):
        table = clothes.table_of(number)
        table.kind = suffix
        clothes.write(np.random.default_rng(0), table, folder, f"run{number}")
    clothes._write_model(folder)
    (folder / "mapping.toml").write_text(clothes.MAPPING)
    (folder / "notes.md").write_text("notes\n")
    for place in ("saved", "a.trials/4", "logs", "a.export"):
        (folder / place).mkdir(parents=True)
        for name in ("task.json", "controller.json", "trials.csv", "trials.json", "run-0.csv", "0000.csv", "notes.txt"):
            (folder / place / name).write_text("mine\n")


def outputs(rng: Rng, folder: Path, base: Path) -> Case:
    """Let a command write onto its input, onto another file, or two outputs onto each other."""
    _furnished(folder, base)
    beside = f"{folder.parent / 'outside' / 'secret.csv'}"
    victim = str(pick(rng, (*_FILES, stores.NAME, clothes.TABLE, "saved", "saved/notes.txt", beside)))
    (folder / "link.html").symlink_to(str(pick(rng, ("notes.md", "run0.csv", beside))))
    (folder / "link.npz").symlink_to("run1.npz")
    html = str(pick(rng, (victim, victim, "link.html", "new.html")))
    model = str(pick(rng, ("run1.npz", "model.npz", "link.npz", victim, "new.npz", "new.onnx", "a.sqlite.npz")))
    logs = ("run0.csv", "run1.npz", "run2.csv", "run3.csv")
    mapped = ("--mapping", "mapping.toml")
    rig = ("--experiment", "experiment.toml") if rng.random() < 0.3 else ()
    lines: tuple[tuple[str, ...], ...] = (
        ("fit", *logs, *mapped, "--kind", "linear", "--out", model),
        ("fit", *logs, *mapped, "--kind", "linear", "--out", model),
        ("replay", "run0.csv", "--model", "model.npz", *mapped),
        ("report", stores.NAME, "--out", html),
        ("report", stores.NAME, "--out", "r.html", "--junit", str(pick(rng, (victim, "r.html", "link.html")))),
        ("report", stores.NAME, "--out", "r.html", "--markdown", str(pick(rng, (victim, "r.html", "new.md")))),
        ("report", stores.NAME, "--junit", "r.xml", "--markdown", "r.xml"),
        ("export", stores.NAME, "--out", str(pick(rng, (victim, "saved", ".", "..")))),
        ("export", stores.NAME),
        ("ask", stores.NAME, *rig, "--out", str(pick(rng, (victim, "saved", ".")))),
        ("ask", stores.NAME, "--trial", "4"),
        ("ask", stores.NAME, "--trial", "4", "--out", str(pick(rng, ("saved", victim)))),
        ("init", str(pick(rng, ("experiment.toml", "new.toml", "mapping.toml", "saved", victim)))),
        ("run", "experiment.toml", "--search", "random", "--budget", "2", "--no-report", "--store", victim),
        ("compare", "one=experiment.toml", "two=pendulum", "--budget", "2", "--stores", victim),
        ("ask", "experiment.toml", "--store", victim),
        ("refine", stores.NAME, "--threshold", "0.1", "--method", "linear", "--budget", "5", "--out", model),
        ("certify", stores.NAME, "--threshold", "0.5", "--kind", "scenario"),
        ("status", stores.NAME),
        ("import", clothes.TABLE, "run0.csv", "--set", "goal=1.0", "--set", "load=0.1", "--start-tolerance", "1e9"),
        ("tell", clothes.TABLE, "2", "--npz", "run1.npz", "--start-tolerance", "1e9"),
        ("remeasure", stores.NAME, *rig),
        ("check", "experiment.toml", "--execute"),
    )
    line = pick(rng, lines)
    return Case(line, code=True, check=lambda status, out: _twins(line, status))


def _twins(line: Sequence[str], status: int) -> list[str]:
    """Return that two outputs went into one file."""
    named = [value for option, value in pairwise(line) if option in ("--out", "--junit", "--markdown")]
    return ["files: two outputs are one file"] if status in (0, 1) and len(set(named)) < len(named) else []


_ARGUED = """
import sys

_logged_in = step


def step(x, u):
    assert sys.argv and sys.modules and sys.version_info
    return _logged_in(x, u)
"""


def secret_system(rng: Rng, folder: Path, base: Path) -> Case:
    """Give a command a system that logs in with secrets, which may have changed since."""
    experiments.write(folder, base)
    argued = rng.random() < 0.2
    if argued:
        with (folder / "experiment_system.py").open("a") as file:
            file.write(_ARGUED)
    shutil.copy(base / "a.sqlite", folder / stores.NAME)
    own = ("--experiment", "experiment.toml")
    run = ("run", "experiment.toml", "--search", "random", "--no-report")
    lines: tuple[tuple[str, ...], ...] = (
        (*run, "--store", "new.sqlite", "--budget", "1"),
        (*run, "--store", "new.sqlite", "--budget", "1", "--json"),
        (*run, "--store", stores.NAME, "--budget", "5"),
        ("run", "experiment.toml", "--search", "none", "--store", "new.sqlite"),
        ("ask", "experiment.toml", "--store", "new.sqlite"),
        ("ask", stores.NAME, *own),
        ("ask", stores.NAME, *own, "--json"),
        ("tell", stores.NAME, "4", "--failed", "x", *own),
        ("check", "experiment.toml"),
        ("check", "experiment.toml", "--execute", "--json"),
        ("export", stores.NAME, "--out", "saved"),
        ("status", stores.NAME, "--json"),
        ("report", stores.NAME, "--out", "r.html", "--markdown", "r.md", "--junit", "r.xml"),
        ("report", stores.NAME, "--out", "r.html", *own),
        ("certify", stores.NAME, "--threshold", "0.5", "--kind", "scenario", "--json"),
        ("certify", stores.NAME, "--audit", "1", "--kind", "scenario", *own),
        ("remeasure", stores.NAME, *own),
        ("compare", "one=experiment.toml", "two=experiment.toml", "--budget", "1"),
    )
    line = pick(rng, lines)
    rotated = rng.random() < 0.4
    resumes = stores.NAME in line and line[0] in ("run", "ask", "tell", "remeasure", "report") and not argued

    def check(status: int, out: bytes) -> list[str]:
        return ["other answer: a changed password refuses the store"] if rotated and resumes and status == 2 else []

    return Case(line, code=True, environment={"ROBOT_PASSWORD": ROTATED} if rotated else {}, check=check)
