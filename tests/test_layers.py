"""The package as a whole: imports run downward, the models stand alone, the core stays small."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import stad_lab

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "stad_lab"
PACKAGES = ("stad_lab", "stad_study", "stad_course")
FILES = sorted(file for name in PACKAGES for file in (ROOT / name).rglob("*.py"))
MODELS = sorted((PACKAGE / "models").glob("*.py"))
CORE = [
    PACKAGE / "envs" / "frames.py",
    *MODELS,
    PACKAGE / "agent.py",
    PACKAGE / "envs" / "dream.py",
    *(PACKAGE / "training" / f"{name}.py" for name in ("trainer", "evolution")),
]
RUNS_CODE = ("eval", "exec", "compile", "__import__", "torch.load", "os.system")
UNSAFE = {"pickle", "dill", "joblib", "shelve", "marshal"}


def name_of(file):
    """The id of a file in a test's name."""
    return file.relative_to(ROOT).as_posix()


def parse(file):
    """The syntax tree of a file."""
    return ast.parse(file.read_text(encoding="utf-8"), str(file))


def imported(tree):
    """The modules that a tree imports, with their packages."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "a relative import"
            yield node.module


def run_python(code):
    """What a fresh Python prints that runs this code."""
    command = [sys.executable, "-c", code]
    process = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=ROOT)
    assert process.returncode == 0, process.stderr
    return process.stdout.strip()


def test_imports_run_downward():
    """pyproject.toml has the layers."""
    command = [Path(sys.executable).with_name("lint-imports"), "pyproject.toml", "--no-cache"]
    process = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=ROOT)
    assert process.returncode == 0, process.stdout + process.stderr


@pytest.mark.parametrize("file", FILES, ids=name_of)
def test_no_import_is_relative_and_no_file_can_run_code_that_it_reads(file):
    tree = parse(file)
    assert not UNSAFE & set(imported(tree))
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            assert called not in RUNS_CODE
            assert keywords.get("shell", "False") == "False"
            if called == "np.load":
                assert keywords.get("allow_pickle", "False") == "False"


@pytest.mark.parametrize("file", MODELS, ids=name_of)
def test_the_models_import_nothing_but_torch_and_numpy_and_each_other(file):
    allowed = {"torch", "numpy", *sys.stdlib_module_names}
    for name in imported(parse(file)):
        assert name.partition(".")[0] in allowed or name.startswith("stad_lab.models."), name


def test_the_command_line_loads_torch_only_when_a_command_needs_it():
    loaded = run_python("import sys, stad_lab.cli; print(*sys.modules)").split()
    assert "stad_lab.cli" in loaded and "torch" not in loaded


def test_the_package_says_what_it_offers():
    assert set(stad_lab.__all__) <= set(dir(stad_lab))
    for name in stad_lab.__all__:
        assert getattr(stad_lab, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'Settings'"):
        stad_lab.Settings  # noqa: B018


@pytest.mark.parametrize("file", FILES, ids=name_of)
def test_every_module_and_public_name_has_a_docstring(file):
    tree, kinds = parse(file), (ast.FunctionDef, ast.ClassDef)
    assert ast.get_docstring(tree)
    public = [node for node in tree.body if isinstance(node, kinds)]
    public += [
        node
        for owner in public
        if isinstance(owner, ast.ClassDef)
        for node in owner.body
        if isinstance(node, kinds)
    ]
    missing = [one.name for one in public if one.name[0] != "_" and not ast.get_docstring(one)]
    assert missing == []


def lines(files):
    """How many lines some files have together."""
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


def test_a_student_can_read_the_core_in_an_evening():
    assert lines(CORE) <= 1500, f"the core has {lines(CORE)} lines"


def test_the_library_without_its_engine_stays_small():
    engine = [*(PACKAGE / "envs").glob("*.py"), PACKAGE / "inference.py"]
    library = lines(PACKAGE.rglob("*.py")) - lines(engine)
    assert library <= 7000, f"the library has {library} lines"


def test_the_architecture_of_v_and_m_is_read_from_a_configuration_in_one_place():
    """A new setting of V or M needs its network and nothing else: the rest calls `of`."""
    calls = [
        (name_of(file), ast.unparse(node.func))
        for file in FILES
        for node in ast.walk(parse(file))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("VAE", "MDNRNN")
    ]
    assert calls == []
