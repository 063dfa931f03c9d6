"""References ``module:attr``: the search for the module, and the checks of the object before it is called."""

from __future__ import annotations

import functools
import importlib
import inspect
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

from ctxval._util.refusals import reworded
from ctxval._util.registry import Registry, has_method
from ctxval.errors import InputError

_added: set[str] = set()  #: folders of experiments that this module has put on ``sys.path``


def reference(text: str, folder: Path | None = None) -> Any:
    """Import ``module:attr``; this runs the module's code."""
    module, colon, attribute = text.partition(":")
    if not (colon and attribute and all(name.isidentifier() for name in module.split("."))):
        raise InputError(f"a reference must be module:attr, such as 'my_rig:experiment', got {text!r}.")
    with _searched_first(os.path.realpath(folder or _here())) as home:
        _require_place(text, module.partition(".")[0], home)
        with (
            reworded(f"{module} failed while it was loaded"),
            reworded(f"{text} cannot be loaded", ImportError, AttributeError, ValueError, TypeError),
        ):
            return getattr(importlib.import_module(module), attribute)


@contextmanager
def _searched_first(home: str) -> Iterator[str]:
    """Put a folder first on ``sys.path``. It stays there, because a module may import others when it is called."""
    # Meanwhile neither the current folder, which `python -m` adds, nor that of another experiment is searched.
    before = list(sys.path)
    if home not in before:
        _added.add(home)
    stated = {os.path.realpath(path) for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path}
    others = {home, os.path.realpath(_here()), *_added} - stated
    sys.path[:] = [home, *(entry for entry in before if os.path.realpath(entry or _here()) not in others)]
    try:
        yield home
    finally:
        sys.path.extend(entry for entry in before if entry not in sys.path)


def _here() -> str:
    with suppress(OSError):  # it was deleted
        return os.getcwd()
    return os.devnull


def _require_place(text: str, module: str, home: str) -> None:
    """Check that a top-level module is found, and that no other module of this name is already loaded."""
    importlib.invalidate_caches()
    # None for a module without a file, such as a built-in one.
    spec = next(filter(None, (finder.find_spec(module, None) for finder in sys.meta_path)), None)
    origin = spec.origin if spec is not None and spec.has_location else None
    place = None if spec is None else _place(origin, spec.submodule_search_locations)
    beside = place is not None and os.path.dirname(place) in (home, os.path.join(home, module))
    if module in sys.stdlib_module_names and not beside:
        raise InputError(f"{text} is in Python's standard library, which contains no part of an experiment.")
    loaded = sys.modules.get(module)
    if loaded is None and place is None:
        where = "in the folder of the file, and those of the command line in the current one"
        why = f"no module named {module!r} is in {home} or installed"
        raise InputError(f"{text} cannot be loaded: {why}. The modules of an experiment file must be {where}.")
    clash = (
        "{} cannot be loaded: a module named {!r} is already in use, {}, and {}. Rename one, or use another process."
    )
    used = _place(getattr(loaded, "__file__", None), getattr(loaded, "__path__", None))
    if used not in (None, place):
        other = f"none of this name is in {home} or installed" if place is None else f"the reference means {place}"
        raise InputError(clash.format(text, module, used, other))
    # No loaded module of another experiment's folder may have the name of any module in this folder.
    if others := _added - {home}:
        for name, each in list(sys.modules.items()):
            used = getattr(each, "__file__", None) if "." not in name else None
            folder = os.path.dirname(used or "")
            apart = used is None or not {folder, os.path.dirname(folder)} & others
            if not apart and PathFinder.find_spec(name, [home]) is not None:
                raise InputError(clash.format(text, name, used, f"there is one in {home} too"))


def _place(file: str | None, folders: Any) -> str | None:
    where = file or next(iter(folders or ()), None)
    return None if where is None else os.path.realpath(where)


# Checks of the object that a reference names


def require_part(registry: Registry[Any], what: str, value: Any) -> Any:
    """Return an object or a class if it has the method of the kind; a model or a distance may also be a function."""
    kind, method = registry.kind, str(registry.method)
    if isinstance(value, type):
        has = has_method(value, method)
    elif kind == "distance":
        has = is_function(value) and accepts(value, 3)
    else:
        has = callable(getattr(value, method, None)) or (kind == "model" and is_function(value) and accepts(value, 2))
    if not has and kind == "distance":
        wanted = "a function (model_trajectory, system_trajectory, task) -> d written in Python"
        raise InputError(f"{what} must be {wanted}, got {_named(value)}.")
    if not has:
        raise InputError(f"{what} must be a {kind}, got {_named(value)}, which has no {method}.")
    return value


def require_function(what: str, value: Any, form: str) -> Any:
    """Return a function if it takes the arguments of a form such as ``(x, u) -> x_next``; it is not called here."""
    count = form.partition("->")[0].count(",") + 1
    if not is_function(value):
        raise InputError(f"{what} must be a function {form} written in Python, got {_named(value)}.")
    if not accepts(value, count):
        raise InputError(f"{what} must be a function {form}; it takes {inspect.signature(value)}.")
    return value


def is_function(value: Any) -> bool:
    """Return whether an object is a function written in Python, or has a ``__call__`` that is one."""
    if isinstance(value, functools.partial):
        return is_function(value.func)
    if inspect.isfunction(_unwrapped(value)):
        return True
    if isinstance(value, type):
        return False
    return any(inspect.isfunction(_unwrapped(vars(base).get("__call__"))) for base in type(value).__mro__)


def _unwrapped(value: Any) -> Any:
    """Return the function inside decorators, such as those of compilers."""
    with suppress(ValueError, AttributeError):
        return inspect.unwrap(value)
    return value


def accepts(function: Any, count: int, /, **named: Any) -> bool:
    """Return whether a function can be called with this number of positional arguments and these named ones."""
    try:
        with suppress(ValueError):  # the function has no signature
            inspect.signature(function).bind(*range(count), **named)
    except TypeError:
        return False
    return True


def _named(value: Any) -> str:
    if isinstance(value, type):
        return f"the class {value.__module__}.{value.__qualname__}"
    if inspect.isroutine(value):
        return f"the {'function' if inspect.isfunction(value) else 'builtin or method'} {value.__name__}"
    return f"an object of the class {type(value).__module__}.{type(value).__qualname__}"
