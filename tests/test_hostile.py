"""Hostile arguments and files: each is refused in one clear line, or is what was asked for.

Hypothesis draws them. The ordinary suite tries a few arguments, `pytest -m long` two thousand
arguments and files.
"""

import copy
import dataclasses
import functools
import json
import shutil

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stad_lab.agent import PRETRAINED, Agent, drive, load_agent
from stad_lab.config import Config
from stad_lab.dreaming import dream_on, make_dream
from stad_lab.envs.car_racing import make_env, place_car
from stad_lab.envs.cars import Cars
from stad_lab.envs.dream import DreamEnv
from stad_lab.envs.dreams import DreamVector
from stad_lab.envs.vector import CarRacingVector
from stad_lab.evaluation.evaluate import check_tracks, load_evaluation
from stad_lab.evaluation.verify import verify
from stad_lab.io.files import CHECKSUM, load_tensors, save_json, save_tensors
from stad_lab.io.weights import load_mdn_rnn, load_vae
from stad_lab.training.dataset import Dataset

REFUSALS = ValueError, OSError, RuntimeError, gym.error.Error
QUIET = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]

scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 3),
    st.sampled_from([10**30, -(10**30), 2**63, b"x", 1j, object(), len]),
    st.floats(),
    st.text(max_size=5),
    st.sampled_from([np.int64(1), np.float64(1.5), np.bool_(True), np.nan]),
)
junk = st.one_of(
    scalars,
    st.lists(scalars, max_size=3),
    st.dictionaries(st.text(max_size=3), scalars, max_size=2),
    st.sampled_from(
        [np.zeros(3), np.zeros((2, 3)), np.full(3, np.nan), np.array("x"), np.zeros(0)]
    ),
)


@functools.cache
def shipped():
    """The agent `input`. Every process of the tests reads this file, and one needs the agent."""
    return load_agent("input")


def acted():
    """An agent that drives two cars."""
    agent = Agent(shipped().world_model, shipped().parameters)
    agent.act_batch(np.zeros((2, 96, 96, 3), np.uint8))
    return agent


def begun(made):
    """An environment whose episode has begun."""
    made.reset()
    return made


def with_options(make, names, **fixed):
    """A call of `make` for each option, which takes the option's value."""
    return {
        f"{make.__name__} {name}": lambda value, name=name: make(**{**fixed, name: value})
        for name in names
    }


RULES = ("bar", "continuous", "lap_complete_percent", "domain_randomize", "track")
VIEWS = ("observes", "size", "frame_skip", "render_mode")
PLACE = ("tile", "speed", "turn", "offset")
BUDGET = 3  # frames: a larger number that is drawn is not driven


def dreams(make):
    """A dream of the shipped V and M."""
    return lambda **options: make(shipped().vae, shipped().mdn_rnn, **options)


CALLS = {
    **with_options(make_env, (*RULES, *VIEWS, "max_episode_steps", "fast")),
    **with_options(CarRacingVector, (*RULES, *VIEWS, "autoreset_mode", "max_episode_steps")),
    **with_options(Cars, (*RULES, "shows"), count=1),
    **{
        f"place {name}": lambda value, name=name: place_car(
            begun(make_env()), **{"tile": 1, name: value}
        )
        for name in PLACE
    },
    "place car": lambda value: begun(Cars(2)).place(value, 1),
    "Cars.reset seeds": lambda value: Cars(2).reset(value),
    "Cars.reset which": lambda value: Cars(2).reset(which=value),
    "Cars.step": lambda value: begun(Cars(2)).step(value),
    "Cars.step which": lambda value: begun(Cars(2)).step(np.zeros((1, 3)), value),
    "Cars.draw": lambda value: begun(Cars(2)).draw(value),
    "Cars.draw before reset": lambda value: Cars(2).draw(value) if value is not None else None,
    "reset seed": lambda value: make_env().reset(seed=value),
    "reset options": lambda value: make_env().reset(options=value),
    "step": lambda value: begun(make_env()).step(value),
    "vector seed": lambda value: CarRacingVector(2).reset(seed=value),
    "vector options": lambda value: CarRacingVector(2).reset(options=value),
    "vector mask": lambda value: CarRacingVector(2).reset(options={"reset_mask": value}),
    "vector step": lambda value: begun(CarRacingVector(2)).step(value),
    "dream temperature": lambda value: dreams(DreamEnv)(temperature=value),
    "dream frames": lambda value: dreams(DreamEnv)(max_frames=value),
    "dream mode": lambda value: dreams(DreamEnv)(render_mode=value),
    "dream latents": lambda value: dreams(DreamEnv)().reset(options={"latents": value}),
    "dream state": lambda value: dreams(DreamEnv)().reset(options={"state": value}),
    "dream step": lambda value: begun(dreams(DreamEnv)()).step(value),
    "dreams mode": lambda value: dreams(DreamVector)(autoreset_mode=value),
    "dreams seed": lambda value: dreams(DreamVector)(num_envs=2).reset(seed=value),
    "dreams step": lambda value: begun(dreams(DreamVector)(num_envs=2)).step(value),
    "make_dream": make_dream,
    "load_agent": load_agent,
    "drive tracks": lambda value: drive(shipped(), value, max_frames=BUDGET),
    "drive patience": lambda value: drive(shipped(), [1], max_frames=BUDGET, patience=value),
    "act": lambda value: load_agent("input").act(value),
    "act_batch": lambda value: acted().act_batch(value),
    "keep": lambda value: acted().keep(value),
    "parameters": lambda value: Agent(shipped().world_model, value),
    "check_tracks": lambda value: check_tracks(value, value),
    "preset": Config.preset,
    "from_dict": Config.from_dict,
    "dream_on seed": lambda value: dream_on(one_car(), 1, seed=value),
}


def one_car():
    """An agent that has driven one car."""
    agent = Agent(shipped().world_model, shipped().parameters)
    agent.act(np.zeros((96, 96, 3), np.uint8))
    return agent


def settings_of(config, prefix=()):
    """The places of all fields of a configuration."""
    for one in dataclasses.fields(config):
        value = getattr(config, one.name)
        if dataclasses.is_dataclass(value):
            yield from settings_of(value, (*prefix, one.name))
        else:
            yield (*prefix, one.name)


FIELDS = list(settings_of(Config()))


def assert_one_line(error):
    """The message is one line of words that is not a conversion's of Python or NumPy."""
    message = str(error)
    assert message and len(message.splitlines()) == 1 and len(message) < 600, message
    raw = "invalid literal|could not convert|truth value|unpack|inhomogeneous|broadcast"
    assert not any(words in message for words in raw.split("|")), message


def try_call(name, value):
    """Call one of CALLS; what it refuses must be in one line."""
    try:
        CALLS[name](copy.deepcopy(value))
    except REFUSALS as error:
        assert_one_line(error)


def try_setting(place, value):
    """Change a setting; it is refused in one line, or is what was asked for."""
    nested = value
    for name in reversed(place):
        nested = {name: nested}
    try:
        found = Config.from_dict(nested)
    except ValueError as error:
        assert_one_line(error)
        return
    for name in place:
        found = getattr(found, name)
    assert type(found) in (type(value), float) and found == value


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(name=st.sampled_from(sorted(CALLS)), value=junk)
def test_a_hostile_argument_is_refused_in_one_line(name, value):
    try_call(name, value)


@pytest.mark.long
@settings(max_examples=1500, deadline=None, database=None)
@given(name=st.sampled_from(sorted(CALLS)), value=junk)
def test_many_hostile_arguments_are_refused_in_one_line(name, value):
    try_call(name, value)


@settings(max_examples=300, deadline=None, derandomize=True, database=None)
@given(place=st.sampled_from(FIELDS), value=junk)
def test_a_hostile_setting_is_refused_or_is_what_was_asked_for(place, value):
    try_setting(place, value)


READERS = {
    "record.json": verify,
    "evolution.json": verify,
    "evaluation.json": lambda folder: load_evaluation(folder / "evaluation.json"),
    "dataset/manifest.json": lambda folder: Dataset(folder / "dataset"),
    "vae.safetensors": lambda folder: load_vae(folder / "vae.safetensors"),
    "mdn_rnn.safetensors": lambda folder: load_mdn_rnn(folder / "mdn_rnn.safetensors"),
    "controller.safetensors": load_agent,
}


@pytest.fixture(scope="module")
def run(quick_run, tmp_path_factory):
    """A copy of a finished run, with an evaluation."""
    folder = shutil.copytree(quick_run, tmp_path_factory.mktemp("hostile") / "run")
    shutil.copy(PRETRAINED / "input" / "evaluation.json", folder)
    return folder


def places_in(value, prefix=()):
    """The places of everything in a nested value."""
    pairs = value.items() if isinstance(value, dict) else enumerate(value)
    for key, part in pairs:
        yield (*prefix, key)
        if isinstance(part, dict | list):
            yield from places_in(part, (*prefix, key))


def put(value, place, new):
    """A copy of a nested value with another part at a place."""
    changed = copy.deepcopy(value)
    part = changed
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = new
    return changed


def try_content(run, name, draw):
    """Change a part of a file and give it the right checksum; reading it ends in one line."""
    path = run / name
    kept = path.read_bytes()
    weights = path.suffix == ".safetensors"
    tensors, found = load_tensors(path) if weights else (None, json.loads(kept))
    found.pop(CHECKSUM, None)
    place = draw(st.sampled_from(list(places_in(found))[:200]))
    changed = put(found, place, draw(json_values))
    try:
        if weights:
            save_tensors(path, tensors, **changed)
        else:
            save_json(path, changed)
        READERS[name](run)
    except REFUSALS as error:
        assert_one_line(error)
    finally:
        path.write_bytes(kept)


json_values = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-2, 10**19), st.floats(allow_nan=False))
    | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=3,
)


@pytest.mark.long
@settings(max_examples=600, deadline=None, database=None, suppress_health_check=QUIET)
@given(name=st.sampled_from(sorted(READERS)), data=st.data())
def test_many_files_with_a_hostile_content_are_refused_in_one_line(name, data, run):
    try_content(run, name, data.draw)
