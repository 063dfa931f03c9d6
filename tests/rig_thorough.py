"""Cases of parametrised tests that only ``make thorough`` runs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def more(*cases: Any) -> list[Any]:
    """Return cases that only ``make thorough`` runs; a tuple is the arguments of one case."""
    return [pytest.param(*(one if isinstance(one, tuple) else (one,)), marks=pytest.mark.thorough) for one in cases]


def some(cases: Iterable[Any], every: int = 4) -> list[Any]:
    """Return all cases, of which ``make test`` runs the first one and each so many-th."""
    return [more((case,))[0] if place % every else case for place, case in enumerate(cases)]
