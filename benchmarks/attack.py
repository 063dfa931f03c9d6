"""Hostile stores, logs, tables, experiment files, systems, requests and arguments, through the command line.

``python benchmarks/attack.py --inputs 20200`` makes each input from its family, its number and the seed alone, and runs
its command line in a process of its own, bounded in time, memory and files. None may end with a traceback, hang, take
much memory, run code, read or write elsewhere, tell a secret, change files that are no outputs, give another answer for
the same data in another format, make a store unreadable, or send the terminal what steers it. The counts go to
benchmarks/results/attack.jsonl, from which it goes on; `benchmarks/reliability.py` makes the page. What went wrong is
printed; ``python benchmarks/attack.py --repeat FAMILY NUMBER --keep FOLDER`` repeats it.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

from hostile import (  # noqa: E402
    archives,
    arguments,
    clocks,
    clothes,
    doors,
    experiments,
    logs,
    numbers,
    oracles,
    served,
    stores,
    written,
)
from hostile.cage import SENTINEL, STATUSES, Case, Outcome, Watched, carry_out, declared  # noqa: E402
from hostile.values import Rng, pick  # noqa: E402
from json_lines import JsonLines  # noqa: E402

RESULTS = ROOT / "benchmarks" / "results" / "attack.jsonl"
KEY = ("family",)
CHUNK = 40
"""Inputs that are counted together."""

_MANUAL = """\
name = "rig"
[space]
goal = [0.5, 3.0, "m"]
load = [0.0, 0.4, "m/s"]
[task]
initial_state = [0.0, "load"]
goal = ["goal", 0.0]
horizon = 60
dt = 0.05
[system]
type = "Manual"
states = { position = "m", speed = "m/s" }
inputs = { force = "N" }
dt = 0.05
[model]
type = "Linear"
A = [[1.0, 0.05], [0.0, 1.0]]
B = [[0.0], [0.05]]
[synthesizer]
type = "LQR"
Q = [10.0, 1.0]
R = [0.1]
[distance]
type = "MaximumDeviation"
scales = [1.0, 1.0]
[search]
type = "random"
"""


_TOUCHES = f"""

import os

PASSWORD = "{oracles.GLOBAL}"
ACCOUNT = {{"password": os.environ["ROBOT_PASSWORD"]}}
_frictional = step


def step(x, u):
    # Drivers log in, with secrets of the environment and of their module.
    assert os.environ["AWS_SECRET_ACCESS_KEY"] and PASSWORD and ACCOUNT
    return _frictional(x, u)
"""


def prepare(base: Path) -> Path:
    """Make what is attacked: an experiment file, a store of it, and stores of a rig that people operate."""
    base.mkdir()
    (base / "rig.toml").write_text(_MANUAL)
    (base / "table.toml").write_text(_MANUAL + clothes.MAPPING)
    done(base, "init", "experiment.toml")
    done(base, "init", "cart.toml", "--hardware")
    # Learned dynamics take as long as a hang.
    (base / "experiment.toml").write_text((base / "experiment.toml").read_text().replace('"auto"  ', '"posterior"  '))
    with (base / "experiment_system.py").open("a") as file:
        file.write(_TOUCHES)
    done(base, "run", "experiment.toml", "--budget", "4", "--search", "random", "--store", "a.sqlite", "--no-report")
    for _ in range(2):
        done(base, "ask", "a.sqlite")
    for store in ("rig", "table"):
        for _ in range(3):
            done(base, "ask", f"{store}.toml", "--store", f"{store}.sqlite")
        done(base, "tell", f"{store}.sqlite", "0", "--distance", "0.1")
        done(base, "tell", f"{store}.sqlite", "1", "--failed", "x")
    for _ in range(3):
        done(base, "ask", "rig.sqlite")
    (base / "network.onnx").write_bytes(_network())
    return base


def done(base: Path, *line: str) -> None:
    """Run a command that must succeed."""
    outcome = carry_out(Case(line, code=True, environment=_environment(base)), base)
    if outcome.status:
        raise RuntimeError(f"{line}: {outcome.status}: {outcome.said}")


def _network() -> bytes:
    """Return a network that is a step of the cart."""
    from onnx import TensorProto, helper  # heavy, and needed once

    nodes = [helper.make_node("Concat", ["x", "u"], ["z"], axis=-1), helper.make_node("MatMul", ["z", "W"], ["y"])]
    weights = helper.make_tensor("W", TensorProto.FLOAT, [3, 2], [1, 0, 0.05, 1, 0, 0.05])
    sides = [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["b", k]) for n, k in (("x", 2), ("u", 1), ("y", 2))]
    graph = helper.make_graph(nodes, "cart", sides[:2], sides[2:], [weights])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    return bytes(model.SerializeToString())


def _environment(folder: Path) -> dict[str, str]:
    """Return variables of a user whose home is a folder."""
    home = {name: str(folder / "home") for name in ("HOME", "XDG_STATE_HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME")}
    (folder / "home").mkdir(exist_ok=True)
    return {**home, "TMPDIR": str(folder / "home"), "PYTHONPATH": os.environ.get("PYTHONPATH", ""), "COLUMNS": "120"}


# Families: (random numbers, folder, base) -> the command line, once the folder is made


@dataclass(frozen=True)
class Family:
    """A kind of hostile input.

    Attributes:
        title: for people.
        share: of all inputs.
        make: writes the files of one input and returns its command line.
        own: whether the stores in it are this user's.
        each: how many inputs one command line takes: a server takes many requests.
    """

    title: str
    share: float
    make: Callable[[Rng, Path, Path], Case]
    own: bool = False
    each: int = 1


def _store(change: Callable[[Rng, Path, Path], None], name: str = "") -> Callable[[Rng, Path, Path], Case]:
    def make(rng: Rng, folder: Path, base: Path) -> Case:
        experiments.write(folder, base)
        change(rng, folder, base / (name or str(pick(rng, ("a.sqlite", "rig.sqlite")))))
        line = stores.commands(rng)
        archives_of(rng, folder)
        return Case(line, code=line[0] == "run")

    return make


def archives_of(rng: Rng, folder: Path) -> None:
    """Write sound recordings, so that what is wrong is the store."""
    np.savez(folder / "run.npz", **archives.sound())
    (folder / "run.csv").write_text("t,position,speed,force\n0,0,0,0\n")
    (folder / "table.csv").write_text("goal,load,distance\n1.0,0.1,0.2\n")


def _told(rng: Rng, folder: Path, base: Path) -> Case:
    """Tell a recording of a trial that waits for one."""
    shutil.copy(base / "rig.sqlite", folder / stores.NAME)
    npz = rng.random() < 0.6
    name = "run.npz" if npz else "run.csv"
    archives.placed(rng, folder / name, archives.npz(rng) if npz else archives.recording_csv(rng))
    more = (*pick(rng, ((), ("--resample",), ("--start-tolerance", "1e9"))), *pick(rng, ((), ("--json",))))
    return Case(("tell", stores.NAME, str(2 + rng.integers(4)), "--npz" if npz else "--trajectory", name, *more))


def _imported(rng: Rng, folder: Path, base: Path) -> Case:
    """Import a table of runs, or one recording."""
    shutil.copy(base / "rig.sqlite", folder / stores.NAME)
    archives.placed(rng, folder / "run.npz", archives.npz(rng))
    archives.placed(rng, folder / "run.csv", archives.recording_csv(rng))
    archives.placed(rng, folder / "table.csv", archives.runs_csv(rng))
    os.mkfifo(folder / "pipe")
    given = ("--set", "goal=1.0", "--set", "load=0.1")
    line = pick(
        rng, (("table.csv",), ("table.csv",), ("table.csv", "table.csv"), ("run.csv", *given), ("run.npz", *given))
    )
    return Case(("import", stores.NAME, *line, *pick(rng, ((), ("--resample",), ("--json",)))))


def _toml(rng: Rng, folder: Path, base: Path) -> Case:
    experiments.write(folder, base)
    text = (base / str(pick(rng, (experiments.FILE, experiments.FILE, "rig.toml")))).read_text()
    (folder / experiments.FILE).write_bytes(experiments.toml(rng, text))
    return Case(experiments.run_or_check(rng), code=True)


def _system(rng: Rng, folder: Path, base: Path) -> Case:
    experiments.write(folder, base)
    code, prints = experiments.module(rng)
    (folder / "experiment_system.py").write_text(code, encoding="utf-8", errors="surrogatepass")
    return Case(experiments.run_or_check(rng), code=True, prints=prints)


def _data(rng: Rng, folder: Path, base: Path) -> Case:
    """Check or run an experiment whose model is learned from hostile recordings, or is a hostile network."""
    experiments.write(folder, base)
    text = (folder / experiments.FILE).read_text()
    kind = int(rng.integers(3))
    name = ("run.npz", "run.csv", "model.onnx")[kind]
    match kind:
        case 0:
            content = archives.npz(rng)
        case 1:
            content = archives.recording_csv(rng, "t,x0,x1,u0")
        case _:
            content = archives.onnx(rng, (base / "network.onnx").read_bytes())
    archives.placed(rng, folder / name, content)
    model = f'type = "Onnx"\nsource = "{name}"' if kind == 2 else f'type = "Linear"\ndata = {{ logs = ["{name}"] }}'
    begin, end = text.index("[model]"), text.index("[synthesizer]")
    (folder / experiments.FILE).write_text(f"{text[:begin]}[model]\n{model}\n\n{text[end:]}")
    return Case(experiments.run_or_check(rng), code=True)


def _arguments(rng: Rng, folder: Path, base: Path) -> Case:
    experiments.write(folder, base)
    shutil.copy(base / "a.sqlite", folder / stores.NAME)
    archives_of(rng, folder)
    return Case(arguments.command_line(rng), code=True)


FAMILIES: dict[str, Family] = {
    "damaged": Family("stores with changed bytes", 0.09, _store(stores.damaged), own=True),
    "crafted": Family("stores changed by SQL", 0.14, _store(stores.crafted)),
    "crafted-own": Family("the same, for stores that this user made", 0.05, _store(stores.crafted), own=True),
    "coded": Family("stores whose settings name code", 0.05, _store(stores.coded, "a.sqlite")),
    "no-store": Family("pipes, devices, folders and others in place of a store", 0.05, _store(stores.no_store)),
    "told": Family("recordings for `ctxval tell`, NPZ and CSV", 0.078, _told, own=True),
    "imported": Family("tables of runs for `ctxval import`", 0.06, _imported, own=True),
    "data": Family("recordings and networks for models", 0.03, _data),
    "toml": Family("experiment files", 0.05, _toml),
    "systems": Family("systems", 0.01, _system),
    "clothes": Family("the same recordings in other formats, columns and units", 0.12, clothes.case, own=True),
    "logs": Family("logs of all kinds, and models, for `replay`, `fit`, `tell` and `import`", 0.1, logs.case, own=True),
    "clocks": Family("times, units and signs that are not what a header says", 0.05, clocks.case, own=True),
    "outputs": Family("outputs onto inputs, and other files", 0.03, doors.outputs, own=True),
    "secrets": Family("systems that use secrets", 0.02, doors.secret_system, own=True),
    "served": Family("requests to `ctxval serve`", 0.02, served.case, own=True, each=served.REQUESTS),
    "names": Family("names of fields in the files that `start` writes", 0.02, written.names, own=True),
    "rigs": Family("rigs that overrun, time out and fail", 0.002, written.rig),
    "arguments": Family("arguments", 0.05, _arguments, own=True),
    "numbers": Family("-0.0, NaN and others for every number that is stored", 0.03, numbers.case, own=True),
}


def case_of(name: str, number: int, seed: int, folder: Path, base: Path) -> Case:
    """Make an input in an empty folder."""
    family = FAMILIES[name]
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
    if family.own:
        shutil.copytree(base / "home", folder / "home")
    environment = _environment(folder)
    case = family.make(rng, folder, base)
    places = (str(base),) if family.own else ()  # a store's own modules are looked up where it was made
    return replace(case, environment={**environment, **case.environment}, places=places)


# Carrying it out


def inflict(name: str, number: int, seed: int, base: Path, keep: Path | None = None, *, apart: bool = False) -> Outcome:
    """Make an input and run its command line; ``apart`` in an interpreter of its own."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as place:
        folder = Path(place) / "f"
        folder.mkdir()
        case = case_of(name, number, seed, folder, base)
        if keep is not None:
            shutil.copytree(folder, keep, symlinks=True)
        # No shell can pass a NUL character.
        alone = apart and case.client is None and not any("\0" in argument for argument in case.arguments)
        outcome = _apart(case, folder) if alone else carry_out(case, folder)
        return replace(outcome, said=f"{arguments.shown(case.arguments)}\n{outcome.said}")


def _apart(case: Case, folder: Path) -> Outcome:
    """Run a command line as a shell does, and look at all files that it opens, also in native code, with strace."""
    command = [sys.executable, "-m", "ctxval", *case.arguments]
    trace = folder.parent / "trace"
    if shutil.which("strace"):
        command = ["strace", "-f", "-qq", "--seccomp-bpf", "-e", "trace=open,openat,creat", "-o", str(trace), *command]
    with Watched(folder, case.arguments) as watched:
        try:
            done = subprocess.run(
                command,
                cwd=folder,
                env={**os.environ, **oracles.SECRETS, **case.environment},
                capture_output=True,
                timeout=90,
                stdin=subprocess.DEVNULL,
            )
        except subprocess.TimeoutExpired:
            return Outcome(-9, ("hang",), 90.0, 0.0)
        opened = trace.read_text(errors="replace") if trace.exists() else ""
        trace.unlink(missing_ok=True)
    why = watched.wrong(done.stdout, done.stderr)
    why += [
        f"read elsewhere: {one}"
        for one in oracles.traced(opened, folder, [*declared(case.arguments, folder), *case.places])
    ]
    why += [] if case.check is None else case.check(done.returncode, done.stdout)
    wrong = ["traceback"] if b"Traceback (most recent call last)" in done.stderr and not case.prints else []
    wrong += [] if done.returncode in STATUSES else ["status"]
    wrong += ["code"] if not case.code and (folder / SENTINEL).exists() else []
    wrong += [one.partition(":")[0] for one in why]
    said = "\n".join([*why[:20], done.stderr[-1500:].decode("utf-8", "backslashreplace")])
    return Outcome(done.returncode, tuple(dict.fromkeys(wrong)), 0.0, 0.0, said)


def _some(given: tuple[str, int, int, int, str, int]) -> tuple[str, int, Counter[str], list[dict[str, Any]]]:
    """Inflict inputs of a family, from one number to another."""
    name, first, last, seed, base, apart = given
    each = FAMILIES[name].each
    counts: Counter[str] = Counter()
    found = []
    for number in range(first, last):
        alone = each == 1 and number % apart == 0
        outcome = inflict(name, number, seed, Path(base), apart=alone)
        counts.update({"inputs": each, f"status {outcome.status}": each, "apart": int(alone)})
        counts.update(outcome.wrong)
        counts["megabytes"] = max(counts["megabytes"], round(outcome.megabytes))
        counts["seconds"] = max(counts["seconds"], round(outcome.seconds))
        if outcome.wrong:
            found.append({"family": name, "number": number, **asdict(outcome)})
    return name, last, counts, found


def _chunks(inputs: int, done: dict[str, Any], seed: int, base: Path, apart: int, only: list[str]) -> list[Any]:
    """Return what is to be done, all families side by side."""
    found = []
    for name in only:
        each = FAMILIES[name].each
        target, size = round(FAMILIES[name].share * inputs / each), max(CHUNK // each, 1)
        for begin in range(done.get(name, {}).get("inputs", 0) // each, target, size):
            found.append((begin / target, (name, begin, min(begin + size, target), seed, str(base), apart)))
    return [job for _, job in sorted(found, key=lambda item: item[0])]


def attack(
    inputs: int,
    seed: int,
    base: Path,
    *,
    workers: int,
    done: dict[str, Any],
    apart: int = 400,
    only: list[str] | None = None,
    on_chunk: Callable[[str, dict[str, int], list[dict[str, Any]]], None] = lambda family, counts, found: None,
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Inflict inputs; return counts of each family, and what went wrong."""
    counts = {name: Counter(kept) for name, kept in done.items()}
    wrong: list[dict[str, Any]] = []
    jobs = _chunks(inputs, done, seed, base, apart, list(FAMILIES) if only is None else only)
    with ProcessPoolExecutor(workers, mp_context=get_context("fork"), initializer=_warm) as pool:
        for name, _, new, found in pool.map(_some, jobs):
            kept = counts.setdefault(name, Counter())
            for key in ("megabytes", "seconds"):
                kept[key] = max(kept[key], new.pop(key, 0))
            kept.update(new)
            wrong += found
            on_chunk(name, dict(sorted(kept.items())), found)
    return {key: dict(sorted(value.items())) for key, value in counts.items()}, wrong


def _warm() -> None:
    """Import what the commands do, once for all the forks."""
    import gc

    import h5py
    import matplotlib.backends.backend_agg
    import matplotlib.pyplot
    import mcap_ros2.writer
    import pyarrow.parquet
    import rosbags.rosbag2
    import rosbags.typesys

    import ctxval
    from ctxval.cli.commands import MODULES

    for module in MODULES.values():
        importlib.import_module(module)
    with contextlib.suppress(ImportError):
        importlib.import_module(
            "mujoco"
        )  # it starts a process to find its window library, which is no code of an input
    assert all((h5py, matplotlib, mcap_ros2, pyarrow, rosbags, ctxval))
    gc.freeze()  # or the collector copies all pages into each fork


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=20_200, help="in all families together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", nargs="*", choices=list(FAMILIES), default=list(FAMILIES))
    parser.add_argument("--anew", action="store_true", help="begin with the first input again, after a change of code")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--findings", type=Path, help="file for what went wrong, one JSON object a line")
    parser.add_argument("--repeat", nargs=2, metavar=("FAMILY", "NUMBER"))
    parser.add_argument("--keep", type=Path, help="folder for the files of the input that is repeated")
    given = parser.parse_args()
    # Commands of rigs name `python`: a version manager's script in its place reads its own files.
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as place:
        base = prepare(Path(place) / "base")
        if given.repeat:
            _warm()
            print(inflict(given.repeat[0], int(given.repeat[1]), given.seed, base, given.keep))
            return
        stored = JsonLines(given.results, KEY)
        done = {} if given.anew else {record["family"]: record["counts"] for record in stored.select(seed=given.seed)}

        def on_chunk(family: str, counts: dict[str, int], found: list[dict[str, Any]]) -> None:
            stored.append({"family": family, "seed": given.seed, "counts": counts})
            for one in found:
                print(one["family"], one["number"], *one["wrong"], one["said"][-300:].replace("\n", " | "), flush=True)
                if given.findings:
                    with given.findings.open("a") as file:
                        file.write(json.dumps(one) + "\n")

        attack(given.inputs, given.seed, base, workers=given.workers, done=done, only=given.only, on_chunk=on_chunk)


if __name__ == "__main__":
    main()
