"""Configuration of the documentation: ``make docs`` builds it with Sphinx, MyST Markdown and the theme Furo."""

from __future__ import annotations

import re
import tomllib
from collections import _tuplegetter  # type: ignore[attr-defined]
from pathlib import Path
from typing import Any

project = "gpe_pl"
author = "the gpe_pl developers"
version = release = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]["version"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["_build", "results/*/*.md"]  # pages include those tables
templates_path = ["_templates"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
suppress_warnings = ["config.cache"]

autosummary_generate = True
autodoc_inherit_docstrings = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_use_type_comments = False  # there are none, and the search for them takes seconds
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False

html_theme = "furo"
html_title = "gpe_pl"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_show_sphinx = False
html_show_copyright = False
copybutton_exclude = ".linenos, .gp"


def escape_bars(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Escape the bars of norms, |x|, which reStructuredText would read as substitutions."""
    for k, line in enumerate(lines):
        parts = line.split("``")
        lines[k] = "``".join(part if inside % 2 else re.sub(r"\|(?=\S)", r"\\|", part) for inside, part in enumerate(parts))


def skip_described_fields(app: Any, what: str, name: str, obj: Any, skip: bool, options: Any) -> bool | None:
    """Leave out the fields of a NamedTuple, which its docstring describes."""
    return True if isinstance(obj, _tuplegetter) else None


def collapse_navigation(app: Any, pagename: str, templatename: str, context: dict[str, Any], doctree: Any) -> None:
    """Expand only the branch of the current page in the navigation. The theme would write the names of all modules on every page."""
    if whole := context.get("toctree"):
        context["toctree"] = lambda **options: whole(**(options | {"collapse": True}))


def setup(app: Any) -> None:
    """Connect the functions above. Sphinx calls this."""
    app.connect("autodoc-skip-member", skip_described_fields)
    app.connect("autodoc-process-docstring", escape_bars, priority=400)  # before napoleon converts it to reStructuredText
    app.connect("html-page-context", collapse_navigation, priority=400)  # before the theme takes the tree of pages
