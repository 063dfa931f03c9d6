"""The public face: complete, sorted, documented."""

from __future__ import annotations

import importlib

import pytest

import ctxval
from ctxval import errors

ROOMS = ["", ".models", ".systems", ".controllers", ".distances", ".searches", ".cases"]


@pytest.mark.parametrize("room", ROOMS)
def test_all_is_sorted_and_complete(room: str) -> None:
    module = importlib.import_module(f"ctxval{room}")
    # Capitals first, as the linter sorts; `__all__` names nothing that is not there.
    assert list(module.__all__) == sorted(
        module.__all__, key=lambda name: (not name.isupper(), not name[0].isupper(), name)
    )
    assert all(hasattr(module, name) for name in module.__all__)
    public = {
        n
        for n, v in vars(module).items()
        if not n.startswith("_") and getattr(v, "__module__", "").startswith("ctxval")
    }
    assert public <= set(module.__all__) | {"errors", "InputError", "UnknownNameError", "Experiment", "COMPLETE"}


@pytest.mark.parametrize("name", list(ctxval.__all__))
def test_everything_public_has_a_docstring(name: str) -> None:
    assert (getattr(ctxval, name).__doc__ or "").strip()


def test_every_error_is_drawn_in_the_tree_and_derives_from_one_base() -> None:
    classes = [v for v in vars(errors).values() if isinstance(v, type) and issubclass(v, Exception)]
    for error in classes:
        assert issubclass(error, errors.CtxvalError)
        assert error.__name__ in (errors.__doc__ or "")


def test_unknown_names_come_with_the_nearest_one() -> None:
    error = errors.UnknownNameError.among("search", "gp_ucb", ["random", "gp-ucb"])
    assert "did you mean 'gp-ucb'" in str(error)
    assert "known: gp-ucb, random" in str(errors.UnknownNameError.among("search", "xyz", ["random", "gp-ucb"]))
