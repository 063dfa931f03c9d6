"""Conversions between the units in which logs are recorded and those of a model."""

from __future__ import annotations

import math
import re

from ctxval.errors import InputError

_TURN = 2 * math.pi
_FACTORS: dict[str, tuple[str, float]] = {
    **{"rad": ("rad", 1.0), "deg": ("rad", _TURN / 360), "mrad": ("rad", 1e-3), "rev": ("rad", _TURN)},
    **{"rad/s": ("rad/s", 1.0), "deg/s": ("rad/s", _TURN / 360), "rpm": ("rad/s", _TURN / 60)},
    **{"m": ("m", 1.0), "cm": ("m", 1e-2), "mm": ("m", 1e-3), "km": ("m", 1e3)},
    **{"m/s": ("m/s", 1.0), "cm/s": ("m/s", 1e-2), "mm/s": ("m/s", 1e-3), "km/h": ("m/s", 1 / 3.6)},
    **{"m/s^2": ("m/s^2", 1.0), "g": ("m/s^2", 9.80665)},
    **{"N": ("N", 1.0), "kN": ("N", 1e3), "Nm": ("Nm", 1.0), "mNm": ("Nm", 1e-3)},
    **{"V": ("V", 1.0), "mV": ("V", 1e-3), "A": ("A", 1.0), "mA": ("A", 1e-3)},
    **{"s": ("s", 1.0), "ms": ("s", 1e-3), "us": ("s", 1e-6), "ns": ("s", 1e-9), "min": ("s", 60.0)},
}
"""The base unit of each unit, and the factor to it."""


def conversion(recorded: str, wanted: str) -> float:
    """Return the factor from one unit to another.

    Raises:
        InputError: if a unit is not known, or the two do not measure the same quantity.
    """
    if _plain(recorded) == _plain(wanted):
        return 1.0
    own, other = (_FACTORS.get(_plain(unit)) for unit in (recorded, wanted))
    if own is None or other is None or own[0] != other[0]:
        raise InputError(f"there is no known factor from {recorded or 'no unit'} to {wanted}: give factor = ...")
    return own[1] / other[1]


def _plain(unit: str) -> str:
    return re.sub(r"[\s*·.]", "", unit).replace("°", "deg").replace("²", "^2").replace("s2", "s^2")
