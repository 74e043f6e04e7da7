"""The site: `make docs`. It needs no network, and search works in files opened from a folder."""

import os
import sys
from pathlib import Path

import chargetune

sys.path.insert(0, str(Path(__file__).parent))
from site_pages import read_page, shown_docstring, shown_signature

project = "chargetune"
author = "The chargetune developers"
copyright = author  # noqa: A001 - the name that Sphinx reads
version = release = chargetune.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["gallery/**/*.ipynb", "gallery/*.py"]
# Functions in the configuration cannot be stored between two builds.
suppress_warnings = ["config.cache"]

myst_enable_extensions = ["deflist"]
# Anchors of headings as a forge makes them, so that the same links work in both.
myst_heading_anchors = 4
highlight_language = "none"

# A name in single backquotes is one of Python where there is one, and else plain code.
default_role = "py:obj"
add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_type_aliases = {"ArrayLike": "ArrayLike", "Expression": "Expression", "Bound": "Bound"}
maximum_signature_line_length = 88
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = f"chargetune {version}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False

sphinx_gallery_conf = {
    "examples_dirs": ["../examples/gallery"],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"\.py$",
    # Without CHARGETUNE_GALLERY=1 the pages show the scripts and run none.
    "plot_gallery": os.environ.get("CHARGETUNE_GALLERY") == "1",
    "within_subsection_order": "site_pages.GalleryOrder",
    # A process for each core of the smallest machine; what a script leaves behind (matplotlib's settings, threads) ends with it.
    "parallel": 2,
    "download_all_examples": False,
    "show_memory": False,
    "capture_repr": (),
    "show_signature": False,
    "min_reported_time": 1,
    "write_computation_times": False,
    "remove_config_comments": True,
    "abort_on_example_error": True,
}


def setup(app):
    """Links that hold on a forge hold on the site too; docstrings are shown as Sphinx reads them."""
    app.connect("source-read", read_page)
    app.connect("autodoc-process-docstring", shown_docstring)
    app.connect("autodoc-process-signature", shown_signature)
