"""Names from files in the files that commands write, and rigs that overrun, time out and fail."""

from __future__ import annotations

import csv
import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hostile.cage import Case
from hostile.values import TEXTS, Rng, pick

_MORE = (
    'x"\n[system]\ntype = "pwned:Rig"\n[y]\n"',
    "x'\n[system]\ntype = 'pwned:Rig'\n#",
    '"""\nimport pwned\n"""',
    "</script><script>alert(1)</script>",
    "$(touch PWNED)`touch PWNED`",
    "\u200fx",
    "x 😀 [m]",
    "\\",
    "x\ty",
)


def names(rng: Rng, folder: Path, base: Path) -> Case:
    """Start from a log whose fields have hostile names, and look into every file that is written."""
    chosen = [str(pick(rng, (*_MORE, *TEXTS)))[:200] for _ in range(3)]
    fields = [name.encode("utf-8", "replace").decode() or f"x{i}" for i, name in enumerate(chosen)]
    speeds = np.cumsum(u := rng.normal(size=150)) * 0.01
    with (folder / "log.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["t", *fields])
        rows.writerows(zip(np.arange(150) / 100, np.cumsum(speeds) * 0.01, speeds, u, strict=True))
    stated = ("--state", f"a={fields[0]}", "--state", fields[1], "--input", f"b={fields[2]}")
    line = ("start", "log.csv", "--out", "out", *pick(rng, ((), stated)))

    def check(status: int, out: bytes) -> Sequence[str]:
        wrong = []
        for path in (folder / "out").glob("*.toml") if status == 0 else ():
            try:
                content = tomllib.loads(path.read_text("utf-8"))
            except ValueError as error:
                wrong.append(f"invalid TOML: {path.name}: {error}")
                continue
            if content.get("system", {}).get("type", "Manual") != "Manual":
                wrong.append(f"a name became a table: {path.name}")
        page = folder / "out" / "report.html"
        if status == 0 and "<script>alert(1)" in page.read_text("utf-8"):
            wrong.append("a name became markup: report.html")
        return wrong

    return Case(line, check=check)


_SPEED = "position, speed = self.state\n"
_RIGS = (
    (_SPEED, f"{_SPEED}        time.sleep(0.2)\n"),  # overruns
    (_SPEED, f"{_SPEED}        time.sleep(60)\n"),  # is stopped at the time-out
    (_SPEED, f"{_SPEED}        raise OSError('no bus')\n"),
    (_SPEED, f"{_SPEED}        sys.exit(3)\n"),
    ("self.state = list(state)", "time.sleep(60)"),  # never arrives
)


def rig(rng: Rng, folder: Path, base: Path) -> Case:
    """Execute one task with the program of `init --hardware`, which fails and must stop the rig."""
    old, new = pick(rng, _RIGS)
    program = (base / "cart_rig.py").read_text().replace(old, new)
    mark = folder / "home" / "stopped"
    program = program.replace('and Ctrl-C."""\n', f'and Ctrl-C."""\n        Path({str(mark)!r}).touch()\n')
    (folder / "cart_rig.py").write_text(program)
    experiment = (base / "cart.toml").read_text().replace("timeout = 60 ", "timeout = 1 ")
    (folder / "cart.toml").write_text(experiment.replace("horizon = 60", f"horizon = {2 + int(rng.integers(8))}"))

    def check(status: int, out: bytes) -> Sequence[str]:
        wrong = [] if mark.exists() else ["the rig was not stopped"]
        return wrong if status else [*wrong, "an execution that failed was accepted"]

    return Case(("check", "cart.toml", "--execute"), code=True, check=check)
