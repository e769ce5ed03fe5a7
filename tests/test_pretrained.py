"""What comes with stad_lab: every shipped part loads, drives, and is described by its own record."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from stad_lab.agent import PRETRAINED, drive, load_agent
from stad_lab.config import Settings
from stad_lab.evaluation.evaluate import summarise
from stad_lab.io.files import checksum
from stad_lab.models.mdn_rnn import load_mdn_rnn
from stad_lab.models.vae import VARIANTS, load_autoencoder
from stad_lab.training.dataset import TRACK_RANGES, track_seeds
from stad_lab.training.evolution import fitness_curves

# An agent is named by its folder: `input`, or `second_round/input`.
AGENTS = sorted(
    file.parent.relative_to(PRETRAINED).as_posix()
    for file in PRETRAINED.rglob("controller.safetensors")
)
README = Path(__file__).parent.parent / "README.md"


def read(agent, name):
    return json.loads((PRETRAINED / agent / name).read_text(encoding="utf-8"))


@pytest.mark.parametrize("variant", VARIANTS)
def test_v_and_m_of_every_variant_are_shipped_with_their_record(variant):
    _, facts = load_autoencoder(PRETRAINED / variant / "autoencoder.safetensors", variant)
    record = read(variant, "record.json")
    settings = Settings.from_dict(record["settings"])
    assert record["variant"] == variant and settings.name == "laptop"
    assert (facts["stride"], facts["latent_size"], facts["width"]) == (
        settings.stride,
        settings.latent_size,
        settings.width,
    )
    assert facts["history"][-1]["step"] == settings.v_steps
    _, m_facts = load_mdn_rnn(PRETRAINED / variant / "mdn_rnn.safetensors", variant)
    assert m_facts["history"][-1]["step"] == settings.m_steps
    assert record["made_with"]["commit"] and not record["made_with"]["uncommitted_changes"]


@pytest.mark.parametrize("variant", VARIANTS)
def test_an_agent_of_every_variant_is_shipped_and_loads_by_its_name(variant):
    assert load_agent(variant).autoencoder.variant == variant


@pytest.mark.parametrize("agent", AGENTS)
def test_a_shipped_evaluation_belongs_to_the_shipped_controller_and_to_unseen_tracks(agent):
    result = read(agent, "evaluation.json")
    returns = np.array([episode["return"] for episode in result["episodes"]])
    assert result["controller_sha256"] == checksum(
        (PRETRAINED / agent / "controller.safetensors").read_bytes()
    )
    assert result["renderer"] == "official" and len(returns) == 100
    assert summarise(returns).items() <= result.items()
    low, high = TRACK_RANGES["test"]
    assert all(low <= episode["track"] < high for episode in result["episodes"])


@pytest.mark.parametrize("agent", AGENTS)
def test_a_shipped_log_holds_every_generation_and_the_best_mean(agent):
    log, record = read(agent, "evolution.json"), read(agent, "record.json")
    settings = Settings.from_dict(record["settings"])
    assert fitness_curves(log["generations"]).shape == (3, settings.generations)
    looks = {
        entry["generation"]: entry["validation"]["mean"]
        for entry in log["generations"]
        if "validation" in entry
    }
    assert log["best"] == {
        "generation": max(looks, key=looks.get),
        "validation": max(looks.values()),
    }
    assert record["budget"]["agents"] == settings.generations * settings.population


@pytest.mark.parametrize("agent", AGENTS)
def test_a_shipped_agent_drives(agent):
    returns, _ = drive(load_agent(Path(agent).name, PRETRAINED / agent), track_seeds("test", 2, 7))
    assert returns.mean() > 600  # driving straight on, or on grass, earns less than 100


@pytest.mark.parametrize("agent", AGENTS)
def test_the_readme_reports_the_shipped_evaluation(agent):
    result = read(agent, "evaluation.json")
    table = README.read_text(encoding="utf-8").partition("| agent | all episodes |")[2]
    row = re.search(rf"^\| `{agent}` .*$", table, re.M).group()
    low, high = result["interval"]
    for figure in (
        f"{result['mean']:.1f}",
        f"{result['standard_deviation']:.1f}",
        f"{low:.1f} to {high:.1f}",
    ):
        assert figure in row


def test_the_shipped_agent_of_input_drives_as_well_with_either_renderer():
    official, fast = read("input", "evaluation.json"), read("input", "evaluation_fast.json")
    assert (official["renderer"], fast["renderer"]) == ("official", "fast")
    assert official["controller_sha256"] == fast["controller_sha256"]
    assert [episode["track"] for episode in official["episodes"]] == [
        episode["track"] for episode in fast["episodes"]
    ]
    assert abs(official["mean"] - fast["mean"]) < 15
