"""CPU seconds of everyday commands and imports, beside those of the last release and of ``import numpy``.

Each is a fresh interpreter, whose modules are compiled beforehand. The public names stand here because ``import
ctxval`` imports them only when they are used. The demo runs once; then its finished campaign is answered again.
"""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import tempfile

from landed import Ratio, beside_landed, report

RELEASE = "23bd7a97"
"""The revision of the last release, 0.2.0."""

REPEATS = 5
NUMPY = "import numpy"
STORE = "demo.sqlite"
CTXVAL = ("-c", "from ctxval.cli import main; main()")
DEMO = (*CTXVAL, "run", "pendulum", "--store", STORE)
COMMANDS = {
    **{code: ("-c", code) for code in (NUMPY, "import ctxval", "from ctxval import Campaign")},
    "ctxval --help": (*CTXVAL, "--help"),
    "ctxval status": (*CTXVAL, "status", STORE),
    "ctxval run, finished before": DEMO,
}
MOST_RATIO = {"import ctxval": 2.0, "from ctxval import Campaign": 2.0}
"""The largest ratio to the time of numpy that is asked for."""

MOST_SECONDS = {"ctxval --help": 0.3, "ctxval status": 0.3, "ctxval run, finished before": 0.7, "demo": 5.0}
"""The largest CPU seconds that are asked for."""


def cpu_seconds(*arguments: str) -> float:
    """Return the CPU seconds of a fresh interpreter."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measured() -> dict[str, list[float]]:
    """Return the CPU seconds of each command in each repeat, with the package on the path."""
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        cpu_seconds(*CTXVAL, "run", "--help")  # compiles
        demo = [cpu_seconds(*DEMO)]
        turns = [{name: cpu_seconds(*command) for name, command in COMMANDS.items()} for _ in range(REPEATS)]
        os.chdir("/")
    return {"demo": demo, **{name: [turn[name] for turn in turns] for name in COMMANDS}}


def main() -> None:
    if "--figures" in sys.argv:
        report(measured())
        return
    ((earlier,), (now,)) = beside_landed(__file__, "--figures", revision=RELEASE)
    missed = []
    for name, seconds in now.items():
        if name != NUMPY:
            print(Ratio("bench_start", f"{name}, in 0.2.0 and now", earlier[name], seconds), flush=True)
        if statistics.median(seconds) > MOST_SECONDS.get(name, float("inf")):
            missed.append(f"{name}: more than {MOST_SECONDS[name]:g} CPU s")
    for name, most in MOST_RATIO.items():
        ratio = Ratio("bench_start", f"{name}, beside {NUMPY}", now[name], now[NUMPY], most=most)
        print(ratio, flush=True)
        missed += [] if ratio.met else [str(ratio)]
    if missed:
        raise SystemExit(f"too slow: {'; '.join(missed)}")


if __name__ == "__main__":
    main()
