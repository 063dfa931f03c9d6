"""How large the source is, as numbers that can be compared between revisions.

``python benchmarks/source_counts.py 6387a59`` prints those of a revision beside those of this checkout. Lines are all
lines of Python files; lines of docstrings and comments are among them.
"""

from __future__ import annotations

import argparse
import ast
import re
import statistics
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


if __name__ == "__main__":
    main()
