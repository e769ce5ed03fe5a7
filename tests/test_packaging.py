"""The house: requirements that agree, clean code, documented names, imports that run downward, no hidden code."""

import ast
import contextlib
import dis
import importlib.metadata
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import CodeType

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "stad_lab"
ROOMS = [
    "checks",
    "settings",
    "car_racing",
    "frames",
    "checkpoints",
    "parallel",
    "training",
    "rollouts",
    "autoencoder",
    "mdn_rnn",
    "controller",
    "agent",
    "dream",
    "drives",
    "play",
    "probe",
    "quality",
    "search_space",
    "evolution",
    "second_round",
    "evaluation",
    "pipeline",
    "finish",
    "verify",
    "cluster",
    "study",
    "benchmark",
    "rows",
    "table",
    "replication",
    "plots",
    "film",
    "widgets",
    "play_widget",
    "environment",
    "__main__",
]
FILES = sorted(PACKAGE.glob("*.py"))


def parse(file):
    """The syntax tree of a file."""
    return ast.parse(file.read_text(encoding="utf-8"), str(file))


def test_environment_txt_and_pyproject_agree():
    lines = [
        line.split("#")[0].strip()
        for line in (ROOT / "environment.txt").read_text(encoding="utf-8").splitlines()
    ]
    requirements = [line for line in lines if line]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert requirements[-1] == "-e ."
    assert sorted(requirements[:-1]) == sorted(project["dependencies"])


def test_every_requirement_is_bounded_and_box2d_py_is_not_among_them():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for requirement in project["dependencies"]:
        assert "==" in requirement or "<" in requirement
        assert not requirement.startswith("box2d")
    assert "torch==2.13.0" in project["dependencies"]


def test_the_installed_versions_are_the_required_ones():
    process = subprocess.run(
        [sys.executable, "-m", "pip", "check"], capture_output=True, text=True, timeout=60
    )
    assert process.returncode == 0, process.stdout


def needed_packages():
    """Every distribution that environment.txt brings, with what those bring in turn."""
    waiting, found = ["stad_lab"], {}
    while waiting:
        name = waiting.pop()
        with contextlib.suppress(
            importlib.metadata.PackageNotFoundError
        ):  # for other systems or extras
            distribution = importlib.metadata.distribution(name)
            if distribution.name not in found:
                found[distribution.name] = distribution
                plain = [line for line in distribution.requires or [] if "extra ==" not in line]
                waiting += [re.match(r"[\w.-]+", line)[0] for line in plain]
    return found


def test_the_licences_of_all_that_is_installed_go_with_mit():
    packages = needed_packages()
    assert {"torch", "distributed", "gymnasium", "jupyterlab"} <= packages.keys()
    for name, distribution in packages.items():
        facts = distribution.metadata
        said = [facts.get("License-Expression") or "", *(facts.get_all("Classifier") or [])]
        said += [(facts.get("License") or "").partition("\n")[0]]
        licences = " ".join(line for line in said if "ense" in line or line in said[:1] + said[-1:])
        strict = re.search(r"(?<!L)GPL|Affero", licences)
        assert not strict or re.search(r"BSD|MIT|Apache|Lesser General", licences), (
            name,
            licences,
        )  # or one to choose


@pytest.mark.parametrize("command", [["check"], ["format", "--check"]])
def test_ruff_is_clean(command):
    process = subprocess.run(
        [sys.executable, "-m", "ruff", *command, ROOT], capture_output=True, text=True, timeout=60
    )
    assert process.returncode == 0, process.stdout + process.stderr


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_public_name_has_a_docstring(file):
    tree = parse(file)
    assert ast.get_docstring(tree)
    kinds = (ast.FunctionDef, ast.ClassDef)
    public = [node for node in tree.body if isinstance(node, kinds)]
    public += [
        node
        for owner in public
        for node in owner.body
        if isinstance(owner, ast.ClassDef) and isinstance(node, kinds)
    ]
    undocumented = [
        node.name for node in public if node.name[0] != "_" and not ast.get_docstring(node)
    ]
    assert undocumented == []


def test_every_file_is_a_room():
    assert {file.stem for file in FILES} - {"__init__"} <= set(ROOMS)


@pytest.mark.parametrize(
    "file", [file for file in FILES if file.stem != "__init__"], ids=lambda file: file.stem
)
def test_imports_run_downward_only(file):
    imported = set()
    for node in ast.walk(parse(file)):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        imported |= {
            name.split(".")[1] if "." in name else name
            for name in names
            if name.split(".")[0] == "stad_lab"
        }
    above = set(ROOMS[: ROOMS.index(file.stem)])
    assert imported <= above


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_nothing_that_is_read_can_run_code(file):
    for node in ast.walk(parse(file)):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            assert called not in (
                "eval",
                "exec",
                "compile",
                "__import__",
                "torch.load",
                "os.system",
            )
            keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            assert keywords.get("shell", "False") == "False"
            if called == "np.load":
                assert keywords["allow_pickle"] == "False"
        if isinstance(node, ast.Import | ast.ImportFrom):
            modules = [alias.name for alias in node.names] + [getattr(node, "module", None)]
            assert not {"pickle", "dill", "joblib", "shelve", "marshal"} & set(modules)


@pytest.mark.parametrize(
    "file", sorted((ROOT / "notebooks").rglob("*.ipynb")), ids=lambda file: file.stem
)
def test_a_notebook_is_committed_without_outputs_so_that_a_diff_shows_what_changed(file):
    text = file.read_text(encoding="utf-8")
    notebook = json.loads(text)
    assert text == json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"
    for cell in notebook["cells"]:
        assert cell.get("outputs", []) == [] and cell.get("execution_count") is None, cell["id"]
        assert not re.search(r"!\[\s*\]\(", "".join(cell["source"])), (
            f"{cell['id']}: a picture without words"
        )


@pytest.mark.parametrize("name", ["instructor", "glossary"])
def test_every_step_and_figure_that_a_page_speaks_of_is_there(name):
    page = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    pages = {
        file.name[:2]: file.read_text(encoding="utf-8")
        for file in (ROOT / "notebooks").glob("*.ipynb")
    }
    steps = re.findall(r"\b(0[0-6]), steps? (\d+)(?:(?:, \d+)*(?:,| and) (\d+))?", page)
    for notebook, *numbers in steps:
        for number in filter(None, numbers):
            assert f"## Step {number}. " in pages[notebook], f"{notebook}, step {number}"
    figures = re.findall(r"\b(0[0-6]), step \d+,(?: exercise \d+,)? \*([^*]+)\*", page)
    for notebook, title in figures:
        assert title in pages[notebook], f"{notebook}: {title}"
    assert (
        len(steps) > 30
        and (len(figures) > 10 or name == "glossary")
        and not re.search(r"\b0[0-6]-\d\d\b", page)
    )


@pytest.mark.parametrize(
    "file", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda file: file.stem
)
def test_a_notebook_has_stable_cell_ids_short_cells_and_a_readable_length(file):
    cells = json.loads(file.read_text(encoding="utf-8"))["cells"]
    ids = [cell["id"] for cell in cells]
    assert all(re.fullmatch(file.stem[:2] + r"-\d\d", name) for name in ids) and len(
        set(ids)
    ) == len(ids)
    assert 15 <= len(cells) <= 40
    long = [
        cell["id"] for cell in cells if cell["cell_type"] == "code" and len(cell["source"]) > 15
    ]
    assert long == []
    assert "check_environment()" in "".join(
        next(cell["source"] for cell in cells if cell["cell_type"] == "code")
    )


def names_in(source):
    """The names of a notebook that a cell reads without having bound them itself before, and those that it binds."""
    read, bound, codes = set(), set(), [compile(source, "cell", "exec")]
    for code in codes:
        codes += [inner for inner in code.co_consts if isinstance(inner, CodeType)]
        for instruction in dis.get_instructions(code):
            if instruction.opname == "STORE_NAME":
                bound.add(instruction.argval)
            elif (
                instruction.opname in ("LOAD_NAME", "LOAD_GLOBAL")
                and instruction.argval not in bound
            ):
                read.add(instruction.argval)
    return read, bound


@pytest.mark.parametrize(
    "file", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda file: file.stem
)
def test_a_cell_that_runs_again_finds_what_it_read_at_first_whatever_ran_since(file):
    cells = json.loads(file.read_text(encoding="utf-8"))["cells"]
    sources = {cell["id"]: "".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"}
    names = {
        cell: names_in(re.sub(r"^%.*$", "", source, flags=re.M)) for cell, source in sources.items()
    }
    order = list(names)
    for place, cell in enumerate(order):
        before, then = (
            set().union(*(names[one][1] for one in part)) for part in (order[:place], order[place:])
        )
        assert sorted(names[cell][0] & before & then) == [], cell


@pytest.mark.parametrize(
    "file", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda file: file.stem
)
def test_no_figure_is_lost_because_a_cell_goes_on_after_it_is_shown(file):
    for cell in json.loads(file.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            *before, _ = ast.parse("".join(cell["source"])).body
            assert not any(ast.unparse(one).startswith(("show(", "show_")) for one in before), cell[
                "id"
            ]


def test_the_lab_is_opened_where_every_file_that_a_notebook_links_to_is_served():
    (command,) = [
        line
        for line in (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
        if "jupyter lab" in line
    ]
    places = [word for word in command.split("jupyter lab")[1].split() if not word.startswith("--")]
    # JupyterLab serves the folder that it is given, or the one where it is started.
    served = (ROOT / places[0] if places else ROOT).resolve()
    linked = 0
    for file in [
        *(ROOT / "notebooks").glob("*.ipynb"),
        *(ROOT / "notebooks" / "exercises").glob("*.ipynb"),
    ]:
        for link in re.findall(r"\]\((\.\./[^)#]*)", file.read_text(encoding="utf-8")):
            assert (file.parent / link).resolve().is_relative_to(served), (file.name, link)
            linked += 1
    assert linked > 5


def test_ci_runs_the_one_test_command_of_the_readme():
    commands = [
        line
        for line in (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
        if line.startswith("python3 ")
    ]
    assert [command.split("&& .venv/bin/")[-1].split()[0] for command in commands] == [
        "jupyter",
        "pytest",
    ]
    assert all(
        command.startswith("python3 -m venv .venv && .venv/bin/pip install -r environment.txt")
        for command in commands
    )
    assert "grep -m 1 '^python3 .*pytest' README.md" in (ROOT / ".ci" / "run").read_text(
        encoding="utf-8"
    )
