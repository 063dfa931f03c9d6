"""Assertions on the facts that a text names, in the place of assertions on its wording.

A fact is the name of a parameter, file, option or code, or a value. Facts have no prose: `make test` counts sentences.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import pytest

E = TypeVar("E", bound=BaseException)


def spellings(fact: object) -> list[str]:
    """Return how a text may write a fact."""
    short = [f"{fact:g}"] if isinstance(fact, float) else []
    return [str(fact), repr(fact), *short]


def is_named(text: str, fact: object) -> bool:
    """Return whether a text has a fact that is no part of a longer word or number."""
    for spelling in spellings(fact):
        before = r"(?<![\w.])" if re.match(r"\w", spelling) else r"(?<!\w)"
        after = r"(?!\.?\w)" if re.search(r"\w$", spelling) else ""
        if re.search(before + re.escape(spelling) + after, text):
            return True
    return False


def assert_names(text: str | Iterable[object], *facts: object) -> None:
    """Assert that a text, or one of several, names each fact."""
    text = text if isinstance(text, str) else "\n".join(map(str, text))
    missing = [fact for fact in facts if not is_named(text, fact)]
    assert not missing, f"{missing} not in {text!r}"


@contextmanager
def refuses(error: type[E] | tuple[type[E], ...], *facts: object) -> Iterator[pytest.ExceptionInfo[E]]:
    """Assert that a block raises exactly this class, or one of several, with one line that names the facts."""
    with pytest.raises(error) as caught:
        yield caught
    assert type(caught.value) in (error if isinstance(error, tuple) else (error,)), repr(caught.value)
    text = str(caught.value)
    assert text.strip()
    assert "Traceback" not in text
    assert_names(text, *facts)


@contextmanager
def warns(category: type[Warning], *facts: object) -> Iterator[None]:
    """Assert that a block warns once, with a text that names the facts."""
    with pytest.warns(category) as caught:
        yield
    (warning,) = (warning for warning in caught if warning.category is category)
    assert_names(str(warning.message), *facts)
