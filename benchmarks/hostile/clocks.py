"""Logs whose times, units or signs are not what their header says: refused, and right ones are read.

A motor with its angle and its rate is logged. The times are in any unit, stated, not stated or stated wrongly, and so
are the units of the angle and the rate. Sensors are noisy, rounded or write a value twice.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from hostile.cage import Case
from hostile.values import Rng, pick

_TIMES = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9, "min": 1 / 60, "h": 1 / 3600}
_NAMES = (
    ("angle", "rate"),
    ("angle", "speed"),
    ("theta", "omega"),
    ("q", "dq"),
    ("joint_pos", "joint_vel"),
    ("z", "vz"),
)
_TURN = 180 / math.pi
_SCALES = (("", 1.0, "", 1.0), ("deg", _TURN, "rad/s", 1.0), ("rad", 1.0, "deg/s", _TURN), ("rad", 1.0, "rad/s", 1.0))


def case(rng: Rng, folder: Path, base: Path) -> Case:
    """Write a log and return a command line that reads it; a wrong step, or a refusal of a right log, is wrong."""
    dt, unit = float(pick(rng, (0.002, 0.005, 0.01, 0.02, 0.05))), str(pick(rng, tuple(_TIMES)))
    stated = str(pick(rng, ("", unit, *_TIMES))) if rng.random() < 0.7 else unit
    names = _NAMES[int(rng.integers(len(_NAMES)))]
    angle, by, rate, rated = _SCALES[int(rng.integers(len(_SCALES)))]
    told, sign = bool(rng.random() < 0.5) or by == rated, -1.0 if rng.random() < 0.15 else 1.0
    times, x, v, u = _motor(rng, dt)
    x, v = _worn(rng, by * x), _worn(rng, sign * rated * v)
    labels = [f"{names[0]} [{angle}]", f"{names[1]} [{rate}]"] if told and angle else list(names)
    head = [f"t [{stated}]" if stated else "t", *labels, "voltage"]
    rows = [",".join(f"{value:.17g}" for value in row) for row in zip(_TIMES[unit] * times, x, v, u, strict=True)]
    (folder / "run.csv").write_text("\n".join([",".join(head), *rows]) + "\n")
    np.savez(folder / "model.npz", A=[[1.0, dt], [0.0, 1.0]], B=[[0.0], [dt]])
    right = (stated or "s") == unit and told and sign > 0
    ratio = by / rated / (_TIMES[unit] / _TIMES[stated or "s"])  # minutes and degrees nearly make up for each other
    fields = ("--state", names[0], "--state", names[1], "--input", "voltage")
    kind = str(pick(rng, ("fit", "replay")))
    more = {"fit": ("--kind", "linear"), "replay": ("--model", "model.npz", "--steps", "1")}[kind]

    def check(status: int, out: bytes) -> list[str]:
        if not right and abs(math.log(ratio)) < 0.1 and sign > 0:
            return []
        shown = f"{kind} of {head} with {unit}, {sign}, {dt} s"
        if status == 2:
            return [f"refused: {shown}"] if right else []
        report = json.loads(out)
        found = float((report if kind == "fit" else report["data"])["dt"])
        wrong = [] if abs(found / dt - 1) < 0.02 else [f"other step: {found} s, {shown}"]
        return wrong if right else [f"read: {shown}"]

    return Case((kind, "run.csv", *fields, *more, "--json"), check=check)


def _motor(rng: Rng, dt: float) -> tuple[Any, Any, Any, Any]:
    n, hold = 300, int(rng.integers(5, 20))
    u = np.repeat(rng.uniform(-3, 3, n // hold + 1), hold)[:n]
    x, fast = np.zeros((n, 2)), 0.02 / dt  # as fast for each step
    for k in range(n - 1):
        x[k + 1] = x[k] + dt * np.array([x[k, 1], fast * (8 * u[k] - 2 * x[k, 1] - 4 * fast * x[k, 0])])
    return dt * np.arange(n), x[:, 0], x[:, 1], u


def _worn(rng: Rng, column: Any) -> Any:
    """Return a signal with noise, rounded, or with values that are written twice."""
    size = float(np.std(column))
    match int(rng.integers(4)):
        case 0:
            return column + 0.03 * size * rng.normal(size=len(column))
        case 1:
            return 0.05 * size * np.round(column / (0.05 * size))
        case 2:
            held = column.copy()
            for k in np.flatnonzero(rng.random(len(column)) < 0.1)[1:]:
                held[k] = held[k - 1]
            return held
    return column
