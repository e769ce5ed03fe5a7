"""The exercises: nbgrader itself gives the solutions full marks and the stubs none, and checks name the mistake."""

import importlib.util
import json
import re
import runpy
import shutil
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

COURSE = Path(__file__).parent.parent / "notebooks" / "exercises"
NAMES = sorted(folder.name for folder in (COURSE / "source").iterdir())
SOURCES = {name: COURSE / "source" / name / f"{name}.ipynb" for name in NAMES}
NOTEBOOKS = [*SOURCES.values(), *(COURSE / f"{name}.ipynb" for name in NAMES)]


def read_cells(path):
    """The cells of a notebook, their sources joined."""
    return [
        cell | {"source": "".join(cell["source"])}
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]
    ]


def grading(cell):
    """nbgrader's metadata of a cell."""
    return cell["metadata"].get("nbgrader", {"grade": False, "solution": False, "grade_id": None})


@pytest.fixture(scope="module")
def generator():
    """The module notebooks/exercises/generate.py."""
    spec = importlib.util.spec_from_file_location("generate", COURSE / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# `pytest -m long` grades the others. Their checks meet their solutions, and what would be wrong, in the tests below.
GRADED = [pytest.param(name, marks=[] if name[:2] == "01" else pytest.mark.long) for name in NAMES]


@pytest.fixture(scope="module")
def graded(request, generator, tmp_path_factory):
    """An assignment made, handed in as its solution and as its empty stub, and graded: (folder of the course, name).

    The student with the stub has copied every cell that is to be answered, with the metadata, as JupyterLab does.
    """
    name, root = request.param, tmp_path_factory.mktemp("course")
    shutil.copytree(SOURCES[name].parent, root / "source" / name)
    shutil.copy(COURSE / "nbgrader_config.py", root)
    course = generator.load_course(root)
    made = course.generate_assignment(name)
    assert made["success"], made["log"]
    for student, work in {"solution": "source", "stub": "release"}.items():
        shutil.copytree(root / work / name, root / "submitted" / student / name)
        if student == "stub":
            copy_answers(root / "submitted" / student / name / f"{name}.ipynb")
        marked = course.autograde(name, student)
        assert marked["success"], marked["log"]
    return root, name


def copy_answers(path):
    """Write every cell of a notebook that is to be answered twice."""
    notebook, cells = nbformat.read(path, 4), []
    for cell in notebook.cells:
        cells.append(cell)
        if grading(cell)["solution"]:
            cells.append(nbformat.from_dict(cell | {"id": f"{cell.id}-copy"}))
    notebook.cells = cells
    nbformat.write(notebook, path)


def open_gradebook(root):
    """nbgrader's book of the marks of a course."""
    from nbgrader.api import (
        Gradebook,
    )  # takes seconds: every process of the tests reads this file, one needs it

    return Gradebook(f"sqlite:///{root / 'gradebook.db'}")


def scores(root, name, student):
    """The marks of an assignment: cell -> nbgrader's grade."""
    with open_gradebook(root) as gradebook:
        submission = gradebook.find_submission_notebook(name, name, student)
        return {
            grade.name: (grade.auto_score, grade.max_score_gradecell) for grade in submission.grades
        }


@pytest.mark.parametrize("graded", GRADED, indirect=True)
def test_autograde_gives_the_solution_full_marks_and_the_stub_none(graded):
    root, name = graded
    cells = [grading(cell) for cell in read_cells(SOURCES[name])]
    graded = [cell["grade_id"] for cell in cells if cell["grade"] and not cell["solution"]]
    full = scores(root, name, "solution")
    assert {cell: full[cell][0] for cell in graded} == {cell: full[cell][1] for cell in graded}
    assert sum(full[cell][1] for cell in graded) >= 10
    assert {score for score, _ in scores(root, name, "stub").values()} == {0}


@pytest.mark.parametrize("graded", GRADED, indirect=True)
def test_the_marks_count_the_machine_s_points_half_and_a_person_s_in_full(
    graded, monkeypatch, capsys
):
    root, name = graded
    points = {
        grading(cell)["grade_id"]: grading(cell)
        for cell in read_cells(SOURCES[name])
        if grading(cell)["grade"]
    }
    machine = sum(cell["points"] for cell in points.values() if not cell["solution"])
    read_by_hand = next(grade_id for grade_id, cell in points.items() if cell["solution"])
    with open_gradebook(root) as gradebook:
        gradebook.find_grade(read_by_hand, name, name, "stub").manual_score = 1.5
        gradebook.db.commit()
    monkeypatch.chdir(root)
    monkeypatch.setattr("sys.argv", ["marks.py", name])
    runpy.run_path(str(COURSE / "marks.py"), run_name="__main__")
    unread = sum(cell["solution"] for cell in points.values())
    told = [f"solution,{machine:.1f},0.0,{machine / 2},{unread}", "stub,0.0,1.5,1.5,0"]
    assert capsys.readouterr().out.splitlines() == ["student,machine,person,mark,unread", *told]


@pytest.mark.parametrize("graded", GRADED, indirect=True)
def test_the_marks_of_an_unknown_assignment_end_in_one_line(graded, tmp_path, monkeypatch):
    root, name = graded
    unknown = f"no assignment '01' in gradebook.db: choose one of {name}"
    for folder, asked, told in (
        (root, "01", unknown),
        (tmp_path, name, "no gradebook.db in .*: go to the folder"),
    ):
        monkeypatch.chdir(folder)
        monkeypatch.setattr("sys.argv", ["marks.py", asked])
        with pytest.raises(SystemExit, match=told):
            runpy.run_path(str(COURSE / "marks.py"), run_name="__main__")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("graded", GRADED, indirect=True)
def test_a_cell_that_a_student_has_copied_is_graded_once_and_stops_no_grading(graded):
    root, name = graded
    cells = read_cells(root / "autograded" / "stub" / name / f"{name}.ipynb")
    ids = [grading(cell)["grade_id"] for cell in cells if "nbgrader" in cell["metadata"]]
    answers = [cell for cell in read_cells(SOURCES[name]) if grading(cell)["solution"]]
    assert len(ids) == len(set(ids)) and len(cells) == len(read_cells(SOURCES[name])) + len(answers)


def test_a_warning_or_a_progress_bar_under_a_check_costs_no_points():
    from nbgrader.utils import determine_grade

    lines = [
        re.findall(r"^sys\.stderr = .*$", cell["source"], re.M)
        for path in SOURCES.values()
        for cell in read_cells(path)
    ]
    line, *others = [found[0] for found in lines if found]
    assert others == [line] * (len(NAMES) - 1)
    noise = "import sys, warnings\nfrom tqdm import tqdm\nwarnings.warn('careful')\nlist(tqdm(range(2)))"
    grade = {
        "nbgrader": {"grade": True, "solution": False, "grade_id": "a", "points": 3, "locked": True}
    }
    cells = [
        nbformat.v4.new_code_cell(f"import sys\n{line}"),
        nbformat.v4.new_code_cell(noise, metadata=grade),
    ]
    points = []
    for some in (cells, cells[1:]):
        notebook = nbformat.v4.new_notebook(cells=some)
        NotebookClient(notebook, timeout=60).execute()
        points.append(determine_grade(notebook.cells[-1])[0])
    assert points == [3, 0]  # without the line nbgrader gives none


@pytest.mark.parametrize("graded", GRADED, indirect=True)
def test_every_cell_of_the_solution_runs(graded):
    root, name = graded
    notebook = json.loads(
        (root / "autograded" / "solution" / name / f"{name}.ipynb").read_text(encoding="utf-8")
    )
    outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", [])]
    assert [output["evalue"] for output in outputs if output["output_type"] == "error"] == []
    pictures = [
        output["data"]["text/html"] for output in outputs if "text/html" in output.get("data", {})
    ]
    assert len(pictures) == sum("show(" in cell["source"] for cell in read_cells(SOURCES[name])) > 0
    assert all(re.search('alt="[^"]{20,}"', "".join(picture)) for picture in pictures)


def test_the_student_versions_are_what_one_command_makes_of_the_sources(generator, tmp_path):
    made = generator.generate(tmp_path)
    assert [path.stem for path in made] == NAMES
    for path in made:
        assert path.read_text(encoding="utf-8") == (COURSE / path.name).read_text(
            encoding="utf-8"
        ), "run notebooks/exercises/generate.py"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_exercises_are_committed_clean(path):
    text = path.read_text(encoding="utf-8")
    notebook = json.loads(text)
    nbformat.validate(nbformat.from_dict(notebook))
    assert text == json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"
    ids = [cell["id"] for cell in notebook["cells"]]
    assert all(re.fullmatch(rf"{path.stem[:2]}-\d\d", name) for name in ids) and len(
        set(ids)
    ) == len(ids)
    assert all(
        cell.get("outputs", []) == [] and cell.get("execution_count") is None
        for cell in notebook["cells"]
    )
    if path.parent == COURSE:
        assert "SOLUTION" not in text and "Model answer" not in text


@pytest.mark.parametrize("name", NAMES)
def test_points_in_the_table_are_those_that_nbgrader_gives(name):
    cells = read_cells(SOURCES[name])
    table = {
        int(number): int(points)
        for number, points in re.findall(r"\| (\d) \|.*\| (\d+) \| [^|]+ \|\n", cells[0]["source"])
    }
    points, exercise = dict.fromkeys(table, 0), None
    for cell in cells:
        heading = re.search(r"^## (\d)\. ", cell["source"], re.MULTILINE)
        exercise = int(heading[1]) if heading else exercise
        if grading(cell)["grade"]:
            points[exercise] += grading(cell)["points"]
    assert points == table and len(table) >= 4
    rubric = re.search(
        r"\| rubric \| points \|\n.*\n((\|.*\n?)+)", "\n\n".join(cell["source"] for cell in cells)
    )
    assert (
        sum(int(row) for row in re.findall(r"\| (\d+) \|$", rubric[1], re.MULTILINE))
        == table[max(table)]
    )


@pytest.fixture(scope="module")
def moments():
    """Assignment and check -> the names that are defined right before it, if all before is solved."""
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stad_lab.viz.widgets.show", lambda figure: figure)
        patch.setattr("sys.stderr", sys.stderr)  # the notebooks set it
        for name in NAMES:
            names = {}
            for cell in read_cells(SOURCES[name]):
                cell_grading = grading(cell)
                needed = cell_grading["grade_id"] or re.search(
                    r"^(def|import|from) ", cell["source"], re.MULTILINE
                )
                if (
                    cell["cell_type"] != "code"
                    or not needed
                    or (cell_grading["grade"] and cell_grading["solution"])
                ):
                    continue
                if cell_grading["grade"]:
                    found[name[:2], cell_grading["grade_id"]] = dict(names), cell["source"]
                exec(cell["source"], names)
            found[name[:2], "the end"] = names, ""
    return found


# Assignment, check, a wrong answer, what the check says to it.
WRONG = [
    (
        "01",
        "differences-values",
        "differences = lambda film, k: (film - film[earlier_index(range(9), k)]) / 255",
        "uint8",
    ),
    (
        "01",
        "differences-values",
        "differences = lambda film, k: (film.astype(np.float32) - np.roll(film, k, axis=0)) / 255",
        "counts from the film's end",
    ),
    (
        "01",
        "differences-values",
        "differences = lambda film, k: -episode_differences(film, k)",
        "sign is turned",
    ),
    (
        "01",
        "differences-start",
        "differences = lambda film, k: episode_differences(film, k) + 1",
        "found 1 at index",
    ),
    (
        "01",
        "differences-start",
        "differences = lambda film, k: np.zeros(film.shape)",
        "dtype float64: expected float32",
    ),
    (
        "01",
        "differences-start",
        "differences = lambda film, k: episode_differences(film, 4)",
        "stride is not used",
    ),
    (
        "01",
        "find-motion-made-up",
        "def find_motion(x, earlier, turns, forwards):\n"
        "    wrap = {(t, f): np.abs(move(earlier, t, f)[:48] - x[:48]).mean() for t in turns for f in forwards}\n"
        "    return min(wrap, key=wrap.get)",
        "3 - 5 is 254",
    ),
    (
        "01",
        "find-motion-made-up",
        "def find_motion(x, earlier, turns, forwards):\n"
        "    wrap = {(t, f): np.abs(x[:48] - move(earlier, t, f)[:48]).mean() for t in turns for f in forwards}\n"
        "    return min(wrap, key=wrap.get)",
        "3 - 5 is 254",
    ),
    (
        "01",
        "find-motion-made-up",
        "solved = find_motion\ndef find_motion(*given): return solved(*given)[::-1]",
        "order is turned round",
    ),
    (
        "01",
        "find-motion-made-up",
        "solved = find_motion\ndef find_motion(x, earlier, *grid): return solved(earlier, x, *grid)",
        "this is the way back",
    ),
    (
        "01",
        "find-motion-made-up",
        "def find_motion(x, earlier, turns, forwards):\n"
        "    wrap = {(t, f): ((move(earlier, t, f) - 1.0 * x) ** 2).mean() for t in turns for f in forwards}\n"
        "    return min(wrap, key=wrap.get)",
        "rows from 48 on",
    ),
    (
        "01",
        "find-motion-made-up",
        "find_motion = lambda x, y, turns, forwards: turns[0]",
        "expected two numbers",
    ),
    (
        "01",
        "find-motion-real",
        "find_motion = lambda x, y, turns, forwards: (0.0, 3.6)",
        "yaw rate 0.00 .*, truth 3",
    ),
    (
        "01",
        "find-motion-real",
        "find_motion = lambda x, y, turns, forwards: (0.31, 0.0)",
        "speed 0.0, truth 4",
    ),
    (
        "01",
        "interval-check",
        "solved = correlation_interval\n"
        "def correlation_interval(x, y, units, rng, resamples): return solved(x, y, np.arange(240), rng, resamples)",
        "far too narrow: you drew rows",
    ),
    (
        "01",
        "interval-check",
        "def correlation_interval(x, y, units, rng, resamples):\n"
        "    drawn = [np.isin(units, rng.choice(np.unique(units), 12)) for _ in range(resamples)]\n"
        "    return np.percentile([np.corrcoef(x[d], y[d])[0, 1] for d in drawn], [2.5, 97.5])",
        "counts it once",
    ),
    (
        "01",
        "interval-check",
        "def correlation_interval(x, y, units, rng, resamples):\n"
        "    own = np.array([np.corrcoef(x[units == u], y[units == u])[0, 1] for u in np.unique(units)])\n"
        "    return np.percentile([rng.choice(own, len(own)).mean() for _ in range(resamples)], [2.5, 97.5])",
        "mean of every unit's own correlation",
    ),
    (
        "02",
        "kl-values",
        "kl = lambda mu, logvar: (mu**2 + logvar.exp() - 1 - logvar).sum(1)",
        "1/2 is missing",
    ),
    (
        "02",
        "kl-values",
        "kl = lambda mu, logvar: 0.5 * (mu**2 + (logvar / 2).exp() - 1 - logvar).sum(1)",
        "the formula wants its square",
    ),
    (
        "02",
        "kl-values",
        "kl = lambda mu, s: 0.5 * (mu**2 + (2 * s).exp() - 1 - 2 * s).sum(1)",
        "of sigma squared, not of sigma",
    ),
    (
        "02",
        "kl-values",
        "kl = lambda mu, v: 0.5 * ((mu**2 + 1) / v.exp() - 1 + v).sum(1)",
        "diverges from q",
    ),
    (
        "02",
        "kl-values",
        "kl = lambda mu, logvar: 0.5 * (mu**2 + logvar.exp() - 1 - logvar)",
        "each latent by itself",
    ),
    (
        "02",
        "reparameterise-values",
        "reparameterise = lambda mu, v, noise: mu + v.exp() * noise",
        "the variance",
    ),
    (
        "02",
        "reparameterise-values",
        "reparameterise = lambda mu, v, noise: mu + v * noise",
        "is a logarithm",
    ),
    (
        "02",
        "reparameterise-values",
        "reparameterise = lambda mu, v, noise: mu + (v / 2).exp()",
        "no noise in it",
    ),
    (
        "02",
        "reparameterise-values",
        "reparameterise = lambda mu, v, noise: mu + (v / 2).exp() * torch.randn_like(mu)",
        "sampled by you",
    ),
    (
        "02",
        "reparameterise-values",
        "reparameterise = lambda mu, v, noise: (mu + (v / 2).exp() * noise).detach()",
        "no gradient comes back",
    ),
    (
        "02",
        "active-check",
        "active = lambda kl: np.flatnonzero(kl.mean(0) > 0.05)",
        "order of the numbers",
    ),
    ("02", "active-check", "active = lambda kl: kl.mean(0) > 0.05", "return their numbers"),
    (
        "02",
        "active-check",
        "active = lambda kl: np.argsort(-np.median(kl, 0))[: (kl.mean(0) > 0.05).sum()]",
        "the median over the frames",
    ),
    (
        "02",
        "active-check",
        "solved = active\nactive = lambda kl, threshold=0.05: solved(kl)",
        "threshold is not used",
    ),
    (
        "02",
        "active-check",
        "active = lambda kl: torch.tensor([3, 0, 1])",
        "expected an array: use .numpy",
    ),
    (
        "02",
        "silence-check",
        "def silence(z, latents): z[:, latents] = 0; return z",
        "changed the z",
    ),
    (
        "02",
        "silence-check",
        "def silence(z, latents): z = z.clone(); z[[1]] = 0; return z",
        "you silenced pictures",
    ),
    (
        "02",
        "reaction-check",
        "solved = reaction\ndef reaction(*given): return solved(*given) / 2",
        "compare with -d",
    ),
    (
        "02",
        "reaction-check",
        "def reaction(vae, film, k):\n"
        "    frame, difference = to_tensors(film, earlier_frames(film, k))\n"
        "    mu, turned = vae.encode(frame, difference)[0], vae.encode(frame, -difference)[0]\n"
        "    return float((mu - turned)[50:].norm() / (mu[50:] - mu[:-50]).norm())",
        "one norm over all frames",
    ),
    (
        "02",
        "reaction-check",
        "solved = reaction\ndef reaction(*given): return torch.tensor(solved(*given))",
        "expected a number: use float",
    ),
    (
        "02",
        "reaction-check",
        "solved = reaction\ndef reaction(*given): return 1 / solved(*given)",
        "upside down",
    ),
    (
        "02",
        "reaction-check",
        "solved = reaction\ndef reaction(vae, film, k): return solved(vae, film, 4)",
        "stride is not used",
    ),
    (
        "02",
        "mean-interval-check",
        "mean_interval = lambda values, rng: np.percentile(values, [2.5, 97.5])",
        "where an episode lies",
    ),
    (
        "02",
        "mean-interval-check",
        "mean_interval = lambda values, rng: np.percentile(rng.choice(values, (10000, 12)).mean(1), [5, 95])",
        "90% interval",
    ),
    (
        "02",
        "mean-interval-check",
        "mean_interval = lambda values, rng: values.mean() + np.array([-1.96, 1.96]) * values.std() / 12**0.5",
        "the formula with 1.96",
    ),
    (
        "03",
        "log-density-values",
        "solved = log_density\nlog_density = lambda logpi, mean, s, target: solved(0 * logpi, mean, s, target)",
        "weights are missing",
    ),
    (
        "03",
        "log-density-values",
        "solved = log_density\nlog_density = lambda *given: -solved(*given)",
        "sign is turned round",
    ),
    (
        "03",
        "log-density-values",
        "def log_density(logpi, mean, logsigma, target):\n"
        "    error = (target[..., None] - mean) / logsigma.exp()\n"
        "    return torch.logsumexp(logpi - error**2 - logsigma - 0.5 * np.log(2 * np.pi), -1)",
        "factor 1/2 before the square",
    ),
    (
        "03",
        "log-density-values",
        "solved = log_density\nlog_density = lambda logpi, mean, s, target: solved(logpi, mean, s / 2, target)",
        "not ln sigma squared",
    ),
    (
        "03",
        "log-density-values",
        "log_density = lambda pi, mean, s, target: "
        "(pi * torch.distributions.Normal(mean, s.exp()).log_prob(target[..., None]).exp()).sum(-1).log()",
        "logarithms of negative numbers",
    ),
    (
        "03",
        "log-density-far",
        "log_density = lambda logpi, mean, s, target: "
        "(logpi + torch.distributions.Normal(mean, s.exp()).log_prob(target[..., None])).exp().sum(-1).log()",
        "is -inf: expected about .*logsumexp",
    ),
    (
        "03",
        "log-density-far",
        "solved = log_density\nlog_density = lambda *given: solved(*given).clamp(min=-1e5)",
        "no clamp",
    ),
    (
        "03",
        "moments-check",
        "moments = lambda p, m, s: ((p.exp() * m).sum(-1), (p.exp() * (2 * s).exp()).sum(-1).sqrt())",
        "the parts lie apart",
    ),
    (
        "03",
        "moments-check",
        "solved = moments\nmoments = lambda p, m, s: (solved(p, m, s)[0], solved(p, m, s - 50)[1])",
        "the parts are wide",
    ),
    (
        "03",
        "moments-check",
        "def moments(logpi, mean, logsigma):\n"
        "    center, within = (logpi.exp() * mean).sum(-1), (logpi.exp() * (2 * logsigma).exp()).sum(-1)\n"
        "    return center, (within + ((mean - center[..., None]) ** 2).mean(-1)).sqrt()",
        "weigh the squares",
    ),
    (
        "03",
        "moments-check",
        "solved = moments\nmoments = lambda p, m, s: solved(p, m, s / 2)",
        "its square exp",
    ),
    (
        "03",
        "moments-check",
        "solved = moments\nmoments = lambda p, m, s: solved(p, m, s)[0]",
        "return mean, deviation",
    ),
    ("03", "moments-check", "moments = lambda p, m, s: 1.0", "return mean, deviation"),
    (
        "03",
        "moments-check",
        "moments = lambda p, m, s: (m.mean(-1), s.mean(-1))",
        "weigh each mean",
    ),
    (
        "03",
        "horizon-check",
        "horizon = lambda dream, constant: int((dream > constant).any(0).argmax()) + 1",
        "take the sums over the episodes",
    ),
    (
        "03",
        "horizon-check",
        "horizon = lambda dream, constant: int(((dream > constant).mean(0) > 0.5).argmax()) + 1",
        "at this step most episodes err more",
    ),
    (
        "03",
        "horizon-check",
        "horizon = lambda dream, constant: int((dream.sum(0) > constant.sum(0)).argmax())",
        "steps count from 1",
    ),
    (
        "03",
        "horizon-check",
        "horizon = lambda dream, constant: int((dream.sum(0) > constant.sum(0)).argmax()) + 1",
        "argmax of no True",
    ),
    (
        "03",
        "horizon-check",
        "horizon = lambda dream, constant: "
        "min(len(dream.T), int(np.flatnonzero(dream.sum(0) <= constant.sum(0)).max()) + 2)",
        "find the first place",
    ),
    (
        "03",
        "horizon-interval-check",
        "horizon_interval = lambda dream, constant, rng: "
        "np.percentile([horizon(dream[[i]], constant[[i]]) for i in range(15)], [2.5, 97.5])",
        "single episodes; draw 15",
    ),
    (
        "03",
        "horizon-interval-check",
        "def horizon_interval(dream, constant, rng):\n"
        "    drawn = [np.take_along_axis(dream, rng.integers(15, size=(15, 60)), 0) for _ in range(2000)]\n"
        "    return np.percentile([horizon(d, constant) for d in drawn], [2.5, 97.5])",
        "steps of one episode belong together",
    ),
    (
        "03",
        "horizon-interval-check",
        "def horizon_interval(dream, constant, rng):\n"
        "    drawn = rng.integers(15, size=(2000, 15))\n"
        "    return np.percentile([horizon(dream[rows], constant[rows]) for rows in drawn], [5, 95])",
        "90% interval",
    ),
    (
        "03",
        "horizon-interval-check",
        "def horizon_interval(dream, constant, rng):\n"
        "    drawn = rng.integers(15, size=(2000, 15))\n"
        "    return np.percentile([horizon(dream[rows], constant) for rows in drawn], [2.5, 97.5])",
        "draw them along",
    ),
    (
        "03",
        "horizon-interval-check",
        "def horizon_interval(dream, constant, rng):\n"
        "    drawn = rng.integers(15, size=(2000, 2, 15))\n"
        "    return np.percentile([horizon(dream[one], constant[other]) for one, other in drawn], [2.5, 97.5])",
        "draw the episodes once, for both",
    ),
    (
        "04",
        "weights-check",
        "weights = lambda n: np.log(n // 2 + 0.5) - np.log(np.arange(1, n // 2 + 1))",
        "sum to 1",
    ),
    (
        "04",
        "weights-check",
        "weights = lambda n: np.log(n // 2 + 0.5) - np.log(np.arange(n // 2))",
        "ranks count from 1",
    ),
    (
        "04",
        "weights-check",
        "def weights(n):\n    raw = np.log(n // 2 + 0.5) - np.log(np.arange(n // 2))\n    return raw / raw.sum()",
        "ranks count from 1",
    ),
    (
        "04",
        "weights-check",
        "def weights(size):\n"
        "    raw = np.log(size // 2 + 0.5) - np.log(np.arange(1, size // 2 + 1))\n"
        "    return raw / raw.sum()",
        "for an even size only",
    ),
    (
        "04",
        "new-mean-check",
        "new_mean = lambda population, cost: weights(10) @ population[np.argsort(cost)[::-1][:5]]",
        "mean of the worst",
    ),
    (
        "04",
        "new-mean-check",
        "new_mean = lambda population, cost: weights(10) @ population[:5]",
        "was not sorted",
    ),
    (
        "04",
        "new-mean-check",
        "new_mean = lambda population, cost: weights(10) @ population[np.argsort(np.argsort(cost))[:5]]",
        "rows at the ranks",
    ),
    (
        "04",
        "ablate-check",
        "def ablate(c, columns): c[:-3].reshape(3, 288)[:, columns] = 0; return c",
        "changed the vector",
    ),
    (
        "04",
        "ablate-check",
        "def ablate(c, columns): c = c.copy(); c[:-3].reshape(288, 3)[columns] = 0; return c",
        r"not \(288, 3\)",
    ),
    (
        "04",
        "ablate-check",
        "solved = ablate\nablate = lambda c, columns: solved(c, slice(32, None))",
        "columns is not used",
    ),
    (
        "04",
        "expected-best-check",
        "expected_best = lambda returns, size, rng: returns.max()",
        "the largest of all",
    ),
    (
        "04",
        "expected-best-check",
        "expected_best = lambda returns, size, rng: "
        "np.mean([rng.choice(returns, size, replace=False).max() for _ in range(10000)])",
        "put the die back",
    ),
    (
        "04",
        "difference-interval-check",
        "difference_interval = lambda a, b, rng: "
        "np.percentile(rng.choice(a, (10000, 30)).mean(1) - rng.choice(b, (10000, 30)).mean(1), [2.5, 97.5])",
        "tracks of its own",
    ),
    (
        "04",
        "difference-interval-check",
        "difference_interval = lambda a, b, rng: np.percentile(a - b, [2.5, 97.5])",
        "where a track lies",
    ),
    (
        "04",
        "difference-interval-check",
        "difference_interval = lambda a, b, rng: "
        "(a - b).mean() + np.array([-1.96, 1.96]) * (a - b).std(ddof=1) / 30**0.5",
        "the formula with 1.96",
    ),
]


@pytest.mark.parametrize(
    ("number", "check", "answer", "message"), WRONG, ids=[f"{w[0]} {w[1]}: {w[3]}" for w in WRONG]
)
def test_a_typical_wrong_answer_earns_the_message_that_names_it(
    moments, number, check, answer, message
):
    names, source = moments[number, check]
    names = dict(names)
    exec(answer, names)
    with pytest.raises(AssertionError, match=message):
        exec(source, names)


def test_right_answers_of_another_form_pass_and_serve_the_cells_after_them(moments):
    names, source = moments["03", "moments-check"]
    names = dict(names)
    exec("solved = moments\nmoments = lambda *mixture: list(solved(*mixture))", names)
    exec(source, names)
    names = dict(
        moments["02", "the end"][0]
    )  # latents in an array that runs backwards, which PyTorch takes for none
    exec(
        "def active(kl, least=0.05): return np.argsort(kl.mean(0))[::-1][: (kl.mean(0) > least).sum()]",
        names,
    )
    exec(moments["02", "active-check"][1], names)
    names |= {"frames": names["frames"][:60], "before": names["before"][:60]}
    (silencing,) = [
        cell["source"] for cell in read_cells(SOURCES[NAMES[1]]) if "lively[:5]" in cell["source"]
    ]
    exec(silencing, names)


def test_cells_that_read_what_comes_along_find_it(moments):
    reading = [
        (name[:2], cell["source"])
        for name in NAMES
        for cell in read_cells(SOURCES[name])
        if "evaluation.json" in cell["source"]
    ]
    assert reading
    for number, source in reading:
        exec(source, dict(moments[number, "the end"][0]))


def test_every_check_meets_two_wrong_answers():
    checks = [
        (name[:2], grading(cell)["grade_id"])
        for name in NAMES
        for cell in read_cells(SOURCES[name])
        if grading(cell)["grade"] and not grading(cell)["solution"]
    ]
    assert [check for check in checks if sum(wrong[:2] == check for wrong in WRONG) < 2] == []
