"""Causes in actuators and sensors: what acts is not what is commanded, and what is recorded is not the state."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, ClassVar

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import counted
from ctxval._util.turns import turns
from ctxval.core.controller import Controller, memory_of, stepped
from ctxval.core.model import Function, Model
from ctxval.core.task import Task
from ctxval.studies.causes.cause import Cause, CauseCandidate, Plant, of_ratio, of_size
from ctxval.studies.causes.flow import PARTS
from ctxval.systems.actuator import Actuator


def _at(values: Array, index: int | list[int] | None, size: float, elsewhere: float = 0.0) -> Array:
    """Return an array of the last axis of values with a size at some places, or everywhere if the index is None."""
    sizes = np.full(values.shape[-1], elsewhere)
    sizes[slice(None) if index is None else index] = size
    return sizes


def _duration(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"


def _exchanged(values: Array, first: Sequence[int], second: Sequence[int]) -> Array:
    order = np.arange(values.shape[-1])
    order[[*first, *second]] = [*second, *first]
    return values[..., order]


@dataclass(frozen=True)
class InputGain(Cause):
    """An input has more or less effect: a weak motor, or a wrong constant. Size: the share of its effect in M."""

    name: ClassVar[str] = "input gain"
    input: int | None = 0  #: index of the input; None for all of them together

    def follow(self, u: Array, memory: Any) -> tuple[Array, Any]:
        return u * _at(u, self.input, self.sizes[0], 1.0), None

    def text(self, plant: Plant) -> str:
        which = "all inputs have" if self.input is None else f"{plant.inputs[self.input][0]} has"
        return f"{which} {self.sizes[0]:.3g} times the effect that M has"

    def mjcf(self, plant: Plant) -> str | None:
        if plant.compiled is None or self.input is None:
            return None
        gear = self.sizes[0] * float(plant.compiled.actuator_gear[self.input, 0])
        return f'<motor name="{plant.compiled.actuator(self.input).name}" gear="{gear:.5g}"/>'


@dataclass(frozen=True)
class OfInput(Cause):
    """A cause in one input. A subclass has the formula of what acts, and the sentence."""

    input: int = 0
    sentence: ClassVar[str]  #: with the ``name`` and ``unit`` of the input and the ``size``; ``play`` is twice the size

    def acts(self, u: Array, before: Array) -> Array:
        """Return what acts ``(...)`` for what is commanded of the input, and what acted before, 0 at first."""
        raise NotImplementedError

    def follow(self, u: Array, memory: Any) -> tuple[Array, Any]:
        acting = np.array(u, dtype=np.float64)
        before = np.zeros_like(acting) if memory is None else memory
        acting[..., self.input] = self.acts(acting[..., self.input], before[..., self.input])
        return acting, acting if self.remembers else None

    def text(self, plant: Plant) -> str:
        (name, unit), (size,) = plant.inputs[self.input], self.sizes or (0.0,)
        return self.sentence.format(name=name, unit=unit, size=size, play=2 * size).rstrip()


@dataclass(frozen=True)
class InputOffset(OfInput):
    """An input has an offset. Size: the offset, in units of the input."""

    name: ClassVar[str] = "input offset"
    sentence: ClassVar[str] = "{name} has an offset of {size:.3g} {unit}"

    def acts(self, u: Array, before: Array) -> Array:
        return u + self.sizes[0]


@dataclass(frozen=True)
class Saturation(OfInput):
    """An input is limited. Size: the limit of its magnitude."""

    name: ClassVar[str] = "saturation"
    sentence: ClassVar[str] = "{name} saturates at {size:.3g} {unit}"

    def acts(self, u: Array, before: Array) -> Array:
        return np.clip(u, -self.sizes[0], self.sizes[0])

    def mjcf(self, plant: Plant) -> str | None:
        if plant.compiled is None:
            return None
        limit = f'ctrllimited="true" ctrlrange="{-self.sizes[0]:.5g} {self.sizes[0]:.5g}"'
        return f'<motor name="{plant.compiled.actuator(self.input).name}" {limit}/>'


@dataclass(frozen=True)
class DeadZone(OfInput):
    """An input has no effect near 0. Size: the magnitude below which it has none, and which is lost above."""

    name: ClassVar[str] = "dead zone"
    sentence: ClassVar[str] = "{name} has a dead zone of {size:.3g} {unit}"

    def acts(self, u: Array, before: Array) -> Array:
        return u - np.clip(u, -self.sizes[0], self.sizes[0])


@dataclass(frozen=True)
class Backlash(OfInput):
    """An input follows with play. Size: half of the play, in units of the input."""

    name: ClassVar[str] = "backlash"
    sentence: ClassVar[str] = "{name} has backlash of {play:.3g} {unit}"
    remembers: ClassVar[bool] = True

    def acts(self, u: Array, before: Array) -> Array:
        return np.clip(before, u - self.sizes[0], u + self.sizes[0])


@dataclass(frozen=True)
class ReversedInput(OfInput):
    """An input acts with the opposite sign."""

    sizes: tuple[float, ...] = ()
    name: ClassVar[str] = "reversed input"
    sentence: ClassVar[str] = "{name} acts with the opposite sign"

    def acts(self, u: Array, before: Array) -> Array:
        return -u


@dataclass(frozen=True)
class Late(Cause):
    """All inputs act late. Before the first input, 0 acts."""

    remembers: ClassVar[bool] = True
    held: bool = True  #: whether the mean over a step acts in it, as in :class:`ctxval.systems.Imperfect`

    @property
    def actuator(self) -> Actuator:
        """What the inputs pass."""
        raise NotImplementedError

    @property
    def kind(self) -> Cause:
        return replace(self, sizes=(), held=True)

    def follow(self, u: Array, memory: Any) -> tuple[Array, Any]:
        return self.actuator.follow(u, memory, 1 if self.held else PARTS)


@dataclass(frozen=True)
class Delay(Late):
    """All inputs act late. Size: the delay in steps, which need not be an integer."""

    name: ClassVar[str] = "delay"

    @property
    def actuator(self) -> Actuator:
        return Actuator(delay=max(self.sizes[0], 0.0))

    def text(self, plant: Plant) -> str:
        steps = f"{self.sizes[0]:.3g} steps" + ("" if self.held else ", not held over a step")
        return f"commands arrive {_duration(plant.dt * self.sizes[0])} late ({steps})"


@dataclass(frozen=True)
class Lag(Late):
    """All inputs are followed by a first-order lag. Size: the time constant in steps."""

    name: ClassVar[str] = "lag"

    @property
    def actuator(self) -> Actuator:
        return Actuator(lag=max(self.sizes[0], 1e-3))

    def text(self, plant: Plant) -> str:
        held = "" if self.held else " while a step goes on"
        return f"the actuators follow{held} with a time constant of {_duration(plant.dt * self.sizes[0])}"


@dataclass(frozen=True)
class ObservationDelay(Cause):
    """The controller acts on old records. Their age is counted, and not fitted."""

    sizes: tuple[float, ...] = ()
    name: ClassVar[str] = "observation delay"
    remembers: ClassVar[bool] = True
    steps: int = 1  #: the age

    def seeing(self, controller: Controller) -> Controller:
        return SeeingLate(controller, self.steps)

    def text(self, plant: Plant) -> str:
        age = _duration(plant.dt * self.steps)
        return f"the observations that the controller acts on are {counted(self.steps, 'step')} old ({age})"


@dataclass(frozen=True)
class SeeingLate:
    """A controller that sees states some steps late, and the first one before it sees another one."""

    controller: Controller
    steps: int

    def start(self, task: Task) -> Any:
        """Return the memory before the first step."""
        return memory_of(self.controller, task), ()

    def step(self, t: int, x: Array, memory: Any) -> tuple[Array, Any]:
        """Return the inputs and the memory after the step."""
        of_controller, before = memory
        known = (*before, np.array(x))[-self.steps - 1 :]
        u, of_controller = stepped(self.controller, t, known[0], of_controller)
        return u, (of_controller, known)


@dataclass(frozen=True)
class SwappedInputs(Cause):
    """Two inputs are exchanged."""

    sizes: tuple[float, ...] = ()
    name: ClassVar[str] = "swapped inputs"
    first: int = 0
    second: int = 1

    def follow(self, u: Array, memory: Any) -> tuple[Array, Any]:
        return _exchanged(u, [self.first], [self.second]), None

    def text(self, plant: Plant) -> str:
        return f"the inputs {plant.inputs[self.first][0]} and {plant.inputs[self.second][0]} are exchanged"


@dataclass(frozen=True)
class SensorOffset(Cause):
    """A state is recorded with an offset. Size: what is recorded minus the state."""

    name: ClassVar[str] = "sensor offset"
    state: int = 0

    def true(self, recorded: Array) -> Array:
        return recorded - _at(recorded, self.state, self.sizes[0])

    def recorded(self, x: Array) -> Array:
        return x + _at(x, self.state, self.sizes[0])

    def text(self, plant: Plant) -> str:
        name, unit = plant.states[self.state]
        size = f"{abs(self.sizes[0]):.3g} {unit}".rstrip()
        return f"the sensor of {name} reads {size} too {'much' if self.sizes[0] > 0 else 'little'}"


@dataclass(frozen=True)
class SensorScale(Cause):
    """A position and its rate are recorded with a wrong scale. Size: what is recorded, divided by the state."""

    name: ClassVar[str] = "sensor scale"
    states: tuple[int, ...] = (0,)  #: indices of the states that are scaled

    def true(self, recorded: Array) -> Array:
        return recorded / _at(recorded, list(self.states), self.sizes[0], 1.0)

    def recorded(self, x: Array) -> Array:
        return x * _at(x, list(self.states), self.sizes[0], 1.0)

    def text(self, plant: Plant) -> str:
        return f"the sensor of {plant.states[self.states[0]][0]} reads {self.sizes[0]:.3g} times the value"


@dataclass(frozen=True)
class WrappedAngle(Cause):
    """The system keeps an angle within a turn, and M does not; or M does, and the system does not."""

    sizes: tuple[float, ...] = ()
    name: ClassVar[str] = "wrapped angle"
    state: int = 0
    turn: float = 2 * np.pi
    low: float = -np.pi  #: the least value of the angle
    of_model: bool = False  #: whether it is M that keeps the angle within the turn

    def model(self, model: Model) -> Model:
        if not self.of_model:
            return model
        return Function(lambda x, u: x + self.gap(np.asarray(model.step(x, u)) - x), vectorized=True)

    def recorded(self, x: Array) -> Array:
        if self.of_model:
            return x
        inside = np.array(x)
        inside[..., self.state] = self.low + (x[..., self.state] - self.low) % self.turn
        return inside

    def gap(self, difference: Array) -> Array:
        return difference - _at(difference, self.state, self.turn) * np.round(difference / self.turn)

    def text(self, plant: Plant) -> str:
        name, pi = plant.states[self.state][0], self.turn < 7
        whole, half = ("2 pi", "pi") if pi else ("360", "180")
        ends = f"0 to {whole}" if self.low == 0 else f"-{half} to {half}"
        keeps = "M, unlike the system, keeps" if self.of_model else "the system, unlike M, keeps"
        return f"{keeps} {name} within {ends}, with jumps of {whole}"


@dataclass(frozen=True)
class SwappedJoints(Cause):
    """The recorded states of two joints are exchanged."""

    sizes: tuple[float, ...] = ()
    name: ClassVar[str] = "swapped joints"
    first: tuple[int, ...] = (0,)  #: indices of their states, in the same order
    second: tuple[int, ...] = (1,)

    def true(self, recorded: Array) -> Array:
        return _exchanged(recorded, self.first, self.second)

    def recorded(self, x: Array) -> Array:
        return self.true(x)

    def text(self, plant: Plant) -> str:
        return f"the sensors of {plant.states[self.first[0]][0]} and {plant.states[self.second[0]][0]} are exchanged"


def of_inputs(plant: Plant) -> Iterator[CauseCandidate]:
    """Yield what may be wrong with inputs."""
    m = len(plant.inputs)
    for k, most in enumerate(plant.commanded.tolist()):
        yield of_ratio(InputGain((1.0,), k))
        yield of_size(InputOffset((0.0,), k), -2 * most, 2 * most, 0.05 * most, 0.0)
        limits = (share * most for share in (0.9, 0.7, 0.5, 0.3, 0.1, 0.03, 0.01))
        yield of_size(Saturation((most,), k), 1e-3 * most, most, 0.05 * most, *limits)
        for kind in (DeadZone, Backlash):
            yield of_size(kind((0.0,), k), 0.0, most, 0.02 * most, *(share * most for share in (0.01, 0.05, 0.15)))
        yield CauseCandidate(ReversedInput((), k))
    if m > 1:
        yield of_ratio(InputGain((1.0,), None))
    for first, second in combinations(range(m), 2):
        yield CauseCandidate(SwappedInputs((), first, second))
    for held in (True, False) if plant.compiled is None else (True,):  # parts of steps of MuJoCo cost more
        yield of_size(Delay((1.0,), held), 0.0, 8.0, 0.2, 0.5, 1.5, 2.5, 4.0)
        yield of_size(Lag((1.0,), held), 0.05, 10.0, 0.2, 0.5, 1.5, 4.0)


def of_sensors(plant: Plant, x: Array) -> Iterator[CauseCandidate]:
    """Yield what may be wrong with sensors of recorded states ``(N, n)``."""
    ranges = np.ptp(x, axis=0)
    groups = [(joint.rate,) if joint.position is None else (joint.position, joint.rate) for joint in plant.joints]
    for group in groups:
        size = max(float(ranges[group[0]]), 1e-9)
        yield of_size(SensorOffset((0.0,), group[0]), -size, size, 0.05 * size, 0.0)
        yield of_ratio(SensorScale((1.0,), group))
    moving = [group for group in groups if ranges[group[0]] > 0]
    pairs = [group for group in moving if len(group) == len(moving[0])]
    for first, second in combinations(pairs, 2):
        yield CauseCandidate(SwappedJoints((), first, second))


def wrapped_angles(x: Sequence[Array], following: Sequence[Array]) -> Iterator[CauseCandidate]:
    """Yield the states that jump by a turn in runs ``(H + 1, n)`` or in M's next states ``(H, n)`` along them alone."""
    gaps = [each - run[1:] for each, run in zip(following, x, strict=True)]
    for state in range(x[0].shape[1]):
        columns, apart = [run[:, state] for run in x], np.abs(np.concatenate(gaps)[:, state])
        turn, _ = turns(columns)
        of_model, columns = not turn, columns if turn else [each[:, state] for each in following]
        turn = turn or turns(columns)[0]
        far = apart[apart > 0.5 * turn]
        if turn and len(far) and (np.abs(far - turn * np.round(far / turn)) < 0.25 * turn).all():
            low = -0.5 * turn if min(column.min() for column in columns) < -0.02 * turn else 0.0
            yield CauseCandidate(WrappedAngle((), state, turn, low, of_model))
