"""True systems S: ready-made ones and adapters."""

from __future__ import annotations

from ctxval._util.registry import Registry
from ctxval.core.system import Simulated, System, WithOutputs
from ctxval.data.recorded_system import Recorded
from ctxval.systems.fmu import FMU
from ctxval.systems.functions import Function, Imperfect, Manual, rk4
from ctxval.systems.gymnasium import Gymnasium
from ctxval.systems.mujoco import MuJoCo
from ctxval.systems.pybullet import PyBullet
from ctxval.systems.subprocess import Subprocess

__all__ = [
    "FMU",
    "REGISTRY",
    "Function",
    "Gymnasium",
    "Imperfect",
    "Manual",
    "MuJoCo",
    "PyBullet",
    "Recorded",
    "Simulated",
    "Subprocess",
    "System",
    "WithOutputs",
    "by_name",
    "rk4",
]

REGISTRY: Registry[System] = Registry("system", __name__, method="execute")
"""The systems that are found by name: those of this package, and those that installed packages add."""

by_name = REGISTRY.make
