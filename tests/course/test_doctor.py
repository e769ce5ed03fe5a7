"""The doctor: green where all is well, a line with its remedy and never a crash where it is not."""

import importlib.util
import os
import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import stad_lab
from stad_course import doctor
from stad_course.doctor import check_environment
from stad_lab.agent import PRETRAINED
from stad_lab.training.trainer import training_device

ROOT = Path(__file__).parents[2]


def check_in_a_process(*options, **variables):
    """`python -m stad_course doctor` in a process of its own."""
    command = [sys.executable, *options, "-m", "stad_course", "doctor"]
    return subprocess.run(
        command,
        cwd=ROOT,
        env=os.environ | variables,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def line(report, name):
    """The line of a report about `name`."""
    return next(line for line in report.lines if line.name == name)


def test_where_everything_is_installed_nothing_is_red(tmp_path):
    report = check_environment(tmp_path)
    assert report.ok, report
    for name in (
        "Python",
        "torch",
        "gymnasium",
        "fast renderer",
        "Gymnasium's renderer",
        "working folder",
        "GPU",
    ):
        assert line(report, name).state == "green"
    assert all(bool(line.remedy) == (line.state != "green") for line in report.lines)


def test_the_command_prints_one_line_for_each_check_and_succeeds():
    process = check_in_a_process()
    assert process.returncode == 0, process.stdout + process.stderr
    assert {text.split()[0] for text in process.stdout.splitlines()[:-1]} - {"remedy:"} <= {
        "green",
        "amber",
    }
    assert "everything needed is here" in process.stdout


def test_a_library_that_does_not_load_is_a_red_line_and_the_rest_is_still_checked(tmp_path):
    (tmp_path / "torch.py").write_text(
        "raise OSError('libgomp.so.1: cannot open “shared” object file')", encoding="utf-8"
    )
    process = check_in_a_process(
        PYTHONPATH=str(tmp_path), PYTHONIOENCODING="ascii"
    )  # a console without such letters
    assert process.returncode == 1 and process.stderr == ""
    lines = process.stdout.splitlines()
    broken = next(number for number, text in enumerate(lines) if "import torch" in text)
    assert (
        lines[broken].startswith("red")
        and r"libgomp.so.1: cannot open \u201cshared" in lines[broken]
    )
    assert "remedy: pip install -r environment.txt" in lines[broken + 1]
    assert any(text.startswith("green  fast renderer") for text in lines)


def test_a_python_without_any_library_gets_a_report_not_a_traceback():
    process = check_in_a_process("-S")
    assert process.returncode == 1 and process.stderr == ""
    assert "No module named 'numpy'" in process.stdout and "follow the remedies" in process.stdout


@pytest.fixture
def packages(monkeypatch):
    """packages(requirements, versions): what stad_lab requires, and what is installed."""

    def set_packages(requirements, versions):
        def version(name):
            if name not in versions:
                raise PackageNotFoundError(name)
            return versions[name]

        extras = SimpleNamespace(get_all=lambda key: ["lab", "tensorboard", "cluster"])
        monkeypatch.setattr(doctor, "requires", lambda name: requirements)
        monkeypatch.setattr(doctor, "metadata", lambda name: extras)
        monkeypatch.setattr(doctor, "version", version)
        return doctor.Report((*doctor.check_packages(), *doctor.check_extras()))

    return set_packages


def test_a_missing_package_and_a_wrong_version_are_red_with_what_is_needed(packages):
    report = packages(
        ["cma>=4", "gymnasium[box2d]==1.4.0", "numpy>=2", "pywin32>=1; sys_platform == 'win64'"],
        {"gymnasium": "0.29.1", "numpy": "2.1", "box2d-py": "2.3.8"},
    )
    assert not report.ok
    assert line(report, "cma").found.startswith("missing for")
    assert line(report, "gymnasium").found == "0.29.1, but stad_lab needs ==1.4.0"
    assert line(report, "numpy").state == "green"
    assert "pip uninstall box2d-py box2d" in line(report, "box2d-py").remedy
    assert all(line.name != "pywin32" for line in report.lines)


def test_what_the_notebooks_lack_is_red_and_what_another_extra_lacks_is_amber(packages):
    requirements = [
        "numpy>=2",
        "ipywidgets>=8; extra == 'lab'",
        "stad_lab[lab]; extra == 'cluster'",
    ]
    requirements += ["distributed>=2; extra == 'cluster'", "bokeh; extra == 'cluster'"]
    report = packages(requirements, {"numpy": "2.1", "distributed": "1.0"})
    assert not report.ok and line(report, "ipywidgets").found.startswith("missing for")
    report = packages(requirements, {"numpy": "2.1", "distributed": "1.0", "ipywidgets": "8.1"})
    assert report.ok
    cluster = line(report, "extra cluster")
    assert cluster.state == "amber" and "stad_lab[cluster]" in cluster.remedy
    assert cluster.found == "incomplete: distributed (1.0), bokeh (missing)"
    assert report._repr_html_().startswith("<details><summary>")  # nothing to be done: one line


def test_an_extra_of_which_nothing_is_installed_is_no_drawback(packages):
    report = packages(["numpy>=2", "tensorboard; extra == 'tensorboard'"], {"numpy": "2.1"})
    assert line(report, "extra tensorboard").state == "green"


def test_a_jupyterlab_that_shows_no_widgets_is_red(monkeypatch):
    monkeypatch.setattr("jupyter_core.paths.jupyter_path", lambda *_: ["/nowhere"])
    (found,) = doctor.check_widgets()
    assert found.state == "red" and "no slider is shown" in found.found


def test_libraries_of_other_extras_may_be_missing_but_not_broken(monkeypatch):
    found = importlib.util.find_spec

    def import_module(name):
        if name in ("distributed", "cv2"):
            raise OSError("libGL.so.1: cannot open shared object file")

    monkeypatch.setattr("importlib.import_module", import_module)
    states = {line.name: line.state for line in doctor.check_imports()}
    assert states == {"import cv2": "red", "import distributed": "amber"}
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: name != "distributed" and found(name)
    )
    assert [line.name for line in doctor.check_imports()] == ["import cv2"]


def test_a_black_picture_is_red(monkeypatch):
    black = np.zeros((96, 96, 3), np.uint8)
    monkeypatch.setattr("stad_lab.envs.cars.Cars.draw", lambda *_: black[None])
    report = doctor.Report(tuple(doctor.check_drive()))
    assert (
        line(report, "fast renderer").state == "red"
        and "black" in line(report, "fast renderer").found
    )
    assert line(report, "Gymnasium's renderer").state == "green"


def test_a_working_folder_that_is_missing_or_read_only_is_red(tmp_path, monkeypatch):
    def refuse(dir):
        raise PermissionError(f"[Errno 13] Permission denied: '{dir}'")

    def working_folder(path):
        return line(doctor.Report(tuple(doctor.check_folder(path))), "working folder")

    missing = working_folder(tmp_path / "missing")
    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    closed = working_folder(tmp_path)
    assert missing.state == closed.state == "red" and missing.remedy and closed.remedy
    assert "there is no such folder" in missing.found and "Permission denied" in closed.found


def test_little_room_is_amber_and_none_is_red():
    states = [
        doctor.graded("free disk", found, amber=3, red=1, remedy="make room").state
        for found in (4, 2, 0.5)
    ]
    assert states == ["green", "amber", "red"]


def test_in_a_container_files_that_were_read_do_not_count_as_used_memory(tmp_path, monkeypatch):
    numbers = {
        "max": "3000000000\n",
        "current": "2900000000\n",
        "stat": "anon 5\ninactive_file 2800000000\n",
    }
    for name, text in numbers.items():
        (tmp_path / f"memory.{name}").write_text(text)
    monkeypatch.setattr(doctor, "LIMITS", tmp_path)
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=8e9))
    line = next(doctor.check_memory())
    assert line.state == "green" and line.found.startswith("2.9")


def test_fewer_cores_by_a_container_s_limit_are_amber_unless_the_threads_are_set(
    tmp_path, monkeypatch
):
    (tmp_path / "cpu.max").write_text("200000 100000\n")
    monkeypatch.setattr(doctor, "LIMITS", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(64)), raising=False)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    (limited,) = doctor.check_processors()
    assert limited.state == "amber" and limited.found == "64, of which the container may use 2"
    assert limited.remedy.startswith("set OMP_NUM_THREADS=2 ")
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    assert [line.state for line in doctor.check_processors()] == ["green"]
    (tmp_path / "cpu.max").write_text("max 100000\n")
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert [line.state for line in doctor.check_processors()] == ["green"]


def test_a_gpu_that_is_too_old_for_this_pytorch_is_amber_and_not_trained_on(monkeypatch, capsys):
    def refuse(*given, device):
        raise RuntimeError("CUDA error: no kernel image is available for execution on the device")

    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.get_device_name", lambda: "Tesla V100")
    monkeypatch.setattr("torch.ones", refuse)
    (gpu,) = doctor.check_gpu()
    assert gpu.state == "amber" and "Tesla V100 cannot be used" in gpu.found
    assert "older CUDA" in gpu.remedy
    assert training_device().type == "cpu" and "no kernel image" in capsys.readouterr().err
    monkeypatch.setattr("torch.ones", lambda *given, device: torch.zeros(1))
    (gpu,) = doctor.check_gpu()
    assert gpu.state == "green" and "Tesla V100" in gpu.found


@pytest.mark.parametrize("refusing", ["torch.ones", "torch.cuda.get_device_name"])
def test_a_gpu_that_another_process_has_taken_is_amber_because_none_is_needed(
    refusing, monkeypatch
):
    def refuse(*given, **named):
        raise RuntimeError("CUDA error: all CUDA-capable devices are busy or unavailable")

    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.get_device_name", lambda: "A100")
    monkeypatch.setattr(refusing, refuse)
    (gpu,) = doctor.check_gpu()
    assert gpu.state == "amber" and "busy" in gpu.found and "none is needed" in gpu.remedy


def test_every_weight_that_comes_along_is_looked_at(tmp_path, monkeypatch):
    assert next(doctor.check_weights()).found.startswith(
        f"{len(list(PRETRAINED.rglob('*.safetensors')))} files"
    )
    cut = tmp_path / "pretrained" / "cropped_frame" / "mdn_rnn.safetensors"
    cut.parent.mkdir(parents=True)
    cut.write_bytes(b"version https://git-lfs.github.com/spec/v1")
    monkeypatch.setattr(stad_lab, "__file__", str(tmp_path / "__init__.py"))
    line = next(doctor.check_weights())
    assert line.state == "red" and "cropped_frame/mdn_rnn" in line.found


def test_an_unknown_preset_is_red_and_names_the_presets(monkeypatch):
    monkeypatch.setenv("STAD_LAB_PRESET", "lapptop")
    (wrong,) = doctor.check_preset()
    assert (
        wrong.state == "red"
        and "lapptop" in wrong.found
        and "quick, fast, laptop, paper" in wrong.remedy
    )


def test_in_a_notebook_the_remedies_stand_open_and_all_green_is_one_folded_line():
    green, red = doctor.Line("green", "a", "1"), doctor.Line("red", "b", "<2>", "do this")
    assert doctor.Report((green,))._repr_html_().startswith("<details><summary>1 green: everything")
    page = doctor.Report((green, red))._repr_html_()
    assert page.startswith("<details open>") and "do this" in page and "&lt;2&gt;" in page
