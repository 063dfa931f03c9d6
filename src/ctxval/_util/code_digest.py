"""Digests of source: of the functions, classes and constants of users that an object reaches, and of modules."""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
import inspect
import linecache
import sys
import sysconfig
import types
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

_SKIPPED = ("ctx", "kind", "type_comment", "returns", "annotation")
"""Fields of a syntax tree that do not affect the computation."""


class _Global(NamedTuple):
    """A name in a module of users, whose definition is source, whatever its value is."""

    module: types.ModuleType
    name: str


def source_digest(value: Any) -> str | None:
    """Return a digest of the top-level statements of users' modules that define an object, and what these use.

    They are reached by names, closures, attributes and base classes. No value is part of the digest, because it may be
    a secret. Returns None if the object reaches none, for example if it belongs to a library.
    """
    reached: dict[Any, Any] = {}
    digests: set[str] = set()
    waiting = [value]
    while waiting:
        item = waiting.pop()
        key = item if isinstance(item, _Global) else id(item)
        if key not in reached:
            reached[key] = item  # also keeps it alive, so that its id stays its own
            source, used = _source_and_uses(item)
            digests.update(source)
            waiting += used
    return _hashed(sorted(digests)) if digests else None


def module_digest(source: str) -> str:
    """Return a digest of a module's syntax tree, without its imports, docstrings, annotations and layout."""
    return _hashed(_plain(ast.parse(source), bare=True))


def is_own(value: Any) -> bool:
    """Return whether a module, function or class belongs to this package."""
    name = value.__name__ if inspect.ismodule(value) else getattr(value, "__module__", None) or ""
    return str(name).partition(".")[0] == __name__.partition(".")[0]


def is_library(value: Any) -> bool:
    """Return whether a module, function or class belongs to an installed package or to Python, or has no file."""
    module = value if inspect.ismodule(value) else sys.modules.get(getattr(value, "__module__", None) or "")
    if module is None or module.__name__ == "__main__":
        return False
    file = getattr(module, "__file__", None)
    if file is None or is_own(module) or {"site-packages", "dist-packages"} & set(Path(file).parts):
        return True
    return any(Path(file).is_relative_to(folder) for folder in _standard_library())


@functools.cache
def _standard_library() -> list[str]:
    return [sysconfig.get_path(name) for name in ("stdlib", "platstdlib")]


def enclosed(function: types.FunctionType) -> list[Any]:
    """Return what a function closes over; None for a variable that has no value yet."""
    contents: list[Any] = []
    for cell in function.__closure__ or ():
        try:
            contents.append(cell.cell_contents)
        except ValueError:
            contents.append(None)
    return contents


def _source_and_uses(item: Any) -> tuple[list[str], list[Any]]:
    """Return the digests of the statements that define an object, if they are users', and the objects that it uses."""
    match item:
        case _Global(module, name):
            source = _read(None if is_library(module) else getattr(module, "__file__", None))
            digests, used = _of_statements(module, source.assigned.get(name, []))
            return digests, [vars(module)[name], *source.imported(item), *used]
        case functools.partial():
            return [], [item.func, *item.args, *item.keywords.values()]
        case types.MethodType():
            return [], [item.__func__, item.__self__]
        case types.FunctionType(__code__=code):
            values = [*enclosed(item), *(item.__defaults__ or ()), *(item.__kwdefaults__ or {}).values()]
            if is_library(item):
                return [], values
            around = [each for each in _read(code.co_filename).body if code.co_firstlineno in _lines(each)]
            digests, used = _of_statements(sys.modules.get(item.__module__), around)
            # Without source, its constants are its identity, because instructions differ between versions of Python.
            return digests or [_constants(code)], [*values, *used]
        case type() if is_library(item):
            return [], []
        case type():
            home, name = sys.modules.get(item.__module__), item.__qualname__.partition(".")[0]
            body = _read(getattr(home, "__file__", None)).body
            digests, used = _of_statements(home, [each for each in body if getattr(each, "name", None) == name])
            return digests or [""], used or [*item.__bases__, *filter(inspect.isfunction, vars(item).values())]
        case types.ModuleType():
            return [], []
    if type(item) in (list, tuple, dict):
        items = list(item.values() if type(item) is dict else item)
        return [], items if len(items) <= 100 else []  # a longer one holds data
    attributes = getattr(item, "__dict__", None)
    if attributes is None:
        return [], [type(item)]
    if is_library(type(item)) and not is_own(type(item)):
        return [], [attributes["__wrapped__"]] if "__wrapped__" in attributes else []  # e.g. functools.cache
    return [], [type(item), *attributes.values()]


def _of_statements(module: types.ModuleType | None, statements: Iterable[ast.stmt]) -> tuple[list[str], list[Any]]:
    """Return digests of statements in a module, and the definitions that they use there and in users' modules."""
    listed, known = list(statements), {} if module is None else vars(module)
    nodes = [node for each in listed for node in ast.walk(each)]
    names = {node.id for node in nodes if isinstance(node, ast.Name)}
    names |= {node.attr for node in nodes if isinstance(node, ast.Attribute)}
    used = [_Global(module, name) for name in sorted(names & known.keys()) if module is not None]
    for inner in (known[each.name] for each in list(used)):
        if inspect.ismodule(inner) and not is_library(inner):
            used += [_Global(inner, name) for name in sorted(names & vars(inner).keys())]
    return [_hashed(_plain(each)) for each in listed], used


def _lines(statement: ast.stmt) -> range:
    first = min(each.lineno for each in (statement, *getattr(statement, "decorator_list", ())))
    return range(first, (statement.end_lineno or first) + 1)


def _constants(code: types.CodeType) -> str:
    def text(each: Any) -> str:
        if isinstance(each, types.CodeType):
            return _constants(each)
        return repr(sorted(map(repr, each)) if isinstance(each, frozenset) else each)

    return _hashed((code.co_names, [text(each) for each in code.co_consts]))


class _Source(NamedTuple):
    """The statements of a module, those that assign a name, and where names are imported from."""

    body: list[ast.stmt]
    assigned: dict[str, list[ast.stmt]]
    imports: dict[str, tuple[str, str]]

    def imported(self, item: _Global) -> list[_Global]:
        source, name = self.imports.get(item.name, ("", ""))
        package = item.module.__package__ or item.module.__name__
        module = sys.modules.get(importlib.util.resolve_name(source, package)) if source else None
        return [_Global(module, name)] if module is not None and name in vars(module) else []


def _read(file: str | None) -> _Source:
    if file is None:
        return _Source([], {}, {})
    linecache.checkcache(file)
    return _parsed("".join(linecache.getlines(file)))


@functools.lru_cache(maxsize=64)
def _parsed(text: str) -> _Source:
    source = _Source([], {}, {})
    try:
        source.body.extend(ast.parse(text).body)
    except (SyntaxError, ValueError, RecursionError):
        return source
    for statement in source.body:
        for node in ast.walk(statement):
            match statement, node:
                case ast.Assign() | ast.AnnAssign() | ast.AugAssign(), ast.Name(id=name, ctx=ast.Store()):
                    source.assigned.setdefault(name, []).append(statement)
                case _, ast.ImportFrom(names=names):
                    place = "." * node.level + (node.module or "")
                    source.imports.update((alias.asname or alias.name, (place, alias.name)) for alias in names)
    return source


def _is_text(node: ast.AST) -> bool:
    """Return whether a statement is a constant that stands alone, which documents what is beside it."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _hashed(tree: Any) -> str:
    return hashlib.sha256(repr(tree).encode()).hexdigest()[:16]


def _plain(node: Any, *, bare: bool = False) -> Any:
    """Return a tree as tuples without docstrings, bare also without imports and texts that stand alone.

    Empty fields are left out, so that every version of Python gives the same tuples.
    """
    if isinstance(node, list):
        return [_plain(item, bare=bare) for item in node]
    if not isinstance(node, ast.AST):
        return (type(node).__name__, repr(node))
    documented = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
    fields = []
    for name, value in ast.iter_fields(node):
        if bare and isinstance(value, list):
            value = [part for part in value if not (isinstance(part, ast.Import | ast.ImportFrom) or _is_text(part))]
        empty = value == [] or (value is None and not isinstance(node, ast.Constant))
        if empty or name in _SKIPPED:
            continue
        if documented and name == "body" and _is_text(value[0]):
            value = value[1:]
        fields.append((name, _plain(value, bare=bare)))
    return (type(node).__name__, *fields)
