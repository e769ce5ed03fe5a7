"""Sphinx configuration of the site: `sphinx-build -W -c docs . docs/_build/site`.

The source folder is the repository, so the notebooks are read in place and their links hold here as
on a code host. Their outputs are cached: only a changed notebook, library or preset runs them
again. Neither the build nor the pages need a network.
"""

import gc
import hashlib
import os
import re
import sys
from pathlib import Path

from docutils import nodes
from sphinx import addnodes
from sphinx.util import logging

from stad_lab.config import PRESET_VARIABLE

gc.set_threshold(100_000)  # Sphinx keeps what it makes: it looks for garbage a sixth of the time

HERE = Path(__file__).parent
PACKAGES = [HERE.parent / name for name in ("stad_lab", "stad_study", "stad_course")]
sys.path[:0] = [str(HERE), str(HERE / "live")]
from colab import address  # noqa: E402
from live_build import write_scripts  # noqa: E402
from site_check import faults  # noqa: E402


def digest(folders: list[Path]) -> str:
    """A short hash of all files of some folders, which names the cache of outputs."""
    files = sorted(
        file
        for folder in folders
        for file in folder.rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    )
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


project = "stad_lab"
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx-mathjax-offline",  # MathJax is part of the site
]
root_doc = "docs/index"
include_patterns = [
    "README.md",
    "docs/**",
    "notebooks/*.ipynb",
    "notebooks/exercises/*.*",
    "stad_lab/pretrained/*/README.md",
]
exclude_patterns = [
    "docs/_*",
    "**/node_modules",
    ".*",
    "runs",
    "**/.ipynb_checkpoints",
    "notebooks/exercises/*.py",
]
templates_path = [str(HERE / "_templates")]
suppress_warnings = ["myst.header"]  # a cell may begin at the second heading level

# Notebooks
PRESET = os.environ.get(PRESET_VARIABLE, "laptop")
os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads that wait for each other are slow
nb_execution_mode = "cache"
nb_execution_cache_path = str(HERE / "_cache" / f"{PRESET}-{digest(PACKAGES)}")
nb_execution_excludepatterns = ["notebooks/exercises/*"]  # their answers are missing
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_ipywidgets_js = {}  # their scripts would need a network: see explain_widgets
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

# Appearance
html_theme = "furo"
html_title = "stad_lab"
html_static_path = [str(HERE / "_static")]
html_search_scorer = str(HERE / "search_scorer.js")  # the reference comes last
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_show_copyright = False
html_show_sphinx = False
html_additional_pages = {"index": "to_start.html"}
html_copy_source = False
html_show_sourcelink = False
pygments_style = "a11y-high-contrast-light"
pygments_dark_style = "a11y-high-contrast-dark"

WIDGET = "application/vnd.jupyter.widget-view+json"
PROGRESS = "%|"  # of tqdm, beside the widget
LIVE = {"00": "dream", "01": "speeds", "02": "latent", "03": "dream", "04": "evolution"}
LIVE |= {"05": "index", "06": "index"}  # nothing there matches one of their widgets


def explain_widgets(app, doctree) -> None:
    """Replace each widget by a note, which leads to the live page of its notebook if it has one.

    A progress bar is a widget, too: it goes, as its end is known.
    """
    notebook = Path(app.env.docname).name[:2]
    for bundle in list(doctree.findall(nodes.container)):
        if any(
            isinstance(child, nodes.container) and child.get("mime_type") == WIDGET
            for child in bundle.children
        ):
            if PROGRESS in bundle.astext():
                bundle.parent.remove(bundle)
                continue
            if any(child.get("mime_type") == "text/html" for child in bundle.children):
                continue  # it says by itself what it asks
            text = "This widget needs a running kernel: open the notebook in JupyterLab."
            note = nodes.paragraph("", text)
            if notebook in LIVE:
                page = {"reftype": "doc", "reftarget": f"/docs/live/{LIVE[notebook]}"}
                page |= {"refdomain": "std", "refexplicit": False, "refdoc": app.env.docname}
                link = addnodes.pending_xref("", nodes.inline(), **page)
                note += [nodes.Text(" Or try this live page: "), link, nodes.Text(".")]
            bundle.replace_self(nodes.container("", note, classes=["without-kernel"]))


def offer_colab(app, doctree) -> None:
    """Put a link to Colab below the title of a notebook, if GitHub builds the site."""
    repository, page = os.environ.get("GITHUB_REPOSITORY"), Path(app.env.docname)
    if not repository or page.parent.as_posix() != "notebooks":
        return
    where = address(repository, f"{page.name}.ipynb")
    link = nodes.reference("", "Open in Google Colab", refuri=where)
    doctree.next_node(nodes.title).parent.insert(1, nodes.paragraph("", "", link))


def help_screen_readers(app, page, template, context, doctree) -> None:
    """Give the sidebar's headings their level, and make an empty header cell an ordinary one."""
    for part in {"body", "furo_navigation_tree"} & context.keys():
        leveled = context[part].replace('role="heading"', 'role="heading" aria-level="2"')
        context[part] = re.sub(r"<th([^>]*)>(\s*(?:<p></p>)?\s*)</th>", r"<td\1>\2</td>", leveled)


def style_live_page(app, page, template, context, doctree) -> None:
    """Give the live pages their own style sheet."""
    if page.startswith("docs/live/") or page == "docs/index":  # which shows the game
        app.add_css_file("../docs/live/live.css", priority=900)


def write_live_scripts(app, error) -> None:
    """Write the scripts of the live pages: their code, weights and data."""
    if error is None and app.builder.name == "html":
        write_scripts(Path(app.outdir) / "docs" / "live")


def check_site(app, error) -> None:
    """Report each fault of the built site as a warning, which `-W` makes an error."""
    if error is None and app.builder.name == "html":
        for fault in faults(Path(app.outdir)):
            logging.getLogger("site_check").warning(fault)


def setup(app) -> None:
    """Connect them; the check runs last, after MathJax has been copied."""
    app.connect("doctree-read", explain_widgets)
    app.connect("doctree-read", offer_colab)
    app.connect("html-page-context", style_live_page)
    app.connect("build-finished", write_live_scripts)
    app.connect("html-page-context", help_screen_readers, priority=900)  # the theme's come first
    app.connect("build-finished", check_site, priority=900)
