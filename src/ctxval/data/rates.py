"""Times and units, as the records themselves show them: a state changes by the integral of its rate.

The change of a state over a window and the integral of another field over it are proportional if the field is the rate
of the state. Their ratio is 1 if times, units and signs are right. Windows are so long that noise, quantisation and
records that are written twice average out. Pairs of fields with a low correlation are no pairs, and are not judged.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.columns import conversion, named_unit
from ctxval._util.representation import ShortRepr
from ctxval._util.texts import enumerated
from ctxval.core.trajectory import Trajectory
from ctxval.errors import InputError

_TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "days": 86400.0}
_COUNTS = (400, 500, 1000, 2000, 2048, 4000, 8000, 10_000, *(2**k for k in range(8, 25)))


# Words in names of fields.
_RATES = "rate rates speed speeds vel velocity velocities omega dq qd gyro twist dot rpm drehzahl geschwindigkeit"
_POSITIONS = "pos position positions angle angles theta phi psi q x y z yaw pitch roll heading encoder winkel"
_FORCES = "torque motor joint force throttle rudder steer steering wheel"
_PROCESS = "temp temperature temperatures level pressure flow heater valve tank concentration humidity ph"
_GENERAL = f"{_RATES} pos position positions angle angles encoder angular linear state v w"
_RATE = re.compile(
    r"[dvw]([xyzqrsh]|th|theta|phi|psi|alpha|beta|yaw|pitch|roll|pos|angle)|([vw])|(.*)(?:dot|vel|rate|speed)"
)
_ACCELERATION = re.compile(r"dd(.+)|(.*)ddot|a([xyz])|acc|(.*)accel|(.*)acceleration")


@dataclass(frozen=True)
class ScaleSettings:
    """When a recorded rate contradicts its state, and which times between two records occur, in seconds."""

    named: float = 0.95  # correlation from which a pair is judged whose names or units say that it is one
    unnamed: float = 0.99  # the same, of a pair that the records alone show
    windows: int = 16  # least number of windows without overlap
    compared: int = 4000  # largest number of windows that are compared for each length
    machines: tuple[float, float] = (1e-4, 1.5)  # that move
    machines_stated: tuple[float, float] = (1e-4, 10.0)  # the same, with a unit in the header
    processes: tuple[float, float] = (1e-2, 9e4)  # such as tanks and ovens
    others: tuple[float, float] = (1e-6, 3600.0)  # systems whose names tell nothing


@dataclass(frozen=True)
class Column(ShortRepr):
    """One state or input of recordings, as far as its scale is concerned."""

    name: str
    unit: str = ""  #: the unit of its values; empty if neither the log nor the user states one
    of_input: bool = False
    scaled: bool = False  #: whether the user states its factor, so that its scale is no mistake

    @property
    def order(self) -> int | None:
        """Which derivative of a position it is, by its unit or else by its name; None if they do not tell."""
        for base, order in product(("m", "rad"), range(3)):
            if self.unit and _factor(self.unit, base + ("", "/s", "/s^2")[order]) is not None:
                return order
        words = words_of(self.name)
        if not set(words).isdisjoint(_PROCESS.split()):
            return None  # the rate of a level is no flow, but in proportion to it
        if any(_ACCELERATION.fullmatch(word) for word in words):
            return 2
        if any(word in _RATES.split() or _RATE.fullmatch(word) for word in words):
            return 1
        numbered = re.fullmatch(r"[a-z]_?\d+", self.name.casefold())
        return 0 if numbered is None and not set(_POSITIONS.split()).isdisjoint(words) else None

    @property
    def stem(self) -> tuple[str, ...]:
        """The words of its name that a state and its rates share."""
        words = (_RATE.fullmatch(word) or _ACCELERATION.fullmatch(word) or word for word in words_of(self.name))
        bare = (word if isinstance(word, str) else "".join(filter(None, word.groups())) for word in words)
        return tuple(word for word in bare if word and word not in _GENERAL.split())


@dataclass(frozen=True)
class Clocked:
    """The times of a log: their column, empty if it has none, the unit in which they are taken, and who states it."""

    column: str = ""
    unit: str = "s"
    in_header: bool = False  #: whether the name of the column states the unit
    confirmed: bool = False  #: whether the user or the format states the unit, or the user states the time step

    @staticmethod
    def of(column: str, unit: str, *, stated: bool) -> Clocked:
        """Return the clock of a column whose unit its name or the user states; ``stated`` if a step is stated."""
        in_header, factor = bool(named_unit(column)[1]), _factor(unit or "s", "s")
        name = next((name for name, seconds in _TIMES.items() if factor == seconds), "s")
        return Clocked(column, name, in_header, stated or (bool(unit) and not in_header))

    def advice(self, *units: str) -> str:
        """Return how to state that the times are in one of these units."""
        if not units or units[0] == "days":
            return "convert the times to s"
        name = named_unit(self.column)[0]
        if self.in_header:
            return f"name the column {name} [{units[0]}] if they are"
        stated = f"name the column {name} [{units[0]}], or give --time '{name} [{units[0]}]' or time_unit in a mapping"
        return f"if they are in {' or '.join(units)}, {stated}"


@dataclass(frozen=True)
class RatePair(ShortRepr):
    """A state, and a field that changes as its rate does."""

    state: Column
    rate: Column
    ratio: float  #: the change of the state, divided by the integral of the rate
    correlation: float  #: the correlation of the two over the windows, and the length of a window in seconds
    window: float
    named: bool  #: whether names or units say that they are a state and its rate, too

    @property
    def relative(self) -> float:
        """The ratio, divided by that which the units state."""
        return self.ratio / (self.expected or 1.0)

    @property
    def expected(self) -> float | None:
        """The ratio that their units state, 1 if one of them states none; None if there is no factor between them."""
        if not self.state.unit or not self.rate.unit:
            return 1.0
        return _factor(self.rate.unit, f"{self.state.unit}/s")

    def __str__(self) -> str:
        over = f"over windows of {self.window:.3g} s with correlation {abs(self.correlation):.3f}"
        if abs(self.ratio) <= 1:
            return f"{self.rate.name} is {1 / self.ratio:.4g} times d({self.state.name})/dt ({over})"
        return f"d({self.state.name})/dt is {self.ratio:.4g} times {self.rate.name} ({over})"


def words_of(path: str) -> list[str]:
    """Return the words in the name of a field, without its unit."""
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", named_unit(path)[0])
    return re.findall("[a-z]+|[0-9]+", name.casefold())


def rate_pairs(
    runs: Sequence[Trajectory], columns: Sequence[Column], dt: float, settings: ScaleSettings = ScaleSettings()
) -> list[RatePair]:
    """Return the states whose rates are recorded, the states first among the columns."""
    count, steps = sum(not column.of_input for column in columns), sum(run.horizon for run in runs)
    correlation, ratio, window = np.zeros((3, count, len(columns)))
    parts = [_integrated(run) for run in runs]
    longest = max((run.horizon for run in runs), default=0)
    for length in (2**k for k in range(20) if 2**k <= longest // 2 and settings.windows * 2**k <= steps):
        changes, integrals = _windows(parts, length, max(1, steps // settings.compared))
        sizes = changes.std(axis=0)[:, None], dt * integrals.std(axis=0)
        with np.errstate(all="ignore"):
            together = dt * (changes - changes.mean(axis=0)).T @ (integrals - integrals.mean(axis=0)) / len(changes)
            alike = np.nan_to_num(together / (sizes[0] * sizes[1]), posinf=0, neginf=0).clip(-1, 1)
            slope = np.nan_to_num(np.sign(alike) * sizes[0] / sizes[1], posinf=0, neginf=0)
        better = np.abs(alike) > np.abs(correlation) + 1e-3  # of windows that are alike, the shortest
        correlation, ratio = np.where(better, alike, correlation), np.where(better, slope, ratio)
        window[better] = length * dt
    named = _named_pairs(columns)
    used, pairs = {row for pair in named for row in pair}, list[RatePair]()
    for i, j in sorted(product(range(count), range(len(columns))), key=lambda pair: -abs(correlation[pair])):
        # A pair of unknown names must be positive, because in an oscillation each state is like the rate of the other.
        orders = columns[i].order, columns[j].order
        unnamed = i != j and not {i, j} & used and None in orders and not columns[j].of_input and ratio[i, j] > 0
        least = settings.named if (i, j) in named else settings.unnamed
        if abs(correlation[i, j]) >= least and ((i, j) in named or unnamed):
            measured = float(ratio[i, j]), float(correlation[i, j]), float(window[i, j])
            pairs.append(RatePair(columns[i], columns[j], *measured, (i, j) in named))
            used |= {i, j} if unnamed else set()
    return pairs


def _named_pairs(columns: Sequence[Column]) -> set[tuple[int, int]]:
    """Return the pairs of a state and its rate by their names, or because there are no others."""
    orders, stems = [column.order for column in columns], [column.stem for column in columns]
    named = set[tuple[int, int]]()
    for j, order in enumerate(orders):
        if order:
            below = [
                i for i, each in enumerate(orders) if not columns[i].of_input and (each or 0) == order - 1 and i != j
            ]
            alike = [i for i in below if stems[i] == stems[j]]
            exact = [i for i in below if orders[i] == order - 1] or below
            if len(alike) == 1 or (len(exact) == 1 and orders.count(order) == 1):
                named.add((alike[0] if len(alike) == 1 else exact[0], j))
    return named


def _integrated(run: Trajectory) -> tuple[Array, Array]:
    """Return the states of a run, and the sums of all states and inputs from its first step on."""
    x = _steady(run.states)
    rates = np.hstack([0.5 * (x[1:] + x[:-1]), run.inputs])
    return x, np.vstack([np.zeros(rates.shape[1]), np.cumsum(rates, axis=0)])


def _windows(parts: Sequence[tuple[Array, Array]], length: int, every: int) -> tuple[Array, Array]:
    """Return the changes of all states and the integrals of all states and inputs over windows of so many steps."""
    changes, integrals = list[Array](), list[Array]()
    for x, sums in parts:
        first = np.arange(0, len(x) - length, every)
        changes.append(x[first + length] - x[first])
        integrals.append(sums[first + length] - sums[first])
    return np.concatenate(changes), np.concatenate(integrals)


def _steady(x: Array) -> Array:
    """Return states without single outliers and without the jumps of an angle that is kept within a turn."""
    if len(x) < 3:
        return x
    steps, spans = np.diff(x, axis=0), np.ptp(x, axis=0)
    jumps = np.abs(steps) > 0.4 * spans
    jumps &= np.where(jumps, 0.0, np.abs(steps)).max(axis=0) < 0.2 * spans
    if jumps.any():  # the step before a jump goes on
        rows = np.maximum.accumulate(np.where(jumps, 0, np.arange(len(steps))[:, None]), axis=0)
        steps = np.take_along_axis(np.where(jumps, 0.0, steps), rows, axis=0)
        x = np.vstack([x[:1], x[0] + np.cumsum(steps, axis=0)])
    low, high = np.minimum(x[:-2], x[1:-1]), np.maximum(x[:-2], x[1:-1])
    return np.vstack([x[:1], np.maximum(low, np.minimum(high, x[2:])), x[-1:]])  # the median of three


def require_scale(
    source: str, runs: Sequence[Trajectory], columns: Sequence[Column], dt: float, clock: Clocked
) -> list[str]:
    """Refuse records whose times, units or signs contradict each other; return sentences on ratios that are unusual.

    Raises:
        InputError: with the measured ratio or the time step, the unit that would explain it, and how to state it.
    """
    pairs = [pair for pair in rate_pairs(runs, columns, dt) if pair.expected is not None]
    low, high = _usual_steps(columns, pairs, clock)
    usual = low <= dt <= high
    agreeing = any(pair.named and _near(pair.relative, 1.0, 0.1) for pair in pairs)
    if clock.column and not agreeing:
        for pair in pairs:
            for unit, factor in _TIMES.items():
                step = dt * factor / _TIMES[clock.unit]
                explains = unit != clock.unit and _near(pair.relative * dt, step, 0.08 if pair.named else 0.02)
                explains &= not _near(pair.relative, 180 / math.pi, 0.023)  # nearer to this than to 60
                if explains and (pair.named or not usual) and (low <= step <= high or step > dt):
                    times = f"as if {clock.column} were in {unit}: a step would take {step:.4g} s instead of {dt:.4g} s"
                    raise InputError(f"{source}: {pair}, {times}; {clock.advice(unit)}.")
        if not usual and not clock.confirmed:
            units = [unit for unit, factor in _TIMES.items() if low <= dt * factor / _TIMES[clock.unit] <= high]
            few = enumerated((column.name for column in columns), 4)
            taken = f"with {clock.column} in {clock.unit}, a step takes {dt:.4g} s"
            raise InputError(
                f"{source}: {taken}, and {low:g} s to {high:g} s are usual for {few}; "
                f"{clock.advice(*units)}. If the step is right, confirm it with dt = {dt:.6g}."
            )
    notes = list[str]()
    for pair in pairs:
        if pair.ratio > 0 and _near(pair.relative, 1.0, math.log(2)):
            continue
        if not pair.named and not _near(abs(math.log(pair.relative)), math.log(180 / math.pi), 0.003):
            continue
        why, far = _explanation(pair), pair.ratio < 0 or not _near(pair.relative, 1.0, math.log(15))
        sentence = f"{pair}{why and f', as if {why}'}"
        # A ratio that no two units explain is an error if no other pair of the log agrees.
        if far and (why or not agreeing) and pair.named and not pair.state.scaled and not pair.rate.scaled:
            how = (
                f"state the units of both in the header, as {pair.state.name} [UNIT], or in a mapping, or their factors"
            )
            if _near(abs(pair.relative), 1.0, 0.1):
                how = "turn one of them with factor = -1 in a mapping"
            raise InputError(f"{source}: {sentence}; {how} (factor = 1 keeps the values).")
        notes.append(sentence)
    return notes


def _usual_steps(
    columns: Sequence[Column], pairs: Sequence[RatePair], clock: Clocked, settings: ScaleSettings = ScaleSettings()
) -> tuple[float, float]:
    """Return the shortest and the longest usual time between two records of such fields, seconds."""
    words = {word for column in columns for word in words_of(column.name)}
    process = not words.isdisjoint(_PROCESS.split())
    if (
        any(column.order is not None for column in columns)
        or not words.isdisjoint(_FORCES.split())
        or (pairs and not process)
    ):
        return settings.machines_stated if clock.in_header else settings.machines
    return settings.processes if process else settings.others


def _explanation(pair: RatePair) -> str:
    """Return the units, the counts or the sign that explain the ratio of a pair; empty if none does."""
    size, sign = abs(pair.relative), " and one has a wrong sign" if pair.ratio < 0 else ""
    if _near(size, 1.0, 0.1):
        return "one of them had a wrong sign"
    units = [
        *product(("rad", "deg", "rev"), ("rad/s", "deg/s", "rev/s", "rpm")),
        *product(("m", "mm", "cm"), ("m/s", "mm/s", "km/h")),
    ]
    factors = {(state, rate): _factor(rate, f"{state}/s") or 1.0 for state, rate in units}
    (state, rate), factor = min(factors.items(), key=lambda item: abs(math.log(size / item[1])))
    if _near(size, factor, max(0.02, 1.5 * (1 - abs(pair.correlation)))):
        return f"{pair.state.name} were in {state} and {pair.rate.name} in {rate}{sign}"
    for count, (unit, turn) in product(_COUNTS, {"rev": 1.0, "rad": 2 * math.pi, "deg": 360.0}.items()):
        for counted, other, ratio in ((pair.state, pair.rate, count / turn), (pair.rate, pair.state, turn / count)):
            if _near(size, ratio, 0.01):
                rest = unit if counted is pair.rate else f"{unit}/s"
                return f"{counted.name} had {count} counts per turn and {other.name} were in {rest}{sign}"
    return ""


def _near(value: float, factor: float, share: float) -> bool:
    return value > 0 and abs(math.log(value / factor)) <= share


def _factor(recorded: str, wanted: str) -> float | None:
    """Return the factor from one unit to another; None if there is none."""
    try:
        return conversion(recorded, wanted)
    except InputError:
        return None
