"""The contract of a trained policy: what it observes of a robot, and what its actions mean, as one file in TOML."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from ctxval._util.arrays import Array, as_finite
from ctxval._util.checked import NonNegativeFloat, PositiveFloat, PositiveInt, Seconds, checked, require_known
from ctxval._util.files import read_toml, write_text
from ctxval._util.registry import construct
from ctxval._util.representation import ShortRepr
from ctxval._util.toml import toml_text
from ctxval.core.controller import Limits, LimitsLike
from ctxval.core.floating_base import Fall, FloatingBase
from ctxval.errors import InputError, ShapeError

Numbers = float | Sequence[float]  #: one number for all, or one for each

TermName = Literal[
    "linear_velocity",
    "angular_velocity",
    "gravity",
    "quaternion",
    "height",
    "joint_positions",
    "joint_errors",
    "joint_rates",
    "last_action",
    "command",
    "clock",
    "constant",
    "states",
]


@checked
@dataclass(frozen=True)
class Term(ShortRepr):
    """A term of the observation: ``scale (clipped value - offset)``.

    ======================  =========================================================================
    ``linear_velocity``     velocity of the base, or of the point ``at`` of it, in the body frame, m/s
    ``angular_velocity``    angular velocity in the body frame, rad/s
    ``gravity``             unit vector of gravity in the body frame
    ``quaternion``          orientation of the base, w first
    ``height``              height of the base, m
    ``joint_positions``     positions of the joints
    ``joint_errors``        positions of the joints minus the default pose
    ``joint_rates``         rates of the joints
    ``last_action``         last output of the network, 0 at the start
    ``command``             command of the task
    ``clock``               sines and cosines of ``period`` for each of the ``phases``
    ``constant``            the numbers ``values``
    ``states``              the states whose indices are ``values``
    ======================  =========================================================================

    Raises:
        InputError: if its values are missing.
        ShapeError: if its point has not three coordinates.
    """

    term: TermName
    scale: Numbers = 1.0  #: factor, a number or one for each component
    offset: Numbers = 0.0  #: what is subtracted before, such as the mean of a normalisation
    clip: Numbers | None = None  #: largest magnitude of a value, or its limits [low, high]; None if there is none
    history: PositiveInt = 1  #: number of steps whose values are observed
    at: Sequence[float] = (0.0, 0.0, 0.0)  #: the point of the base, such as an IMU, in the body frame, metres
    period: Seconds = 1.0  #: period of a clock
    phases: Sequence[float] = (0.0,)  #: phases of a clock at the start, in turns
    order: Literal["sin cos", "cos sin"] = "sin cos"  #: whether the sines or the cosines of a clock come first
    values: Sequence[float] = ()

    def __post_init__(self) -> None:
        _make_tuples(self)
        if self.term in ("constant", "states") and not self.values:
            raise InputError(f"the term {self.term} needs its values.")
        if len(self.at) != 3:
            raise ShapeError(f"the point of a term needs three coordinates, got {list(self.at)}.")

    def of(self, value: Array) -> Array:
        """Return a value ``(..., k)`` as it is observed."""
        scaled = clipped(value, self.clip)
        if self.offset != 0.0:
            scaled = scaled - np.asarray(self.offset)
        return scaled if self.scale == 1.0 else scaled * np.asarray(self.scale)


@checked
@dataclass(frozen=True)
class Action(ShortRepr):
    """What the outputs a of a network mean.

    The ``target`` of a ``position`` is ``default + scale a``, and the inputs of the system are these positions. With
    ``torque``, the inputs are ``kp (default + scale a - q) - kd dq``, at each step of the task. With ``direct``, the
    inputs are ``scale a``.

    Raises:
        InputError: if torques have no gains, or if the limits have another form.
    """

    target: Literal["position", "torque", "direct"] = "position"
    scale: Numbers = 1.0
    clip: Numbers | None = None  #: largest magnitude of the outputs, or their limits [low, high], before all else
    kp: Numbers = 0.0  #: gains of the torques, N m/rad
    kd: Numbers = 0.0  #: N m s/rad
    #: limits of the inputs, rows ``[low, high]`` for each, or one number h for ``[-h, h]`` of all
    limits: LimitsLike | None = None

    def __post_init__(self) -> None:
        if self.limits is not None:
            Limits.of(self.limits)  # refuses other forms
        _make_tuples(self)
        if self.target == "torque" and not np.any(np.asarray(self.kp) > 0):
            raise InputError("torques need the gains kp and kd.")


@checked
@dataclass(frozen=True)
class PolicyContract(ShortRepr):
    """What a trained policy observes, and what its actions mean.

    Joints are names in the MJCF, or their indices among its joints after the base, in the order of the policy.

    Raises:
        InputError: if terms, joints or the fall do not fit the base.
        ShapeError: if the pose has no number for each joint.
    """

    network: str | Path  #: file of the network: ``.onnx``, ``.npz``, ``.pt`` (TorchScript) or ``.zip`` (SB3)
    observation: Sequence[Term]  #: the terms, in order
    dt: Seconds  #: time between two actions, seconds
    joints: Sequence[str | int] = ()
    default: Sequence[float] = ()  #: the default pose, the position of each joint
    action: Action = field(default_factory=Action)
    decimation: PositiveInt = 1  #: number of steps of the task in the time between two actions
    latency: NonNegativeFloat = 0.0  #: time by which actions act late, a multiple of the steps of the task, seconds
    base: Literal["free", "planar", "fixed"] = "free"  #: the base of the robot (:class:`FloatingBase`)
    history: PositiveInt = 1  #: number of whole observations that the network takes
    history_order: Literal["oldest first", "newest first"] = "oldest first"
    history_start: Literal["first", "zero"] = "first"  #: what the steps before the start are: the first, or 0
    clip: PositiveFloat | None = None  #: largest magnitude of an observation; None if there is none
    fall_height: float | None = None  #: the robot has fallen if its base is lower, metres
    fall_tilt: PositiveFloat | None = None  #: ... or more tilted, radians

    def __post_init__(self) -> None:
        _make_tuples(self)
        if not self.observation:
            raise InputError("the contract of a policy needs terms of its observation.")
        if len(self.default) != len(self.joints):
            got = f"{len(self.joints)} joints and {len(self.default)} numbers"
            raise ShapeError(f"the default pose must have a number for each joint, got {got}.")
        if self.action.target != "direct" and not self.joints:
            raise InputError(f"actions that are {self.action.target}s need the joints of the robot.")
        if self.base != "free" and (wrong := {each.term for each in self.observation} & set(_OF_FREE)):
            raise InputError(f"a {self.base} base has no {', '.join(sorted(wrong))}.")
        if self.base == "fixed" and (self.fall_height, self.fall_tilt) != (None, None):
            raise InputError("a robot with a fixed base does not fall.")

    def fall(self, base: FloatingBase) -> Fall | None:
        """Return the condition of a fall of a base; None if there is none."""
        stated = (self.fall_height, self.fall_tilt) != (None, None)
        return Fall(self.fall_height, self.fall_tilt, base) if stated else None

    # Files

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a contract from a TOML file; the path of the network is relative to its folder."""
        table = read_toml(path)
        contract = cls.from_table(table)
        return replace(contract, network=Path(path).parent / contract.network)

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Self:
        """Return a contract from a table with the fields of this class, with tables for the terms and the action.

        Raises:
            InputError: if a key is missing, or the observation is no list.
        """
        require_known("entry of a policy's contract", table, [each.name for each in fields(cls)])
        given = dict(table)
        for name in ("network", "dt", "observation"):
            if name not in given:
                raise InputError(f"the contract of a policy needs {name}.")
        terms = given["observation"]
        if not isinstance(terms, list):
            raise InputError(f"the observation of a policy must be a list of terms, got {terms!r}.")
        plain = [{"term": each} if isinstance(each, str) else each for each in terms]
        given["observation"] = [construct("a term of the observation", Term, each) for each in plain]
        given["action"] = construct("the action", Action, given.get("action", {}))
        return construct("the contract", cls, given)  # type: ignore[no-any-return]

    def to_table(self) -> dict[str, Any]:
        """Return the contract as a table without defaults."""
        table = _without_defaults(self) | {"network": str(self.network)}
        if "action" in table:
            table["action"] = _without_defaults(self.action)
        observed = [_without_defaults(each) for each in self.observation]
        return table | {"observation": [each["term"] if len(each) == 1 else each for each in observed]}

    def write(self, path: str | Path) -> Path:
        """Write the contract as a TOML file, which :meth:`read` reads; the path of the network is relative to it."""
        table = self.to_table() | {"network": os.path.relpath(self.network, Path(path).parent)}
        tables = {name: table.pop(name) for name in ("observation", "action") if name in table}
        return write_text(Path(path), toml_text(table | tables))


_OF_FREE = ("linear_velocity", "angular_velocity", "gravity", "quaternion")


def _make_tuples(given: Any) -> None:
    """Make tuples of the lists and arrays of a frozen dataclass, so that equal ones compare as equal."""
    for name, value in vars(given).items():
        if isinstance(value, list | np.ndarray):
            object.__setattr__(given, name, tuple(value.tolist() if isinstance(value, np.ndarray) else value))


def _range(clip: Numbers) -> tuple[float, float]:
    """Return the limits that a largest magnitude, or a pair, stands for."""
    array = as_finite("clip", clip)
    if array.shape not in ((), (2,)):
        raise ShapeError(f"clip must be a number or [low, high], got {clip!r}.")
    return (-float(array), float(array)) if array.shape == () else (float(array[0]), float(array[1]))


def clipped(values: Array, clip: Numbers | None) -> Array:
    """Return values clipped to a largest magnitude, or to limits ``[low, high]``."""
    return values if clip is None else np.clip(values, *_range(clip))


def _without_defaults(given: Any) -> dict[str, Any]:
    changed = dict[str, Any]()
    for each in fields(given):
        value = getattr(given, each.name)
        default = each.default if each.default_factory is MISSING else each.default_factory()
        if value != default:
            changed[each.name] = list(value) if isinstance(value, tuple) else value
    return changed
