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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

_SKIPPED = ("ctx", "kind", "type_comment", "returns", "annotation")
"""Fields of a syntax tree that do not affect the computation."""

_Function = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda


class _Global(NamedTuple):
    """A name in a module of users, whose definition is source, whatever its value is."""

    module: types.ModuleType
    name: str


def source_digest(value: Any) -> str | None:
    """Return a digest of the source of all functions, classes and constants of users that an object reaches.

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
    """Return the digests of what an object is made of, if that is source of users, and the objects that it uses."""
    match item:
        case _Global(module, name):
            known = _read(None if is_library(module) else getattr(module, "__file__", None))
            body = known.assigned.get(name, [])
            used = [vars(module)[name], *known.imported(item), *_globals(module, _loaded(body))]
            return [_hashed(_plain(node)) for node in body], used
        case functools.partial():
            return [], [item.func, *item.args, *item.keywords.values()]
        case types.MethodType():
            return [], [item.__func__, item.__self__]
        case types.FunctionType():
            used = [*enclosed(item), *(item.__defaults__ or ()), *(item.__kwdefaults__ or {}).values()]
            if is_library(item):
                return [], used
            node = _function_node(item.__code__)
            # Without source, its constants are its identity, because instructions differ between versions of Python.
            digest = _constants(item.__code__) if node is None else _hashed(_plain(node, top=True))
            return [digest], used + _globals(sys.modules.get(item.__module__), _names(item.__code__))
        case type():
            if is_library(item):
                return [], []
            functions = [function for member in vars(item).values() for function in _functions_in(member)]
            home = sys.modules.get(item.__module__)
            tree = _read(getattr(home, "__file__", None)).classes.get(item.__qualname__)
            if tree is None:
                return [""], [*item.__bases__, *functions]
            # The functions of the class without generated ones, and the definitions that its body uses.
            written = [function for function in functions if not function.__code__.co_filename.startswith("<")]
            return [_hashed(_plain(tree, top=True))], [*item.__bases__, *written, *_globals(home, _loaded([tree]))]
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


def _functions_in(member: Any) -> list[types.FunctionType]:
    """Return the Python functions of a class attribute: a method, the functions of a property, wrapped functions."""
    inner = (getattr(member, name, None) for name in ("fget", "fset", "__func__", "func", "__wrapped__"))
    functions = [function for wrapped in inner if callable(wrapped) for function in _functions_in(wrapped)]
    return [member, *functions] if isinstance(member, types.FunctionType) else functions


def _globals(module: types.ModuleType | None, names: set[str]) -> list[_Global]:
    """Return the definitions behind the names that source in a module uses, also those in users' modules."""
    if module is None:
        return []
    used = [_Global(module, name) for name in sorted(names & vars(module).keys())]
    values = (vars(module)[item.name] for item in used)
    modules = [value for value in values if inspect.ismodule(value) and not is_library(value)]
    return [*used, *(_Global(inner, name) for inner in modules for name in sorted(names & vars(inner).keys()))]


def _names(code: types.CodeType) -> set[str]:
    inner = (_names(item) for item in code.co_consts if isinstance(item, types.CodeType))
    return set(code.co_names).union(*inner)


def _loaded(nodes: Iterable[ast.AST]) -> set[str]:
    names: set[str] = set()
    for node in nodes:
        match node:
            case ast.Name(id=name) | ast.Attribute(attr=name):
                names.add(name)
        names |= _loaded(child for child in ast.iter_child_nodes(node) if not isinstance(child, _Function))
    return names


def _constants(code: types.CodeType) -> str:
    constants = [
        _constants(item)
        if isinstance(item, types.CodeType)
        else repr(sorted(map(repr, item)) if isinstance(item, frozenset) else item)
        for item in code.co_consts
    ]
    return _hashed((code.co_names, constants))


@dataclass
class _Source:
    functions: dict[str, list[_Function]] = field(default_factory=dict)
    classes: dict[str, ast.AST] = field(default_factory=dict)
    assigned: dict[str, list[ast.stmt]] = field(default_factory=dict)
    imports: dict[str, tuple[str, str]] = field(default_factory=dict)

    def imported(self, item: _Global) -> list[_Global]:
        source, name = self.imports.get(item.name, ("", ""))
        package = item.module.__package__ or item.module.__name__
        module = sys.modules.get(importlib.util.resolve_name(source, package)) if source else None
        return [_Global(module, name)] if module is not None and name in vars(module) else []


def _read(file: str | None) -> _Source:
    if file is None:
        return _Source()
    linecache.checkcache(file)
    return _parsed("".join(linecache.getlines(file)))


@functools.lru_cache(maxsize=64)
def _parsed(source: str) -> _Source:
    definitions = _Source()
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError):
        return definitions

    def visit(parent: ast.AST, path: str) -> None:
        for node in ast.iter_child_nodes(parent):
            inside = path
            match node:
                case ast.ClassDef(name=name):
                    definitions.classes[f"{path}{name}"] = node
                    inside = f"{path}{name}."
                case ast.Lambda():
                    definitions.functions.setdefault("<lambda>", []).append(node)
                case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                    definitions.functions.setdefault(name, []).append(node)
                    inside = f"{path}{name}.<locals>."
                case ast.ImportFrom(names=names):
                    place = "." * node.level + (node.module or "")
                    definitions.imports.update((alias.asname or alias.name, (place, alias.name)) for alias in names)
            visit(node, inside)

    visit(tree, "")
    for statement in tree.body:
        for part in ast.walk(statement):
            match statement, part:
                case ast.Assign() | ast.AnnAssign() | ast.AugAssign(), ast.Name(id=name, ctx=ast.Store()):
                    definitions.assigned.setdefault(name, []).append(statement)
    return definitions


def _function_node(code: types.CodeType) -> ast.AST | None:
    matching = []
    for node in _read(code.co_filename).functions.get(code.co_name, ()):
        if isinstance(node, ast.Lambda):
            matches = all(_covers(node.body, place) for place in code.co_positions())
        else:
            matches = code.co_firstlineno == min(part.lineno for part in (node, *node.decorator_list))
        if matches:
            matching.append(node)
    return min(matching, key=lambda node: sum(1 for _ in ast.walk(node)), default=None)


def _covers(node: ast.expr, place: tuple[int | None, int | None, int | None, int | None]) -> bool:
    match place:
        # An instruction at one place was added by the compiler, such as the one at the start of a function.
        case (int(line), int(last_line), int(column), int(last)) if (line, column) != (last_line, last):
            end = (node.end_lineno or 0, node.end_col_offset or 0)
            return (node.lineno, node.col_offset) <= (line, column) and (last_line, last) <= end
    return True


def _is_text(node: ast.AST) -> bool:
    """Return whether a statement is a constant that stands alone, which documents what is beside it."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _hashed(tree: Any) -> str:
    return hashlib.sha256(repr(tree).encode()).hexdigest()[:16]


def _plain(node: Any, *, top: bool = False, bare: bool = False) -> Any:
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
        if empty or name in _SKIPPED or (top and name == "name"):
            continue
        if documented and name == "body" and _is_text(value[0]):
            value = value[1:]
        fields.append((name, _plain(value, bare=bare)))
    return (type(node).__name__, *fields)
