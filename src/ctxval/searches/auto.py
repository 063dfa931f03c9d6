"""The richest search that the trials allow."""

from __future__ import annotations

from ctxval.searches.climbs import Climbs


class Auto(Climbs):
    """Climbs on the distance that executed trajectories predict; the scalar search where there are none."""
