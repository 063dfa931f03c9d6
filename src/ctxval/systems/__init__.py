"""True systems S: ready-made ones and adapters."""

from ctxval.integrate import rk4
from ctxval.system import System
from ctxval.systems.mujoco import MuJoCo
from ctxval.systems.simulated import Simulated

__all__ = ["MuJoCo", "Simulated", "System", "rk4"]
