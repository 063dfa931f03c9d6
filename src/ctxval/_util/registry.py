"""Registries: the parts of one kind by name, built-in ones and those that installed packages add by entry points."""

from __future__ import annotations

import functools
import importlib
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from ctxval._util.checked import checked, require_known
from ctxval._util.refusals import reworded
from ctxval._util.representation import ShortRepr
from ctxval._util.texts import reason_of
from ctxval.errors import InputError, UnknownNameError

if TYPE_CHECKING:  # importlib.metadata is slow to import, and is needed only for names that are not built in
    from importlib.metadata import EntryPoint

Part = TypeVar("Part", bound=Callable[..., Any])
Made = TypeVar("Made")


@dataclass(frozen=True)
class Declaration:
    """Declares a class, or a function that makes an object, as a part that is found by name; checks its arguments.

    A part of this package is found once its package exports it in ``__all__``. Its objects show their attributes.
    """

    name: str = ""  # the name of the class by default
    _: KW_ONLY
    files: tuple[str, ...] = ()  # arguments that are paths of files
    folder: str | None = None  # the argument that is a folder, which is the experiment's by default
    functions: Mapping[str, str] = field(default_factory=dict)  # arguments that are functions: (x, u) -> x_next
    parts: Mapping[str, str] = field(default_factory=dict)  # arguments that are parts, each with its kind: synthesizer

    def __call__(self, made: Part) -> Part:
        made = checked(made)
        shown: Any = made
        if shown.__repr__ is object.__repr__:  # a class without one of its own
            shown.__repr__ = ShortRepr.__repr__
        _declarations[made] = replace(self, name=self.name or made.__name__)
        return made


part = Declaration
_declarations: dict[Any, Declaration] = {}


def declaration_of(made: Any) -> Declaration | None:
    """Return how a class or a function was declared; None if it was not. A subclass does not inherit it."""
    with suppress(TypeError):  # it cannot be hashed
        return _declarations.get(made)
    return None


class Registry(Mapping[str, Any], Generic[Made]):
    """The parts of one kind by name: a mapping of names to classes, or to functions that make an object.

    A built-in part is never replaced by one of an installed package. Installed packages are looked at only if a name
    is not built in, or if names are listed; their code is imported only if one of their parts is asked for.

    Args:
        kind: what a part is, in messages: system, model, synthesizer, distance, search, certificate, case.
        package: the package that exports the parts, unless modules are given; the group of the entry points.
        method: the method that each part has; None if parts are plain functions.
        modules: built-in parts that are imported when they are asked for: name -> ``module:attr``.
    """

    def __init__(
        self, kind: str, package: str, *, method: str | None = None, modules: Mapping[str, str] | None = None
    ) -> None:
        self.kind, self.group, self.method, self._modules = kind, package, method, modules

    @functools.cached_property
    def _exported(self) -> dict[str, Any]:
        exported = {} if self._modules is not None else vars(sys.modules[self.group])
        parts = [exported.get(name) for name in exported.get("__all__", ())]
        named = {declared.name: made for made in parts if (declared := declaration_of(made)) is not None}
        return dict(sorted(named.items()))

    @property
    def built_in(self) -> tuple[str, ...]:
        return (*self._exported, *(self._modules or ()))

    @property
    def installed(self) -> tuple[str, ...]:
        """The names of the parts that other installed packages add, sorted; none if their metadata is damaged."""
        with suppress(InputError):
            return tuple(sorted({point.name for point in self._entry_points()} - {*self.built_in}))
        return ()

    def find(self, name: str) -> Any:
        if name in self._exported:
            return self._exported[name]
        if self._modules is not None and name in self._modules:
            module, _, attribute = self._modules[name].partition(":")
            return getattr(importlib.import_module(module), attribute)
        points = [point for point in self._entry_points() if point.name == name]
        if not points:
            raise UnknownNameError.among(self.kind, name, [*self.built_in, *self.installed])
        packages = sorted("of unknown name" if point.dist is None else str(point.dist.name) for point in points)
        if len(points) > 1:
            both = " and ".join(packages)
            raise InputError(f"two installed packages have a {self.kind} {name!r}: {both}; uninstall one of them.")
        what, value = f"the {self.kind} {name!r} of the installed package {packages[0]}", points[0].value
        try:
            made = points[0].load()
        except (Exception, SystemExit) as error:  # the module of another package may quit
            raise InputError(f"{what} cannot be loaded from {value!r}: {reason_of(error)}.") from error
        if not callable(made) or (isinstance(made, type) and not has_method(made, self.method)):
            wanted = "a function" if self.method is None else f"a class with the method {self.method}"
            raise InputError(f"{what} must be {wanted}, which {value!r} is not.")
        return made

    def summary(self, name: str) -> str:
        return (inspect.getdoc(self.find(name)) or "").partition("\n")[0].removesuffix(".")

    def make(self, name: str, /, **arguments: Any) -> Made:
        return self.require_made(name, construct(f"the {self.kind} {name}", self.find(name), arguments))

    def require_made(self, name: str, made: Any) -> Made:
        if self.method is not None and not callable(getattr(made, self.method, None)):
            got = type(made).__qualname__
            raise InputError(f"the {self.kind} {name} must have the method {self.method}; its class, {got}, has none.")
        return made  # type: ignore[no-any-return]

    def __getitem__(self, name: str) -> Any:
        try:
            return self.find(name)
        except UnknownNameError:
            raise KeyError(name) from None

    def __iter__(self) -> Iterator[str]:
        return iter((*self.built_in, *self.installed))

    def __len__(self) -> int:
        return len(self.built_in) + len(self.installed)

    def __contains__(self, name: object) -> bool:
        return name in self.built_in or name in self.installed

    def __repr__(self) -> str:
        return f"Registry({self.kind}: {', '.join(self)})"

    def _entry_points(self) -> list[EntryPoint]:
        from importlib.metadata import entry_points

        # Metadata is files of others, in which anything may stand.
        with reworded(f"the entry points of installed packages cannot be read, in which a {self.kind} is sought"):
            return list(entry_points(group=self.group))


def has_method(cls: type, method: str | None) -> bool:
    """Return whether objects of a class have a method; True if there is none to have."""
    return method is None or any(callable(vars(base).get(method)) for base in cls.__mro__)


def construct(what: str, build: Any, arguments: Mapping[str, Any], *first: Any) -> Any:
    with reworded(f"{what} cannot be made"):
        taken = inspect.signature(build).parameters
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in taken.values()):
            require_known(f"argument of {what}", arguments, taken)
        return build(*first, **arguments)
