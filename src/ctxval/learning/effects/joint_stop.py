"""Stops of joints: a position beyond which a joint does not go, or not without a spring that pushes it back."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval.learning.effects.effect import Effect, EffectCandidate, Observed, Parameter
from ctxval.learning.effects.plant import Joint, Plant


@dataclass(frozen=True)
class StopSettings:
    """When a joint that rests where it goes no further has met a stop, and no friction holds it."""

    near: float = 2e-3  # share of the range within which positions are one: more than the steps of usual encoders
    fewest: int = 20  # steps of rest
    pushed: float = 3.0  # usual residuals of M in this run by which M goes beyond in a tenth of these steps
    varied: float = 3.0  # by which this varies: at the end of a way without a stop, a rest has one residual


@dataclass(frozen=True)
class JointStop(Effect):
    """A joint stops at a position. Sizes: the position; of a soft stop, also its stiffness.

    A soft stop accelerates the joint in proportion to the way beyond it, by an implicit step that is stable for all
    stiffnesses; a hard one is the limit of this. No stop throws a joint back.
    """

    name: ClassVar[str] = "joint stop"
    joint: Joint = Joint(1, 0)  # noqa: RUF009  # it is frozen
    upper: bool = True  #: whether positions below the stop are free
    soft: bool = False
    dt: float = 1.0  #: seconds

    @classmethod
    def candidates(cls, observed: Observed) -> Iterator[EffectCandidate]:
        plant = observed.plant
        with np.errstate(all="ignore"):
            reached = np.asarray(plant.model.step(np.array(observed.x), np.array(observed.u)))
        for joint in plant.joints:
            if joint.position is None:
                continue
            recorded, unit = observed.x[:, joint.position], plant.states[joint.position][1]
            low, high = float(recorded.min()), float(recorded.max())
            for upper, end in ((True, high), (False, low)):
                beyond = reached[:, joint.position] > end if upper else reached[:, joint.position] < end
                if beyond.sum() < 2 or high <= low:  # M goes nowhere where the system did not
                    continue
                size = 0.1 * (high - low)
                position = Parameter("position", end - 5 * size, end + size, 0.1 * size, unit)
                stiffness = Parameter("stiffness", 0.0, 1e3 / plant.dt**2, 0.1 / plant.dt**2, "per s^2")
                yield EffectCandidate(cls((end,), joint, upper, False, plant.dt), (position,), ((end,),))
                inside = end - 0.5 * size if upper else end + 0.5 * size
                soft = cls((end, 0.0), joint, upper, True, plant.dt)
                yield EffectCandidate(soft, (position, stiffness), ((inside, 0.3 / plant.dt**2),))

    def allowed(self, x: Array) -> Array:
        x, sign = np.array(x), 1.0 if self.upper else -1.0
        beyond = np.maximum(sign * (x[..., self.joint.position] - self.sizes[0]), 0.0)
        if self.soft:
            pushed = self.sizes[1] * self.dt**2
            back = beyond * pushed / (1 + pushed)
        else:
            back = beyond
        rate = sign * x[..., self.joint.rate]
        x[..., self.joint.position] -= sign * back
        x[..., self.joint.rate] = sign * np.maximum(rate - back / self.dt, np.minimum(rate, 0.0))
        return x

    def sentence(self, plant: Plant) -> str:
        name, unit = plant.joint_name(self.joint), plant.states[self.joint.position or 0][1]
        soft = f" softly ({self.sizes[1]:.3g} {unit}/s^2 for each {unit} beyond)" if self.soft else ""
        side = "" if self.upper else "from above "
        return f"{name} stops {side}at {self.sizes[0]:.3g} {unit}".rstrip() + soft

    def repair(self, plant: Plant) -> dict[str, str]:
        return {"urdf": f'<limit {"upper" if self.upper else "lower"}="{self.sizes[0]:.5g}"/>'}


def seen_stops(
    joints: Sequence[Joint],
    x: Sequence[Array],
    following: Sequence[Array],
    dt: float,
    settings: StopSettings = StopSettings(),
) -> Iterator[EffectCandidate]:
    """Yield the hard stops that runs ``(H + 1, n)`` show beside M's next states ``(H, n)`` along them.

    A joint rests at one end of its recorded positions while M, pushed by varying inputs, goes beyond.
    """
    for joint in joints:
        for upper, sign in ((True, 1.0), (False, -1.0)) if joint.position is not None else ():
            paths = [sign * run[:, joint.position] for run in x]
            end, low = max(path.max() for path in paths), min(path.min() for path in paths)
            for path, reached in zip(paths, following, strict=True):
                beyond = sign * reached[:, joint.position] - path[1:]
                resting = np.minimum(path[:-1], path[1:]) > end - settings.near * (end - low)
                if resting.sum() < settings.fewest or resting.all() or not np.isfinite(beyond).all():
                    continue
                usual = max(float(np.sqrt((beyond[~resting] ** 2).mean())), 1e-300)
                little, much = np.quantile(beyond[resting], (0.1, 0.9))
                if much > settings.pushed * usual and much - little > settings.varied * usual:
                    stop = sign * float(np.median(path[1:][resting]))
                    near = settings.near * (end - low)
                    position = Parameter("position", stop - near, stop + near, near)
                    yield EffectCandidate(JointStop((stop,), joint, upper, False, dt), (position,), ((stop,),))
                    break
