"""Compiling the engine: announced once, kept where a folder can be written, safe to do twice."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

import stad_lab
from stad_lab.envs.compiling import NOTICE, PATIENCE

# Compiles or loads one function, as the engine does with all of its own.
SMALL = """
import numba, sys
from stad_lab.envs import compiling, physics
with compiling.announced():
    print(physics.cross(1.0, 2.0, 3.0, 5.0))
    print(physics.along(0.0, 1.0, 2.0, 3.0))
print("kept in", physics.cross.stats.cache_path)
print("loaded", sum(physics.cross.stats.cache_hits.values()))
"""
ENGINE = """
from stad_lab.envs.cars import Cars
cars = Cars(1)
cars.reset([1])
print(cars.step([[0, 1, 0]])[0].tobytes().hex(), cars.draw().sum())
"""


def start(code, **environment):
    """A new Python that runs some code."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", code], env=os.environ | environment, **pipes)


def run(code, **environment):
    """What a new Python prints to stdout and to stderr."""
    process = start(code, **environment)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    return output.splitlines(), errors.splitlines()


# A file in the place of a folder stops every user, root too.
@pytest.fixture
def read_only_package(tmp_path):
    """A folder with a copy of the package in which nothing can be kept."""
    if os.name == "nt":
        pytest.skip("Windows itself names the folder of a user's cache")
    shutil.copytree(
        Path(stad_lab.__file__).parent / "envs",
        tmp_path / "stad_lab" / "envs",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    (tmp_path / "stad_lab" / "__init__.py").touch()
    (tmp_path / "stad_lab" / "envs" / "__pycache__").touch()
    return {"PYTHONPATH": str(tmp_path), "PYTHONSAFEPATH": "1", "NUMBA_CACHE_DIR": ""}


def test_a_read_only_package_is_kept_in_the_user_s_cache(read_only_package, tmp_path):
    home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    for loaded in (0, 1):
        output, errors = run(SMALL, **read_only_package, **home)
        assert output[-1] == f"loaded {loaded}" and errors == [NOTICE] * (1 - loaded)
        assert str(tmp_path) in output[2]


def test_without_a_home_a_folder_of_this_user_for_temporary_files_serves(
    read_only_package, tmp_path
):
    home = {"HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null/cache", "TMPDIR": str(tmp_path)}
    for loaded in (0, 1):
        output, errors = run(SMALL, **read_only_package, **home)
        assert output[-1] == f"loaded {loaded}" and errors == [NOTICE] * (1 - loaded)
    (folder,) = tmp_path.glob("stad_lab-*")
    assert str(folder) in output[2] and folder.stat().st_mode & 0o077 == 0


def test_where_nothing_can_be_written_it_compiles_each_time(read_only_package):
    home = {"HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null/cache"}
    code = "import tempfile; tempfile.tempdir = '/dev/null'\n" + SMALL
    code = code.replace('print("kept', "#").replace('print("loaded', "#")
    for _ in range(2):
        output, errors = run(code, **read_only_package, **home)
        assert output == ["-1.0", "(10.0, -2.0)"] and errors == [NOTICE]


def test_compiling_is_announced_by_one_line_and_done_once_for_two_processes_that_start_together(
    tmp_path,
):
    hits = "sum(sum(one.stats.cache_hits.values()) for one in (physics.cross, physics.along))"
    code = SMALL + f"print({hits})"
    both = [start(code, NUMBA_CACHE_DIR=str(tmp_path)) for _ in range(2)]
    loaded = {}
    for process in both:
        output, errors = process.communicate(timeout=300)
        assert process.returncode == 0 and output.startswith("-1.0\n(10.0, -2.0)\n")
        loaded[int(output.splitlines()[-1])] = errors.splitlines()
    # What the second had looked for before the first kept it, it compiles itself: one at most.
    second = max(loaded)
    assert loaded[0] == [NOTICE] and second in (1, 2) and loaded[second] == [NOTICE] * (2 - second)
    output, errors = run(code, NUMBA_CACHE_DIR=str(tmp_path))
    assert output[:2] == ["-1.0", "(10.0, -2.0)"] and output[-1] == "2" and errors == []


def test_a_process_that_was_killed_while_it_compiled_stops_no_other(tmp_path):
    process = start(SMALL, NUMBA_CACHE_DIR=str(tmp_path))
    assert process.stderr.readline() == NOTICE + "\n"
    process.kill()
    process.communicate()
    begin = time.monotonic()
    assert run(SMALL, NUMBA_CACHE_DIR=str(tmp_path))[0][:2] == ["-1.0", "(10.0, -2.0)"]
    assert time.monotonic() - begin < PATIENCE


def test_threads_that_make_the_first_cars_at_once_wait_for_one_compilation():
    code = """
from concurrent.futures import ThreadPoolExecutor
from stad_lab.envs import cars
compile_pictures, done = cars.compile_pictures, []
def note():
    compile_pictures()
    done.append(1)
cars.compile_pictures = note
def work(seed):
    car, compiled = cars.Cars(1), len(done)
    car.reset([seed])
    return compiled, int(car.draw().sum())
with ThreadPoolExecutor(4) as pool:
    found = set(pool.map(work, [1] * 4))
print(len(found), *(compiled for compiled, _ in found))
"""
    assert run(code)[0] == ["1 1"]


@pytest.mark.long
def test_two_processes_may_compile_the_whole_engine_at_once(tmp_path):
    both = [start(ENGINE, NUMBA_CACHE_DIR=str(tmp_path)) for _ in range(2)]
    found = [process.communicate(timeout=600) for process in both]
    assert found[0][0] == found[1][0] and NOTICE in found[0][1]
    output, errors = run(ENGINE, NUMBA_CACHE_DIR=str(tmp_path))
    assert output == found[0][0].splitlines() and errors == []
