"""The benchmark: contenders take turns, parts add up, and every measurement is kept."""

import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stad_lab.agent import load_agent
from stad_lab.benchmark import (
    FAST,
    GYMNASIUM,
    M_STEPS,
    PARTS,
    PHYSICS,
    SOURCE,
    benchmark,
    compare_pictures,
    describe,
    frame_budget,
    generation_speed,
    m_speed,
    project,
    save_world_models_sizes,
    take_turns,
    v_speed,
)
from stad_lab.cli import main
from stad_lab.config import Config
from stad_lab.io.files import load_json
from stad_lab.io.weights import load_world_model
from stad_lab.training.dataset import Dataset, collect


def test_contenders_take_turns_in_alternating_order():
    calls = []

    def contender(name, speed):
        def run(number):
            calls.append((number, name))
            return speed * (1 + number)

        return run

    table = take_turns({"slow": contender("slow", 10), "quick": contender("quick", 30)}, 3, "test")
    assert calls == [
        (0, "slow"),
        (0, "quick"),
        (1, "quick"),
        (1, "slow"),
        (2, "slow"),
        (2, "quick"),
    ]
    assert table["slow"] == {"median": 20, "ratio": 1, "rounds": [10, 20, 30]}
    assert table["quick"] == {"median": 60, "ratio": 3, "rounds": [30, 60, 90]}
    assert "60    3.00x" in describe("frames a second", table)


def test_each_part_of_a_frame_takes_less_than_the_whole():
    budget = frame_budget(cars=2, frames=40)
    whole = budget.pop("together")
    assert budget.keys() == {
        "physics",
        "reset",
        "picture",
        "preparation",
        "V",
        "M",
        "C",
        "all else",
    }
    assert all(0 < budget[name] < whole for name in ("physics", "preparation", "V", "M", "C"))


def test_agents_drive_with_world_models_sizes(tmp_path):
    save_world_models_sizes(tmp_path)
    agent = load_agent(SOURCE)
    large = load_world_model(tmp_path).vae.width
    assert large == Config.preset("paper").vae.width > agent.vae.width
    population = np.repeat(agent.parameters[None], 2, axis=0)
    with ThreadPoolExecutor(1) as executor:
        for tracks in (1, 2):
            brief = Config.preset("paper", evolution={"max_frames": 10, "tracks": tracks})
            assert generation_speed(population, brief, executor, tmp_path, 0) > 0


def test_both_renderers_are_compared_frame_by_frame():
    errors, equal = compare_pictures(1, frames=5)
    assert errors.shape == (6, 3) and equal and errors.max() < 10


@pytest.mark.long
def test_the_whole_benchmark_runs_to_its_end(tmp_path):
    file = tmp_path / "benchmark.json"
    assert main(["benchmark", "--rounds", "1", "--json", str(file)]) == 0
    assert {"made_with", "rounds", *PARTS} <= load_json(file).keys()


def test_what_is_measured_is_kept_though_a_later_part_fails(tmp_path, monkeypatch):
    def fail(rounds):
        raise ValueError("broken")

    monkeypatch.setattr("stad_lab.benchmark.PARTS", {"parity": lambda rounds: {}, "loop": fail})
    with pytest.raises(ValueError, match="broken"):
        benchmark(["parity", "loop"], 1, tmp_path / "benchmark.json")
    assert "parity" in load_json(tmp_path / "benchmark.json")


def test_the_training_of_v_and_m_is_timed(tmp_path):
    brief = {"vae": {"steps": 7}, "mdn_rnn": {"steps": M_STEPS, "batch": 2}}
    config = Config.preset("quick", variant="input", **brief)
    collect(config, tmp_path)
    for speed in (v_speed(config, Dataset(tmp_path), 0), m_speed(config, 0)):
        assert 1 < speed < 1e9


def test_more_workers_are_less_efficient_by_what_one_process_does_for_all():
    costs = {"frames a second, a batch of 1": 1000.0, "frames a second, a batch of 16": 4000.0}
    costs |= {"milliseconds of Dask for a task": 0.0}
    costs |= {"milliseconds of CMA-ES for a generation of 64": 0.0}
    assert project(costs, 1) == 1
    assert project(costs, 64) == pytest.approx(1)
    assert project(costs, 1024) == pytest.approx(0.25)  # one car for each worker
    costs["milliseconds of Dask for a task"] = 1.0
    assert project(costs, 1024) < 0.25


def test_the_command_writes_every_measurement(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("stad_lab.benchmark.MAX_FRAMES", 30)  # of an episode
    file = tmp_path / "benchmark.json"
    options = ["--parts", "renderer", "--rounds", "1", "--json", str(file)]
    assert main(["benchmark", *options]) == 0
    printed = capsys.readouterr().out
    result = json.loads(file.read_text(encoding="utf-8"))
    table = result["renderer"]["frames a second on one core"]
    assert {GYMNASIUM, FAST, PHYSICS} <= table.keys()
    assert all(len(row["rounds"]) == 1 and row["median"] > 0 for row in table.values())
    assert table[FAST]["ratio"] > 1
    command = "python -m stad_lab benchmark --parts renderer --rounds 1"
    assert result["made_with"]["command"] == command
    assert f"{FAST}  " in printed
    took_part = any(name.startswith("EnvPool") for name in table)
    assert ("EnvPool is not installed" in printed) != took_part


@pytest.mark.parametrize(("parts", "rounds"), [(["speed"], 5), (["parity"], 0)])
def test_an_unknown_part_or_no_round_is_refused(parts, rounds):
    with pytest.raises(
        ValueError,
        match=r"choose from parity, renderer, loop, training, cluster, with 1 round or more",
    ):
        benchmark(parts, rounds)
