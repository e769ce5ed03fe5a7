"""The site: it builds without a warning and without a network, and its own check finds what no page may have.

The notebooks run in the suite already, each on its own. So this build takes them as they are committed, without
outputs, and runs one small notebook in their place: what it does not see is only how their own outputs look. The real
site is built from the notebooks as they ran, with one command and under the same check.
"""

import io
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from PIL import Image

from stad_lab.viz.widgets import show

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "docs"))
import gallery
from site_check import faults

CELLS = (
    "from matplotlib.figure import Figure\nfrom stad_lab.viz.widgets import explore, show, slider\n"
    "figure = Figure(figsize=(1, 1))\nfigure.set_label('an empty square')\nshow(figure)",
    "explore(lambda x: figure, x=slider(0, 1, 0, 'x'))",
)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site built from a copy of its sources and one small notebook that runs: (its folder, the process)."""
    source = tmp_path_factory.mktemp("source")
    for folder in ("docs", "notebooks"):
        shutil.copytree(
            ROOT / folder, source / folder, ignore=shutil.ignore_patterns("_*", "rooms", ".ipynb_*")
        )
    shutil.copy(ROOT / "README.md", source)
    cells = [{"cell_type": "markdown", "metadata": {}, "source": "# Small\n\n$$\\alpha_t = x^2$$"}]
    cells += [
        {
            "cell_type": "code",
            "metadata": {},
            "source": cell,
            "outputs": [],
            "execution_count": None,
        }
        for cell in CELLS
    ]
    notebook = {"cells": cells, "metadata": {}, "nbformat": 4, "nbformat_minor": 4}
    (source / "notebooks" / "small.ipynb").write_text(json.dumps(notebook))
    out = source / "docs" / "_build" / "site"
    (source / "conf.py").write_text(
        f"import sys\nsys.path.insert(0, {str(ROOT / 'docs')!r})\nfrom conf import *\n"
        f"nb_execution_excludepatterns += ['notebooks/[0-9]*']\nnb_execution_cache_path = {str(source / 'cache')!r}\n"
    )
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", source, out]
    return out, subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)


def test_the_readme_s_gallery_shows_figures_of_cells_that_there_are():
    readme, cells = (ROOT / "README.md").read_text(encoding="utf-8"), set()
    for notebook in (ROOT / "notebooks").glob("0*.ipynb"):
        cells |= {
            cell["id"]
            for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]
            if cell["cell_type"] == "code"
        }
    pictures = {file.stem: file for file in (ROOT / "notebooks" / "pictures").glob("0*.png")}
    assert set(gallery.CELLS) == set(pictures) <= cells
    for cell, file in pictures.items():
        (alternative,) = re.findall(rf"!\[([^\]]+)\]\(notebooks/pictures/{cell}\.png\)", readme)
        assert Image.open(file).text["Description"].startswith(alternative)


def test_the_figure_of_a_cell_is_what_a_reader_of_the_notebook_sees(tmp_path, monkeypatch):
    figure = Figure(figsize=(1, 1))
    figure.set_label("an empty square")
    source = f"from IPython.display import HTML\nHTML({show(figure).data!r})"  # a kernel that imports PyTorch is slow
    cells = [
        {
            "id": "7-2",
            "cell_type": "code",
            "metadata": {},
            "source": source,
            "outputs": [],
            "execution_count": None,
        }
    ]
    notebook = {"cells": cells, "metadata": {}, "nbformat": 4, "nbformat_minor": 5}
    (tmp_path / "7-_small.ipynb").write_text(json.dumps(notebook))
    monkeypatch.setattr(gallery, "NOTEBOOKS", tmp_path)
    picture = Image.open(io.BytesIO(gallery.figure_of("7-2")))
    assert picture.size == (100, 100) and picture.text["Description"] == "an empty square"


def test_the_site_builds_without_a_warning(site):
    _, process = site
    assert process.returncode == 0, process.stdout + process.stderr


def test_every_notebook_and_every_room_has_its_page_and_the_search_its_index(site):
    folder, _ = site
    notebooks = {file.stem for file in (ROOT / "notebooks").glob("*.ipynb")}
    rooms = {file.stem for file in (ROOT / "stad_lab").glob("*.py")} - {"__init__", "__main__"}
    assert notebooks <= {file.stem for file in (folder / "notebooks").glob("*.html")}
    assert rooms == {
        file.stem.removeprefix("stad_lab.") for file in (folder / "docs" / "rooms").glob("*.html")
    }
    assert "load_agent" in (folder / "docs" / "rooms" / "stad_lab.agent.html").read_text(
        encoding="utf-8"
    )
    assert "notebooks/02_difference_autoencoders" in (folder / "searchindex.js").read_text(
        encoding="utf-8"
    )


def test_a_notebook_that_runs_shows_its_figure_and_a_note_where_its_widget_stood(site):
    page = (site[0] / "notebooks" / "small.html").read_text(encoding="utf-8")
    assert 'alt="an empty square"' in page and "data:image/png;base64," in page
    assert "a widget that needs a running kernel" in page and "VBox(" not in page


def test_formulas_come_from_the_site_itself(site):
    page = (site[0] / "notebooks" / "small.html").read_text(encoding="utf-8")
    assert "\\alpha_t" in page and "mathjax/tex-chtml.js" in page and "cdn." not in page
    assert (site[0] / "_static" / "mathjax" / "tex-chtml.js").exists()
    assert list((site[0] / "_static" / "mathjax").rglob("MathJax_Main-Regular.woff"))


def test_the_check_finds_what_no_page_may_have(tmp_path):
    (tmp_path / "other.html").write_text("<h1 id='here'>Other</h1>")
    (tmp_path / "page.html").write_text(
        "<img src='data:,'><img src='data:,' alt='words'><a href='other.html#here'>good</a><a href='https://x.org'>good</a>"
        "<a href='other.html#there'>bad</a><a href='gone.html'>bad</a><script src='https://x.org/x.js'></script>"
    )
    found = faults(tmp_path)
    assert len(found) == 4
    for what in (
        "without alternative text",
        "a place that is not there",
        "a file that is not there",
        "the network",
    ):
        assert sum(what in fault for fault in found) == 1
