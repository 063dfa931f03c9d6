"""Settings of Sphinx for the manual: `make docs` writes docs/_build/html."""

from __future__ import annotations

import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))  # manual_pages

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy is imported

from ctxval import __version__

project = "ctxval"
copyright = "the ctxval developers"
release = version = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
    "manual_pages",
]
exclude_patterns = ["_build", "auto_examples/**/*.ipynb", "auto_examples/**/*.py", "auto_examples/**/*.zip"]

# Pages
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4  # the same anchors as those of a repository browser
smartquotes_action = "qe"  # "--option" stays as it is
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
html_theme = "furo"
html_title = f"ctxval {__version__}"
html_math_renderer = "mathml"  # of manual_pages: no page needs a network
html_static_path = ["_static"]
html_css_files = ["manual.css"]
html_copy_source = False
html_show_sourcelink = False
copybutton_prompt_text = "$ "
copybutton_only_copy_prompt_lines = True

# Docstrings
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_type_aliases = {"Array": "ctxval.Array", "ArrayLike": "ArrayLike"}
autosummary_generate = False  # the pages of the API have tables and descriptions in one place
napoleon_numpy_docstring = False
napoleon_use_ivar = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100

sphinx_gallery_conf = {
    "examples_dirs": "../examples/gallery",
    "gallery_dirs": "auto_examples",
    "filename_pattern": "/plot_",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_memory": False,
    "remove_config_comments": True,
    "within_subsection_order": "FileNameSortKey",
    "write_computation_times": False,
    "show_signature": False,
    "image_scrapers": ("matplotlib",),
}
