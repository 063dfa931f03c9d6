"""How large the source is, as numbers that can be compared between revisions.

``python benchmarks/source_counts.py 6387a59`` prints those of a revision beside those of this checkout. Lines are all
lines of Python files; lines of docstrings and comments are among them.

Branches on suites, outputs and quantiles are conditions, and operands of ``and``, ``or`` and ``not``, that ask for the
truth of a value of one of these names, or whether it is None.

Assertions on sentences are the texts with more than two words of prose that tests compare with: operands in ``assert``,
the argument ``match``, and facts of ``tests/facts.py``. Those of parametrised tests and of loops count once each.
"""

from __future__ import annotations

import argparse
import ast
import re
import statistics
from collections.abc import Iterator
from pathlib import Path

from landed import tree_of

PATTERNS = {
    "raise": r"\braise\b",
    "isinstance": r"\bisinstance\(",
    "except": r"^\s*except\b",
    "except, broad": r"^\s*except( (Base)?Exception\b|:)",
    "hand-written reprs": r"def __repr__",
    "docstrings with Raises:": r"^\s*Raises:",
    "functions require_*": r"def _?require_",
    "locals named found, one, own, said, told": r"^\s+(found|one|own|said|told)(: [^=]+)? = ",
}


PROSE = re.compile(r"(?<![\w./'-])[A-Za-z][a-z]+(?![\w/_(=-]|\.\w)")
"""Words: no names with digits, dots or underscores, no options, paths or calls."""
LOOKING = {"startswith", "endswith", "count", "index", "find", "search", "match", "fullmatch", "findall", "escape"}
LOOKING |= {"all", "any", "set", "sorted", "list", "tuple", "dict", "zip"}
"""Calls whose texts are compared, too."""
NAMING = {"refuses", "assert_names"}


def _called(node: ast.Call) -> str:
    return node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")


def _compared(node: ast.AST) -> Iterator[ast.AST]:
    """Yield an expression and its parts, without the arguments of calls that compute something."""
    yield node
    if isinstance(node, ast.JoinedStr | ast.Constant):
        return
    if isinstance(node, ast.Call) and _called(node) not in LOOKING:
        return
    for child in [node.value] if isinstance(node, ast.Subscript) else ast.iter_child_nodes(node):  # a key is a name
        yield from _compared(child)


def _text(node: ast.AST) -> str:
    parts = node.values if isinstance(node, ast.JoinedStr) else [node]
    text = " 1 ".join(part.value for part in parts if isinstance(part, ast.Constant) and isinstance(part.value, str))
    return "" if "\n" in text.strip() else text  # files and code have several lines


def _named(function: ast.AST, names: set[str]) -> Iterator[ast.AST]:
    """Yield the values that names have in a function: assigned, of a loop, or parametrised."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            target, values = node.targets[0], [node.value]
        elif isinstance(node, ast.For | ast.comprehension) and isinstance(node.iter, ast.List | ast.Tuple):
            target, values = node.target, node.iter.elts
        elif isinstance(node, ast.Call) and _called(node) == "parametrize" and isinstance(node.args[1], ast.List):
            target, values = node.args[0], node.args[1].elts
        else:
            continue
        places = target.elts if isinstance(target, ast.Tuple | ast.List) else [target]
        for i, place in enumerate(places):
            if getattr(place, "id", getattr(place, "value", None)) in names:
                whole = not isinstance(target, ast.Tuple | ast.List)
                for value in values:
                    row = getattr(value, "elts", getattr(value, "args", []))
                    yield from [value] if whole else row[i : i + 1]


def sentence_assertions(text: str) -> list[tuple[int, str]]:
    """Return the lines of a test file, and the sentences in them, that its tests compare with."""
    found: dict[tuple[int, int], str] = {}
    for scope in ast.parse(text).body:
        asserted = [node.test for node in ast.walk(scope) if isinstance(node, ast.Assert)]
        for call in (node for node in ast.walk(scope) if isinstance(node, ast.Call)):
            asserted += [word.value for word in call.keywords if word.arg == "match"]
            asserted += call.args if _called(call) in NAMING else []
        parts = [part for expression in asserted for part in _compared(expression)]
        names = {part.id for part in parts if isinstance(part, ast.Name)}
        parts += [part for value in _named(scope, names) for part in _compared(value)]
        for part in parts:
            if isinstance(part, ast.Constant | ast.JoinedStr) and len(PROSE.findall(_text(part))) > 2:
                found[part.lineno, part.col_offset] = _text(part)
    return [(line, said) for (line, _), said in sorted(found.items())]


def counts_of_tests(tests: Path) -> dict[str, int]:
    """Return the counts of a folder of tests."""
    texts = [path.read_text() for path in sorted(tests.rglob("*.py"))]
    return {
        "lines of tests": sum(text.count("\n") for text in texts),
        "assertions on sentences": sum(len(sentence_assertions(text)) for text in texts),
    }


def is_numeric(value: ast.expr) -> bool:
    """Return whether an expression is a number, or a tuple or an array of numbers."""
    match value:
        case ast.Constant():
            return type(value.value) in (int, float)
        case ast.UnaryOp():
            return is_numeric(value.operand)
        case ast.BinOp():
            return is_numeric(value.left) and is_numeric(value.right)
        case ast.Tuple() | ast.List() | ast.Set():
            return bool(value.elts) and all(map(is_numeric, value.elts))
        case ast.Call(func=ast.Attribute(value=ast.Name(id="np")) | ast.Name(id="range")):
            return bool(value.args) and all(map(is_numeric, value.args))
    return False


def numeric_constants(text: str) -> list[str]:
    """Return the names in capitals of a module that are numbers, or tuples or arrays of them: no fields of settings."""
    names = list[str]()
    for node in ast.parse(text).body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None and is_numeric(node.value):
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                parts = target.elts if isinstance(target, ast.Tuple) else [target]
                names += [part.id for part in parts if isinstance(part, ast.Name) and part.id.isupper()]
    return names


BRANCHING = {"suite", "outputs", "quantile"}


def _last_name(node: ast.expr) -> str:
    match node:
        case ast.NamedExpr(value=value):
            return _last_name(value)
        case ast.Attribute(attr=name) | ast.Name(id=name):
            return name.lstrip("_")
        case ast.Subscript(slice=ast.Constant(value=str(name))) | ast.Call(args=[ast.Constant(value=str(name)), *_]):
            return name
    return ""


def branches(nodes: list[ast.AST]) -> int:
    """Return how many conditions ask whether there is a suite, outputs or a quantile."""
    tested = list[ast.expr]()
    for node in nodes:
        match node:
            case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test) | ast.Assert(test=test):
                tested.append(test)
            case ast.comprehension(ifs=parts) | ast.BoolOp(values=parts):
                tested += parts
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                tested.append(operand)
            case ast.Compare(left=left, ops=[ast.Is() | ast.IsNot()]):
                tested.append(left)
    return len({id(each) for each in tested if _last_name(each) in BRANCHING})


def counts(source: Path) -> dict[str, float]:
    """Return all counts of the package in a folder ``src``."""
    texts = [path.read_text() for path in sorted(source.rglob("*.py"))]
    nodes = [node for text in texts for node in ast.walk(ast.parse(text))]
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    lengths = [(node.end_lineno or node.lineno) - node.lineno + 1 for node in functions]
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    strings = [node.body[0] for node in nodes if isinstance(node, documented) and ast.get_docstring(node) is not None]
    return {
        "lines": sum(text.count("\n") for text in texts),
        "lines of docstrings": sum((node.end_lineno or node.lineno) - node.lineno + 1 for node in strings),
        "files": len(texts),
        "functions": len(functions),
        "lines of a function, mean": round(statistics.mean(lengths), 1),
        "branches on suite, outputs, quantile": branches(nodes),
        "numeric module constants": sum(len(numeric_constants(text)) for text in texts),
        **{name: sum(len(re.findall(pattern, text, re.M)) for text in texts) for name, pattern in PATTERNS.items()},
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("revisions", nargs="*", default=["6387a59"])
    revisions = parser.parse_args().revisions
    columns = [counts(tree_of(revision) / "src") for revision in revisions]
    columns.append(counts(Path(__file__).resolve().parents[1] / "src"))
    print(f"| | {' | '.join([*revisions, 'now'])} |")
    print("|---" * (1 + len(columns)) + "|")
    for name in columns[0]:
        print(f"| {name} | {' | '.join(f'{column[name]:g}' for column in columns)} |")
    for name, number in counts_of_tests(Path(__file__).resolve().parents[1] / "tests").items():
        print(f"{name}, now: {number}")


if __name__ == "__main__":
    main()
