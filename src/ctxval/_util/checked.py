"""Arguments of public functions and constructors, checked against their annotations before the body runs.

``@checked`` decorates a function or a class; ``@part`` includes it. Every constructor refuses a wrong value in the same
words, so no body repeats the check. An annotation that only type checkers can resolve checks nothing.
"""

from __future__ import annotations

import functools
import inspect
import reprlib
import sys
import types
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin

import numpy as np

from ctxval.errors import InputError, UnknownNameError

Checkable = TypeVar("Checkable", bound=Callable[..., Any])


class Must(NamedTuple):
    """The range of a number, ``Annotated[float, Must(...)]``: what it must be, for the message, and whether it is."""

    be: str
    hold: Callable[[Any], bool]


PositiveInt = Annotated[int, Must("a positive integer", lambda value: 1 <= value < 2**53)]
NonNegativeInt = Annotated[int, Must("an integer >= 0", lambda value: value >= 0)]
PositiveFloat = Annotated[float, Must("a positive number", lambda value: 0 < value < np.inf)]
NonNegativeFloat = Annotated[float, Must("a finite number >= 0", lambda value: 0 <= value < np.inf)]
FiniteFloat = Annotated[float, Must("a finite number", lambda value: abs(value) < np.inf)]
Seconds = Annotated[float, Must("a positive number of seconds", lambda value: 0 < value < np.inf)]
TimeLimit = Annotated[float, Must("a positive number of seconds, or infinity", lambda value: value > 0)]
Norm = Annotated[float, Must("1, 2 or inf", lambda value: value in (1, 2, np.inf))]
Probability = Annotated[float, Must("strictly between 0 and 1", lambda value: 0 < value < 1)]

_SHOWN = reprlib.Repr()
_SHOWN.maxstring = _SHOWN.maxother = 200

_PLAIN: dict[Any, tuple[str, tuple[type, ...]]] = {
    bool: ("True or False", (bool, np.bool_)),
    int: ("an integer", (int, np.integer)),
    float: ("a number", (int, float, np.integer, np.floating)),
    str: ("a text", (str,)),
}


def checked(made: Checkable) -> Checkable:
    """Check the arguments of a function or of a class's own constructor at each call, unless they are the default."""
    function: Any = vars(made).get("__init__") if isinstance(made, type) else made
    if function is None:
        return made  # the constructor is that of a base class
    signature = inspect.signature(function)

    @functools.cache
    def annotations() -> dict[str, Any]:
        """Return those of parameters; those of the fields of a dataclass are read where the field is defined."""
        variadic = {inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL}
        plain = {name for name, parameter in signature.parameters.items() if parameter.kind not in variadic}
        known = {}
        for name, annotation in function.__annotations__.items():
            homes = [cls for cls in getattr(made, "__mro__", ()) if name in vars(cls).get("__annotations__", {})]
            place = vars(sys.modules[homes[0].__module__]) if homes else function.__globals__
            with suppress(NameError, AttributeError, TypeError):  # an annotation for type checkers alone
                if name in plain:
                    known[name] = eval(annotation, dict(place)) if isinstance(annotation, str) else annotation
        return known

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError:
            return function(*args, **kwargs)  # raises Python's own error
        for name, value in given.items():
            if name in annotations() and value is not signature.parameters[name].default:
                require(name, annotations()[name], value)
        return function(*args, **kwargs)

    if not isinstance(made, type):
        return call  # type: ignore[return-value]
    setattr(made, "__init__", call)  # noqa: B010
    return made


def require(name: str, annotation: Any, value: Any) -> Any:
    if get_origin(annotation) is Literal and isinstance(value, str) and value not in get_args(annotation):
        raise UnknownNameError.among(name, value, get_args(annotation))
    wanted = _missed(annotation, value)
    if wanted:
        part = getattr(value, "__dict__", {}).get(name)  # that of an experiment, for example
        meant = "" if part is None or _missed(annotation, part) else f": give its .{name}"
        raise InputError(f"{name} must be {wanted}, got {_SHOWN.repr(value)}{meant}.")
    return value


def require_known(kind: str, names: Iterable[str], known: Collection[str]) -> None:
    for name in names:
        if name not in known:
            raise UnknownNameError.among(kind, name, known)


def _missed(annotation: Any, value: Any) -> str:
    """Return what a value must be; empty if it is that, or if nothing is known of the annotation."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        base, must = arguments[0], arguments[1]
        return must.be if _missed(base, value) or not must.hold(value) else ""
    if annotation in _PLAIN:
        wanted, kinds = _PLAIN[annotation]
        confused = isinstance(value, bool | np.bool_) and annotation in (int, float)
        beyond = annotation is float and isinstance(value, int) and abs(value) > sys.float_info.max
        return wanted if confused or beyond or not isinstance(value, kinds) or value != value else ""
    if origin in (Union, types.UnionType):
        missed = [_missed(alternative, value) for alternative in arguments]
        given = [text for text in missed if text != "None"]  # which is the default, if it is allowed
        return " or ".join(dict.fromkeys(given)) if all(missed) else ""
    if origin is Literal:
        return "" if isinstance(value, str) and value in arguments else f"one of {', '.join(map(repr, arguments))}"
    if annotation in (None, types.NoneType):
        return "" if value is None else "None"
    if origin is Callable:
        return "" if callable(value) else "a function"
    cls = origin or annotation
    unknown = not isinstance(cls, type) or cls is object or cls.__module__.startswith("numpy")
    return "" if unknown else _missed_class(cls, arguments, value)


def _missed_class(cls: type, arguments: tuple[Any, ...], value: Any) -> str:
    if issubclass(cls, Mapping):
        if not isinstance(value, Mapping):
            first = value[0] if isinstance(value, list | tuple) and value else ""
            name = first if isinstance(first, str) and first.isidentifier() else "name"
            return f"a table of names and values, such as {{ {name} = ... }}"
        of_items = ((key, _missed(arguments[1], item)) for key, item in value.items()) if arguments else ()
        return next((f"a table of which each value is {be}, also {key!r}" for key, be in of_items if be), "")
    if cls in (list, tuple) or cls.__name__ == "Sequence":
        if isinstance(value, str | bytes | Mapping) or not (hasattr(value, "__len__") and hasattr(value, "__iter__")):
            return "a list"
        kinds = arguments if cls is tuple and ... not in arguments else (arguments or (Any,))[:1] * len(value)
        if len(kinds) != len(value):
            return f"a list of {len(kinds)} values"
        missed = next(filter(None, map(_missed, kinds, value)), "")
        return missed and f"a list of which each item is {missed}"
    public = {name: method for name, method in vars(cls).items() if not name.startswith("_") or name == "__call__"}
    required = {
        name: method
        for name, method in public.items()
        if getattr(cls, "_is_protocol", False) and inspect.isfunction(method)
    }
    # The methods of a class want an object of it first.
    unbound = isinstance(value, type) and any(
        inspect.isfunction(inspect.getattr_static(value, name, None)) for name in required
    )
    try:
        if isinstance(value, cls) and not unbound:
            return ""
    except TypeError:  # a protocol that cannot be checked, which no plain value fulfils
        if not required or not isinstance(value, str | int | float | list | dict):
            return ""
    methods = [f"{name}({', '.join([*inspect.signature(method).parameters][1:])})" for name, method in required.items()]
    article = "an" if cls.__name__[0] in "AEIO" else "a"
    instance = ", an object and no class" if unbound else ""
    return f"{article} {cls.__name__}{' with ' if methods else ''}{' and '.join(methods)}{instance}"
