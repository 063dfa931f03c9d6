"""-0.0, NaN and other numbers into every number that a store keeps: afterwards, its trials and their runs are readable.

The numbers come from people (distances, tables, tasks, limits), and from users' code: steps, controllers, distances,
task functions that write into what they are given, and the choices and notes of searches.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from ctxval import Store
from ctxval.errors import CtxvalError
from hostile import experiments, stores
from hostile.cage import Case
from hostile.values import Rng, pick

_TEXTS = ("-0", "-0.0", "nan", "-nan", "inf", "-inf", "5e-324", "-5e-324", "1e-310", "1e308", "1e309", "0", "1_0", "٣")
_TEXTS += ("9007199254740993", "9223372036854775808", "1" + "0" * 400, "0x10", "1e", "+0", "--0", "true", "")

_PYTHON = (
    *("-0.0", "float('nan')", "float('inf')", "5e-324", "-5e-324", "1e308", "2**53 + 1", "2**63", "10**400", "True"),
    *("np.float32(-0.0)", "np.float32(0.1)", "np.float16('nan')", "np.int8(0)", "np.longdouble('1e-4000')", "'1_0'"),
    *("np.ma.masked", "np.ma.masked_array(0.5, True)", "1j", "0.5 + 0j", "np.array(-0.0)", "np.array([-0.0])", "None"),
    *("np.bool_(True)", "['0.5']", "[True]", "b'1'", "np.array('1')", "-np.minimum(0.0, 0.0)", "np.datetime64('NaT')"),
)

_CODE = {
    "a step": "_sound = step\ndef step(x, u):\n    following = _sound(x, u)\n    return [{value}, following[1]]\n",
    "a step in place": "_sound = step\ndef step(x, u):\n    following = _sound(x, u)\n    x[...] = u[...] = {value}\n"
    "    return following\n",
    "a distance": "def distance(model, system, task):\n    return {value}\n",
    "a distance in place": "def distance(model, system, task):\n    for run in (model, system):\n"
    "        run.states[...] = run.times[...] = {value}\n    return 0.5\n",
    "a task": "from ctxval import Task\ndef task(p):\n"
    "    return Task([0.0, {value}], goal=[p.goal, 0.0], horizon=9, dt=0.05)\n",
    "a task in place": "from ctxval import Task\ndef task(p):\n"
    "    made = Task([0.0, 0.0], goal=[p.goal, 0.0], horizon=9, "
    "dt=0.05)\n    for array in (p.points, p._space.low, p._space.high, made.initial_state):\n"
    "        array[...] = {value}\n    return made\n",
}
"""What is added to the module of the system; a text names what gives the number."""


def case(rng: Rng, folder: Path, base: Path) -> Case:
    """Give a strange number to a command, by people's hands or by users' code, and read the store afterwards."""
    make: Callable[[Rng, Path, Path], tuple[str, ...]] = pick(rng, (_told, _imported, _asked, _limits, _coded, _coded))
    line = make(rng, folder, base)
    return Case(line, code=True, check=lambda status, out: _unreadable(folder))


def _told(rng: Rng, folder: Path, base: Path) -> tuple[str, ...]:
    shutil.copy(base / "rig.sqlite", folder / stores.NAME)
    replace = pick(rng, ((), ("--replace", "wrong \udcff")))
    return ("tell", stores.NAME, "0" if replace else "2", f"--distance={pick(rng, _TEXTS)}", *replace)


def _imported(rng: Rng, folder: Path, base: Path) -> tuple[str, ...]:
    shutil.copy(base / "rig.sqlite", folder / stores.NAME)
    rows = [",".join(pick(rng, (str(pick(rng, _TEXTS)), "1.0", "0.1")) for _ in range(3)) for _ in range(2)]
    (folder / "table.csv").write_text("\n".join(["goal,load,distance", *rows]) + "\n")
    return ("import", stores.NAME, "table.csv")


def _asked(rng: Rng, folder: Path, base: Path) -> tuple[str, ...]:
    shutil.copy(base / "rig.sqlite", folder / stores.NAME)
    return ("ask", stores.NAME, "--set", f"goal={pick(rng, _TEXTS)}", "--set", f"load={pick(rng, (*_TEXTS, '0.1'))}")


def _limits(rng: Rng, folder: Path, base: Path) -> tuple[str, ...]:
    experiments.write(folder, base)
    if rng.random() < 0.4:
        path = folder / experiments.FILE
        low, high = pick(rng, (("-1.5e308", "1.5e308"), ("-0.0", "5e-324"), ("0", "1e-320"), ("nan", "1")))
        path.write_text(path.read_text().replace("[0.5, 3.0,", f"[{low}, {high},"))
    threshold = (f"--threshold={pick(rng, _TEXTS)}",) if rng.random() < 0.6 else ()
    seed = (f"--seed={pick(rng, _TEXTS)}",) if rng.random() < 0.3 else ()
    search = ("--search", "random", "--budget", "2", "--no-report", "--store", stores.NAME)
    return ("run", experiments.FILE, *search, *threshold, *seed)


def _coded(rng: Rng, folder: Path, base: Path) -> tuple[str, ...]:
    experiments.write(folder, base)
    name, value = str(pick(rng, tuple(_CODE))), str(pick(rng, _PYTHON))
    module = folder / "experiment_system.py"
    module.write_text(f"{module.read_text()}\nimport numpy as np\n{_CODE[name].format(value=value)}")
    path = folder / experiments.FILE
    text = path.read_text()
    head, between = text[: text.index("[space]")], text[text.index("[space]") :]
    if "task" in name:
        first, last = between.index("[task]"), between.index("[states]")
        head, between = f'{head}task = {{ ref = "experiment_system:task" }}\n', between[:first] + between[last:]
    if "distance" in name:
        first, last = between.index("[distance]"), between.index("[search]")
        between = f'{between[:first]}[distance]\ntype = "experiment_system:distance"\n{between[last:]}'
    path.write_text(head + between)
    return ("run", experiments.FILE, "--search", "random", "--budget", "3", "--no-report", "--store", stores.NAME)


def _unreadable(folder: Path) -> Sequence[str]:
    """Return what of the store cannot be read any more."""
    path = folder / stores.NAME
    if not path.exists():
        return ()
    try:
        store = Store.existing(path)
        numbers = [trial.number for trial in store.trials()]
        for side in ("model", "system"):
            store.trajectories(numbers, side)  # type: ignore[arg-type]
        for read in (store.history, store.thresholds, store.settings, store.description):
            read()
    except CtxvalError as error:
        return (f"destroyed: {error}",)
    return ()
