"""What a threshold is about: the largest distance over the tasks, its quantile under noise, or that of a share of them.

A campaign asks for the largest distance d*, or for the distance that a share of the tasks stays below. If executions of
one task turn out to differ by noise, it is a quantile over the executions of the worst task.
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, final

import numpy as np

from ctxval._util.arrays import Array
from ctxval.core.quantiles import QUANTILE


class Target(ABC):
    """What a threshold is about."""

    quantile: float  #: the share of the executions of each task that it is about if they differ by noise
    share: float  #: the share of the tasks that it is about
    is_noisy: ClassVar[bool] = False  #: whether executions of one task differ, so that one alone falsifies nothing
    by_draws: ClassVar[bool] = False  #: whether independent draws of tasks decide it, so that its tests are such draws
    drawn: ClassVar[str] = "tasks"  #: what drawn tests are a sample of

    @classmethod
    def asked(cls, quantile: float, share: float) -> Target:
        """Return the target of the options of these names, before it is known whether the system is noisy."""
        return Share(share, quantile) if share < 1 else Largest(quantile)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Target:
        """Return the target that :meth:`to_json` returned."""
        quantile, share = values.get("quantile"), float(values.get("share", 1.0))
        return cls.asked(QUANTILE, share) if quantile is None else Quantile(float(quantile), share)

    def to_json(self) -> dict[str, float | None]:
        """Return the quantile, which is None without noise, and the share of the tasks if it is less than 1."""
        of_tasks = {"share": self.share} if self.share < 1 else {}
        return {"quantile": self.quantile if self.is_noisy else None, **of_tasks}

    @property
    def often(self) -> str:
        """In how many executions of a task it holds, as a part of a sentence."""
        return ""

    @property
    def of_distance(self) -> str:
        """What a threshold limits in each task."""
        return "d"

    @property
    def volume(self) -> float:
        """The share of the tasks that it leaves out."""
        return round(1 - self.share, 12)

    def exceeding(self, upper: str, limit: str) -> str:
        """Return why a bound above a threshold leaves it open, if no executed distance is above it."""
        return f"no distance above {limit} was executed, but d* may be up to {upper}"

    def with_noise(self) -> Target:
        """Return the target if executions of one task differ by noise."""
        return Quantile(self.quantile, self.share)

    def raised(self, upper: float, best: float) -> float:
        """Return a bound by draws of the dynamics, raised to the largest executed distance if that contradicts it."""
        return upper  # a noisy execution may exceed the quantile, and so may some tasks the distance of a share

    def testable(self, highest: float, maxima: Array) -> float:
        """Return the largest distance that an execution is expected to have, by the mean and by draws ``(S,)``."""
        return highest

    def large(self, bound: float, highest: float) -> tuple[float, str]:
        """Return the distance by whose share executed ones are large, and its name: a bound, or that of the mean."""
        return bound, "bound"

    def reached(self, best: float, predicted: Callable[[], float]) -> float:
        """Return the least value that the bound can have: the largest executed distance, or the predicted target."""
        return best


@final
@dataclass(frozen=True)
class Largest(Target):
    """The largest distance over all tasks."""

    quantile: float = QUANTILE
    share: float = field(default=1.0, init=False)

    def raised(self, upper: float, best: float) -> float:
        return max(upper, best)


LARGEST_DISTANCE = Largest()
"""What is asked for by default."""


@final
@dataclass(frozen=True)
class Quantile(Target):
    """The largest quantile over tasks of the distances of their executions, which differ by noise."""

    is_noisy: ClassVar[bool] = True
    drawn: ClassVar[str] = "executions"

    quantile: float = QUANTILE
    share: float = 1.0  #: the share that was asked for; with noise, none is bounded

    @property
    def often(self) -> str:
        return f" in at least {100 * self.quantile:g} % of its executions"

    @property
    def of_distance(self) -> str:
        return f"the {self.quantile:g} quantile of d"

    def exceeding(self, upper: str, limit: str) -> str:
        share = f"{100 * self.quantile:g} % of the executions of a task"
        return f"{share} may have distances of up to {upper}, and the threshold is {limit}"

    def testable(self, highest: float, maxima: Array) -> float:
        return min(highest, float(np.median(maxima)))

    def large(self, bound: float, highest: float) -> tuple[float, str]:
        # Most executions of a noisy task are far below the bound on a quantile, however well it is known.
        return highest, "largest predicted distance"


@final
@dataclass(frozen=True)
class Share(Target):
    """The distance that a share of the tasks stays below."""

    by_draws: ClassVar[bool] = True

    share: float
    quantile: float = QUANTILE

    def reached(self, best: float, predicted: Callable[[], float]) -> float:
        return predicted()
