"""Packaging: lists of packages that agree, clean code, notebooks whose diffs can be read."""

import ast
import contextlib
import dis
import functools
import importlib.metadata
import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import CodeType

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
CORE = PYPROJECT["project"]["dependencies"]
EXTRAS = {  # without the extras that an extra includes
    extra: [one for one in some if not one.startswith("stad_lab[")]
    for extra, some in PYPROJECT["project"]["optional-dependencies"].items()
}
GROUPS = PYPROJECT["dependency-groups"]
MOST = 4  # packages that the engine may need
LISTED = ("train", "lab", "course", "cluster", "tensorboard")  # extras that environment.txt brings
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def read_list(name):
    """The requirements of a file, without comments and without stad_lab itself."""
    texts = (ROOT / name).read_text(encoding="utf-8").splitlines()
    found = [line.split("#")[0].strip() for line in texts]
    return [line for line in found if line and line != "-e ."]


def by_name(requirements):
    """Requirements by the package's normalised name."""
    return {normal(one.name): one for one in map(Requirement, requirements)}


def normal(name):
    """The normalised name of a package."""
    return re.sub(r"[-_.]+", "-", name).lower()


def test_environment_txt_has_the_packages_of_pyproject():
    installed = by_name(read_list("environment.txt"))
    needed = [*CORE, *(one for extra in LISTED for one in EXTRAS[extra])]
    needed = by_name([*needed, *(one for group in GROUPS.values() for one in group)])
    assert installed.keys() == needed.keys()
    for name, requirement in installed.items():
        pin = re.fullmatch(r"==([\d.]+)", str(requirement.specifier))
        assert requirement.extras == needed[name].extras
        fits = pin and needed[name].specifier.contains(pin[1])
        assert fits or requirement.specifier == needed[name].specifier, name
    assert "-e ." in (ROOT / "environment.txt").read_text(encoding="utf-8").splitlines()


def test_scores_can_be_reproduced_because_gymnasium_and_torch_are_pinned():
    installed = by_name(read_list("environment.txt"))
    for name in ("gymnasium", "torch"):
        assert str(installed[name].specifier).startswith("==")


def test_the_engine_needs_little_and_nothing_of_training_tests_pages_courses_or_notebooks():
    core = by_name(CORE)
    assert len(core) <= MOST
    others = [one for part in (EXTRAS, GROUPS) for some in part.values() for one in some]
    assert not core.keys() & by_name(others).keys()
    assert set(EXTRAS) == {"train", "lab", "course", "cluster", "tensorboard", "benchmark"}
    assert set(GROUPS) == {"test", "docs", "lint"}


def test_every_range_has_an_upper_bound_and_box2d_py_is_not_required():
    listed = [*CORE, *(one for some in EXTRAS.values() for one in some)]
    for name, requirement in by_name(listed).items():
        assert "<" in str(requirement.specifier) and not name.startswith("box2d")


def test_the_library_requires_every_package_that_it_imports():
    distributions = packages_distributions()
    extras = {name for some in EXTRAS.values() for name in by_name(some)}
    brought = {"box2d", "pygame-ce"}  # by gymnasium[box2d]
    own = ("stad_lab", "stad_study", "stad_course")
    for file in [file for name in own for file in (ROOT / name).rglob("*.py")]:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            modules += [node.module] if isinstance(node, ast.ImportFrom) else []
            for module in {one.partition(".")[0] for one in modules}:
                if module in own or module in sys.stdlib_module_names:
                    continue
                names = {normal(one) for one in distributions.get(module, [module])}
                assert names & {*by_name(CORE), *extras, *brought}, (file.name, module)


def test_the_lock_file_pins_everything_and_names_no_place():
    locked = by_name(read_list("requirements.lock"))
    for name, requirement in by_name(read_list("environment.txt")).items():
        version = str(locked[name].specifier).removeprefix("==")
        assert requirement.specifier.contains(version), name
    for line in read_list("requirements.lock"):
        assert re.fullmatch(r"[\w.-]+==[\w.]+", line), line


def test_the_installed_versions_fit_each_other():
    command = [sys.executable, "-m", "pip", "check"]
    process = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert process.returncode == 0, process.stdout


def needed_packages():
    """Every distribution that environment.txt brings, with what those bring in turn."""
    waiting, found = list(by_name(read_list("environment.txt"))), {}
    while waiting:
        name = waiting.pop()
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):  # of other systems
            distribution = importlib.metadata.distribution(name)
            if distribution.name not in found:
                found[distribution.name] = distribution
                plain = [line for line in distribution.requires or [] if "extra ==" not in line]
                waiting += [Requirement(line).name for line in plain]
    return found


def test_the_licences_of_all_that_is_installed_go_with_mit():
    packages = needed_packages()
    assert {"torch", "distributed", "gymnasium", "jupyterlab"} <= packages.keys()
    for name, distribution in packages.items():
        said = distribution.metadata
        lines = [said.get("License-Expression") or "", (said.get("License") or "").split("\n")[0]]
        lines += [line for line in said.get_all("Classifier") or [] if "License" in line]
        licences = " ".join(lines)
        strict = re.search(r"(?<!L)GPL|Affero", licences)
        free = re.search(r"BSD|MIT|Apache|Lesser General", licences)  # perhaps one to choose
        assert not strict or free, (name, licences)


BLOCK = """
import importlib.metadata, sys

class Block:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {blocked!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Block())
"""
ENGINE = """
import sys
import gymnasium, numpy
from gymnasium.utils.env_checker import check_env

NAME = "stad_lab:StadLab/CarRacing-v3"
check_env(gymnasium.make(NAME).unwrapped, skip_render_check=True)
env = gymnasium.make(NAME, render_mode="rgb_array", bar=False)
assert env.reset(seed=1)[0].shape == (96, 96, 3) and env.render().shape == (400, 600, 3)
assert (type(env.unwrapped).__name__, env.spec.max_episode_steps) == ("CarRacing", 1000)
made = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "SameStep"}
envs = gymnasium.make_vec(NAME, num_envs=16, **made)
assert (type(envs).__name__, envs.spec.id) == ("CarRacingVector", "StadLab/CarRacing-v3")
assert (envs.max_episode_steps, envs.metadata["autoreset_mode"].value) == (1000, "SameStep")
seen, _ = envs.reset(seed=1)
for _ in range(3):
    seen, rewards, *_ = envs.step(envs.action_space.sample())
assert seen.shape == (16, 96, 96, 3) and rewards.shape == (16,)
assert "torch" not in sys.modules
"""
RECORD = """
from pathlib import Path
env = gymnasium.make(NAME, render_mode="rgb_array", max_episode_steps=20)
env = gymnasium.wrappers.RecordVideo(env, "films", episode_trigger=lambda episode: True)
env.reset(seed=1)
while not env.step(env.action_space.sample())[3]:
    pass
env.close()
assert [*Path("films").glob("*.mp4")]
"""


packages_distributions = functools.cache(importlib.metadata.packages_distributions)


def blocker():
    """Code after which what the extras bring cannot be imported, as if it were not installed."""
    modules = packages_distributions()
    extras = {name for some in EXTRAS.values() for name in by_name(some)}
    return BLOCK.format(
        blocked={module for module, names in modules.items() if {*map(normal, names)} & extras}
    )


def run_code(code, **options):
    """Run code in a fresh Python: the finished process."""
    options = {"capture_output": True, "text": True, "timeout": 120} | options
    return subprocess.run([sys.executable, "-c", code], **options)


def test_the_engine_drives_where_nothing_but_its_own_packages_is_installed(tmp_path):
    process = run_code(blocker() + ENGINE, cwd=tmp_path)
    assert process.returncode == 0, process.stderr


def test_without_the_extra_that_trains_a_message_names_it():
    for code in ("from stad_lab import load_agent", "import runpy; runpy.run_module('stad_lab')"):
        run = code if "runpy" not in code else f"{code[:-1]}, run_name='__main__')"
        error = run_code(blocker() + run).stderr.splitlines()[-1]
        assert error.endswith("pip install 'stad_lab[train]'"), error


def test_the_controller_needs_numpy_alone():
    code = "import sys, stad_lab.models.controller; print(*sys.modules)"
    loaded = {name.partition(".")[0] for name in run_code(code).stdout.split()}
    own = {normal(name) for some in (CORE, *EXTRAS.values()) for name in by_name(some)}
    modules = packages_distributions()
    assert {one for one in loaded if {*map(normal, modules.get(one, []))} & own} == {"numpy"}
    assert not loaded & {"Box2D", "pygame", "cv2"}  # which gymnasium needs


@pytest.mark.parametrize(
    "first",
    [
        "import gymnasium; import stad_lab",
        "import stad_lab",
        "import stad_lab, importlib.util; importlib.util.find_spec('gymnasium')",
    ],
)
def test_the_environments_are_registered_whichever_is_imported_first(first):
    names = "'StadLab/CarRacing-v3', 'StadLab/Dream-v0'"
    code = f"{first}; import gymnasium; print(*map(gymnasium.spec, ({names})))"
    assert run_code(code).stdout.count("EnvSpec") == 2


@pytest.mark.long
def test_in_new_environments_the_engine_drives_and_with_train_an_agent_does(tmp_path):
    """A new environment gets the engine's packages, then those of `train`, which takes minutes."""
    source = shutil.copytree(
        ROOT, tmp_path / "source", ignore=shutil.ignore_patterns(".*", "notebooks", "docs", "build")
    )
    python = tmp_path / "venv" / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    run = {"check": True, "cwd": tmp_path, "timeout": 1800, "text": True}
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], **run)
    subprocess.run([python, "-m", "pip", "install", "-q", source, "moviepy"], **run)
    missing = "import importlib.util; assert not importlib.util.find_spec('torch')"
    subprocess.run([python, "-c", missing + ENGINE + RECORD], **run)
    subprocess.run([python, "-m", "pip", "install", "-q", f"{source}[train]"], **run)
    code = """
import importlib.util
from stad_lab import load_agent
from stad_lab.agent import drive
for name in ("matplotlib", "IPython", "jupyterlab", "pytest", "sphinx", "distributed"):
    assert importlib.util.find_spec(name) is None, name
episodes = drive(load_agent("frame"), [0])
print(episodes.returns[0], episodes.lengths[0])
"""
    command = [python, "-c", code]
    printed = subprocess.run(command, capture_output=True, **run).stdout.split()
    assert float(printed[0]) > 600 and 0 < int(printed[1]) <= 1000
    train = [python, "-m", "stad_lab", "train", "quick", "--out", tmp_path / "run"]
    subprocess.run(train, **run)
    assert (tmp_path / "run" / "controller.safetensors").exists()


@pytest.mark.parametrize("command", [["check"], ["format", "--check"]])
def test_ruff_is_clean(command):
    command = [sys.executable, "-m", "ruff", *command, ROOT]
    process = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert process.returncode == 0, process.stdout + process.stderr


@pytest.mark.parametrize(
    "file", sorted((ROOT / "notebooks").rglob("*.ipynb")), ids=lambda file: file.stem
)
def test_a_notebook_has_no_outputs_so_that_a_diff_shows_what_changed(file):
    text = file.read_text(encoding="utf-8")
    assert text == json.dumps(json.loads(text), indent=1, ensure_ascii=False) + "\n"
    for cell in cells_of(file):
        assert cell.get("outputs", []) == [] and cell.get("execution_count") is None, cell["id"]
        pictures = re.findall(r"!\[\s*\]\(", "".join(cell["source"]))
        assert not pictures, f"{cell['id']}: a picture without words"


def cells_of(file):
    """The cells of a notebook."""
    return json.loads(file.read_text(encoding="utf-8"))["cells"]


def texts_of(file):
    """The sources of the Markdown cells of a notebook."""
    return ["".join(cell["source"]) for cell in cells_of(file) if cell["cell_type"] == "markdown"]


def code_of(file):
    """The code cells of a notebook: id -> source."""
    cells = [cell for cell in cells_of(file) if cell["cell_type"] == "code"]
    return {cell["id"]: "".join(cell["source"]) for cell in cells}


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_a_notebook_has_stable_cell_ids_short_cells_and_a_readable_length(file):
    ids, code = [cell["id"] for cell in cells_of(file)], code_of(file)
    # The quiz, whose source gives its answers away:
    folded = {cell["id"] for cell in cells_of(file) if "jupyter" in cell["metadata"]}
    assert all(re.fullmatch(file.stem.partition("_")[0] + r"-\d\d", name) for name in ids)
    assert len(set(ids)) == len(ids)
    assert 15 <= len(ids) <= 55
    tall, wide, most = 12, 88, 2500
    lines = {name: source.splitlines() for name, source in code.items()}
    long = {name for name, own in lines.items() if len(own) > tall or max(map(len, own)) > wide}
    assert long <= folded
    assert sum(len(text.split()) for text in texts_of(file)) <= most


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_the_steps_of_a_notebook_are_numbered_without_a_gap(file):
    steps = re.findall(r"^## Step (\d+)\. ", "\n".join(texts_of(file)), re.M)
    assert steps == [str(number) for number in range(1, len(steps) + 1)]
    assert len(steps) >= 4


def test_the_first_lesson_alone_checks_the_environment():
    checks = [
        one.stem for one in NOTEBOOKS if "check_environment()" in "".join(code_of(one).values())
    ]
    assert checks == ["00_first_drive"]


def names_in(source):
    """The names of a notebook that a cell reads before it binds them, and those that it binds."""
    read, bound, codes = set(), set(), [compile(source, "cell", "exec")]
    for code in codes:
        codes += [inner for inner in code.co_consts if isinstance(inner, CodeType)]
        for one in dis.get_instructions(code):
            if one.opname == "STORE_NAME":
                bound.add(one.argval)
            elif one.opname in ("LOAD_NAME", "LOAD_GLOBAL") and one.argval not in bound:
                read.add(one.argval)
    return read, bound


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_a_cell_may_run_again_whatever_ran_since(file):
    """No cell reads a name that an earlier cell binds and a later one binds again."""
    names = {
        cell: names_in(re.sub(r"^%.*$", "", source, flags=re.M))
        for cell, source in code_of(file).items()
    }
    order = list(names)
    for place, cell in enumerate(order):
        before = set().union(*(names[one][1] for one in order[:place]))
        later = set().union(*(names[one][1] for one in order[place:]))
        assert sorted(names[cell][0] & before & later) == [], cell


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_no_figure_is_lost_because_a_cell_continues_after_it(file):
    for cell, source in code_of(file).items():
        *before, _ = ast.parse(source).body
        assert not any(ast.unparse(one).startswith(("show(", "show_")) for one in before), cell


def test_jupyterlab_serves_every_file_that_a_notebook_links_to():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (command,) = [line for line in readme.splitlines() if "jupyter lab" in line]
    places = [word for word in command.split("jupyter lab")[1].split() if not word.startswith("--")]
    # JupyterLab serves the folder that it is given, or the one where it is started.
    served = (ROOT / places[0] if places else ROOT).resolve()
    linked = 0
    for file in [*NOTEBOOKS, *(ROOT / "notebooks" / "exercises").glob("*.ipynb")]:
        for link in re.findall(r"\]\((\.\./[^)#]*)", file.read_text(encoding="utf-8")):
            assert (file.parent / link).resolve().is_relative_to(served), (file.name, link)
            linked += 1
    assert linked > 5


def test_ci_runs_the_one_test_command_of_the_readme():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    commands = [line for line in readme.splitlines() if line.startswith("python3 ")]
    install = "python3 -m venv .venv && .venv/bin/pip install -r environment.txt && .venv/bin/"
    assert all(command.startswith(install) for command in commands)
    names = [command.removeprefix(install).split()[0] for command in commands]
    assert names == ["jupyter", "pytest"]
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "grep -m 1 '^python3 .*pytest' README.md" in script


def test_the_package_says_that_it_has_types_and_under_which_licences_it_is():
    assert (ROOT / "stad_lab" / "py.typed").exists()
    assert "py.typed" in PYPROJECT["tool"]["setuptools"]["package-data"]["stad_lab"]
    files = PYPROJECT["project"]["license-files"]
    texts = [(ROOT / name).read_text(encoding="utf-8") for name in files]
    assert "MIT License" in texts[0] and "CC BY 4.0" in texts[1]


def test_the_changelog_begins_with_what_is_not_released_and_knows_the_present_version():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    versions = re.findall(r"^## (\S+)", text, re.MULTILINE)
    assert versions[:2] == ["Unreleased", PYPROJECT["project"]["version"]]


@pytest.mark.parametrize(
    "file", sorted([*(ROOT / ".github").rglob("*.yml"), ROOT / ".pre-commit-config.yaml"])
)
def test_every_file_that_a_code_host_reads_is_valid_yaml(file):
    yaml = pytest.importorskip("yaml")  # which JupyterLab and Sphinx bring
    found = yaml.safe_load(file.read_text(encoding="utf-8"))
    assert {*found} & {"jobs", "body", "repos", "blank_issues_enabled"}
