"""True systems S: ready-made ones and adapters."""

from ctxval.core.system import System
from ctxval.systems.fmu import FMU
from ctxval.systems.function import Function
from ctxval.systems.gymnasium import Gymnasium
from ctxval.systems.integrate import rk4
from ctxval.systems.manual import Manual
from ctxval.systems.mujoco import MuJoCo
from ctxval.systems.simulated import Simulated
from ctxval.systems.subprocess import Subprocess

__all__ = ["FMU", "Function", "Gymnasium", "Manual", "MuJoCo", "Simulated", "Subprocess", "System", "rk4"]
