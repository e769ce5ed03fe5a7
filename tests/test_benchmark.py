"""The benchmark: fair turns, parts that add up, contenders that compute the same; the speeds are its own business."""

import dataclasses
import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stad_lab.__main__ import main
from stad_lab.agent import load_agent, read_world_model
from stad_lab.benchmark import (
    FAST,
    GYMNASIUM,
    PARTS,
    PHYSICS,
    VARIANT,
    benchmark,
    describe,
    frame_budget,
    generation_speed,
    make_world_models_sizes,
    take_turns,
    train_m,
    train_v,
)
from stad_lab.config import Settings
from stad_lab.io.files import load_json
from stad_lab.training.dataset import collect_rollouts


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
    make_world_models_sizes(tmp_path)
    brief = Settings.preset("paper", max_frames=10)
    agent = load_agent(VARIANT)
    assert (
        read_world_model(tmp_path, VARIANT).autoencoder.width
        == brief.width
        > agent.autoencoder.width
    )
    with ThreadPoolExecutor(1) as executor:
        population = np.repeat(agent.parameters[None], 2, axis=0)
        for tracks in (1, 2):
            assert (
                generation_speed(
                    population, dataclasses.replace(brief, tracks=tracks), executor, tmp_path, 0
                )
                > 0
            )


@pytest.mark.long
def test_the_whole_benchmark_runs_to_its_end(tmp_path):
    assert main(["benchmark", "--rounds", "1", "--json", str(tmp_path / "benchmark.json")]) == 0
    assert load_json(tmp_path / "benchmark.json").keys() == {"made_with", "rounds", *PARTS}


def test_what_is_measured_is_kept_though_a_later_part_fails(tmp_path, monkeypatch):
    def fail(rounds):
        raise ValueError("broken")

    monkeypatch.setattr("stad_lab.benchmark.PARTS", {"parity": lambda rounds: {}, "loop": fail})
    with pytest.raises(ValueError, match="broken"):
        benchmark(["parity", "loop"], 1, tmp_path / "benchmark.json")
    assert "parity" in load_json(tmp_path / "benchmark.json")


def test_the_plain_way_and_ours_train_the_same_v(tmp_path):
    collect_rollouts(Settings.preset("quick"), tmp_path)
    (_, plain), (_, ours) = (train_v(way, 8, tmp_path, seed=0, steps=6) for way in (True, False))
    (_, other) = train_v(False, 8, tmp_path, seed=1, steps=6)
    assert ours == pytest.approx(plain, rel=1e-3)
    assert ours != pytest.approx(other, rel=1e-3)


def test_m_s_speed_is_measured():
    assert 1 < train_m(True, seed=0, steps=6, batch=4) < 1e9


def test_the_command_writes_every_measurement(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("stad_lab.benchmark.MAX_FRAMES", 30)  # of an episode
    assert (
        main(
            [
                "benchmark",
                "--part",
                "renderer",
                "--rounds",
                "1",
                "--json",
                str(tmp_path / "benchmark.json"),
            ]
        )
        == 0
    )
    printed = capsys.readouterr().out
    result = json.loads((tmp_path / "benchmark.json").read_text(encoding="utf-8"))
    table = result["renderer"]["frames a second on one core"]
    assert {GYMNASIUM, FAST, PHYSICS} <= table.keys()
    assert all(len(row["rounds"]) == 1 and row["median"] > 0 for row in table.values())
    assert table[FAST]["ratio"] > 1
    assert (
        result["made_with"]["command"] == "python -m stad_lab benchmark --part renderer --rounds 1"
    )
    assert f"{FAST}  " in printed
    assert ("EnvPool is not installed" in printed) != any(
        name.startswith("EnvPool") for name in table
    )


@pytest.mark.parametrize(("parts", "rounds"), [(["speed"], 5), (["parity"], 0)])
def test_an_unknown_part_or_no_round_is_refused(parts, rounds):
    with pytest.raises(
        ValueError,
        match=r"choose from parity, renderer, loop, training, cluster, with 1 round or more",
    ):
        benchmark(parts, rounds)
