from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import _pages
import _tutorial
from torchrl_l1._version import __version__

project = "torchrl_l1"
author = "torchrl_l1 contributors"
copyright = f"2026, {author}"
version = release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx.ext.mathjax",
]
exclude_patterns = ["_build", "_generated", "results"]

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
# Docstrings that come from TorchRL's base classes refer to pages that are not here.
autodoc_inherit_docstrings = False
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = f"torchrl_l1 {release}"
html_show_sourcelink = False

# References into this package must resolve; other libraries' inventories are not fetched.
nitpicky = True
nitpick_ignore_regex = [(r"py:.*", r"(?!torchrl_l1\.).*|.*\._.*")]

_pages.write(Path(__file__).parent / "_generated")
_tutorial.write(Path(__file__).with_name("tutorial.py"), Path(__file__).parent / "_generated")


def setup(app: Any) -> None:
    app.connect("missing-reference", _pages.resolve_public_name)
