"""Which fields of logs are states and which are inputs, by their records first, then by units and names.

An input holds its values and jumps between them, has the unit of a command, or changes before other fields do. Words in
names are hints alone. A clock or a counter is neither.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.representation import ShortRepr
from ctxval.data import Signal
from ctxval.data.rates import Column, words_of

# Words in names: of commands, of actuators, of measurements, of states, and of fields that are neither.
_COMMANDS = (
    "cmd command commands commanded action actions ref reference target goal set setpoint sp desired ctrl pwm duty"
)
_ACTUATORS = (
    "u input inputs tau torque force voltage volt volts throttle steer steering brake effort control valve thrust "
    "enable heater heating cooling pump fan rudder elevator aileron"
)
_MEASURED = "measured actual feedback sensor estimate estimated"
_STATES = (
    "rate rates speed vel velocity velocities omega dq qd gyro twist pos position positions angle theta phi psi q x y "
    "z yaw pitch roll heading height altitude state states displacement deflection encoder level pressure"
)
_THERMAL = "temp temps temperature temperatures temperatur"
_SLOW = "level pressure flow concentration humidity"
_OTHERS = (
    "time stamp timestamp sec nsec secs nanosec index frame episode seq id count counter status battery done reward "
    "success run trial"
)
_COMMAND_UNITS = re.compile(r"[kmu]?(N|Nm|N ?m|V|A|W)|%|pwm|duty", re.IGNORECASE)
_STATE_UNITS = re.compile(
    r"[cmk]?m|m?rad|deg|°|rev|rpm|(°|deg ?)?[CKF]|m?bar|[kM]?Pa|m\^?3|[lL]|([ckm]?m|m?rad|deg|°|rev)/(s|h|min)(\^?2)?"
)


@dataclass(frozen=True, eq=False)
class Evidence(ShortRepr):
    """The records of one field, and what they show of it."""

    path: str
    unit: str
    signals: Sequence[Signal]

    @property
    def values(self) -> Array:
        """The values of all logs, shape ``(N, k)``."""
        return np.concatenate([signal.values for signal in self.signals])

    @property
    def counts(self) -> bool:
        """Whether it grows by one number from record to record, or with the time, as an index or a clock does."""
        for signal in self.signals:
            column, times = signal.values[:, 0], signal.times
            if (
                signal.values.shape[1] > 1
                or len(column) < 3
                or not np.isfinite(column).all()
                or column[-1] == column[0]
            ):
                return False
            along = [np.arange(len(column)), times] if np.ptp(times) > 0 else [np.arange(len(column))]
            if (np.diff(column) <= 0).any():
                return False
            away = [np.abs(column - column[0] - np.ptp(column) * (t - t[0]) / np.ptp(t)).max() for t in along]
            if min(away) > 1e-6 * np.ptp(column):
                return False
        return True

    @cached_property
    def repeated(self) -> float:
        """The share of the records that repeat the one before."""
        values = [signal.values[np.isfinite(signal.values).all(axis=1)] for signal in self.signals]
        same = np.concatenate([(np.diff(each, axis=0) == 0).all(axis=1) for each in values])
        return float(same.mean()) if len(same) else 1.0

    @property
    def held(self) -> bool:
        """Whether it keeps its value in most records, and jumps by large parts of its range in the others."""
        values = [signal.values[np.isfinite(signal.values).all(axis=1)] for signal in self.signals]
        changes = np.concatenate([np.diff(each, axis=0) for each in values])
        span = np.ptp(np.concatenate(values), axis=0)
        jumps = np.abs(changes[changes.any(axis=1)]) / np.maximum(span, 1e-300)
        if not len(jumps) or len(jumps) >= 0.5 * len(changes):
            return False
        sizes = jumps.max(axis=1)
        rounded = sizes.min() < 0.9 and float((sizes < 1.5 * sizes.min()).mean()) > 0.7  # steps of one digit
        return not rounded and float(np.median(sizes)) > 0.05

    @property
    def hint(self) -> float:
        """How much its unit and its name speak for an input, positive, or for a state, negative."""
        words, unit = set(words_of(self.path)), self.unit.strip()
        if not words.isdisjoint(_COMMANDS.split()):
            return 6.0
        hint = 0.0
        acts = not words.isdisjoint(_ACTUATORS.split())
        if unit:  # a rudder may be in degrees, but u in m/s is a speed
            of_state = -1.0 if acts and words != {"u"} else -3.0
            hint += 2.0 if _COMMAND_UNITS.fullmatch(unit) else of_state if _STATE_UNITS.fullmatch(unit) else 0.0
        states = {word for word in words & {*_STATES.split(), *_THERMAL.split()} if len(word) > 1}
        if acts:
            hint += 2.5 if words.isdisjoint(states) else 2.0
        elif states or Column(self.path).order == 1:
            hint -= 1.5
        elif len("".join(words - {*"0123456789"})) == 1:
            hint -= 0.5
        return hint - 3.0 * (not words.isdisjoint(_MEASURED.split()) and hint <= 0)

    @property
    def other(self) -> bool:
        """Whether its name says that it is neither a state nor an input."""
        words = set(words_of(self.path))
        return not words.isdisjoint(_OTHERS.split()) and words.isdisjoint(_COMMANDS.split())

    @property
    def thermal(self) -> bool:
        """Whether it is a temperature, which in a log of motion is no state of it."""
        words = [word for word in words_of(self.path) if not word.isdigit()]
        return words == ["t"] or not set(words).isdisjoint(_THERMAL.split()) or self.unit in ("degC", "°C", "K", "C")

    @property
    def process(self) -> bool:
        """Whether it is a quantity of a process, whose rate is no state of its own."""
        return self.thermal or not {"level", "pressure", "flow", "concentration", "humidity"}.isdisjoint(
            words_of(self.path)
        )


def roles(fields: Sequence[Evidence]) -> tuple[list[str], list[str]]:
    """Return the paths of the states and of the inputs among fields that change, in the order of the fields."""
    usable = [field for field in fields if not field.other and not field.counts]
    scores = {
        field.path: field.hint + (-0.5 if not field.held else 3.5 if field.repeated > 0.9 else 2.0) for field in usable
    }
    for path in leading(usable):
        if abs(scores[path]) < 1:  # of a field whose unit and name tell something, they count more
            scores[path] += 1.5
    inputs = [path for path, score in scores.items() if score > 0]
    left = [field for field in usable if field.path not in inputs]
    moving = [field for field in left if field.hint <= -1 and not field.process]
    if moving:
        left = [field for field in left if not field.thermal]
    shared = {Column(field.path).stem for field in moving} - {()}
    hinted = [field for field in left if field.hint <= -1 or Column(field.path).stem in shared]
    letters = [field for field in left if field.hint < 0] if hinted else left  # letters, such as p, q and r of a drone
    return [field.path for field in left if field in hinted or field in letters], inputs


def leading(fields: Sequence[Evidence]) -> list[str]:
    """Return the fields that help to predict others, and that no other field helps to predict, as inputs do.

    The prediction is affine in the last two records of each field, and the fields have the same times.
    """
    single = [field for field in fields if field.signals[0].values.shape[1] == 1]
    counts = [len(signal.values) for signal in single[0].signals] if single else []
    if not 2 <= len(single) <= 16 or any(
        [len(signal.values) for signal in field.signals] != counts for field in single
    ):
        return []
    past, following = list[Array](), list[Array]()
    for number in range(len(counts)):
        columns = np.hstack([field.signals[number].values for field in single])
        past.append(np.stack([columns[1:-1], columns[:-2]], axis=-1))
        following.append(columns[2:])
    Z, Y = np.concatenate(past), np.concatenate(following)
    good = np.isfinite(Z).all(axis=(1, 2)) & np.isfinite(Y).all(axis=1)
    every = max(1, int(good.sum()) // 5000)
    Z, Y = Z[good][::every], Y[good][::every]
    n = len(single)
    if len(Y) < 10 * n + 20:
        return []
    Z = (Z - Z.mean(axis=0)) / np.maximum(Z.std(axis=0), 1e-12)
    Y = (Y - Y.mean(axis=0)) / np.maximum(Y.std(axis=0), 1e-12)

    def unexplained(of: int, by: Sequence[int]) -> float:
        X = Z[:, list(by)].reshape(len(Z), -1)
        weights = np.linalg.lstsq(X[::2], Y[::2, of], rcond=1e-10)[0]
        return float(((Y[1::2, of] - X[1::2] @ weights) ** 2).mean()) + 1e-12

    everything = range(n)
    leaders = list[str]()
    for i in everything:
        rest = [k for k in everything if k != i]
        helps = max(1 - unexplained(k, everything) / unexplained(k, rest) for k in rest)
        if helps > 0.3 and unexplained(i, [i]) > 0.5 and 1 - unexplained(i, everything) / unexplained(i, [i]) < 0.1:
            leaders.append(single[i].path)
    return leaders
