"""The report of a run: one file with scores, film and curves, for runs finished or not."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from stad_lab.agent import PRETRAINED
from stad_lab.cli import main
from stad_lab.evaluation.evaluate import load_evaluation
from stad_lab.evaluation.statistics import summarise
from stad_lab.io.files import save_json
from stad_lab.io.weights import CONTROLLER_FILE, MDN_RNN_FILE
from stad_lab.viz.report import report
from stad_lab.viz.video import FILM


@pytest.fixture(autouse=True)
def short_films(monkeypatch):
    """Films of 30 frames, so that a report takes a second."""
    monkeypatch.setitem(FILM, "frames", 30)


@pytest.fixture
def run(quick_run, tmp_path):
    """A copy of the quick run that a test may change."""
    return shutil.copytree(quick_run, tmp_path / "run")


def pictures(page):
    """How many pictures of each kind a page holds."""
    kinds = re.findall(r'src="data:image/(\w+);base64', page)
    return {kind: kinds.count(kind) for kind in kinds}


def test_the_report_of_a_shipped_agent_has_its_scores_film_and_curves():
    folder = PRETRAINED / "frame"
    page = report(folder)
    means = [load_evaluation(file)["mean"] for file in folder.glob("evaluation*.json")]
    assert means
    assert all(f"mean {mean:.1f}" in page for mean in means)
    assert pictures(page) == {"gif": 1, "png": 4}
    assert len(re.findall(r'alt="[^"]+"', page)) == 5


def test_the_headline_is_the_full_evaluation_of_this_c_with_gymnasium_s_pictures(tmp_path):
    folder = shutil.copytree(PRETRAINED / "frame", tmp_path / "run")
    full = load_evaluation(folder / "evaluation.json")
    some = full["episodes"][:5]
    brief = full | {"episodes": some} | summarise(np.array([one["return"] for one in some]))
    save_json(folder / "evaluation-5.json", brief)
    save_json(folder / "evaluation-earlier.json", full | {"controller": "0"})
    page = report(folder)
    assert f"Mean return {full['mean']:.1f}" in page
    assert "tracks 0 to 4," in page
    (folder / "evaluation.json").unlink()
    (folder / "evaluation-5.json").unlink()
    assert "evaluate --agent" in report(folder)


def test_a_run_whose_folder_has_the_name_of_a_shipped_agent_shows_its_own_film(run, monkeypatch):
    film, own = re.compile('data:image/gif;base64,[^"]*'), run.rename(run.parent / "input")
    monkeypatch.chdir(own.parent)
    assert film.findall(report(Path("input"))) == film.findall(report(own))


def test_a_report_asks_for_no_other_file(quick_run):
    page = report(quick_run)
    assert not re.search(r"<script|<link|href=|url\(", page)
    assert all(source.startswith("data:") for source in re.findall(r'src="([^"]*)', page))


def test_the_report_of_an_unfinished_run_shows_what_is_there(run):
    (run / CONTROLLER_FILE).unlink()
    (run / MDN_RNN_FILE).unlink()
    page = report(run)
    assert "gif" not in pictures(page)
    assert "evaluate --agent" in page


def test_the_command_writes_the_report_into_the_run(run):
    assert main(["report", "--run", str(run)]) == 0
    assert (run / "report.html").read_text(encoding="utf-8").startswith("<!doctype html>")


@pytest.mark.parametrize("by_path", [False, True])
def test_the_report_of_a_shipped_agent_is_not_written_into_the_package(
    by_path, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    before = sorted(PRETRAINED.rglob("*"))
    agent = str(PRETRAINED / ".." / PRETRAINED.name / "frame") if by_path else "frame"
    assert main(["report", "--run", agent]) == 0
    assert (tmp_path / "report-frame.html").exists()
    assert sorted(PRETRAINED.rglob("*")) == before


@pytest.mark.parametrize("name", ["record.json", "vae.safetensors"])
def test_a_damaged_file_ends_in_one_line_and_writes_nothing(run, capsys, name):
    (run / name).write_bytes(b"{")
    assert main(["report", "--run", str(run)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert name in line
    assert not (run / "report.html").exists()


def test_a_misspelt_run_gets_no_folder(tmp_path, capsys):
    assert main(["report", "--run", str(tmp_path / "typo")]) == 2
    assert "there is no folder" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_report_is_written_to_html_files_only(quick_run, tmp_path, capsys):
    assert main(["report", "--run", str(quick_run), "--out", str(tmp_path / "a.pdf")]) == 2
    assert "expected a .html" in capsys.readouterr().err
