"""Searches by the names that stored results have."""

from __future__ import annotations

from typing import Any

from ctxval import searches


def search_named(name: str, **options: Any) -> searches.Search:
    """Return a search; ``scalar`` is Bayesian optimisation of the distance."""
    return searches.by_name("bayesian-optimisation" if name == "scalar" else name, **options)
