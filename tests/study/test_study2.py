"""Study 2: the gate decides what runs, and a long run can be continued elsewhere."""

import dataclasses

import numpy as np
import pandas
import pytest

from stad_lab.config import Config
from stad_lab.io.files import load_json, save_json
from stad_lab.training.evolution import LOG
from stad_lab.training.record import RECORD
from stad_study import evolved, study2, tables
from stad_study.evolved import count_runs, find_runs, run_evolved
from stad_study.study import STUDIES
from stad_study.study2 import STUDY2, Run
from stad_study.study2_claims import describe_study2

ONE, FOUR = ([Run(seed, "frame", episodes) for seed in (300, 301)] for episodes in (1, 4))
SIXTEEN = [Run(300, "frame", 16)]


def write_tables(folder, scores):
    """Tables of runs, each with its score on all tracks."""
    rng, lines = np.random.default_rng(0), []
    for run, score in scores.items():
        returns = score + rng.normal(0, 1, 400)
        returns += score - returns.mean()
        columns = {str(1000 + track): one for track, one in enumerate(returns)}
        made = {"mean": score, "processor": "a CPU", "controller": "c"}
        lines.append(run._asdict() | columns | made)
    for name in ("runs", "returns"):
        tables.save(f"study2_{name}", pandas.DataFrame(lines), folder)


def test_the_gate_decides_what_runs(tmp_path):
    assert find_runs(STUDY2, to=tmp_path) == FOUR + ONE
    write_tables(tmp_path, dict.fromkeys(FOUR, 800.0))
    assert find_runs(STUDY2, to=tmp_path) == FOUR + ONE  # 1 episode is tried before it is decided
    write_tables(tmp_path, {FOUR[0]: 900.0, FOUR[1]: 779.0})
    assert find_runs(STUDY2, to=tmp_path) == FOUR + ONE + SIXTEEN
    write_tables(tmp_path, dict.fromkeys(FOUR, 800.0) | dict.fromkeys(ONE, 700.0))
    after = find_runs(STUDY2, to=tmp_path)[4:]
    assert {run.episodes for run in after} == {4}
    counts = pandas.Series([run.variant for run in FOUR + after]).value_counts()
    assert counts.to_dict() == {"frame": 5, "input_output": 5, "input": 2, "output": 2}
    write_tables(tmp_path, dict.fromkeys(FOUR + ONE, 500.0) | dict.fromkeys(SIXTEEN, 850.0))
    after = find_runs(STUDY2, to=tmp_path)[5:]
    counts = pandas.Series([run.variant for run in SIXTEEN + after]).value_counts()
    assert counts.to_dict() == {"frame": 2, "input_output": 2}


def test_the_comparison_waits_for_the_last_run(tmp_path):
    scores = dict.fromkeys(FOUR, 800.0) | dict.fromkeys(ONE, 700.0)
    write_tables(tmp_path, scores)
    for run in find_runs(STUDY2, to=tmp_path)[4:]:
        scores[run] = 840.0 if run.variant == "input_output" else 800.0
    write_tables(tmp_path, dict(list(scores.items())[:-1]))
    found = describe_study2(tmp_path)
    assert found["gate"]["4"]["passed"] and not found["gate"]["1"]["passed"]
    assert "comparison" not in found and "scores" not in found
    write_tables(tmp_path, scores)
    found = describe_study2(tmp_path)
    assert found["comparison"]["difference"] == pytest.approx(40, abs=2)
    assert found["comparison"]["episodes"] == 4
    assert found["scores"]["input_output, 4 each"] == [840.0] * 5
    assert found["scores"]["frame, 1 each"] == [700.0] * 2


def test_a_run_without_all_its_returns_is_refused(tmp_path):
    scores = dict.fromkeys(FOUR, 800.0) | dict.fromkeys(ONE, 700.0)
    write_tables(tmp_path, scores)
    write_tables(tmp_path, scores | dict.fromkeys(find_runs(STUDY2, to=tmp_path)[4:], 800.0))
    table = tables.read("study2_returns", tmp_path)
    table.loc[3, "1007"] = np.nan
    tables.save("study2_returns", table, tmp_path)
    with pytest.raises(ValueError, match="study2_returns: expected a return of each run"):
        describe_study2(tmp_path)


def quick(generations):
    """A budget of seconds."""
    evolution = {"generations": generations, "validate_every": 2, "max_frames": 15}
    trained = {"vae": {"steps": 4}, "mdn_rnn": {"steps": 2}}
    return Config.preset("quick", processes=1, evolution=evolution, **trained)


def test_a_run_continues_from_the_log_that_is_kept_of_it(tmp_path, monkeypatch, capsys):
    short = dataclasses.replace(STUDIES["study1"], tracks=range(1000, 1004), max_frames=20)
    monkeypatch.setitem(STUDIES, "study1", short)
    run, networks = FOUR[0], tmp_path / "networks"
    monkeypatch.setattr(study2, "CONFIG", quick(2))
    evolved.run_one(STUDY2, run, tmp_path / "stopped", networks)
    kept = networks / "study2" / run.name / LOG
    assert np.shape(load_json(kept)["generations"][1]["returns"]) == (4, 4)  # candidates, episodes
    losses = load_json(kept.parents[1] / study2.LOSSES)
    assert {name: one["history"][-1]["step"] for name, one in losses.items()} == {
        "vae": quick(2).vae.steps,
        "mdn_rnn": quick(2).mdn_rnn.steps,
    }
    monkeypatch.setattr(study2, "CONFIG", quick(4))
    to = {"only": [run.name], "to": tmp_path / "data", "networks": networks}
    run_evolved(STUDY2, tmp_path / "elsewhere", **to)
    printed = capsys.readouterr()
    assert "evolve C (frame):  50%" in printed.err and f"goes on from {kept}" in printed.out
    assert count_runs(STUDY2, tmp_path / "data")["gate, 4 each"] == (1, 2)
    run_evolved(STUDY2, tmp_path / "whole", **to)  # all of it, although the whole log is kept
    printed = capsys.readouterr()
    assert "bit-identical" in printed.out and "evolve C (frame):   0%" in printed.err


def test_one_call_goes_on_after_the_gate(tmp_path, monkeypatch):
    scores = {}

    def do_run(study, run, root, to, networks, repeat):
        scores[run] = 800.0
        write_tables(to, scores)

    monkeypatch.setattr(evolved, "do_run", do_run)
    run_evolved(STUDY2, tmp_path, to=tmp_path)
    assert (
        list(scores)[:4] == FOUR + ONE and len(scores) == len(find_runs(STUDY2, to=tmp_path)) == 16
    )


def test_v_and_m_of_a_seed_are_trained_on_one_kind_of_device(tmp_path):
    record = tmp_path / "study2" / "seed300" / "frame" / RECORD
    save_json(
        record,
        {"kind": "record", "variant": "frame", "made_with": {"trained_on": "cuda, a GPU"}},
    )
    with pytest.raises(ValueError, match="seed300/frame were trained on cuda: train those of all"):
        study2.prepare(Run(300, "input", 4), tmp_path / "runs", tmp_path)
