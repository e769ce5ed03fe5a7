"""The settings: three presets, and a clear error for everything that is wrong."""

import dataclasses
import inspect

import pytest

from stad_lab import Settings
from stad_lab.config import PRESETS


def test_there_are_three_presets():
    assert list(PRESETS) == ["quick", "laptop", "paper"]
    for name in PRESETS:
        assert Settings.preset(name).name == name


def test_the_paper_preset_is_the_paper_s_budget():
    paper = Settings.preset("paper")
    assert (paper.episodes, paper.episode_frames, paper.stride) == (1000, 1000, 4)
    assert (paper.generations, paper.population) == (600, 8)
    assert (paper.latent_size, paper.hidden_size, paper.mixtures) == (32, 256, 5)
    assert paper.max_frames == 1000
    assert paper.patience == 0  # no episode is given up


def test_the_environment_variable_names_the_preset(monkeypatch):
    monkeypatch.setenv("STAD_LAB_SETTINGS", "paper")
    assert Settings.preset() == PRESETS["paper"]
    assert Settings.preset("quick") == PRESETS["quick"]
    monkeypatch.delenv("STAD_LAB_SETTINGS")
    assert Settings.preset() == PRESETS["laptop"] == Settings()


def test_a_wrong_environment_variable_is_an_error(monkeypatch):
    monkeypatch.setenv("STAD_LAB_SETTINGS", "huge")
    with pytest.raises(
        ValueError, match="unknown settings 'huge': choose one of quick, laptop, paper"
    ):
        Settings.preset()


def test_a_preset_can_be_changed():
    assert Settings.preset("quick", stride=2) == dataclasses.replace(PRESETS["quick"], stride=2)
    assert PRESETS["quick"].stride == 4


@pytest.mark.parametrize("name", PRESETS)
def test_settings_survive_the_way_through_a_dict(name):
    assert Settings.from_dict(PRESETS[name].as_dict()) == PRESETS[name]


def test_settings_cannot_be_changed_by_accident():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Settings().stride = 3


def test_an_unknown_preset_is_refused_with_the_choices():
    with pytest.raises(
        ValueError, match="unknown settings 'fast': choose one of quick, laptop, paper"
    ):
        Settings.preset("fast")


def test_a_preset_keeps_its_name():
    with pytest.raises(
        ValueError,
        match="name='laptop' of the settings 'quick': the name cannot be set; choose a preset with",
    ):
        Settings.preset("quick", name="laptop")


@pytest.mark.parametrize(
    "make", [lambda: Settings.preset("quick", strid=2), lambda: Settings.from_dict({"strid": 2})]
)
def test_an_unknown_field_is_refused_with_the_choices(make):
    with pytest.raises(
        ValueError, match=r"unknown setting 'strid': the settings are name, seed, .*stride"
    ):
        make()


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("stride", 0, "expected 1 to"),
        ("stride", 2.5, "expected int"),
        ("stride", True, "expected int"),
        ("stride", "4", "expected int"),
        ("crop_bar", 1, "expected bool"),
        ("sigma", 0.0, "expected 1e-12 to"),
        ("sigma", "big", "expected float"),
        ("kl_weight", -0.1, "expected 0 to"),
        ("kl_weight", 10**400, "expected 0 to"),
        ("kl_weight", float("nan"), "expected 0 to"),
        ("initial_gas", float("nan"), "expected"),
        ("v_learning_rate", float("inf"), "expected 1e-12 to"),
        ("random_starts", 1.5, "expected 0 to 1"),
        ("population", 3, "expected 4 to"),
        ("processes", 0, "expected 1 to"),
        ("episodes", 1, "expected 2 to"),  # one to train on, one held out
        ("seed", None, "expected int"),
        ("episode_frames", 1500, "expected 1 to 1000"),  # CarRacing ends an episode then
        ("max_frames", 1001, "expected 1 to 1000"),
        ("processes", 10**9, "expected 1 to 10000"),
        ("width", 10**6, "expected 1 to 1000"),
        ("episodes", 10**12, r"expected 2 to 1e\+06"),
        ("name", "mine", "expected the preset"),
    ],
)
def test_a_wrong_value_is_refused_with_its_name_and_what_was_expected(field, value, expected):
    with pytest.raises(ValueError, match=expected) as error:
        Settings(**{field: value})
    assert f"{field}={value!r}" in str(error.value)


def test_values_that_do_not_go_together_are_refused():
    with pytest.raises(
        ValueError, match=r"m_sequence=100 does not fit .*episode_frames=80: use at most 79"
    ):
        Settings(episode_frames=80)
    with pytest.raises(
        ValueError, match=r"episode_frames=20, but with stride=30 .*use more than 30 frames"
    ):
        Settings(episode_frames=20, stride=30, m_sequence=5)
    with pytest.raises(
        ValueError, match=r"generations=54 is not a multiple of validate_every=5: the last"
    ):
        Settings(generations=54)
    with pytest.raises(
        ValueError,
        match=r"sigma_decay=0\.5 shrinks sigma=.* in 55 generations: use .* nearer to 1, or 0",
    ):
        Settings(sigma_decay=0.5)


def test_every_setting_has_its_sentence():
    source = inspect.getsource(Settings)
    for field in dataclasses.fields(Settings):
        following = source.split(f"    {field.name}: ")[1].split("\n", 2)[1].strip()
        assert following.startswith('"""'), field.name
        assert following.endswith('."""'), field.name
