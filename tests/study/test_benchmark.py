"""The benchmark: contenders take turns, parts add up, and every measurement is kept."""

import json

import numpy as np
import pytest

from stad_lab.agent import load_agent
from stad_lab.config import Config
from stad_lab.io.files import load_json
from stad_lab.io.workers import worker_threads
from stad_lab.training.dataset import Dataset, collect
from stad_study.benchmark import (
    GYMNASIUM,
    M_STEPS,
    PARTS,
    SOURCE,
    benchmark,
    describe,
    frame_budget,
    generation_speed,
    m_speed,
    take_turns,
    v_speed,
)
from stad_study.cli import main


def test_contenders_take_turns_in_alternating_order():
    calls = []

    def contender(name, speed):
        def run(number):
            calls.append((number, name))
            return speed * (1 + number)

        return run

    contenders = {"slow": contender("slow", 10), "EnvPool 1": contender("quick", 20)}
    table = take_turns(contenders, 3, "test")
    assert calls[:2] == [(3, "slow"), (3, "quick")]  # these do not count
    assert calls[2:6] == [(0, "slow"), (0, "quick"), (1, "quick"), (1, "slow")]
    one = {"median": 20, "rounds": [10, 20, 30], "ratio": 1, "ratio to EnvPool": 0.5}
    assert table["slow"] == one
    assert table["EnvPool 1"]["ratio"] == 2
    assert "40    2.00x    1.00x" in describe("frames a second", table)


def test_the_parts_of_a_frame_take_time_and_leave_some_for_all_else():
    budget = frame_budget(cars=2, frames=10)
    whole = budget.pop("together")
    names = {"reset", "physics", "picture", "frames", "V", "M", "C", "all else"}
    assert budget.keys() == names
    assert whole > 0 and all(value > 0 for value in budget.values())  # no part counts twice


def test_a_generation_is_timed():
    agent = load_agent(SOURCE)
    population = np.repeat(agent.parameters[None], 2, axis=0)
    brief = Config.preset("paper", evolution={"max_frames": 10, "tracks": 1})
    with worker_threads(2) as two:
        assert generation_speed(population, brief, two, agent.world_model, 0) > 0


@pytest.mark.long
def test_the_whole_benchmark_runs_to_its_end(tmp_path, monkeypatch):
    monkeypatch.setattr("stad_study.benchmark.WHOLE_RUNS", {"a run": ("quick", ["our engine"])})
    file = tmp_path / "benchmark.json"
    assert main(["benchmark", "--rounds", "1", "--json", str(file)]) == 0
    assert {"made_with", "rounds", *PARTS} <= load_json(file).keys()


def test_what_is_measured_is_kept_though_a_later_part_fails(tmp_path, monkeypatch):
    def fail(rounds):
        raise ValueError("broken")

    monkeypatch.setattr("stad_study.benchmark.PARTS", {"parity": lambda rounds: {}, "loop": fail})
    with pytest.raises(ValueError, match="broken"):
        benchmark(["parity", "loop"], 1, tmp_path / "benchmark.json")
    assert "parity" in load_json(tmp_path / "benchmark.json")


def test_a_file_of_a_run_is_not_overwritten(tmp_path, capsys):
    file = tmp_path / "evolution.json"
    file.write_text("{}")
    assert main(["benchmark", "--json", str(file)]) == 2
    assert "choose another name" in capsys.readouterr().err and file.read_text() == "{}"


def test_the_training_of_v_and_m_is_timed(tmp_path):
    brief = {"vae": {"steps": 7}, "mdn_rnn": {"steps": M_STEPS, "batch": 2}}
    config = Config.preset("quick", variant="input", **brief)
    collect(config, tmp_path)
    for speed in (v_speed(config, Dataset(tmp_path), 0), m_speed(config, 0)):
        assert 1 < speed < 1e9


def test_the_command_writes_every_measurement_and_adds_it_if_asked(tmp_path, monkeypatch, capsys):
    added = []
    monkeypatch.setattr("stad_study.tables.add_speed", added.append)
    monkeypatch.setattr("stad_study.benchmark.MAX_FRAMES", 30)  # of a round
    file = tmp_path / "benchmark.json"
    options = ["--parts", "renderer", "--rounds", "1", "--json", str(file), "--add"]
    assert main(["benchmark", *options]) == 0 and added == [file]
    printed = capsys.readouterr().out
    result = json.loads(file.read_text(encoding="utf-8"))
    table = result["renderer"]["frames a second on one core"]
    assert all(len(row["rounds"]) == 1 and row["median"] > 0 for row in table.values())
    assert table["no picture, 16 cars"]["ratio"] > 1 == table[GYMNASIUM]["ratio"]
    assert result["made_with"]["command"].endswith("benchmark --parts renderer --rounds 1")
    assert "agent's frame, 16 cars  " in printed
    took_part = any(name.startswith("EnvPool") for name in table)
    assert ("EnvPool is not installed" in printed) != took_part


@pytest.mark.parametrize(("parts", "rounds"), [(["speed"], 5), (["parity"], 0)])
def test_an_unknown_part_or_no_round_is_refused(parts, rounds):
    choice = "choose from parity, renderer, loop, training, run, with 1 round or more"
    with pytest.raises(ValueError, match=choice):
        benchmark(parts, rounds)
