"""The pages are up to date, short, linked and in plain words; the site builds without a network.

The notebooks run in the suite already, each on its own. This build takes them without outputs and
runs one small notebook in their place. It has the reference of a few modules, while the docstrings
of all are parsed one by one; `pytest -m long` builds the reference of every module.
"""

import importlib
import inspect
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from matplotlib.figure import Figure
from PIL import Image

from stad_course import cli as course
from stad_lab import cli, command_line
from stad_lab.agent import PRETRAINED, shipped_agents
from stad_lab.evaluation.evaluate import load_evaluation
from stad_study import cli as study
from stad_study.claims import read_claims

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "docs"))
import blocks  # noqa: E402
import colab  # noqa: E402
import gallery  # noqa: E402
import renew  # noqa: E402
from site_check import faults  # noqa: E402

PAGES = {file.relative_to(ROOT).as_posix(): file for file in renew.pages()}
# words; any other page 1,500. Protocol and results hold six studies; a log only grows.
LIMITS = {"README.md": 900, "docs/protocol.md": 1700}
LIMITS |= {"docs/protocol-log.md": 4000, "docs/results.md": 2000}
# Words of our own for which the field has others.
PRIVATE = (
    r"luck\w*|redraw\w*|foresee\w*|forecast\w*|honest\w*|mutants?|second round|going back|floors?|"
    r"twins?|gauges?|made anew|last bit|cars in step|V's|looks?|searche?s?|rooms?|house"
)
CELLS = (
    "from matplotlib.figure import Figure\n"
    "from stad_lab.viz.widgets import explore, show, show_animation, slider\n"
    "figure = Figure(figsize=(1, 1))\nfigure.set_label('an empty square')\nshow(figure)",
    "explore(lambda x: figure, x=slider(0, 1, 0, 'x'))",
    "from tqdm.auto import tqdm\nlist(tqdm([1]))",
    "import numpy as np\nfrom stad_lab.viz.video import animate_pictures\n"
    "film = animate_pictures({'x': np.zeros((3, 64, 64, 3), np.uint8)})\n"
    "show_animation(film, 'a black film')",
    "import pandas\npandas.DataFrame({f'a long name {n}': [n] for n in range(20)})",
)
LAB = "someone/their_lab"  # a repository on GitHub
LINK = r"\{py:\w+\}`~([\w.]+)\.\w+`"  # to what a module defines
NAMED = {name for file in PAGES.values() for name in re.findall(LINK, file.read_text("utf-8"))}
SERIOUS = {"serious", "critical"}  # impacts of axe
# axe's rule on contrast is slow. Ink and paper follow from tags, classes and styles, so of all
# texts that have these alike, up to the root, one stays. A live page goes on: its elements stay.
THIN = """() => {
    const seen = new Set(), texts = [], all = document.createTreeWalker(document.body, 4)
    while (all.nextNode()) if (all.currentNode.data.trim()) texts.push(all.currentNode)
    for (const text of texts) {
        let kind = ""
        for (let one = text.parentElement; one; one = one.parentElement)
            kind += `${one.tagName}.${one.getAttribute("class")}[${one.getAttribute("style")}]`
        const parent = text.parentElement
        if (!seen.has(kind)) seen.add(kind)
        else if (parent.childNodes.length > 1 || parent.closest("#live, .figure")) text.remove()
        else parent.remove()
    }
}"""


def small_notebook(*sources):
    """A notebook with one formula and these code cells, as JSON."""
    cells = [{"cell_type": "markdown", "metadata": {}, "source": "# Small\n\n$$\\alpha_t = x^2$$"}]
    code = {"cell_type": "code", "metadata": {}, "outputs": [], "execution_count": None}
    cells += [code | {"source": source} for source in sources]
    return json.dumps({"cells": cells, "metadata": {}, "nbformat": 4, "nbformat_minor": 4})


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site with the reference of those modules that a page names: as `build` returns it."""
    return build(tmp_path_factory.mktemp("source"), set(blocks.modules()) - NAMED)


@pytest.fixture(scope="module")
def whole_site(tmp_path_factory):
    """The site with the reference of all modules: as `build` returns it."""
    return build(tmp_path_factory.mktemp("source"), set())


def build(source, left_out):
    """The site from a copy of its sources and one small notebook: (its folder, the process).

    Args:
        left_out: modules whose pages are not built.
    """
    ignored = shutil.ignore_patterns("_*", "modules", ".ipynb_*")
    for folder in ("docs", "notebooks"):
        shutil.copytree(ROOT / folder, source / folder, ignore=ignored)
    for name, file in PAGES.items():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, source / name)
    reference = source / "docs" / "reference.md"
    lines = reference.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = (line for line in lines if line.strip() not in left_out)
    reference.write_text("".join(kept), encoding="utf-8")
    (source / "notebooks" / "00_small.ipynb").write_text(small_notebook(*CELLS))
    notebooks = [f"notebooks/{file.name}" for file in (ROOT / "notebooks").glob("0*.ipynb")]
    out = source / "docs" / "_build" / "site"
    (source / "conf.py").write_text(
        f"import sys\nsys.path.insert(0, {str(ROOT / 'docs')!r})\nfrom conf import *\n"
        f"nb_execution_excludepatterns += {notebooks}\n"
        f"nb_execution_cache_path = {str(source / 'cache')!r}\n"
    )
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", source, out]
    run = {"capture_output": True, "text": True, "timeout": 600, "check": False}
    return out, subprocess.run(command, env=os.environ | {"GITHUB_REPOSITORY": LAB}, **run)


def test_no_page_is_stale():
    claims = read_claims()
    assert not renew.stale(claims), "run: python docs/renew.py"
    for name in blocks.FIGURES:
        picture = Image.open(gallery.PICTURES / f"{name}.png")
        label = blocks.FIGURES[name](claims).get_label()
        assert picture.text["Description"] == label, "run: python docs/renew.py"


@pytest.mark.parametrize("agent", shipped_agents())
def test_a_model_hub_reads_an_agents_recorded_score_from_its_card(agent):
    _, metadata, _ = (PRETRAINED / agent / "README.md").read_text("utf-8").split("---\n", 2)
    (entry,) = yaml.safe_load(metadata)["model-index"]
    (result,) = entry["results"]
    scores = {one["type"]: one["value"] for one in result["metrics"]}
    recorded = load_evaluation(PRETRAINED / agent / "evaluation.json")
    assert float(scores["mean_reward"].partition(" ")[0]) == round(recorded["mean"], 2)


def test_a_marker_takes_a_number_by_its_path_and_format():
    page = "It has <!-- claims: agents/frame/mean:.1f -->1<!-- /claims --> points."
    filled = renew.fill(page, {"agents": {"frame": {"mean": 924.66}}})
    assert filled == page.replace("-->1<", "-->924.7<")


def test_a_marker_without_data_is_an_error():
    with pytest.raises(KeyError):
        renew.fill("<!-- claims: agents/frame/mean:.1f --><!-- /claims -->", {"agents": {}})


@pytest.mark.parametrize("name", PAGES)
def test_a_page_has_few_words_and_none_of_our_own(name):
    text = PAGES[name].read_text(encoding="utf-8")
    visible = re.sub(r"<!--.*?-->|!\[[^\]]*\]", "", text, flags=re.S)
    assert len(re.findall(r"[^\s|]*\w[^\s|]*", visible)) <= LIMITS.get(name, 1500)
    found = re.findall(rf"\b(?:{PRIVATE})\b", re.sub(r"`[^`]*`|\]\([^)]*\)", "", visible))
    assert not found


@pytest.mark.parametrize("name", PAGES)
def test_links_resolve_and_no_marker_of_a_number_begins_a_line(name):
    text = PAGES[name].read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)#\s]+)", text):
        assert "://" in link or (PAGES[name].parent / link).exists(), link
    assert not re.search(r"^\s*<!-- claims: [^>]+ -->[^\n]", text, re.M)


@pytest.mark.parametrize("name", PAGES)
def test_every_command_on_a_page_is_one_that_the_command_line_takes(name):
    text = PAGES[name].read_text(encoding="utf-8").replace("\\\n", " ")
    for package, line in re.findall(r"^python -m stad_(lab|study|course) (.*)$", text, re.M):
        words = shlex.split(line, comments=True)
        if package == "lab":
            cli.parse(words)
        else:
            command_line.parse({"study": study, "course": course}[package].PROGRAM, words)


@pytest.mark.parametrize("name", ["instructor", "glossary"])
def test_every_step_and_figure_that_a_page_names_exists(name):
    page = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    notebooks = {
        file.name.partition("_")[0]: file.read_text(encoding="utf-8")
        for file in (ROOT / "notebooks").glob("0*.ipynb")
    }
    named = r"\b(0[0-6]b?), (?:from )?steps? (\d+)(?:(?:, \d+)*(?:,| and| to) (\d+))?"
    for notebook, *numbers in re.findall(named, page):
        for number in filter(None, numbers):
            assert f"## Step {number}. " in notebooks[notebook], f"{notebook}, step {number}"
    for notebook, title in re.findall(r"\b(0[0-6]b?), step \d+, \*([^*]+)\*", page):
        assert title in notebooks[notebook], f"{notebook}: {title}"


def test_the_gallery_has_a_picture_of_each_of_its_cells():
    cells = set()
    for notebook in (ROOT / "notebooks").glob("0*.ipynb"):
        found = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        cells |= {cell["id"] for cell in found if cell["cell_type"] == "code"}
    pictures = {file.stem for file in gallery.PICTURES.glob("0*.png")}
    assert set(gallery.CELLS) == pictures <= cells


def test_the_figure_of_a_cell_is_the_one_that_a_reader_sees(tmp_path, monkeypatch):
    from stad_lab.viz.widgets import show

    figure = Figure(figsize=(1, 1))
    figure.set_label("an empty square")
    # A kernel that imports PyTorch is slow, so the cell has a ready figure.
    cell = f"from IPython.display import HTML\nHTML({show(figure).data!r})"
    notebook = json.loads(small_notebook(cell)) | {"nbformat_minor": 5}
    for number, one in enumerate(notebook["cells"]):
        one["id"] = f"7-{number}"
    (tmp_path / "7_small.ipynb").write_text(json.dumps(notebook))
    monkeypatch.setattr(gallery, "NOTEBOOKS", tmp_path)
    picture = Image.open(io.BytesIO(gallery.figure_of("7-1")))
    assert picture.size == (100, 100) and picture.text["Description"] == "an empty square"


def test_a_notebook_for_colab_installs_first_and_has_no_relative_link(tmp_path):
    colab.main(LAB, str(tmp_path))
    for file in (ROOT / "notebooks").glob("*.ipynb"):
        cells = json.loads((tmp_path / file.name).read_text(encoding="utf-8"))["cells"]
        first = next(cell for cell in cells if cell["cell_type"] == "code")
        assert f"github.com/{LAB} stad_lab" in "".join(first["source"])
        texts = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown"]
        for link in re.findall(r"\]\(([^)]+)\)", "".join(texts)):
            assert link.startswith("https://"), link
    with pytest.raises(SystemExit, match="expected OWNER/NAME"):
        colab.main(f"https://github.com/{LAB}", str(tmp_path))


def assert_built(built, modules):
    """A site was built without a warning, with the pages of these modules and no others."""
    folder, process = built
    assert process.returncode == 0, process.stdout + process.stderr
    assert {file.stem for file in (folder / "docs" / "modules").glob("*.html")} == modules


def test_the_site_builds_without_a_warning(site):
    assert_built(site, NAMED)


@pytest.mark.long
def test_the_site_with_a_page_of_every_module_builds_without_a_warning(whole_site):
    assert_built(whole_site, set(blocks.modules()))


def documented(module):
    """The docstrings that the reference shows of a module: (name, docstring)."""
    waiting = [(module.__name__, module)]
    while waiting:
        name, one = waiting.pop()
        yield name, inspect.getdoc(one) or ""
        if inspect.ismodule(one) or inspect.isclass(one):
            for key, value in vars(one).items():
                value = getattr(value, "__func__", value)
                own = getattr(value, "__module__", None) == module.__name__
                shown = inspect.isroutine(value) or inspect.isclass(value)
                if (own and shown) or isinstance(value, property):
                    waiting.append((f"{name}.{key}", value))


@pytest.mark.parametrize("name", blocks.modules())
def test_every_docstring_of_a_module_is_right_restructuredtext(name):
    from docutils.core import publish_doctree  # this takes a second
    from docutils.utils import SystemMessage
    from sphinx.ext.napoleon import Config, GoogleDocstring

    config = Config(napoleon_numpy_docstring=False, napoleon_use_ivar=True)
    strict = {"halt_level": 2, "report_level": 5, "_disable_config": True}
    for where, docstring in documented(importlib.import_module(name)):
        text = ".. default-role:: code\n\n" + str(GoogleDocstring(docstring, config))
        try:
            publish_doctree(text, settings_overrides=strict)
        except SystemMessage as error:
            pytest.fail(f"{where}: {error}\n{text}")


def test_every_notebook_has_its_page_and_the_index_of_words_is_there(site):
    folder, _ = site
    notebooks = {file.stem for file in (ROOT / "notebooks").glob("*.ipynb")}
    assert notebooks <= {file.stem for file in (folder / "notebooks").glob("*.html")}
    pages = {file.stem: file for file in (folder / "docs" / "modules").glob("*.html")}
    assert "load_agent" in pages["stad_lab.agent"].read_text(encoding="utf-8")
    index = (folder / "searchindex.js").read_text(encoding="utf-8")
    assert "notebooks/02b_what_latents_carry" in index


def test_a_notebook_that_runs_shows_its_figure_and_a_live_page_instead_of_its_widget(site):
    page = (site[0] / "notebooks" / "00_small.html").read_text(encoding="utf-8")
    assert 'alt="an empty square"' in page and "data:image/png;base64," in page
    assert page.count('class="without-kernel') == 1 and "VBox(" not in page and "%|" not in page
    assert 'href="../docs/live/dream.html"' in page
    assert f"colab.research.google.com/github/{LAB}/blob/colab/00_small.ipynb" in page


def test_formulas_come_from_the_site_itself(site):
    page = (site[0] / "notebooks" / "00_small.html").read_text(encoding="utf-8")
    assert "\\alpha_t" in page and "mathjax/tex-chtml.js" in page and "cdn." not in page
    assert (site[0] / "_static" / "mathjax" / "tex-chtml.js").exists()
    assert list((site[0] / "_static" / "mathjax").rglob("MathJax_Main-Regular.woff"))


def test_the_check_of_the_site_finds_each_kind_of_fault(tmp_path):
    (tmp_path / "other.html").write_text("<h1 id='here'>Other</h1>")
    (tmp_path / "page.html").write_text(
        "<img src='data:,'><img src='data:,' alt='words'><a href='other.html#here'>good</a>"
        "<a href='https://x.org'>good</a><a href='other.html#there'>bad</a>"
        "<a href='gone.html'>bad</a><script src='https://x.org/x.js'></script>"
    )
    found = faults(tmp_path)
    assert len(found) == 4
    for what in ("alternative text", "a missing anchor", "a missing file", "the network"):
        assert sum(what in fault for fault in found) == 1


def violations(page, part, **options):
    """What axe holds against a part of a page: (rule, theme, where, why) for each element."""
    run = "([part, options]) => axe.run(part, options).then(found => found.violations)"
    found = page.evaluate(run, [part, options | {"resultTypes": ["violations"], "preload": False}])
    theme = page.evaluate("document.body.dataset.theme")
    return [
        (rule["id"], theme, element["target"], element["failureSummary"])
        for rule in found
        for element in rule["nodes"]
        if rule["impact"] in SERIOUS
    ]


# On a phone the theme lets an article's frame scroll, so that the article itself is never too wide.
RIGHT_END = """() => {
    const [frame, article] = [".content", "article"].map((one) => document.querySelector(one))
    const hidden = frame ? frame.scrollWidth - frame.clientWidth : 0
    return hidden > 1 ? Infinity : (article?.getBoundingClientRect().right ?? 0)
}"""

# A page hears of a new size when it draws its next frame.
DRAWN = "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"


def all_violations(page, file):
    """What axe holds against a file of the site, in both themes; and no page is too wide."""
    page.goto(file.as_uri())
    page.evaluate("window.MathJax?.startup?.promise.then(() => 0)")
    page.wait_for_selector("#live[data-state=ready], body:not(:has(#live))")
    for width in (390, 1100, 1300, 360):
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate(RIGHT_END) <= width, file
    page.evaluate(DRAWN)
    page.evaluate("document.body.dataset.theme = 'light'")
    part = "html" if file.stem == "index" else "article"  # the sidebar is alike everywhere
    found = violations(page, part, rules={"color-contrast": {"enabled": False}})
    page.evaluate(THIN)
    for theme in ("light", "dark"):
        page.evaluate(f"document.body.dataset.theme = '{theme}'")
        found += violations(page, part, runOnly=["color-contrast"])
    assert not page.locator("[data-state=failed]").count(), file
    return [(file.name, *one) for one in found]


def check_accessible(files, browser):
    """Let axe check the pages at a phone's width, where most blocks scroll."""
    from axe_playwright_python.base import AXE_SCRIPT

    # A page that moves would draw while axe reads it.
    page = browser.new_page(viewport={"width": 360, "height": 700}, reduced_motion="reduce")
    page.add_init_script(AXE_SCRIPT)
    assert not (found := [one for file in files for one in all_violations(page, file)]), found
    page.close()


# In the suite axe checks what is built differently; the other pages are in the long tests.
KINDS = (
    "docs/index", "docs/live/*", "README", "docs/results", "docs/modules/*agent",
    "notebooks/00_small", "notebooks/exercises/01*", "**/frame/README",
)  # fmt: skip


def kinds_of_pages(folder):
    """One page of a site for each kind, and those that compute; the other pages."""
    pages = sorted(set(folder.rglob("*.html")) - {folder / "index.html"})
    chosen = {file for pattern in KINDS for file in folder.glob(f"{pattern}.html")}
    assert len(chosen) >= len(KINDS)
    return sorted(chosen), [file for file in pages if file not in chosen]


def test_no_page_is_wider_than_its_window_and_axe_finds_nothing_serious_in_either_theme(
    site, browser
):
    check_accessible(kinds_of_pages(site[0])[0], browser)


@pytest.mark.long
def test_axe_finds_nothing_serious_on_any_other_page(whole_site, browser):
    check_accessible(kinds_of_pages(whole_site[0])[1], browser)


def test_a_film_can_be_paused_and_begins_still_for_who_wants_no_motion(site, browser):
    for motion, begins in (("no-preference", "Pause"), ("reduce", "Play")):
        page = browser.new_page(reduced_motion=motion)
        page.goto((site[0] / "notebooks" / "00_small.html").as_uri())
        for label in (begins, {"Pause": "Play", "Play": "Pause"}[begins]):
            button = page.get_by_role("button", name=f"{label} the film")
            assert page.get_by_role("img", name="a black film").evaluate("one => one.tagName") == (
                "IMG" if label == "Pause" else "CANVAS"
            )
            button.press("Enter")
        page.close()
