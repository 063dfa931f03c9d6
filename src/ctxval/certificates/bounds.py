"""Numbers of certificates as text, with units and tasks; bounds are always rounded up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from ctxval._util.representation import shown
from ctxval._util.texts import enumerated, parted, quoted
from ctxval.core.space import TaskSpace
from ctxval.core.trial import Trial
from ctxval.errors import CertificateError

ERRORS = 2.0
"""Number of its standard errors by which a bound from random draws must stay below a threshold."""

_NAMED = 3  # most task parameters that a sentence names


def with_error(upper: float, error: float) -> str:
    """Return a bound and its standard error as text, both rounded up, with the digits that the error supports."""
    if not error > 0 or not np.isfinite(error + upper):
        return at_most(upper)
    high, low = (int(np.floor(np.log10(abs(value)))) for value in (upper or error, error))  # of the first digits
    # Two digits of an error that starts with 1, and never more than four of the bound.
    last = max(low - (error < 2 * 10.0**low), high - 3)
    if error < 10.0**last:
        return at_most(upper)
    return f"{at_most(upper, max(high - last + 1, 1))} ± {at_most(error, max(low - last + 1, 1))}"


def at_most(value: float, digits: int = 4) -> str:
    """Return a bound as text, rounded up: the printed number must be a valid bound as well."""
    short = f"{value:.{digits}g}"
    if float(short) >= value or not np.isfinite(value):
        return short
    return f"{value + 10.0 ** (np.floor(np.log10(abs(value))) - digits + 1):.{digits}g}"


def rank_of(confidence: float, draws: int) -> int:
    """Return the rank, from 1, of the order statistic that a further draw stays below with this probability."""
    return max(1, int(np.ceil((draws + 1) * confidence - 1e-9)))


def rank_within(confidence: float, draws: int, of: str = "") -> int:
    """Return :func:`rank_of`; a CertificateError if it needs more draws, which are called ``of``."""
    if (rank := rank_of(confidence, draws)) > draws:
        of = of or f"{draws} posterior samples of the dynamics"
        raise CertificateError(f"a confidence of {confidence:g} needs more than {of}.")
    return rank


def percent(probability: float) -> str:
    """Return a probability such as 0.95 as ``95 %``."""
    return f"{100 * probability:.9g} %"


def two_digits(value: float) -> str:
    """Return a number with two digits that count, such as 210 and not 2.1e+02."""
    return f"{float(f'{value:.2g}'):g}"


def of_tasks(distribution: str | None) -> str:
    """Return of what a share is a share; the distribution of tasks is a text, None if it is uniform."""
    return "of the tasks" if distribution is None else "of the tasks under the stated distribution"


def late(acting: Mapping[str, float]) -> str:
    """Return how inputs act, such as ``acting with a delay of 2 steps``; empty if commands act as they are."""
    return f"acting with {with_units(acting)}" if acting else ""


def rubbing(friction: Mapping[str, float]) -> str:
    """Return the dry friction at inputs, such as ``dry friction (torque 0.6 N m)``; empty if there is none."""
    return f"dry friction ({with_units(friction)})" if friction else ""


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


def radius_of(within: Mapping[str, float]) -> str:
    """Return the radius of a pocket with its unit; both radii, with the names of the states, if they differ."""
    radii = [(*parted(label), two_digits(radius)) for label, radius in within.items()]
    each = [f"{radius} {unit}".rstrip() for _, unit, radius in radii]
    if len(set(each)) == 1:
        return each[0]
    return " and ".join(f"{radius} in {name}" for radius, (name, _, _) in zip(each, radii, strict=True))


def distinguishable(value: float, tau: float) -> tuple[str, str]:
    """Return two numbers as texts, with enough digits to show which one is larger."""
    for digits in range(4, 17):
        texts = at_most(value, digits) if value <= tau else f"{value:.{digits}g}", f"{tau:.{max(digits, 6)}g}"
        if np.sign(float(texts[0]) - float(texts[1])) == np.sign(value - tau):
            return texts
    return repr(value), repr(tau)


@dataclass(frozen=True)
class Quantities:
    """What gives numbers their units, and tasks their names."""

    units: str = ""  #: the units of the distance
    space: TaskSpace | None = None  #: the task space; None if it is not known

    def of(self, text: str) -> str:
        """Return a distance as text with its units."""
        return f"{text} {self.units}".rstrip()

    @property
    def ranges(self) -> str:
        """The tasks, such as `` (start 0 to 0.4 m, goal 0.2 to 1.2 m)``; empty if they are not known or too many."""
        if self.space is None:
            return ""
        if self.space.members is not None:
            return f" of the suite of {len(self.space.members)}"
        if self.space.dimension > _NAMED:
            return ""
        ends = zip(self.space.labels, self.space.low.tolist(), self.space.high.tolist(), strict=True)
        ranges = ((*parted(label), low, high) for label, low, high in ends)
        return f" ({', '.join(f'{name} {low:.4g} to {high:.4g} {unit}'.rstrip() for name, unit, low, high in ranges)})"

    def task(self, trial: Trial) -> str:
        """Return the task of a trial by its parameters, at most six of them."""
        space, at = self.space, trial.unit_point
        if space is None or at.shape != (space.dimension,):
            return shown(trial.parameters)
        values = space.labelled(space.from_unit(at))
        return with_units(dict(islice(values.items(), 6)), digits=4) + (", ..." if len(values) > 6 else "")

    def lengths(self, share: float) -> str:
        """Return a share of each range in the units of the task parameters, if they are few and known."""
        space = self.space
        if space is None or space.dimension > _NAMED:  # of a suite, no gaps are bounded
            return f"{share:.2g} of each parameter's range"
        widths = zip(space.labels, (space.high - space.low).tolist(), strict=True)
        lengths = {label: f"{share * width:.2g} {parted(label)[1]}".rstrip() for label, width in widths}
        return " and ".join(f"{length} in {parted(label)[0]}" for label, length in lengths.items())


NO_UNITS = Quantities()
