"""The site: `make docs` builds it from these pages, the docstrings of `wepose_pin` and the scripts of `examples/`."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE / "extensions")]

import wepose_pin  # noqa: E402

project = "wepose-pin"
author = "the wepose-pin developers"
copyright = "the wepose-pin developers, BSD-3-Clause"
release = version = wepose_pin.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "commands",
    "gallery",
    "mathml",
    "notebook",
]
exclude_patterns = ["extensions", "_build"]
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 4
suppress_warnings = ["myst.header"]  # pages of diagnostics begin a group at any depth

default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # types stand in the parameters' descriptions
napoleon_google_docstring = False
napoleon_use_rtype = False
copybutton_prompt_text = r"\$ |>>> "
copybutton_prompt_is_regexp = True

highlight_language = "text"  # of blocks that name none: folders and commands
html_theme = "furo"
html_title = f"wepose-pin {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
