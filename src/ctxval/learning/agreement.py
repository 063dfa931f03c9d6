"""When M agrees with the system: errors that matter to no distance, for campaigns that learn nothing, too."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AgreementSettings:
    """What counts as an error that matters to no distance, and on which tasks that is tried."""

    share: float = 0.01  # share of the threshold up to which a distance is negligible
    margin: float = 2.0  # multiple of an executed distance that those of other tasks may have
    amplified: float = 100.0  # largest factor by which executed distances may exceed those under constant errors
    ways: int = 8  # combinations of signs of a constant error of each state
    tasks: int = 256  # random tasks under these errors
    tasks_alone: int = 16  # the same, if each closed loop is designed and run on its own
