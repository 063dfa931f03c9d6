"""Columns of tables: which one is meant, which one has the times, and what stands for a missing value in them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from ctxval._util.arrays import Array
from ctxval._util.texts import enumerated
from ctxval._util.units import conversion, named_unit
from ctxval.errors import InputError

TIMES = ("t", "time", "times", "timestamp")
"""Names of columns of times, the first of which is taken: a state may be called ``time`` too."""

EPISODES = tuple(f"{name}{ending}" for name in ("episode", "run", "trial") for ending in ("", "_index", "_id"))
"""Names of columns that number the recordings in one table."""

FAR = 3.0  # largest ratio between the median time of two samples and a time step to which they are interpolated


def require_distinct(source: str, names: Sequence[str]) -> None:
    """Refuse a table with two columns of one name, also if they differ in their units."""
    plain = [named_unit(name)[0] if name.endswith(("]", ")")) else name for name in names if name]
    name, count = max(Counter(plain).items(), key=lambda pair: pair[1], default=("", 0))
    if count > 1:
        raise InputError(f"{source} has two columns {name[:60]!r}: each name must be there once.")


def column_of(source: str, names: Sequence[str], field: str) -> tuple[str, str] | None:
    """Return the column that a field means, and its unit; None if there is none.

    A field is a column's name with or without its unit, or with a unit in brackets that the column does not state.
    """
    plain, unit, weak = named_unit(field)
    if field in names:
        return field, "" if weak else unit
    if field.endswith(("]", ")")) and unit:
        column = column_of(source, names, plain)
        return None if column is None or column[1] not in ("", unit) else (column[0], unit)
    matching = [name for name in names if named_unit(name)[0] == field]
    if len(matching) > 1:
        raise InputError(f"{source} has several columns for {field}: {enumerated(matching, 5)}; name one of them.")
    return (matching[0], named_unit(matching[0])[1]) if matching else None


def time_column(source: str, names: Sequence[str]) -> tuple[str, str] | None:
    """Return the column of the times and its unit, empty if it states none; None if there is no such column."""
    plain = {name: named_unit(name)[0] for name in names}
    for time in TIMES:
        matching = [name for name, bare in plain.items() if time in (bare, bare.casefold() if time != "t" else "")]
        if time in matching or len(matching) == 1:
            column = time if time in matching else matching[0]
            return column, named_unit(column)[1]
        if matching:
            raise InputError(f"{source} has several columns of times, {enumerated(matching, 5)}; name one of them.")
    return None


def in_seconds(source: str, times: Array, unit: str) -> Array:
    """Return times in seconds; times since 1970 without a unit are recognised by their size."""
    if not unit and len(times):
        middle = float(np.median(times))
        # The smallest times after 1973, in units in which no recording has such a length.
        unit = next((name for least, name in ((1e17, "ns"), (1e14, "us"), (1e11, "ms")) if middle > least), "s")
    try:
        return np.asarray(times * conversion(unit or "s", "s"))
    except InputError:
        known = "s, ms, us, ns, min or h"
        raise InputError(f"{source}: the unit of its times must be {known}, got {unit[:40]!r}.") from None


def unit_advice(period: float, dt: float) -> str:
    """Return the sentence that times probably have another unit; empty if their period does not suggest one."""
    for factor, unit in ((1e3, "ms"), (1e6, "us"), (1e9, "ns")):
        if 1 / FAR < period / dt / factor < FAR:
            return (
                f"if the times are in {unit}, name their column t [{unit}], or give time_unit = {unit!r} in a mapping"
            )
        if 1 / FAR < period * factor / dt < FAR:
            return f"the times seem to be in s although they are stated in {unit}"
    return ""


def sentinels(values: Array, factor: float = 1.0) -> list[float]:
    """Return the values that stand for a missing one, such as -999, -9999 or 1e9, and are far outside all others.

    The factor is that to the unit before a conversion of the table, which converted marks such as -999 too.
    """
    marks, rest = list[float](), np.asarray(values[np.isfinite(values)])
    while len(rest):
        low, high = float(rest.min()), float(rest.max())
        largest = low if abs(low) > abs(high) else high
        others = rest[rest != largest]
        size = abs(largest)
        powers = (float(f"1e{round(np.log10(size))}"),) if 1e6 <= size < np.inf else ()
        limits = (32767.0, -32768.0, 65535.0, 2147483647.0, -2147483648.0, 4294967295.0)
        near = size > 1e30 or any(math.isclose(largest, mark, rel_tol=1e-7) for mark in (*limits, *powers))
        if not len(others) or not (near or _all_nines(largest) or _all_nines(factor * largest)):
            break
        ranges = 2 * float(np.ptp(others))
        if min(abs(largest - float(others.min())), abs(largest - float(others.max()))) <= ranges:
            break
        marks.append(largest)
        rest = others
    return marks


def _all_nines(value: float) -> bool:
    """Return whether all digits are nines, also if the number was rounded to 32 bits or converted to another unit."""
    return abs(value) >= 99 and any(set(f"{abs(value):.{digits}g}".replace(".", "")) == {"9"} for digits in (7, 15))
