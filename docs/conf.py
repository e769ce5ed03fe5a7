"""The site of the notebooks as they ran, and of the library: sphinx-build -W -c docs . docs/_build/site

The source folder is the whole repository, so that the notebooks are read where they lie, and their links hold here as
on a code host. Their outputs are cached: only a change of a notebook, of stad_lab or of the settings runs them again.
Nothing needs a network, neither the build nor the finished pages.
"""

import hashlib
import os
import sys
from pathlib import Path

from docutils import nodes
from sphinx.util import logging

from stad_lab import Settings

HERE = Path(__file__).parent
PACKAGE = HERE.parent / "stad_lab"
sys.path.insert(0, str(HERE))
from site_check import faults


def digest(folder: Path) -> str:
    """A short name for the present state of all files of a folder; the cache of outputs is valid for one state."""
    files = sorted(
        file for file in folder.rglob("*") if file.is_file() and "__pycache__" not in file.parts
    )
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


project = "stad_lab"
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx-mathjax-offline",  # formulas without a network: it serves MathJax from the site itself
]
root_doc = "docs/index"
include_patterns = ["README.md", "docs/**", "notebooks/*.ipynb", "notebooks/exercises/*.*"]
exclude_patterns = ["docs/_*", ".*", "runs", "**/.ipynb_checkpoints", "notebooks/exercises/*.py"]
templates_path = [str(HERE / "_templates")]
suppress_warnings = [
    "myst.header"
]  # a notebook's markdown cell may begin a step at the second level

# Notebooks
os.environ.setdefault(
    "OMP_NUM_THREADS", "1"
)  # on busy cores, threads that wait for each other slow PyTorch manyfold
nb_execution_mode = "cache"
nb_execution_cache_path = str(HERE / "_cache" / f"{Settings.preset().name}-{digest(PACKAGE)}")
nb_execution_excludepatterns = [
    "notebooks/exercises/*"
]  # their answers are missing, and they say so
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_ipywidgets_js = {}  # widgets need a kernel, and their scripts a network: see explain_widgets
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3

# Reference
default_role = "code"
autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_default_options = {"members": True}
napoleon_numpy_docstring = False

# Looks
html_theme = "furo"
html_title = "stad_lab"
html_static_path = [str(HERE / "_static")]
html_css_files = ["site.css"]
html_show_copyright = False
html_show_sphinx = False
html_additional_pages = {"index": "to_start.html"}
html_copy_source = False
html_show_sourcelink = False
pygments_style = "friendly"
pygments_dark_style = "github-dark"

WIDGET = "application/vnd.jupyter.widget-view+json"


def explain_widgets(app, doctree) -> None:
    """Where a widget stood in the notebook, say so: without a kernel there is nothing to move."""
    for bundle in list(doctree.findall(nodes.container)):
        if any(
            isinstance(child, nodes.container) and child.get("mime_type") == WIDGET
            for child in bundle.children
        ):
            text = "Here stands a widget that needs a running kernel: open the notebook in JupyterLab to move it."
            bundle.replace_self(
                nodes.container("", nodes.paragraph("", text), classes=["without-kernel"])
            )


def check_site(app, error) -> None:
    """Turn every fault of the finished pages into a warning, which `-W` makes an error."""
    if error is None and app.builder.name == "html":
        for fault in faults(Path(app.outdir)):
            logging.getLogger("site_check").warning(fault)


def setup(app) -> None:
    """Hook the two in; the site is checked after all its files, MathJax's among them, are there."""
    app.connect("doctree-read", explain_widgets)
    app.connect("build-finished", check_site, priority=900)
