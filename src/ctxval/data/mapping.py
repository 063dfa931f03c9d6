"""Which fields of a log are the states and inputs of a model, in which units, and with which delay."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

from ctxval._util.arrays import Array
from ctxval._util.checked import FiniteFloat, NonNegativeInt, Seconds, checked, require, require_known
from ctxval._util.columns import column_of, conversion, named_unit
from ctxval._util.files import read_toml
from ctxval._util.refusals import reworded
from ctxval._util.representation import ShortRepr
from ctxval._util.texts import enumerated
from ctxval.data.log import LISTED, Clock, Log
from ctxval.errors import InputError

Stamp = Literal["auto", "log", "publish", "header"]

_VALID = re.compile(r"\s*(\S.*?)\s*(==|!=)\s*([+-]?\d+(?:\.\d*)?)\s*")


@checked
@dataclass(frozen=True)
class Field:
    """Where one state or input is in a log; the value is ``factor * recorded + offset``.

    Raises:
        InputError: if path, derivative or window are not valid.
    """

    #: the name of a column, such as ``angle`` or ``observation.state[2]``, or a field of a message, such as
    #: ``/joint_states.position[0]``. A vector stands for all its components.
    path: str = ""
    unit: str = ""  #: the unit in which the model takes the value
    #: the unit in the log, if it is another one and the name of the column does not state it. Known units are
    #: converted.
    recorded: str = ""
    factor: FiniteFloat | None = None  #: the factor, if the units are not known; None for that of the units
    offset: FiniteFloat = 0.0  #: added to the value, in the unit of the model
    #: whether it is an angle in radians that the log may keep between -pi and pi: it is continued over turns
    angle: bool = False
    #: whether a value holds until the next one is logged, however long that takes, such as that of a command that is
    #: sent only if it changes
    held: bool = False
    #: the name of a recorded state of which this one is the derivative; it has no path then. It is that of a parabola
    #: through ``window`` records, half of which come later.
    derivative_of: str = ""
    window: int = 7  #: the number of these records, an odd number of at least 3

    def __post_init__(self) -> None:
        if self.derivative_of:
            if self.path:
                raise InputError(f"a derivative of {self.derivative_of} has no path, got {self.path!r}.")
            if self.window < 3 or self.window % 2 == 0:
                raise InputError(f"window must be an odd number of at least 3, got {self.window!r}.")
            return
        if not self.path.strip():
            raise InputError(f"the path of a field must be a text, got {self.path!r}.")
        self.scale("")

    def scale(self, stated: str) -> float:
        """Return the factor of the recorded value; ``stated`` is the unit that the log itself states, if any.

        Raises:
            InputError: if the recorded unit is another one.
        """
        if self.factor is not None:
            return float(self.factor)
        with reworded(f"the field {self.path}", InputError):
            if stated and self.recorded and conversion(stated, self.recorded) != 1:
                raise InputError(f"it is recorded in {stated}, and the mapping states {self.recorded}.")
            recorded = stated or self.recorded
            return conversion(recorded, self.unit) if recorded and (self.unit or not stated) else 1.0


@dataclass(frozen=True)
class Observer(ShortRepr):
    """A function of the user's own that estimates states from the records of one recording.

    Raises:
        InputError: if it is no function ``(y, u, dt) -> x``.
    """

    #: ``(y, u, dt) -> x``, from the recorded states ``(H + 1, p)``, the inputs ``(H, m)`` and the time step in seconds
    #: to states ``(H + 1, n)``. The first states may be NaN, while it settles; they are left out. None until it is
    #: loaded.
    function: Callable[[Array, Array, float], Array] | None
    #: the names of the n states with their units; empty for those of the records, or else x0, x1, ..
    states: Mapping[str, str] = field(default_factory=dict)
    #: ``module:attr`` of the function, which the command line loads from the folder of the mapping's file
    reference: str = ""

    def __post_init__(self) -> None:
        if self.function is not None and not callable(self.function):
            raise InputError(f"an observer must be a function (y, u, dt) -> x, got {self.function!r}.")
        require("states", Mapping[str, str], self.states)


@dataclass(frozen=True)
class LogMapping(ShortRepr):
    """How recordings become states and inputs at equal steps.

    Raises:
        InputError: if there is no state, or if a name or ``valid`` is not valid.
    """

    states: Mapping[str, Field]  #: the fields of the states and inputs by name, in the order of the model
    inputs: Mapping[str, Field] = field(default_factory=dict)
    time: str | None = None  #: where the times come from, as in :class:`Clock`
    time_unit: str = ""
    stamp: Stamp = "auto"
    #: length of a step in seconds; None for the mean period of the first state. A table without times has one row for
    #: each step.
    dt: float | None = None
    #: seconds between the time at which an input is logged and the time from which it acts on the states
    delay: float = 0.0
    #: longest time in seconds between two samples of one field over which it is interpolated or held; None for 1.5
    #: mean periods of the field. A recording is split at longer gaps and at missing values.
    longest_gap: float | None = None
    #: the number of earlier steps whose states and inputs are further states, if the records at one step do not
    #: determine the next ones
    lags: int = 0
    #: which rows count, such as ``status == 0``: a field, ``==`` or ``!=``, and a number; None for all rows
    valid: str | None = None
    #: a function that estimates the states from the recorded ones, or an :class:`Observer`; None if they are the states
    observer: Observer | Callable[[Array, Array, float], Array] | None = None

    def __post_init__(self) -> None:
        if self.observer is not None and not isinstance(self.observer, Observer):
            object.__setattr__(self, "observer", Observer(self.observer))
        for kind in ("states", "inputs"):
            fields = {name: _field(name, described) for name, described in getattr(self, kind).items()}
            object.__setattr__(self, kind, fields)
        if not any(not field.derivative_of for field in self.states.values()):
            raise InputError("a mapping of a log needs at least one state.")
        if both := [name for name in self.states if name in self.inputs]:
            raise InputError(f"{both[0]} is a state and an input: give them different names.")
        conversion(self.time_unit or "s", "s")
        if self.valid is not None and _VALID.fullmatch(str(self.valid)) is None:
            raise InputError(f"valid must be a field and a number, such as 'status == 0', got {self.valid!r}.")
        ranges = {"dt": Seconds | None, "longest_gap": Seconds | None, "delay": FiniteFloat, "lags": NonNegativeInt}
        for name, annotation in {"stamp": Stamp, **ranges}.items():
            require(name, annotation, getattr(self, name))
        if derived := [name for name, given in self.inputs.items() if given.derivative_of]:
            raise InputError(f"the input {derived[0]} cannot be a derivative.")

    @property
    def fields(self) -> dict[str, Field]:
        """All recorded fields by name, the states first; derivatives are none of them."""
        return {name: field for name, field in self.states.items() if not field.derivative_of} | dict(self.inputs)

    @property
    def clock(self) -> Clock:
        return Clock(self.time, self.time_unit, None, self.stamp)

    @property
    def condition(self) -> tuple[str, bool, float] | None:
        """The field of ``valid``, whether it must equal the number, and the number."""
        matched = None if self.valid is None else _VALID.fullmatch(self.valid)
        return None if matched is None else (matched[1], matched[2] == "==", float(matched[3]))

    def in_units(self, states: Mapping[str, str], inputs: Mapping[str, str]) -> LogMapping:
        """Return this mapping with the units of an experiment, for fields that state none; by name, else by place."""

        def with_units(fields: Mapping[str, Field], units: Mapping[str, str]) -> dict[str, Field]:
            by_place = units.values() if len(units) == len(fields) else [""] * len(fields)
            return {
                name: replace(field, unit=field.unit or units.get(name, unit)) if field.factor is None else field
                for (name, field), unit in zip(fields.items(), by_place, strict=True)
            }

        return replace(self, states=with_units(self.states, states), inputs=with_units(self.inputs, inputs))

    @staticmethod
    def from_table(table: Mapping[str, Any]) -> LogMapping:
        """Return the mapping that a table of TOML describes, with the attributes of this class as its keys.

        ``states`` and ``inputs`` are tables of fields by name; a field is a path, or a table with the attributes of
        :class:`Field`. An observer is a table with ``function = { ref = "module:attr" }`` and its ``states``.

        Raises:
            InputError: if states are missing, or a table has another form.
        """
        require_known("entry of the mapping of recordings", table, [field.name for field in fields(LogMapping)])
        if "states" not in table:
            raise InputError("the mapping of recordings needs states.")
        for kind in ("states", "inputs"):
            if not isinstance(given := table.get(kind, {}), Mapping):
                example = 'angle = "column"'
                raise InputError(f"{kind} must be a table of fields by name, such as {{ {example} }}, got {given!r}.")
        match table:
            case {"observer": {"function": {"ref": str(function)}} as observer}:
                require_known("entry of the observer", observer, ["function", "states"])
                return LogMapping(**{**table, "observer": Observer(None, observer.get("states", {}), function)})
            case {"observer": given}:
                example = 'function = { ref = "module:attr" }'
                raise InputError(f"an observer must be a table with {example}, got {given!r}.")
        return LogMapping(**table)

    @staticmethod
    def from_toml(path: str | Path) -> LogMapping:
        """Return the mapping in a TOML file, or in the table ``[recordings]`` of an experiment file."""
        table = read_toml(path)
        with reworded(str(path), InputError):
            return LogMapping.from_table(table.get("recordings", table))

    @staticmethod
    def usual(log: Log, states: Mapping[str, str] | None = None, inputs: Mapping[str, str] | None = None) -> LogMapping:
        """Return the mapping of a log whose fields have usual names.

        The states are ``states``, ``x`` or ``observation.state``, or the columns ``x0``, ``x1``, ...; the inputs are
        ``inputs``, ``u``, ``action`` or ``actions``, or the columns ``u0``, ``u1``, ... The names in ``states`` and
        ``inputs``, with their units, are looked for before these.

        Raises:
            InputError: if no field has a usual name.
        """
        columns, states, inputs = log.fields(), states or {}, inputs or {}
        wanted = {name: Field(name, unit) for name, unit in {**states, **inputs}.items()}
        if wanted and all(column_of(log.source, columns, name) for name in wanted):
            outputs = {name: wanted[name] for name in states if name not in inputs}
            return LogMapping(outputs, {name: wanted[name] for name in inputs}, dt=log.period)
        vectors = ("states", "x", "observation.state")
        usual = _usual(columns, vectors, "x"), _usual(columns, ("inputs", "u", "action", "actions"), "u")
        if not usual[0]:
            how = "name the states and inputs with --state and --input of a command that has them, in a mapping, or in "
            how += "[states] and [inputs] of the experiment file"
            known = f"{', '.join(vectors)}, x0): {how}; the fields are {enumerated(columns, LISTED)}"
            raise InputError(f"{log.source} has no states under a usual name ({known}.")
        return LogMapping(*usual, dt=log.period)


def _usual(known: Sequence[str], vectors: Sequence[str], letter: str) -> dict[str, Field]:
    for name in vectors:
        if name in known:
            return {letter: Field(name)}
    columns: dict[str, Field] = {}
    plain = {named_unit(name)[0] for name in known}
    while (name := f"{letter}{len(columns)}") in plain:
        columns[name] = Field(name)
    return columns


def _field(name: str, described: Any) -> Field:
    match described:
        case Field():
            return described
        case str():
            return Field(described)
    if not isinstance(described, Mapping):
        raise InputError(f"the field {name} must be a path or a table, got {described!r}.")
    if "field" in described:
        raise InputError(f"the field {name} has a path in place of a field: path = {described['field']!r}.")
    require_known(f"entry of the field {name}", described, [field.name for field in fields(Field)])
    with reworded(f"the field {name}", InputError):
        return Field(**{**({} if "derivative_of" in described else {"path": name}), **described})
