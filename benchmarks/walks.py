"""How many functions of the package a reader passes on three ways through it, at revisions and in this checkout.

A recorded trajectory until it changes the next suggestion: ``Campaign.tell`` and ``Campaign.ask``. A threshold until
its sentence: ``Campaign.verdict``, as text. A task until its distance: ``Validation.distances`` of one task.
All are those of the paper's pendulum, with executions that learned dynamics follow from. Functions are counted once,
whatever the number of calls; lambdas and comprehensions are parts of the functions that they stand in.
``python benchmarks/walks.py 6387a59`` prints those of a revision beside those of this checkout; ``--list`` prints the
functions of this checkout by file.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

from landed import tree_of

HERE = Path(__file__).resolve()
EXECUTIONS = 6


def functions_of(action: Callable[[], object], package: Path) -> list[str]:
    """Return ``file:function`` of the functions of the package that an action enters, sorted."""
    codes = set[CodeType]()

    def enter(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            codes.add(frame.f_code)

    sys.setprofile(enter)
    try:
        action()
    finally:
        sys.setprofile(None)
    entered = {(code.co_filename, code.co_qualname) for code in codes if code.co_qualname[-1] != ">"}
    return sorted(
        f"{Path(file).relative_to(package)}:{name}" for file, name in entered if Path(file).is_relative_to(package)
    )


def walk() -> dict[str, list[str]]:
    """Return the functions of each way, of the package that is imported."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # child processes are not seen
    import ctxval  # of the revision
    from ctxval import Campaign, cases

    def told() -> Any:
        campaign.tell(opened, trajectory)
        return campaign.ask()

    def judged() -> Any:
        return str(other.verdict(3 * other.worst.distance))  # so far above that a bound is computed

    def measured() -> Any:
        return experiment.validation.distances([[1.0]])

    package = Path(ctxval.__file__).parent
    experiment = cases.by_name("pendulum")
    campaign, other = (Campaign(experiment.validation, seed=1).run(EXECUTIONS) for _ in range(2))
    opened = campaign.ask()
    trajectory = experiment.validation.system.execute(opened.plan.controller, opened.plan.task)
    ways = {
        "a recorded trajectory, until the next suggestion": told,
        "a threshold, until its sentence": judged,
        "a task, until its distance": measured,
    }
    return {name: functions_of(action, package) for name, action in ways.items()}


def main() -> None:
    """Print the table, or with ``--json`` the functions of the package that is imported."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("revisions", nargs="*", default=["6387a59"])
    parser.add_argument("--list", action="store_true", help="print the functions of this checkout")
    parser.add_argument("--json", action="store_true", help="print the functions of the package that is imported")
    options = parser.parse_args()
    if options.json:
        print(json.dumps(walk()))
        return
    walks = []
    for tree in [*map(tree_of, options.revisions), HERE.parents[1]]:
        environment = {**os.environ, "PYTHONPATH": str(tree / "src"), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, str(HERE), "--json"]
        output = subprocess.run(command, env=environment, cwd=HERE.parent, check=True, capture_output=True, text=True)
        walks.append(json.loads(output.stdout.splitlines()[-1]))
    print(f"| | {' | '.join([*options.revisions, 'now'])} |")
    print("|---" * (1 + len(walks)) + "|")
    for name in walks[-1]:
        counts = (f"{len(each[name])} in {len({entry.partition(':')[0] for entry in each[name]})}" for each in walks)
        print(f"| {name}: functions, in files | {' | '.join(counts)} |")
    if options.list:
        print(*(f"\n{name}\n" + "\n".join(functions) for name, functions in walks[-1].items()), sep="\n")


if __name__ == "__main__":
    main()
