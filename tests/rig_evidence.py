"""Evidence in plain numbers, against which no diagnostic of the dynamics bound speaks."""

from __future__ import annotations

import numpy as np

from ctxval.certificates import CheckedPrediction, Evidence, StateInputCoverage, StateInputGap


def prediction(trial: int, median: float = 0.5, distance: float = 0.5) -> CheckedPrediction:
    return CheckedPrediction(trial, 0.5, median, 1.1 * median, distance)


def gap(size: float, *coordinates: str) -> StateInputGap:
    return StateInputGap(size, coordinates or ("u[0]",), {"x[0]": 1.0, "u[0]": 3.0})


COVERED = StateInputCoverage(gap(0.1), gap(0.01), gap(0.2, "x[0]", "u[0]"), {"x[0]": 0.1, "u[0]": 0.2}, np.zeros(2), 99)
GOOD = Evidence(
    maxima=np.linspace(0.9, 1.0, 40),
    points=np.random.default_rng(0).random((40, 2)),
    highest=0.95,
    local_maxima=np.random.default_rng(1).random((5, 2)),
    evaluations=9000,
    executions=4,
    left_out=0.01,
    noise=1e-6,
    predictions=tuple(prediction(k) for k in range(1, 4)),
    coverage=COVERED,
    tests=0,
    best=0.8,
    worst=(0.2, 0.7),
)
