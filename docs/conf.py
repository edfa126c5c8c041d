"""How the site is built: ``make docs``.

NSMODEL_SHORT=1 builds a small one: two cases, pictures on one page, notebooks that were not run.
"""

import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]

from runs import package_hash  # noqa: E402

from nsmodel.version import VERSION  # noqa: E402

SHORT = bool(os.environ.get("NSMODEL_SHORT"))

project, author, copyright, release = "nsmodel", "the authors of nsmodel", "the authors of nsmodel", VERSION
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.intersphinx",
    "gallery",
    "snippets",
    "links",
    "notebooks",
    "commands",
    "docstrings",
    "formulas",
]
exclude_patterns = ["_*", "figures", "examples", "images"]
suppress_warnings = ["misc.highlighting_failure"]  # Outputs have "..." where lines are left out.
nitpicky = True

# -- what is made by running: kept beside the site, and made anew where the package changes

made_in = str(HERE.parent / "build" / "docs")
gallery_cases = ["diode_bridge", "moving_disc"] if SHORT else []
snippet_pages = ["guide"] if SHORT else []
nb_execution_mode = "off" if SHORT else "cache"
nb_execution_cache_path = f"{made_in}/notebooks-{package_hash()}"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True
nb_ipywidgets_js = {}
nb_number_source_lines = False

smartquotes = False  # x' is a derivative, --out an option

# -- Markdown: as on a host of repositories, and nothing that a name in a model could turn into HTML

myst_enable_extensions = ["dollarmath", "deflist", "colon_fence", "attrs_inline"]
myst_disable_syntax = ["html_block", "html_inline"]
myst_heading_anchors = 4
myst_update_mathjax = False
myst_links_external_new_tab = False

# -- the reference

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
default_role = "literal"
maximum_signature_line_length = 80
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"
intersphinx_mapping = {
    name: (address, f"_inventories/{name}.inv")
    for name, address in {
        "python": "https://docs.python.org/3/",
        "numpy": "https://numpy.org/doc/stable/",
        "matplotlib": "https://matplotlib.org/stable/",
        "xarray": "https://docs.xarray.dev/en/stable/",
        "pandas": "https://pandas.pydata.org/docs/",
    }.items()
}
nitpick_ignore_regex = [
    ("py:.*", r"casadi\..*"),  # has no inventory
    ("py:class", r"nsmodel\..+|[A-Z]\w+"),  # in signatures: types that are not public
]

# -- pages

html_theme = "furo"
html_title = "nsmodel"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_js_files = ["offline.js"]
html_math_renderer = "katex"
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_show_copyright = False
pygments_style = "friendly"
pygments_dark_style = "github-dark"
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b5cad", "color-brand-content": "#0b5cad"},
    "dark_css_variables": {"color-brand-primary": "#7cb8ff", "color-brand-content": "#7cb8ff"},
}
