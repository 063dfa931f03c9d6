"""Numbers of certificates as text; bounds are always rounded up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ctxval._util.texts import enumerated, parted, quoted

ERRORS = 2.0
"""Number of its standard errors by which a bound from random draws must stay below a threshold."""


def with_error(upper: float, error: float) -> str:
    """Return a bound and its standard error as text, both rounded up, with the digits that the error supports."""
    if not error > 0 or not np.isfinite(error + upper):
        return at_most(upper)
    high, low = _place(upper or error), _place(error)
    # Two digits of an error that starts with 1, and never more than four of the bound.
    last = max(low - (error < 2 * 10.0**low), high - 3)
    if error < 10.0**last:
        return at_most(upper)
    return f"{at_most(upper, max(high - last + 1, 1))} ± {at_most(error, max(low - last + 1, 1))}"


def _place(value: float) -> int:
    """Return the power of ten of a number's first digit."""
    return int(np.floor(np.log10(abs(value))))


def at_most(value: float, digits: int = 4) -> str:
    """Return a bound as text, rounded up: the printed number must be a valid bound as well."""
    short = f"{value:.{digits}g}"
    if float(short) >= value or not np.isfinite(value):
        return short
    return f"{value + 10.0 ** (np.floor(np.log10(abs(value))) - digits + 1):.{digits}g}"


def rank_of(confidence: float, draws: int) -> int:
    """Return the rank, from 1, of the order statistic that a further draw stays below with this probability.

    It is larger than the number of draws if the confidence needs more of them.
    """
    return max(1, int(np.ceil((draws + 1) * confidence - 1e-9)))


def percent(probability: float) -> str:
    """Return a probability such as 0.95 as ``95 %``."""
    return f"{100 * probability:.9g} %"


def of_tasks(distribution: str | None) -> str:
    """Return of what a share is a share; the distribution of tasks is a text, None if it is uniform."""
    return "of the tasks" if distribution is None else "of the tasks under the stated distribution"


def late(actuator: Sequence[float] | None) -> str:
    """Return how inputs act, given their delay and their time constant in steps; empty if they act at once."""
    if actuator is None:
        return ""
    (delay, lag), at_once = actuator, 0.05
    delayed, slow = (f"{each:.2g} step{'' if f'{each:.2g}' == '1' else 's'}" for each in actuator)
    parts = [f"{delayed} late"] if delay > at_once else []
    parts += [f"with a time constant of {slow}"] if lag > 5 * at_once else []
    return f"acting {' and '.join(parts)}" if parts else ""


def except_for(physical: Sequence[str]) -> str:
    """Return the task parameters that dynamics may change with, after a comma; empty if there are none."""
    return f", except for {enumerated(physical, 10)}" if physical else ""


def state_of(estimated: object) -> str:
    """Return what learned dynamics are a function of, beside the input."""
    return "M's state (estimated from outputs)" if estimated else "recorded state"


def with_units(values: Mapping[str, float | str], digits: int = 2) -> str:
    """Return numbers with their names; the unit of a label ``name [unit]`` follows its number. Texts are quoted."""
    parts = ((*parted(label), value) for label, value in values.items())
    texts = ((name, unit, repr(quoted(v)) if isinstance(v, str) else f"{v:.{digits}g}") for name, unit, v in parts)
    return ", ".join(f"{name} {text} {unit}".rstrip() for name, unit, text in texts)


def as_text(value: object) -> str:
    """Return a number, a list of numbers or a table of numbers as text; floats have four significant digits."""
    match value:
        case None:
            return "-"
        case float():
            return f"{value:.4g}"
        case list() | tuple():
            return ", ".join(as_text(item) for item in value)
        case dict():
            return ", ".join(f"{name} {as_text(item)}" for name, item in value.items())
        case _:
            return str(value)
