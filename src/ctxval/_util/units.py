"""Units of recorded quantities: conversions between them, and the names of columns that state them.

Unlike ``pint``, angles have a dimension of their own here: ``pint`` converts 1 Hz to 1 rad/s, and degrees to numbers.
"""

from __future__ import annotations

import math
import re

from ctxval.errors import InputError

Powers = tuple[int, int, int, int, int]
"""Powers of m, kg, s, A and rad."""

_UNITS: dict[str, tuple[float, Powers]] = {
    **{"1": (1.0, (0, 0, 0, 0, 0)), "m": (1.0, (1, 0, 0, 0, 0)), "kg": (1.0, (0, 1, 0, 0, 0))},
    **{"s": (1.0, (0, 0, 1, 0, 0)), "min": (60.0, (0, 0, 1, 0, 0)), "h": (3600.0, (0, 0, 1, 0, 0))},
    **{"rad": (1.0, (0, 0, 0, 0, 1)), "deg": (math.pi / 180, (0, 0, 0, 0, 1)), "rev": (2 * math.pi, (0, 0, 0, 0, 1))},
    **{"rpm": (2 * math.pi / 60, (0, 0, -1, 0, 1)), "Hz": (1.0, (0, 0, -1, 0, 0)), "g": (9.80665, (1, 0, -2, 0, 0))},
    **{"N": (1.0, (1, 1, -2, 0, 0)), "Nm": (1.0, (2, 1, -2, 0, 0)), "J": (1.0, (2, 1, -2, 0, 0))},
    **{"W": (1.0, (2, 1, -3, 0, 0)), "V": (1.0, (2, 1, -3, -1, 0)), "A": (1.0, (0, 0, 0, 1, 0))},
}
_PREFIXES = {"M": 1e6, "k": 1e3, "c": 1e-2, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}
_WITH_PREFIX = ("m", "s", "rad", "Hz", "N", "Nm", "J", "W", "V", "A")
_OTHER_NAMES = {
    **{"sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "millisecond": "ms", "usec": "us"},
    **{"milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns", "nsec": "ns", "minutes": "min"},
    **{"°": "deg", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad", "meter": "m", "meters": "m"},
    **{"metre": "m", "metres": "m", "dps": "deg/s", "mps": "m/s", "kph": "km/h", "kmh": "km/h", "N.m": "Nm"},
}
_FACTOR = re.compile(r"([A-Za-z°µμ]+|1)(?:\^?(-?[1-4]))?")

# The forms ``angle [deg]``, ``angle (deg)``, ``angle_deg`` and ``rate_deg_s``.
_BRACKETS = re.compile(r"(.*?)\s*(?:\[\s*(?!\d+\s*\])([^\[\]]*?)\s*\]|\(([^()]*)\))\s*")
_SUFFIX = re.compile(
    r"(.+?)_(deg|rad|mrad|rpm|dps|mps|kmh|(?:[kcmun]?(?:m|s|N|Nm|V|A))|sec|msec|usec|nsec)(?:_(?:per_)?(s2?))?"
)


def conversion(recorded: str, wanted: str) -> float:
    """Return the factor from one unit to another."""
    if _plain(recorded) == _plain(wanted):
        return 1.0
    source, target = _parsed(recorded), _parsed(wanted)
    if source is None or target is None or source[1] != target[1]:
        units = f"from {recorded or 'no unit'} to {wanted or 'no unit'}"
        raise InputError(f"there is no known factor {units}: give factor = ...")
    return source[0] / target[0]


def named_unit(column: str) -> tuple[str, str, bool]:
    """Return the name and the unit that a column states, and whether the unit may be part of the name instead.

    ``x_m`` may be a measured x, so such endings are weak.
    """
    if len(column) > 200:
        return column, "", False
    if (bracketed := _BRACKETS.fullmatch(column)) is not None:
        return bracketed[1], (bracketed[2] or bracketed[3] or "").strip(), False
    if (ended := _SUFFIX.fullmatch(column)) is None:
        return column.strip(), "", False
    rate = {"s": "/s", "s2": "/s^2"}.get(ended[3] or "", "")
    return ended[1], ended[2] + rate, not rate and ended[2] in ("m", "s", "N", "V", "A")


def _parsed(unit: str) -> tuple[float, Powers] | None:
    """Return the factor to SI units and the powers of them; None if the unit is not known."""
    text = _OTHER_NAMES.get(unit.strip(), unit.strip()).replace("²", "^2").replace("³", "^3").replace("**", "^")
    numerator, *denominators = text.split("/")
    factor, powers = 1.0, [0] * 5
    for sign, part in ((1, numerator), *((-1, denominator) for denominator in denominators)):
        names = re.split(r"[\s*·.]+", part.strip())
        if sign < 0 and len(names) > 1:
            return None  # m/s kg is ambiguous
        for name in names:
            matched = _FACTOR.fullmatch(name)
            if matched is None:
                return None
            base, prefix = _OTHER_NAMES.get(matched[1], matched[1]), 1.0
            if base not in _UNITS and base[:1] in _PREFIXES and base[1:] in _WITH_PREFIX:
                base, prefix = base[1:], _PREFIXES[base[:1]]
            if base not in _UNITS:
                return None
            power = sign * int(matched[2] or 1)
            factor *= (prefix * _UNITS[base][0]) ** power
            powers = [total + power * single for total, single in zip(powers, _UNITS[base][1], strict=True)]
    return factor, tuple(powers)  # type: ignore[return-value]


def _plain(unit: str) -> str:
    return re.sub(r"[\s*·.]", "", unit).replace("°", "deg").replace("²", "^2").replace("s2", "s^2")
