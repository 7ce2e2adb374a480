# SPDX-License-Identifier: Apache-2.0
"""Sphinx configuration of the documentation site; `make site` builds it into build/site.

The source folder is the root of the repository, so that a link between two Markdown files leads to
the same place on the site and in the repository. The order of the pages is that of the links in
docs/README.md and in the README.md of each folder (`tools/site_pages.py`).
"""

import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "src")]  # with the code of this folder, installed or not
os.environ["COLUMNS"] = "100"  # width of what examples print

import loopcal  # noqa: E402

project = "loopcal"
author = copyright = "The loopcal developers"  # noqa: A001
version = release = loopcal.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
    "tools.site_pages",
]
root_doc = "docs/README"
include_patterns = ["docs/**", "README.md", "ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md",
                    "SECURITY.md", "benchmarks/README.md", "evidence/README.md", "native/README.md",
                    "examples/*/README.md"]  # fmt: skip
exclude_patterns = [".*", "build", "dist", "runs", "src", "tests", "tools", "constraints",
                    "docs/gallery", "docs/evidence"]  # fmt: skip
smartquotes = False  # `--hold-out` keeps its hyphens
default_role = "py:obj"  # names in single backticks, as the docstrings have them

# --- Markdown
myst_heading_anchors = 4
myst_links_external_new_tab = False

# --- Python and commands
autodoc_typehints = "signature"
autodoc_type_aliases = {
    name: name
    for name in ("ArrayLike", "BoolArray", "Figure", "FloatArray", "IntArray", "Progress", "Rule")
}
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88
add_module_names = False
python_use_unqualified_type_names = True

# --- gallery
sphinx_gallery_conf = {
    "examples_dirs": ["docs/gallery"],
    "gallery_dirs": ["docs/generated/gallery"],
    "filename_pattern": r".*\.py$",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_signature": False,
    "remove_config_comments": True,
    "write_computation_times": False,
    "thumbnail_size": (420, 280),
    "image_scrapers": ("tools.site_gallery.scrape_figures",),
    "ignore_repr_types": r"matplotlib|NotebookFigure",
}

# --- appearance
html_theme = "furo"
html_title = "loopcal"
html_copy_source = False
html_show_search_summary = False  # a page from disk may not read others
html_static_path = ["site/static"]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_show_sphinx = False
html_extra_path = ["site/index.html"]
copybutton_exclude = ".linenos, .gp, .go"
