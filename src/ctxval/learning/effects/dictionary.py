"""The dictionary: all effects that recorded executions of a plant may have, with bounds of their sizes."""

from __future__ import annotations

import numpy as np

from ctxval._util.arrays import Array
from ctxval.learning import effects
from ctxval.learning.effects.effect import Effect, EffectCandidate, Observed
from ctxval.learning.effects.plant import Plant

# Of effects that explain executions alike, the first one is named; those of other files are the last ones.
_FIRST = ("gain", "bias", "saturation", "dead_zone", "backlash", "transport", "friction", "inertia", "mujoco")


def kinds() -> list[type[Effect]]:
    """Return all kinds of effects, which their package exports, the simplest ones first."""
    exported = (getattr(effects, name) for name in effects.__all__)
    found = [each for each in exported if isinstance(each, type) and issubclass(each, Effect)]

    def place(kind: type[Effect]) -> int:
        name = kind.__module__.rpartition(".")[2]
        return _FIRST.index(name) if name in _FIRST else len(_FIRST)

    return sorted(found, key=place)


def candidates(
    plant: Plant, x: Array, u: Array, residuals: Array, *, seconds: float, estimated: bool = False, runs: int = 1
) -> tuple[EffectCandidate, ...]:
    """Return the effects that a plant may have, from transitions of executions.

    Args:
        plant: the plant.
        x: recorded states, shape ``(N, n)``.
        u: inputs, shape ``(N, m)``.
        residuals: what M misses of the next states, shape ``(N, n)``.
        seconds: the length of the longest execution.
        estimated: whether states are estimated from outputs.
        runs: the number of executions, which may have offsets of their own.
    """
    missed = np.sqrt([(column**2).mean() for column in residuals.T])
    observed = Observed(plant, x, u, missed, seconds, estimated, runs)
    return tuple(candidate for kind in kinds() for candidate in kind.candidates(observed))
