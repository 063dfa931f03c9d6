"""True systems S: ready-made ones and adapters."""

from ctxval.integrate import rk4
from ctxval.system import System
from ctxval.systems.simulated import Simulated

__all__ = ["Simulated", "System", "rk4"]
