"""Which fields of a log are the states and inputs of a model, in which units, and with which delay."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

from ctxval._util.files import read_bytes
from ctxval._util.representation import record
from ctxval._util.texts import enumerated
from ctxval.data.log import LISTED, Clock, Log
from ctxval.data.units import conversion
from ctxval.errors import InputError, UnknownNameError

Stamp = Literal["log", "publish", "header"]

_STATES = ("states", "x", "observation.state")
_INPUTS = ("inputs", "u", "action")
"""Names of whole vectors that are looked for if there is no mapping."""


@dataclass(frozen=True)
class Field:
    """Where one state or input is in a log; the value is ``factor * recorded + offset``.

    Attributes:
        path: the name of a column, such as ``angle`` or ``observation.state[2]``, or a field of a message, such as
            ``/joint_states.position[0]``. A vector stands for all its components.
        unit: the unit in which the model takes the value.
        recorded: the unit in the log, if it is another one. Known units are converted.
        factor: the factor, if the units are not known; None for that of the units.
        offset: added to the value, in the unit of the model.
        angle: whether it is an angle in radians that the log may keep between -pi and pi: it is continued over turns.
        held: whether a value holds until the next one is logged, however long that takes, such as that of a command
            that is sent only if it changes.

    Raises:
        InputError: if the path is empty, or the units cannot be converted.
    """

    path: str
    unit: str = ""
    recorded: str = ""
    factor: float | None = None
    offset: float = 0.0
    angle: bool = False
    held: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.path, str) or not self.path.strip():
            raise InputError(f"the path of a field must be a text, got {self.path!r}.")
        for name in ("unit", "recorded"):
            if not isinstance(getattr(self, name), str):
                raise InputError(f"{name} of the field {self.path} must be a text, got {getattr(self, name)!r}.")
        for name in ("factor", "offset"):
            value = getattr(self, name)
            if value is not None and not _is_number(value):
                raise InputError(f"{name} of the field {self.path} must be a finite number, got {value!r}.")
        _ = self.scale

    @property
    def scale(self) -> float:
        """The factor of the recorded value."""
        if self.factor is not None:
            return float(self.factor)
        try:
            return conversion(self.recorded, self.unit) if self.recorded else 1.0
        except InputError as error:
            raise InputError(f"the field {self.path}: {error}") from error


@dataclass(frozen=True)
class LogMapping:
    """How recordings become states and inputs at equal steps.

    Attributes:
        states, inputs: the fields of the states and inputs by name, in the order of the model.
        time: the column of the times of a table; None to look for ``t``, ``time``, ``times`` or ``timestamp``.
        time_unit: the unit of this column: s, ms, us or ns.
        stamp: the time of a message: ``log``, when it was recorded; ``publish``, when it was sent; or ``header``, the
            ``header.stamp`` in it.
        dt: length of a step in seconds; None for the median period of the first state. A table without times has one
            row for each step.
        delay: seconds between the time at which an input is logged and the time from which it acts on the states.
        longest_gap: longest time in seconds between two samples of one field over which it is interpolated or held;
            None for 1.5 median periods of the field. A recording is split at longer gaps and at missing values.

    Raises:
        InputError: if there is no state, or a number is not allowed.
        UnknownNameError: if there is no such stamp.
    """

    states: Mapping[str, Field]
    inputs: Mapping[str, Field] = field(default_factory=dict)
    time: str | None = None
    time_unit: str = "s"
    stamp: Stamp = "log"
    dt: float | None = None
    delay: float = 0.0
    longest_gap: float | None = None

    def __post_init__(self) -> None:
        for name in ("states", "inputs"):
            object.__setattr__(self, name, {key: _field(key, one) for key, one in dict(getattr(self, name)).items()})
        if not self.states:
            raise InputError("a mapping of a log needs at least one state.")
        if both := [name for name in self.states if name in self.inputs]:
            raise InputError(f"{both[0]} is a state and an input: give them different names.")
        conversion(self.time_unit, "s")
        if self.stamp not in get_args(Stamp):
            raise UnknownNameError.among("stamp", str(self.stamp), get_args(Stamp))
        for name in ("dt", "longest_gap"):
            value = getattr(self, name)
            if value is not None and not (_is_number(value) and value > 0):
                raise InputError(f"{name} of a mapping must be a positive number of seconds, got {value!r}.")
        if not _is_number(self.delay):
            raise InputError(f"delay of a mapping must be a finite number of seconds, got {self.delay!r}.")

    @property
    def fields(self) -> dict[str, Field]:
        """All fields by name, the states first."""
        return {**self.states, **self.inputs}

    @property
    def clock(self) -> Clock:
        """Where the times come from."""
        return Clock(self.time, self.time_unit, None, self.stamp)

    @staticmethod
    def from_table(table: Mapping[str, Any]) -> LogMapping:
        """Return the mapping that a table of TOML describes, with the attributes of this class as its keys.

        A field is a path, or a table with the attributes of :class:`Field`. ``states`` and ``inputs`` may also be lists
        of paths.

        Raises:
            UnknownNameError: if there is no such key.
            InputError: if a value is not allowed.
        """
        known = [one.name for one in fields(LogMapping)]
        for key in table:
            if key not in known:
                raise UnknownNameError.among("entry of the mapping of recordings", key, known)
        parts = {key: _named(key, table[key]) for key in ("states", "inputs") if key in table}
        if "states" not in parts:
            raise InputError("the mapping of recordings needs states.")
        return LogMapping(**{**table, **parts})

    @staticmethod
    def from_toml(path: str | Path) -> LogMapping:
        """Return the mapping in a TOML file, or in the table ``[recordings]`` of an experiment file.

        Raises:
            InputError: if the file cannot be read, is not TOML, or a value is not allowed.
        """
        try:
            content = tomllib.loads(read_bytes(path).decode("utf-8"))
        except InputError as error:
            raise InputError(f"{path} cannot be read: {error}.") from error
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path} is not valid TOML: {error}.") from error
        try:
            return LogMapping.from_table(content.get("recordings", content))
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    @staticmethod
    def usual(log: Log) -> LogMapping:
        """Return the mapping of a log whose fields have usual names.

        The states are ``states``, ``x`` or ``observation.state``, or the columns ``x0``, ``x1``, ...; the inputs are
        ``inputs``, ``u`` or ``action``, or the columns ``u0``, ``u1``, ...

        Raises:
            InputError: if the log has none of them; the message lists its fields.
        """
        known = log.fields()
        states, inputs = _usual(known, _STATES, "x"), _usual(known, _INPUTS, "u")
        if not states:
            raise InputError(
                f"{log.source} has no states under a usual name ({', '.join(_STATES)}, x0): name the states and inputs "
                f"with --state and --input or in a mapping; the fields are {enumerated(known, LISTED)}."
            )
        return LogMapping(states, inputs, dt=log.period)

    def __repr__(self) -> str:
        return record(self)


def _usual(known: Sequence[str], vectors: Sequence[str], letter: str) -> dict[str, Field]:
    for name in vectors:
        if name in known:
            return {letter: Field(name)}
    found: dict[str, Field] = {}
    while f"{letter}{len(found)}" in known:
        found[f"{letter}{len(found)}"] = Field(f"{letter}{len(found)}")
    return found


def _field(name: str, given: Any) -> Field:
    if isinstance(given, Field):
        return given
    if isinstance(given, str):
        return Field(given)
    if isinstance(given, Mapping):
        known = [one.name for one in fields(Field)]
        table = {("path" if key == "field" else key): value for key, value in given.items()}
        for key in table:
            if key not in known:
                raise UnknownNameError.among(f"entry of the field {name}", key, known)
        return Field(**{"path": name, **table})
    raise InputError(f"the field {name} must be a path or a table, got {given!r}.")


def _named(kind: str, given: Any) -> dict[str, Any]:
    if isinstance(given, str):
        given = [given]
    if isinstance(given, list):
        given = {str(one.get("path") if isinstance(one, Mapping) else one): one for one in given}
    if not isinstance(given, Mapping):
        raise InputError(f"{kind} must be a table of fields or a list of paths, got {given!r}.")
    return {name: replace(_field(name, one)) for name, one in given.items()}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
