"""The exercises: nbgrader gives solutions full marks and stubs none; checks name the mistake."""

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

from stad_lab.envs import frames

COURSE = Path(__file__).parent.parent / "notebooks" / "exercises"
NAMES = sorted(folder.name for folder in (COURSE / "source").glob("0*"))
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


# `pytest -m long` grades the others. Their solutions and wrong answers meet their checks below.
GRADED = [pytest.param(name, marks=[] if name[:2] == "01" else pytest.mark.long) for name in NAMES]


@pytest.fixture(scope="module")
def graded(request, generator, tmp_path_factory):
    """An assignment, handed in as its solution and as its stub, and graded: (course folder, name).

    The student with the stub has copied every cell that is to be answered, with its metadata, as
    JupyterLab does.
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
    printed = capsys.readouterr()
    assert printed.out.splitlines() == ["student,machine,person,mark,unread", *told]
    assert not printed.err


@pytest.mark.parametrize("kind", ["manual_score", "extra_credit"])
@pytest.mark.parametrize("graded", GRADED, indirect=True)
def test_points_by_hand_where_the_machine_grades_are_counted_and_warned_of(
    graded, kind, monkeypatch, capsys
):
    root, name = graded
    cells = [grading(cell) for cell in read_cells(SOURCES[name])]
    by_machine = next(cell["grade_id"] for cell in cells if cell["grade"] and not cell["solution"])
    monkeypatch.chdir(root)
    monkeypatch.setattr("sys.argv", ["marks.py", name])
    with open_gradebook(root) as gradebook:
        grade = gradebook.find_grade(by_machine, name, name, "stub")
        setattr(grade, kind, 3.0)
        gradebook.db.commit()
        runpy.run_path(str(COURSE / "marks.py"), run_name="__main__")
        setattr(grade, kind, None)
        gradebook.db.commit()
    printed = capsys.readouterr()
    assert float(printed.out.splitlines()[-1].split(",")[2]) >= 3
    assert re.fullmatch(rf"warning: stub has 3.0 points by hand on '{by_machine}'.*\n", printed.err)


@pytest.mark.parametrize("graded", GRADED, indirect=True)
def test_the_marks_of_an_unknown_assignment_end_in_one_line(graded, tmp_path, monkeypatch, capsys):
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
    assert not list(tmp_path.iterdir()) and not capsys.readouterr().out


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
    noise = "import warnings\nfrom tqdm import tqdm\nwarnings.warn('careful')\nlist(tqdm(range(2)))"
    grade = {
        "nbgrader": {"grade": True, "solution": False, "grade_id": "a", "points": 3, "locked": True}
    }
    cells = [
        nbformat.v4.new_code_cell(noise, metadata=grade),
        nbformat.v4.new_code_cell(f"import sys\n{line}"),
        nbformat.v4.new_code_cell(noise, metadata=grade),
    ]
    notebook = nbformat.v4.new_notebook(cells=cells)
    NotebookClient(notebook, timeout=60).execute()
    points = [determine_grade(cell)[0] for cell in notebook.cells[::2]]
    assert points == [0, 3]  # before the line nbgrader gives none


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


@pytest.mark.parametrize("graded", GRADED, indirect=True)
def test_an_open_exercise_ends_in_a_panel_and_not_in_a_traceback(graded):
    root, name = graded
    cells = read_cells(root / "autograded" / "stub" / name / f"{name}.ipynb")
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    panels = [output["traceback"] for output in outputs if output["output_type"] == "error"]
    assert len(panels) >= 5 and all(len(panel) == 2 for panel in panels[:3])
    assert all("Not done yet" in panel[0] for panel in panels[:3])


def test_the_notebooks_do_not_show_what_their_checks_look_for():
    for path in NOTEBOOKS:
        checks = [cell for cell in read_cells(path) if grading(cell)["grade"]]
        sources = [cell["source"] for cell in checks if not grading(cell)["solution"]]
        assert sources and all(source.startswith("checks.") for source in sources)


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


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_a_cell_has_at_most_12_lines_of_88_columns_and_a_model_answer_may_be_taller(path):
    tall, wide = 12, 88
    code = [cell for cell in read_cells(path) if cell["cell_type"] == "code"]
    lines = {cell["id"]: cell["source"].splitlines() for cell in code}
    answers = {cell["id"] for cell in code if grading(cell)["solution"] and path.parent != COURSE}
    assert [name for name, own in lines.items() if max(map(len, own)) > wide] == []
    assert {name for name, own in lines.items() if len(own) > tall} <= answers


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
    """Assignment and check -> the names that are defined before it, if all before is solved."""
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stad_lab.viz.widgets.show", lambda figure: figure)
        patch.setattr("sys.stderr", sys.stderr)  # the notebooks set it
        for name in NAMES:
            names = {}
            for cell in read_cells(SOURCES[name]):
                cell_grading = grading(cell)
                needed = cell_grading["grade_id"] or re.search(
                    r"^(def|import|from|sys\.stderr|quick|awake)\b",
                    cell["source"],
                    re.MULTILINE,
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


def read_wrong_answers():
    """Assignment, check, a wrong answer, and what the check says to it: tests/wrong_answers.txt."""
    blocks = Path(__file__).with_name("wrong_answers.txt").read_text(encoding="utf-8").split("\n\n")
    for block in blocks[1:]:
        head, answer = block.split("\n", 1)
        number, check, message = re.fullmatch(r"(\d+) ([\w-]+): (.+)", head).groups()
        yield number, check, answer, message


WRONG = list(read_wrong_answers())


@pytest.mark.parametrize(
    ("number", "check", "answer", "message"), WRONG, ids=[f"{w[0]} {w[1]}: {w[3]}" for w in WRONG]
)
def test_a_typical_wrong_answer_earns_the_message_that_names_it(
    moments, number, check, answer, message
):
    names, source = moments[number, check]
    names = vars(frames) | names  # the wrong answers use what a student is to write
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
        "def active(kl, least=0.05):\n"
        "    return np.argsort(kl.mean(0))[::-1][: (kl.mean(0) > least).sum()]",
        names,
    )
    exec(moments["02", "active-check"][1], names)
    names |= {"frames": names["frames"][:60], "before": names["before"][:60]}
    silencing = [
        cell["source"] for cell in read_cells(SOURCES[NAMES[1]]) if "most[:5]" in cell["source"]
    ]
    exec("\n".join(silencing), names)


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
