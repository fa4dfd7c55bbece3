"""Sphinx configuration of this site (`make docs`). Pages generated from the code are in `_ext/`."""

import sys
import tomllib
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]

project = "CaRTS"
author = "The CaRTS developers"
copyright = f"2026, {author}"
release = tomllib.loads((HERE.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
    "generated_pages",
    "offline_math",
]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build", "_ext", "requirements*"]

myst_enable_extensions = ["attrs_block", "attrs_inline", "colon_fence", "deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 3
# Pages of the guide link to sources and to the README, which are not pages of the site.
myst_url_schemes = ["http", "https", "mailto"]

# Docstrings are written with `code` in single backticks.
default_role = "literal"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True}
napoleon_use_rtype = False
napoleon_use_ivar = True
python_maximum_signature_line_length = 88

copybutton_exclude = ".linenos, .gp, .go"

html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"CaRTS {release}"
html_static_path = ["_static", "../static/tokens.css"]
html_css_files = ["tokens.css", "site.css"]
html_favicon = "../static/icon.svg"
html_logo = "../static/logo.svg"
html_show_sourcelink = False
html_copy_source = False
