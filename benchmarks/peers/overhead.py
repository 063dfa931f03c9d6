"""CPU time of a suggestion after n known values, and the memory that it takes, each in a process of its own.

``python -m peers.overhead`` in ``benchmarks`` runs what is not stored. All methods that can begin with a history are
given the same one, of uniformly random tasks; the others make their own, in a run that nothing stops.
"""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
import time
from typing import Any

import numpy as np

from json_lines import JsonLines
from peers.functions import Function, function
from peers.methods import METHODS
from peers.recorder import Recorder
from peers.run import applies, record
from study_auto import RESULTS

COUNTS = (20, 100, 500)
SUGGESTIONS = 3
"""Their mean is reported; the first of them learns hyperparameters in all methods that have some."""
WARM = 45
"""Values before a suggestion that is not counted, in which libraries load what they load late."""
PATIENCE = 240.0
"""Seconds for all of them, after which a method counts as too slow."""
SEED = 0
STORED = JsonLines(RESULTS / "peers_overhead.jsonl", ("case", "method", "n"))

# Case, methods and counts; 20 dimensions for all, and the Dubins car where the inner loop is simulated.
MEASURED: list[tuple[str, list[str], tuple[int, ...]]] = [
    ("linear-10", list(METHODS), COUNTS[:2]),
    ("dubins-basin", ["auto", "auto-no-data", "scalar"], COUNTS[:2]),
    ("linear-10", ["scalar"], (1000,)),
    ("linear-10", list(METHODS), COUNTS[2:]),
]


def knowing(found: Function, n: int, more: int) -> Recorder:
    """Return a recorder that knows n values at random points and takes some more."""
    recorder = Recorder(found, n + more)
    for point in np.random.default_rng(SEED).random((n, found.dimension)):
        recorder.know(point)
    return recorder


def measure(case: str, name: str, n: int) -> dict[str, Any]:
    """Return the CPU and wall seconds of suggestions after n values, and the largest memory of this process in MB."""
    method = METHODS[name]
    maximise, found = method.load(), function(case, SEED)
    if method.resumes:
        record(maximise, knowing(found, WARM, 1), SEED)
    recorder = knowing(found, n, SUGGESTIONS) if method.resumes else Recorder(found, n + SUGGESTIONS)
    started = time.perf_counter()
    _, error = record(maximise, recorder, SEED)
    return {
        "method": name,
        "case": case,
        "n": n,
        "seconds": [round(seconds, 5) for seconds in recorder.seconds[-SUGGESTIONS:]],
        "wall": round(time.perf_counter() - started, 4),
        "memory": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        "error": error,
    }


def measured_apart(case: str, name: str, n: int) -> dict[str, Any]:
    """Return what a new process measures, or that it took too long."""
    command = [sys.executable, "-W", "ignore", "-m", "peers.overhead", case, name, str(n)]
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=True)
    except subprocess.TimeoutExpired:
        return {"method": name, "case": case, "n": n, "seconds": [], "error": f"over {PATIENCE:g} s for {SUGGESTIONS}"}
    result: dict[str, Any] = json.loads(ended.stdout.splitlines()[-1])
    return result


def main() -> None:
    """Measure what is missing."""
    for case, names, counts in MEASURED:
        for n in counts:
            for name in names:
                if METHODS[name].installed and applies(name, case) and (case, name, n) not in STORED:
                    result = measured_apart(case, name, n)
                    STORED.append(result)
                    print(case, name, n, statistics.mean(result["seconds"] or [np.nan]), result["error"] or "")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(measure(sys.argv[1], sys.argv[2], int(sys.argv[3]))))
    else:
        main()
