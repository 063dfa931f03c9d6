"""An extension of Sphinx for the manual: pages from docstrings, links out of this folder, and formulas.

The pages of the manual are also read in a repository browser. Their links are therefore paths of files, also of files
outside of this folder.
"""

from __future__ import annotations

import importlib
import inspect
import posixpath
import re
import sys
from functools import cache
from pathlib import Path
from types import GenericAlias
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.ext import autosummary
from sphinx.pycode import ModuleAnalyzer

import ctxval

DOCS = Path(__file__).parent
ROOT = DOCS.parent
API = "reference/api"
FIRST = ("systems", "models", "controllers", "distances", "searches", "certificates")
MODULES = (
    "ctxval",
    *(f"ctxval.{ctxval._MODULES[name]}" for name in dict.fromkeys((*FIRST, *ctxval._MODULES))),
)
"""The public modules, in the order of the reference."""

COPIED = {"CONTRIBUTING.md": "contributing", "CHANGELOG.md": "changelog"}
"""Texts outside of this folder that are pages of the manual, and the names of the pages."""

LINK = re.compile(r"(?<=\]\()(?!\w+:|#)(?P<path>[^)#\s]+)(?P<anchor>#[^)\s]*)?(?=\))")


def public_names(module: str) -> list[str]:
    """Return the public names of a module: ``__all__``, or else its own functions and classes."""
    found = importlib.import_module(module)
    if hasattr(found, "__all__"):
        return list(found.__all__)
    own = (name for name, value in vars(found).items() if getattr(value, "__module__", None) == module)
    return [name for name in own if not name.startswith("_")]


def api_page(module: str) -> str:
    """Return the page of a module: a table of its classes and functions, and what each of its names is."""
    names = public_names(module)
    rows = "\n".join(f"   {name}" for name in names if not _is_constant(name, _value(module, name)))
    described = "\n\n".join(_description(module, name) for name in names)
    return (
        f"# `{module}`\n\n```{{eval-rst}}\n.. automodule:: {module}\n\n.. currentmodule:: {module}\n\n"
        f".. autosummary::\n   :nosignatures:\n\n{rows}\n```\n\n"
        f"## Descriptions\n\n```{{eval-rst}}\n.. currentmodule:: {module}\n\n{described}\n```\n"
    )


def _value(module: str, name: str) -> Any:
    return getattr(importlib.import_module(module), name)


def _is_constant(name: str, value: Any) -> bool:
    """Return whether a name is described by the docstring below it: it is no class or function, or an older name."""
    other = inspect.isclass(value) and value.__name__ != name
    return other or not callable(value) or isinstance(value, GenericAlias)


def _description(module: str, name: str) -> str:
    value = _value(module, name)
    if _is_constant(name, value):
        text = "\n".join(f"   {line}".rstrip() for line in _text_of_constant(module, name))
        return f".. py:data:: {name}\n\n{text}"
    elsewhere = documented().get(_defined(value), f"{module}.{name}") != f"{module}.{name}"
    once = "\n   :no-index:" if elsewhere else ""
    return f".. autoclass:: {name}\n   :members:{once}" if inspect.isclass(value) else f".. autofunction:: {name}{once}"


def _text_of_constant(module: str, name: str) -> list[str]:
    """Return the docstring below a constant, in the module or in the module that defines it."""
    for holder in (module, *sorted(found for found in sys.modules if found.startswith("ctxval"))):
        text = ModuleAnalyzer.for_module(holder).find_attr_docs().get(("", name))
        if text:
            return text
    return []


def _defined(value: Any) -> str:
    return f"{value.__module__}.{getattr(value, '__qualname__', '')}"


def write_pages(app: Sphinx) -> None:
    """Write the pages that are made from the code and from texts outside of this folder, if they have changed."""
    folder = DOCS / API
    folder.mkdir(parents=True, exist_ok=True)
    for module in MODULES:
        _write(folder / f"{module}.md", api_page(module))
    for source, page in COPIED.items():
        _write(DOCS / f"{page}.md", relinked((ROOT / source).read_text(), ".", page))


def _write(path: Path, text: str) -> None:
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


def relink(app: Sphinx, page: str, source: list[str]) -> None:
    """Let the links of a page out of this folder lead to pages of the manual."""
    if page not in COPIED.values():
        source[0] = relinked(source[0], posixpath.dirname(f"docs/{page}"), page)


def relinked(text: str, folder: str, page: str) -> str:
    """Return a text with links that hold inside the manual.

    Args:
        text: the text, whose links are relative to a folder.
        folder: the folder of the text, relative to the root of the repository.
        page: the name of the page, relative to this folder.
    """
    here = posixpath.dirname(page) or "."

    def replaced(link: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(folder, link["path"]))
        target = COPIED.get(path, "index" if path == "README.md" else None)
        if target is None and path.startswith("docs/") and folder != posixpath.dirname(f"docs/{page}"):
            return posixpath.relpath(path.removeprefix("docs/"), here) + (link["anchor"] or "")
        if target is None:
            return link[0]
        return posixpath.relpath(f"{target}.md", here) + (link["anchor"] or "")

    return LINK.sub(replaced, text)


@cache
def documented() -> dict[str, str]:
    """Return the public name of each object, by the name under which it is defined."""
    names: dict[str, str] = {}
    for module in MODULES:
        for name in public_names(module):
            value = _value(module, name)
            if not _is_constant(name, value) and not inspect.ismethod(value):
                names.setdefault(_defined(value), f"{module}.{name}")
    return names


def resolve(app: Sphinx, env: Any, node: Any, content: nodes.Element) -> nodes.Element | None:
    """Resolve a reference to the module that defines an object: the object is documented under its public name."""
    target = documented().get(node.get("reftarget", ""))
    if target is None or node.get("refdomain") != "py":
        return None
    return env.get_domain("py").resolve_xref(env, node["refdoc"], app.builder, "obj", target, node, content)


def without_signature(app: Sphinx, what: str, name: str, value: Any, *_: Any) -> tuple[str, None] | None:
    """Leave out the signature of a protocol: nobody calls it."""
    return ("", None) if getattr(value, "_is_protocol", False) else None


SEVERAL = re.compile(r"^(\s*:(?:ivar|param) )((?:[*\\\w]+, )+[*\\\w]+):")


def keep_together(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Keep arguments that are described together in one field; Sphinx would take the first for the type of the last."""
    lines[:] = [SEVERAL.sub(lambda found: f"{found[1]}{found[2].replace(', ', ',')}:", line) for line in lines]


ACCENT = re.compile(r"\\(hat|bar|tilde)\s*(\w)(?=[_^])")


def formula(visitor: Any, node: nodes.Element) -> None:
    """Write a formula as MathML, which browsers draw without a script."""
    block = isinstance(node, nodes.math_block)
    text = ACCENT.sub(r"{\\\1{\2}\\,}", node.astext().replace(r"\dots", r"\ldots"))  # an index stays beside its accent
    visitor.body.append(tex2mathml(text, as_block=block))
    raise nodes.SkipNode


ACCESSIBLE = (
    (re.compile('role="heading">'), 'role="heading" aria-level="2">'),
    (re.compile('<aside class="(sidebar|toc)-drawer">'), r'<aside class="\1-drawer" aria-label="\1">'),
    (re.compile("<pre>"), '<pre tabindex="0">'),  # the keyboard scrolls it
    (re.compile(r'(<article role="main" id="furo-main-content">\s*)<noscript>'), r"\1<h1>Search</h1><noscript>"),
    (re.compile(r'<dl>((?:\n<dd><em class="sig-param">.*</dd>)+)\n</dl>'), r'<ul class="signature">\1\n</ul>'),
    (re.compile(r'<dd>(<em class="sig-param">.*)</dd>'), r"<li>\1</li>"),
)
"""What axe-core misses in pages of Sphinx and of the theme, and what takes its place."""


def make_accessible(app: Sphinx, error: Exception | None) -> None:
    """Replace in the built pages what a reader of the screen or a keyboard does not reach."""
    for path in Path(app.outdir).rglob("*.html"):
        text = path.read_text()
        for pattern, replacement in ACCESSIBLE:
            text = pattern.sub(replacement, text)
        _write(path, text)


def setup(app: Sphinx) -> dict[str, Any]:
    """Add this extension to Sphinx."""
    app.connect("builder-inited", write_pages)
    app.connect("source-read", relink)
    app.connect("missing-reference", resolve)
    app.connect("autodoc-process-signature", without_signature)
    app.connect("autodoc-process-docstring", keep_together, priority=900)  # after napoleon
    autosummary.WELL_KNOWN_ABBREVIATIONS = (*autosummary.WELL_KNOWN_ABBREVIATIONS, "eq.", "eqs.")
    app.connect("build-finished", make_accessible)
    app.add_html_math_renderer("mathml", inline_renderers=(formula, None), block_renderers=(formula, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
