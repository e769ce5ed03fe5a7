"""Verify: a file that was edited, and given a right checksum again, is found."""

import os
import platform
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stad_lab.agent import load_agent
from stad_lab.evaluation.evaluate import KIND, describe_agent, report
from stad_lab.evaluation.verify import verify
from stad_lab.io.files import load_json, save_json
from stad_study.ship import copy_in_half

EVALUATION, LOG, RECORD = "evaluation-run.json", "evolution.json", "record.json"


@pytest.fixture
def check(monkeypatch):
    """`verify` in this process, without driving: what it says of each part of a run."""
    monkeypatch.setattr("stad_lab.evaluation.verify.drive_again", lambda *given: "ok")
    with ThreadPoolExecutor(1) as executor:
        yield lambda folder: verify(folder, executor)


@pytest.fixture
def evaluated(quick_run, tmp_path):
    """A copy of the quick run, with an evaluation of two episodes."""
    run = shutil.copytree(quick_run, tmp_path / "run")
    summary = report([0, 1], np.array([10.0, 20.0]), np.array([60, 60]))
    identity = describe_agent(load_agent(run), fast=True)
    save_json(run / EVALUATION, {"kind": KIND, **identity, **summary, "seconds": 1.0})
    return run


def edit(file, change):
    """Change the content of a JSON file; its checksum is right again."""
    content = load_json(file)
    change(content)
    save_json(file, content)


def test_a_whole_run_has_no_failure(evaluated, check):
    found = check(evaluated)
    assert {*found} == {
        "record", "dataset", "V", "M", "log of CMA-ES", "C", "evaluations", "episodes",
    }  # fmt: skip
    assert all(outcome.startswith("ok") for outcome in found.values())


def test_an_agent_in_half_precision_is_not_measured_by_the_validations_of_its_run(
    quick_run, tmp_path
):
    shutil.copytree(quick_run, tmp_path / "run")
    copy_in_half(tmp_path / "run", tmp_path / "agent")
    found = verify(tmp_path / "agent")
    assert not any(outcome.startswith("FAILED") for outcome in found.values()), found
    assert found["episodes"].startswith("none") and "evaluate the agent first" in found["episodes"]


def worst_is_best(log):
    """Turn the ranks of the first generation around."""
    first = log["generations"][0]
    first["returns"] = [[-value for value in own] for own in first["returns"]]


def other_generation(log):
    """Name the other one of the two validated generations as the best."""
    log["best"]["generation"] = 6 - log["best"]["generation"]


SUMMARIES = [
    (lambda file: file.update(mean=950.0), "says mean=950.0"),
    (lambda file: file.update(interval=[9, 11]), "says interval="),
    (lambda file: file.update(episodes=[]), "has 0 episodes"),
    (lambda file: file["episodes"][1].update(track=0), "2 episodes on 1 tracks"),
    (lambda file: file.update(variant="frame"), "another controller"),
    (lambda file: file.update(controller="x"), "another controller"),
]
LOGS = [
    (lambda file: file["best"].update(validation=950.0), "C", "its validations give"),
    (other_generation, "C", "the log names"),
    (worst_is_best, "log of CMA-ES", "another mean in generation 1"),
]


@pytest.mark.parametrize(
    ("name", "change", "part", "message"),
    [(EVALUATION, change, "evaluations", message) for change, message in SUMMARIES]
    + [(LOG, *edited) for edited in LOGS]
    + [(RECORD, lambda file: file["config"]["vae"].update(stride=2), "V", "vae.stride=4, now")],
)
def test_an_edited_file_fails(name, change, part, message, evaluated, check):
    edit(evaluated / name, change)
    found = check(evaluated)
    assert found[part].startswith("FAILED") and message in found[part]
    others = [outcome for one, outcome in found.items() if one != part]
    assert name == LOG or all(outcome.startswith("ok") for outcome in others)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="a kind of processor of x86_64")
def test_a_record_names_the_kind_of_processor_that_blas_computes_for():
    asked = "from stad_lab.training.record import blas; print(blas())"
    for kind in ("Haswell", "Sandybridge"):
        told = subprocess.run(
            [sys.executable, "-c", asked],
            env={**os.environ, "OPENBLAS_CORETYPE": kind},
            capture_output=True,
            text=True,
            check=True,
        )
        assert told.stdout.strip().endswith(kind)
