"""The docs site: ``make docs`` builds it, warnings are errors."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import kjax

project = "kjax"
author = "the kjax authors"
release = version = kjax.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["results/**/table.md", "_build"]

html_theme = "furo"
html_title = f"kjax {version}"
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#2b6cb0", "color-brand-content": "#2b6cb0"},
}
html_copy_source = False

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"

autodoc_typehints = "none"  # the signatures show them; shapes stand in the docstrings
autodoc_member_order = "bysource"
autodoc_class_signature = "separated"
napoleon_google_docstring = True
napoleon_use_ivar = True


def _escape_bars(app, what, name, obj, options, lines):
    """``|x|`` in a docstring is a norm, no substitution."""
    for i, line in enumerate(lines):
        if "|" in line and "``" not in line:
            lines[i] = line.replace("|", "\\|")


def setup(app):
    """Register what changes docstrings before napoleon's own pass."""
    app.connect("autodoc-process-docstring", _escape_bars, priority=900)
