"""The configuration: presets, and a clear error for every wrong value."""

import dataclasses
import inspect
import itertools

import pytest

from stad_lab import Config
from stad_lab.config import (
    PRESETS,
    TRACK_RANGES,
    DataConfig,
    EvolutionConfig,
    MDNRNNConfig,
    VAEConfig,
    check_same,
    track_seeds,
)


def test_the_paper_preset_is_the_budget_of_the_paper():
    paper = Config.preset("paper")
    assert (paper.data.episodes, paper.data.episode_frames, paper.vae.stride) == (1000, 1000, 4)
    assert (paper.evolution.generations, paper.evolution.population) == (600, 8)
    assert (paper.vae.latent_size, paper.mdn_rnn.hidden_size, paper.mdn_rnn.mixtures) == (
        32,
        256,
        5,
    )
    assert (paper.evolution.max_frames, paper.evolution.patience) == (1000, 0)


def test_the_environment_variable_names_the_preset(monkeypatch):
    monkeypatch.setenv("STAD_LAB_PRESET", "paper")
    assert Config.preset() == PRESETS["paper"]
    assert Config.preset("quick") == PRESETS["quick"]
    monkeypatch.delenv("STAD_LAB_PRESET")
    assert Config.preset() == PRESETS["laptop"] == Config()


def test_an_unknown_preset_is_refused_with_the_choices(monkeypatch):
    with pytest.raises(ValueError, match="'fats': choose one of quick, fast, laptop, paper"):
        Config.preset("fats")
    monkeypatch.setenv("STAD_LAB_PRESET", "huge")
    with pytest.raises(ValueError, match="'huge': choose one of quick, fast, laptop, paper"):
        Config.preset()


def test_a_copy_with_other_values_leaves_the_preset_as_it_is():
    changed = Config.preset("quick", seed=1, vae={"stride": 2})
    assert (changed.seed, changed.vae.stride) == (1, 2)
    assert changed.replace(seed=0, vae={"stride": 4}) == PRESETS["quick"]
    assert PRESETS["quick"].vae.stride == 4
    with pytest.raises(dataclasses.FrozenInstanceError):
        changed.vae.stride = 3


@pytest.mark.parametrize("name", PRESETS)
def test_a_config_survives_the_way_through_a_dict(name):
    assert Config.from_dict(PRESETS[name].as_dict()) == PRESETS[name]


def test_a_field_that_an_older_run_does_not_have_takes_its_default():
    older = PRESETS["quick"].as_dict()
    del older["evolution"]["replay_share"]
    assert Config.from_dict(older) == PRESETS["quick"]


@pytest.mark.parametrize(
    "make",
    [
        lambda: Config.preset("quick", vae={"strid": 2}),
        lambda: Config.from_dict({"vae": {"strid": 2}}),
    ],
)
def test_an_unknown_field_is_refused_with_the_choices(make):
    with pytest.raises(ValueError, match=r"unknown setting 'strid': expected one of .*stride"):
        make()


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("variant", "both", "choose one of 'frame', 'input', 'output', 'input_output'"),
        ("evolution.features", "x", "choose one of 'z, h', 'z', 'h'"),
        ("evolution.step_size_rule", "MSR", "choose one of 'CSA', 'TPA'"),
        ("vae.stride", 0, "expected 1 to"),
        ("vae.stride", 2.5, "expected int"),
        ("vae.stride", True, "expected int"),
        ("vae.stride", "4", "expected int"),
        ("data.crop_bar", 1, "expected bool"),
        ("evolution.sigma", 0.0, "expected 1e-12 to"),
        ("evolution.sigma", "big", "expected float"),
        ("vae.kl_weight", -0.1, "expected 0 to"),
        ("vae.kl_weight", 10**400, "expected 0 to"),
        ("vae.kl_weight", float("nan"), "expected 0 to"),
        ("evolution.initial_gas", float("nan"), "expected"),
        ("vae.learning_rate", float("inf"), "expected 1e-12 to"),
        ("data.random_starts", 1.5, "expected 0 to 1"),
        ("evolution.population", 3, "expected 4 to"),
        ("evolution.patience", -1, "expected 0 to"),
        ("processes", 0, "expected 1 to"),
        ("data.episodes", 1, "expected 2 to"),  # one to train on, one held out
        ("seed", None, "expected int"),
        ("data.episode_frames", 1500, "expected 1 to 1000"),  # CarRacing ends an episode then
        ("evolution.max_frames", 1001, "expected 1 to 1000"),
        ("processes", 10**9, "expected 1 to 10000"),
        ("vae.width", 10**6, "expected 1 to 1000"),
        ("data.episodes", 10**12, r"expected 2 to 1e\+06"),
        ("vae", 3, "expected a VAEConfig or a dict of it"),
    ],
)
def test_a_wrong_value_is_refused_with_its_name_and_what_was_expected(field, value, expected):
    stage, _, name = field.rpartition(".")
    with pytest.raises(ValueError, match=expected) as error:
        Config().replace(**{stage: {name: value}} if stage else {name: value})
    assert f"{field}={value!r}" in str(error.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"data": {"episode_frames": 80}},
            r"mdn_rnn.sequence=100 does not fit .*data.episode_frames=80: use at most 79",
        ),
        (
            {"data": {"episode_frames": 20}, "vae": {"stride": 30}, "mdn_rnn": {"sequence": 5}},
            r"data.episode_frames=20: expected more than vae.stride=30",
        ),
        (
            {"evolution": {"generations": 54}},
            r"generations=54 is not a multiple of evolution.validate_every=5",
        ),
        (
            {"evolution": {"sigma_decay": 0.5}},
            r"sigma_decay=0\.5 shrinks sigma=.* in 55 generations: use .* nearer to 1,\s+or 0",
        ),
    ],
)
def test_values_that_do_not_fit_together_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Config().replace(**changes)


@pytest.mark.parametrize("kind", [Config, DataConfig, VAEConfig, MDNRNNConfig, EvolutionConfig])
def test_every_field_has_a_sentence_of_help(kind):
    source = inspect.getsource(kind)
    for field in dataclasses.fields(kind):
        if not dataclasses.is_dataclass(field.type):
            following = source.split(f"    {field.name}: ")[1].split("\n", 2)[1].strip()
            assert following.startswith('"""'), field.name
            assert following.endswith('."""'), field.name


def test_another_value_is_refused_and_one_that_did_not_exist_counts_as_its_default(tmp_path):
    older = {"seed": 0, "vae": {"stride": 4}}
    check_same(tmp_path, older, {"vae": {"stride": 4, "free_bits": 0.0}})
    for now, message in (
        ({"vae": {"stride": 2}}, r"made with vae\.stride=4, now vae\.stride=2 is asked"),
        ({"vae": {"free_bits": 0.5}}, r"made with vae\.free_bits=0\.0, now vae\.free_bits=0\.5"),
    ):
        with pytest.raises(ValueError, match=message):
            check_same(tmp_path, older, now)


def test_no_two_uses_share_a_track():
    bounds = sorted(TRACK_RANGES.values())
    assert all(high <= low for (_, high), (low, _) in itertools.pairwise(bounds))
    for use, (low, high) in TRACK_RANGES.items():
        assert all(low <= track < high for track in track_seeds(use, 100, seed=3))
