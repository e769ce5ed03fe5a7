"""The records of runs and measurements: the README says what they say, and promises what they keep."""

import json
import re
from pathlib import Path

import pytest

from stad_lab.settings import PRESETS, Settings

RECORDS = Path(__file__).parent.parent / "stad_lab" / "records"
README = (Path(__file__).parent.parent / "README.md").read_text()
STAGES = {"random episodes": "rollouts", "V": "autoencoder", "M": "mdn_rnn", "C": "controller"}


def read(name):
    return json.loads((RECORDS / name).read_text())


def cells(label):
    """The cells of README's table row with this label."""
    row = re.search(rf"^\| {re.escape(label)} \|(.*)\|$", README, re.M)
    assert row, label
    return [cell.strip() for cell in row.group(1).split("|")]


@pytest.mark.parametrize("preset", ["laptop", "paper"])
def test_a_run_was_made_with_the_preset_as_it_is_by_committed_code(preset):
    record = read(f"{preset}_input/record.json")
    assert Settings.from_dict(record["settings"]) == PRESETS[preset]
    assert record["made_with"]["commit"] and not record["made_with"]["uncommitted_changes"]
    assert len(read(f"{preset}_input/evolution.json")["generations"]) == PRESETS[preset].generations
    assert len(read(f"{preset}_input/evaluation.json")["episodes"]) == 100


@pytest.mark.parametrize(("column", "preset", "limit"), [(0, "laptop", 30), (1, "paper", 120)])
def test_the_readme_s_stages_are_the_run_s_and_keep_the_promise(column, preset, limit):
    record, result = read(f"{preset}_input/record.json"), read(f"{preset}_input/evaluation.json")
    for label, stage in STAGES.items():
        assert cells(label)[column] == f"{record['seconds'][stage] / 60:.1f}"
    minutes = (sum(record["seconds"].values()) + result["seconds"]) / 60
    assert cells("together")[column] == f"{minutes:.1f}"
    assert minutes <= limit
    assert cells("mean return of the 100")[column] == f"{result['mean']:.1f}"


def test_the_readme_s_speeds_are_the_benchmark_s():
    result = read("benchmark.json")
    speeds = result["renderer"]["frames a second on one core"] | result["loop"]["frames a second, a generation"]
    assert any(name.startswith("EnvPool") for name in speeds)
    for name, value in speeds.items():
        label = {"Gymnasium": "Gymnasium 1.4.0"}.get(name, name.removesuffix(", 2 processes"))
        if not label.endswith("1 process"):
            assert cells(label) == [f"{value['median']:,.0f}", f"{value['ratio']:.1f}"]


def test_no_process_of_the_paper_run_held_more_than_3_gb():
    memory = read("paper_input/record.json")["peak_memory"]
    assert memory.keys() == set(STAGES.values())
    assert all(0 < peak < 3000 for starts in memory.values() for start in starts for peak in start.values())
