"""The code of a function or class: a digest of its syntax tree, and the outer names that it uses."""

from __future__ import annotations

import ast
import dis
import functools
import hashlib
import inspect
import linecache
import sys
import sysconfig
import types
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_OWN = __name__.partition(".")[0]

_SKIPPED = ("ctx", "kind", "type_comment", "returns", "annotation")
"""Fields of a syntax tree that do not affect the computation."""

_Function = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda


@dataclass(frozen=True)
class Code:
    """The identity of the code of a function or class.

    Attributes:
        digest: digest of the syntax tree, without the name, docstrings, annotations and the place in the file.
        names: dotted names that the code looks up outside itself, such as ``np.sin`` and ``GAIN``.
    """

    digest: str
    names: tuple[str, ...]


def is_own(value: Any) -> bool:
    """Return whether a function or class belongs to this package."""
    return _top_level(value) == _OWN


def is_library(value: Any) -> bool:
    """Return whether a module, function or class belongs to an installed package or to Python, or has no file."""
    module = value if inspect.ismodule(value) else sys.modules.get(getattr(value, "__module__", None) or "")
    if module is None:
        return False
    if module.__name__ == "__main__":
        return False
    file = getattr(module, "__file__", None)
    return file is None or _top_level(module) == _OWN or any(Path(file).is_relative_to(place) for place in _installed())


def same_package(value: Any, other: Any) -> bool:
    """Return whether two modules, functions or classes belong to the same top-level package."""
    return _top_level(value) == _top_level(other)


def _top_level(value: Any) -> str:
    name = value.__name__ if inspect.ismodule(value) else getattr(value, "__module__", None) or ""
    return str(name).partition(".")[0]


@functools.cache
def _installed() -> tuple[Path, ...]:
    return tuple(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib"))


def code_of(value: Any) -> Code | None:
    """Return the code of a Python function or class; None if its source cannot be read."""
    node = _class_node(value) if isinstance(value, type) else _function_node(value)
    if node is None:
        return None
    digest = _hashed(_plain(node, top=True))
    loaded = _loaded_by_class(value, node) if isinstance(value, type) else _loaded(value.__code__)
    return Code(digest, tuple(sorted(name for name in _names(node) if name.partition(".")[0] in loaded)))


def module_digest(source: str) -> str:
    """Return a digest of a module's syntax tree, without its imports, docstrings, annotations and layout.

    Raises:
        SyntaxError: the source is not Python.
    """
    return _hashed(_plain(_WithoutImports().visit(ast.parse(source))))


def bytecode_digest(value: Any) -> str | None:
    """Return a digest of the names and constants of a function or class. It serves if the source cannot be read.

    The instructions are left out because they differ between versions of Python. Returns None if there is no code.
    """
    if isinstance(value, type):
        functions = {name: functions_in(item) for name, item in vars(value).items()}
        known: Any = {name: [_constants(one.__code__) for one in found] for name, found in functions.items() if found}
        return hashlib.sha256(repr(sorted(known.items())).encode()).hexdigest()[:16] if known else None
    return _constants(value.__code__) if isinstance(value, types.FunctionType) else None


def _constants(code: types.CodeType) -> str:
    constants = [
        _constants(item)
        if isinstance(item, types.CodeType)
        else repr(sorted(map(repr, item)) if isinstance(item, frozenset) else item)
        for item in code.co_consts
    ]
    return hashlib.sha256(repr((code.co_names, constants)).encode()).hexdigest()[:16]


# The syntax tree


class _WithoutImports(ast.NodeTransformer):
    """Removes imports and the texts that stand alone as statements, which document what is beside them."""

    def visit_Import(self, node: ast.Import) -> None:
        """Remove an import."""

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        """Remove an import."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        """Remove a docstring."""
        return None if isinstance(node.value, ast.Constant) else node


def _hashed(tree: Any) -> str:
    return hashlib.sha256(repr(tree).encode()).hexdigest()[:16]


def _tree(file: str | None) -> ast.Module | None:
    if file is None:
        return None
    linecache.checkcache(file)
    return _parsed("".join(linecache.getlines(file)))


@functools.lru_cache(maxsize=64)
def _parsed(source: str) -> ast.Module | None:
    try:
        return ast.parse(source) if source else None
    except (SyntaxError, ValueError, RecursionError):
        return None


def _function_node(function: Any) -> ast.AST | None:
    code = getattr(function, "__code__", None)
    tree = _tree(code.co_filename) if isinstance(code, types.CodeType) else None
    if tree is None or code is None:
        return None
    found = [node for node in ast.walk(tree) if isinstance(node, _Function) and _is_of(node, code)]
    return min(found, key=_extent, default=None)


def _is_of(node: _Function, code: types.CodeType) -> bool:
    if isinstance(node, ast.Lambda):
        return code.co_name == "<lambda>" and all(_covers(node.body, place) for place in code.co_positions())
    first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
    return code.co_name == node.name and first == code.co_firstlineno


def _covers(node: ast.expr, place: tuple[int | None, int | None, int | None, int | None]) -> bool:
    line, last_line, column, last_column = place
    if line is None or last_line is None or column is None or last_column is None:
        return True
    if (line, column) == (last_line, last_column):
        return True  # an instruction that the compiler added, such as the one at the start of a function
    end = (node.end_lineno or 0, node.end_col_offset or 0)
    return (node.lineno, node.col_offset) <= (line, column) and (last_line, last_column) <= end


def _extent(node: ast.AST) -> int:
    return sum(1 for _ in ast.walk(node))


def _class_node(cls: type) -> ast.AST | None:
    module = sys.modules.get(cls.__module__)
    tree = _tree(getattr(module, "__file__", None))
    return None if tree is None else dict(_classes(tree, "")).get(cls.__qualname__)


def _classes(node: ast.AST, path: str) -> Iterator[tuple[str, ast.AST]]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef):
            yield f"{path}{child.name}", child
            yield from _classes(child, f"{path}{child.name}.")
        elif isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            yield from _classes(child, f"{path}{child.name}.<locals>.")
        else:
            yield from _classes(child, path)


def _plain(node: Any, *, top: bool = False) -> Any:
    """Return a tree as tuples. Empty fields are left out, so that every version of Python gives the same tuples."""
    if isinstance(node, list):
        return [_plain(item) for item in node]
    if not isinstance(node, ast.AST):
        return (type(node).__name__, repr(node))
    fields = []
    for name, value in ast.iter_fields(node):
        empty = value == [] or (value is None and not isinstance(node, ast.Constant))
        if empty or name in _SKIPPED or (top and name == "name"):
            continue
        fields.append((name, _plain(_without_docstring(node, value) if name == "body" else value)))
    return (type(node).__name__, *fields)


def _without_docstring(node: ast.AST, body: Any) -> Any:
    documented = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and isinstance(body, list)
    if documented and body and isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant):
        return body[1:]
    return body


def _loaded(code: types.CodeType) -> set[str]:
    """Return the global names that a function and the functions inside it look up."""
    names = {step.argval for step in dis.get_instructions(code) if step.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    inner = (_loaded(item) for item in code.co_consts if isinstance(item, types.CodeType))
    return names.union(*inner)


def _loaded_by_class(cls: type, node: ast.AST) -> set[str]:
    functions = [function for item in vars(cls).values() for function in functions_in(item)]
    methods = (_loaded(function.__code__) for function in functions)
    return _loaded_outside_functions(node).union(*methods)


def _loaded_outside_functions(node: ast.AST) -> set[str]:
    found = {node.id} if isinstance(node, ast.Name) else set()
    inner = (_loaded_outside_functions(n) for n in ast.iter_child_nodes(node) if not isinstance(n, _Function))
    return found.union(*inner)


def functions_in(item: Any) -> list[types.FunctionType]:
    """Return the Python functions of a class attribute: a method, the functions of a property, wrapped functions."""
    found: list[types.FunctionType] = []
    seen: list[Any] = []
    waiting = [item]
    while waiting:
        one = waiting.pop()
        if any(one is other for other in seen):
            continue
        seen.append(one)
        if isinstance(one, types.FunctionType):
            found.append(one)
        inner = (getattr(one, name, None) for name in ("fget", "fset", "__func__", "func", "__wrapped__"))
        waiting.extend(each for each in inner if callable(each))
    return found


def _names(node: ast.AST) -> set[str]:
    found = {name for child in _computing(node) if (name := _dotted(child)) is not None}
    # "np.linalg" and "np" are left out if "np.linalg.norm" is there.
    return {name for name in found if not any(other.startswith(f"{name}.") for other in found)}


def _computing(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a node and all nodes below it, except annotations."""
    yield node
    for field, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and field not in _SKIPPED:
                yield from _computing(child)


def _dotted(node: ast.AST) -> str | None:
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        before = _dotted(node.value)
        return None if before is None else f"{before}.{node.attr}"
    return None
