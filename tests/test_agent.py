"""The agent: any CarRacing-v3 in, actions out, the same for one car as for many."""

import math
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

from stad_lab import Agent, load_agent, make_env
from stad_lab.agent import (
    PRETRAINED,
    drive,
    load_controller,
    load_world_model,
    read_world_model,
    run_folder,
    save_controller,
)
from stad_lab.config import Settings
from stad_lab.envs.car_racing import FastCarRacing
from stad_lab.envs.frames import to_frame
from stad_lab.models import mdn_rnn
from stad_lab.models.controller import initial_parameters, parameter_count
from stad_lab.models.mdn_rnn import MDNRNN, encode_frames
from stad_lab.models.vae import VARIANTS, AutoEncoder, load_autoencoder
from stad_lab.training.dataset import Rollouts
from stad_lab.training.pipeline import ship, train
from stad_lab.training.subspace import features


def make_agent(variant="input_output", cars=None, stride=4, crop_bar=True):
    """An untrained agent whose actions depend on all it sees; with `cars` it has a controller for each."""
    torch.manual_seed(0)
    autoencoder, mdn_rnn = AutoEncoder(variant, 32, 4).eval(), MDNRNN(32, 16, 3).eval()
    autoencoder.encoder[-1].weight.data *= 10
    size = (parameter_count(32, 16),) if cars is None else (cars, parameter_count(32, 16))
    return Agent(
        autoencoder, mdn_rnn, 0.3 * np.random.default_rng(0).standard_normal(size), stride, crop_bar
    )


def act_along(agent, observations):
    """The actions of one car, (frames, 3)."""
    agent.reset()
    return np.array([agent.act(observation) for observation in observations])


def test_actions_are_float32_within_bounds(agent, observations):
    actions = act_along(agent, observations[:10])
    assert actions.dtype == np.float32
    assert actions.shape == (10, 3)
    assert (actions >= [-1, 0, 0]).all()
    assert (actions <= 1).all()


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_batch_of_cars_acts_like_single_ones(variant, observations):
    alone = [
        act_along(make_agent(variant), observations[start : start + 12]) for start in (0, 20, 40)
    ]
    agent = make_agent(variant)
    together = [
        agent.act_batch(np.stack([observations[start + t] for start in (0, 20, 40)]))
        for t in range(12)
    ]
    assert np.allclose(np.stack(alone, axis=1), together, atol=1e-5)
    assert np.std(alone[0], axis=0).max() > 1e-3  # and the actions are not all the same


def test_the_quick_run_s_agent_acts_alike_alone_and_in_a_batch(agent, observations):
    alone = act_along(agent, observations[20:32])
    agent.reset()
    together = [agent.act_batch([observations[20 + t]] * 3) for t in range(12)]
    assert np.allclose(alone[:, None], together, atol=1e-5)


def test_each_car_may_have_a_controller_of_its_own(observations):
    many = make_agent(cars=3)
    rows = many.parameters
    together = np.array([many.act_batch([observation] * 3) for observation in observations[:8]])
    for car in range(3):
        single = make_agent()
        single.parameters = rows[car]
        assert np.allclose(together[:, car], act_along(single, observations[:8]), atol=1e-5)
    assert not np.allclose(together[:, 0], together[:, 1], atol=1e-3)


@pytest.mark.parametrize("cars", [[0, 2], np.array([True, False, True])])
def test_keep_goes_on_with_some_of_the_cars(cars, observations):
    agent = make_agent(cars=3)
    starts = (0, 20, 40)
    before = make_agent(cars=3)
    for t in range(8):
        agent.act_batch([observations[start + t] for start in starts])
        expected = before.act_batch([observations[start + t] for start in starts])
    agent.keep(np.array(cars))
    for t in range(8, 14):
        expected = before.act_batch([observations[start + t] for start in starts])
        kept = agent.act_batch([observations[start + t] for start in (0, 40)])
        assert np.allclose(kept, expected[[0, 2]], atol=1e-5)


def test_an_agent_that_has_not_acted_says_so():
    agent = make_agent(cars=3)
    with pytest.raises(ValueError, match="has not acted yet"):
        agent.keep(np.array([0]))
    with pytest.raises(ValueError, match="has not acted yet"):
        agent.take_in(np.zeros((3, 3), np.float32), None)


def test_a_folder_that_is_made_again_is_read_again(tmp_path):
    run = tmp_path / "run"
    for shipped, cropped in (("input", True), ("second_round/input", False)):
        shutil.copytree(PRETRAINED / shipped, run, dirs_exist_ok=True, copy_function=shutil.copy)
        assert load_world_model(run, "input").crop_bar is cropped
        assert load_world_model(run, "input") is load_world_model(run, "input")


def test_reset_forgets_the_past(observations):
    agent = make_agent()
    first = act_along(agent, observations[:8])
    agent.act(observations[50])
    assert not np.allclose(agent.act(observations[0]), first[0], atol=1e-5)
    assert np.array_equal(act_along(agent, observations[:8]), first)


def test_reset_gives_every_car_back():
    agent = make_agent(cars=2)
    drive(agent, [1, 2], max_frames=3)
    agent.reset()
    returns, lengths = drive(agent, [1, 2], max_frames=3)
    assert len(returns) == 2
    assert lengths.tolist() == [3, 3]


@pytest.mark.parametrize("stride", [1, 4])
def test_the_difference_is_zero_until_stride_frames_were_seen(stride, observations):
    sees, blind = make_agent(stride=stride), make_agent(stride=stride)
    encode = blind.autoencoder.encode
    blind.autoencoder.encode = lambda frame, difference: encode(frame, torch.zeros_like(difference))
    for t in range(stride + 3):
        same = np.array_equal(sees.act(observations[t]), blind.act(observations[t]))
        assert np.array_equal(sees.latents, blind.latents) == (t < stride)
        assert same == (t < stride)


def test_c_sees_the_mean_of_z_and_the_memory_before_this_frame(observations):
    agent = make_agent()
    agent.act(observations[0])
    assert agent.latents.shape == (1, 32)
    assert not agent.hidden.any()
    memory = agent.state[0][0].numpy()
    agent.act(observations[1])
    assert agent.hidden.shape == (1, 16)
    assert np.array_equal(agent.hidden, memory)
    assert memory.any()


def test_an_agent_drives_gymnasium_s_own_car_racing(agent):
    env = gymnasium.make("CarRacing-v3")
    observation, _ = env.reset(seed=5)
    agent.reset()
    for _ in range(10):
        action = agent.act(observation)
        assert env.action_space.contains(action)
        observation, *_ = env.step(action)


def test_a_script_needs_only_gymnasium_and_load_agent(quick_run, tmp_path):
    script = f"""
import gymnasium
from stad_lab import load_agent
env = gymnasium.make("CarRacing-v3")
agent = load_agent("input_output", {str(quick_run)!r})
observation, _ = env.reset(seed=5)
agent.reset()
for _ in range(5):
    observation, *_ = env.step(agent.act(observation))
print("drove")
"""
    (tmp_path / "script.py").write_text(script)
    process = subprocess.run(
        [sys.executable, tmp_path / "script.py"], capture_output=True, text=True, timeout=60
    )
    assert process.stdout == "drove\n", process.stderr


def test_cars_that_drive_in_step_end_one_by_one_with_the_returns_of_single_ones():
    tracks = [3, 11, 19]
    returns, lengths = drive(make_agent(cars=3), tracks, max_frames=120, patience=30)
    rows = make_agent(cars=3).parameters
    assert len(set(lengths)) > 1
    for car, track in enumerate(tracks):
        single = make_agent()
        single.parameters = rows[car]
        alone = drive(single, [track], max_frames=120, patience=30)
        assert lengths[car] == alone[1][0]
        assert returns[car] == pytest.approx(alone[0][0], abs=1e-6)


def test_no_gas_reaches_a_car_above_the_top_speed_and_all_below(monkeypatch):
    agent, step, seen = make_agent(), FastCarRacing.step, []
    agent.parameters = np.zeros_like(agent.parameters)
    agent.parameters[-2] = 20  # full gas

    def watched_step(env, action):
        if action is not None:
            seen.append((env.car.hull.linearVelocity.length, action[1]))
        return step(env, action)

    monkeypatch.setattr(FastCarRacing, "step", watched_step)
    for limit in (math.inf, 20.0):
        seen.clear()
        drive(agent, [4], max_frames=60, top_speed=limit)
        speed, gas = np.array(seen).T
        assert (gas[speed <= limit] > 0.9).all()
        assert (gas[speed > limit] == 0).all()
        assert len(seen) == 60 and (speed > 20).any()


def test_patience_ends_an_episode_that_reaches_no_new_tile():
    agent = make_agent()
    agent.parameters = np.zeros_like(agent.parameters)
    agent.parameters[-1] = 20  # the brake
    agent.parameters[-2] = -20  # no gas
    returns, lengths = drive(agent, [4], patience=25, max_frames=80)
    env = make_env()
    env.reset(seed=4)
    rewards = [env.step(np.array([0, 0, 1], np.float32))[1] for _ in range(80)]
    last_tile = max((t for t, reward in enumerate(rewards, 1) if reward > 0), default=0)
    assert lengths[0] == last_tile + 25
    assert returns[0] == pytest.approx(sum(rewards[: lengths[0]]))
    assert drive(agent, [4], patience=0, max_frames=80)[1][0] == 80


@pytest.mark.parametrize(
    "observation",
    [
        np.zeros((64, 64, 3), np.uint8),
        np.zeros((1, 96, 96, 3), np.uint8),
        np.zeros((96, 96, 3), np.float64),
    ],
)
def test_an_observation_of_another_shape_or_dtype_is_refused(observation, agent):
    with pytest.raises(
        ValueError, match=r"expected uint8 and \(96, 96, 3\), as CarRacing-v3 gives.*do not wrap"
    ) as error:
        agent.act(observation)
    assert str(observation.shape) in str(error.value)
    assert str(observation.dtype) in str(error.value)


def test_another_number_of_cars_is_refused(agent, observations):
    agent.act_batch(observations[:3])
    with pytest.raises(
        ValueError, match=r"2 observations, expected 3, as in the step before: call agent.reset"
    ):
        agent.act_batch(observations[:2])


def test_a_first_step_that_is_refused_leaves_the_number_of_cars_open(agent, observations):
    agent.reset()
    with pytest.raises(ValueError, match="0 observations: expected at least 1"):
        agent.act_batch([])
    with pytest.raises(ValueError, match="expected uint8"):
        agent.act(observations[0][:64])
    assert agent.act_batch(observations[:3]).shape == (3, 3)


def test_tracks_may_be_numpy_s_integers_and_none_is_below_zero(agent):
    found = [drive(agent, tracks, max_frames=3)[0] for tracks in ([1, 2], np.array([1, 2]))]
    assert np.array_equal(*found)
    with pytest.raises(ValueError, match="track -1: expected at least 0"):
        drive(agent, [3, -1])


def test_a_drive_without_a_frame_is_refused(agent):
    with pytest.raises(ValueError, match="max_frames=0: expected at least 1"):
        drive(agent, [0], max_frames=0)


def test_the_stride_of_a_run_is_that_of_its_v_its_m_its_components_and_its_agent(
    quick_run, observations, tmp_path, monkeypatch
):
    rollouts, given, weights = Rollouts(quick_run / "rollouts"), [], {}
    fit = mdn_rnn.fit_mdn_rnn
    monkeypatch.setattr(mdn_rnn, "fit_mdn_rnn", lambda *all: (given.append(all), fit(*all)))
    for stride in (4, 2):
        settings, run = (
            Settings.preset("quick", stride=stride, v_steps=2, m_steps=1),
            tmp_path / str(stride),
        )
        train("input_output", settings, run, quick_run / "rollouts", until="mdn_rnn")
        weights[stride] = load_autoencoder(run / "autoencoder.safetensors")[0].state_dict()
    assert not all(
        torch.equal(weights[2][name], weights[4][name]) for name in weights[2]
    )  # V saw other differences
    world_model = read_world_model(run, "input_output")
    path, first = run / "controller.safetensors", initial_parameters(32, 24)
    save_controller(path, first, variant="input_output", **world_model.identities)
    agent = load_agent("input_output", run)
    *_, encoded, actions, _, _ = given[-1]
    for episode, frames in enumerate(rollouts.frames):
        seen = encode_frames(agent.autoencoder, frames, 2)
        assert np.array_equal(encoded[episode], seen) and np.array_equal(
            actions[episode], rollouts.actions[episode]
        )
        assert np.array_equal(features(world_model, frames, actions[episode])[:, :32], seen[0])
    act_along(agent, observations[:4])
    frames = np.array([to_frame(observation, agent.crop_bar) for observation in observations[:4]])
    assert np.allclose(
        agent.latents[0], encode_frames(agent.autoencoder, frames, 2)[0][-1], atol=1e-5
    )


def test_a_number_of_cars_other_than_that_of_controllers_is_refused(observations):
    for count in (1, 2):
        with pytest.raises(ValueError, match=rf"\b{count} observations.*\b4 controllers"):
            make_agent(cars=4).act_batch(observations[:count])


def test_a_nan_action_never_reaches_the_car(observations):
    agent = make_agent()
    agent.mdn_rnn.lstm.bias_ih_l0.data.fill_(float("nan"))
    agent.act(observations[0])
    with pytest.raises(
        ValueError,
        match=r"action \[.*nan.*\] before squashing, expected finite numbers: check z, h and C",
    ):
        agent.act(observations[1])


def test_parameters_of_another_size_are_refused():
    agent = make_agent()
    with pytest.raises(ValueError, match=r"shape \(867,\), expected \(147,\).*another size"):
        Agent(agent.autoencoder, agent.mdn_rnn, np.zeros(867), agent.stride, agent.crop_bar)


def test_an_unknown_variant_is_refused_with_the_choices(quick_run):
    with pytest.raises(
        ValueError, match="unknown variant 'both': choose one of frame, input, output, input_output"
    ):
        load_agent("both", quick_run)


def test_a_missing_agent_is_an_error_that_names_the_command(tmp_path):
    for folder, problem in ((tmp_path, "is empty"), (tmp_path / "nowhere", "is not a folder")):
        with pytest.raises(
            FileNotFoundError,
            match=f"{problem}: expected a run made by `python -m stad_lab train --var",
        ):
            load_agent("frame", folder)


def test_a_variant_that_is_not_shipped_is_an_error_that_names_the_command(monkeypatch, tmp_path):
    (tmp_path / "input").mkdir()
    (tmp_path / "input" / "controller.safetensors").touch()
    monkeypatch.setattr("stad_lab.agent.PRETRAINED", tmp_path)
    with pytest.raises(
        FileNotFoundError,
        match="no trained 'frame' agent comes with stad_lab, only input: train one",
    ):
        load_agent("frame")


def test_without_an_agent_of_a_first_round_that_of_a_second_one_is_taken(monkeypatch, tmp_path):
    for folder in ("input", "second_round/input", "second_round/frame"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "controller.safetensors").touch()
    (tmp_path / "frame").mkdir()  # V and M alone
    monkeypatch.setattr("stad_lab.agent.PRETRAINED", tmp_path)
    assert run_folder("input") == tmp_path / "input"
    assert run_folder("frame") == tmp_path / "second_round" / "frame"
    assert run_folder("output") == tmp_path / "output"
    assert run_folder("input", "runs/mine") == Path("runs/mine")


@pytest.mark.parametrize("part", ["autoencoder", "mdn_rnn", "controller"])
def test_a_truncated_file_is_an_error_that_names_it(part, quick_run, tmp_path):
    run = shutil.copytree(quick_run, tmp_path / "run")
    file = run / f"{part}.safetensors"
    file.write_bytes(file.read_bytes()[:-10])
    with pytest.raises(
        ValueError, match=f"{part}.safetensors is damaged .*: delete it and train it: python -m"
    ):
        load_agent("input_output", run)


def test_weights_that_stad_lab_did_not_write_are_refused(quick_run, tmp_path):
    from safetensors.torch import save_file

    run = shutil.copytree(quick_run, tmp_path / "run")
    save_file({"parameters": torch.zeros(195)}, run / "controller.safetensors")
    with pytest.raises(
        ValueError,
        match=r"controller.safetensors was not written by stad_lab: give a file that `python",
    ):
        load_agent("input_output", run)


def test_a_controller_is_read_as_it_was_written(tmp_path):
    parameters = np.random.default_rng(0).standard_normal(867)
    save_controller(tmp_path / "c.safetensors", parameters, variant="input")
    assert np.array_equal(load_controller(tmp_path / "c.safetensors", "input")[0], parameters)
    with pytest.raises(
        ValueError, match="holds variant 'input', and 'frame' was asked for: give its own run"
    ):
        load_controller(tmp_path / "c.safetensors", "frame")


def test_a_shipped_agent_acts_almost_like_the_run_it_comes_from(
    quick_run, agent, observations, tmp_path
):
    shipped = load_agent("input_output", ship("input_output", quick_run, tmp_path))
    assert np.allclose(
        act_along(shipped, observations[:12]), act_along(agent, observations[:12]), atol=1e-3
    )
    sizes = [
        (folder / "autoencoder.safetensors").stat().st_size
        for folder in (tmp_path / "input_output", quick_run)
    ]
    assert sizes[0] < 0.6 * sizes[1]


def test_a_damaged_run_is_not_shipped_and_one_without_c_leaves_none_of_before(quick_run, tmp_path):
    run, target = (
        shutil.copytree(quick_run, tmp_path / "run"),
        ship("input_output", quick_run, tmp_path / "shipped"),
    )
    (target / "evaluation.json").write_text("{}")  # of the agent that was shipped
    before = {file.name: file.read_bytes() for file in target.iterdir()}
    (run / "controller.safetensors").write_bytes(b"cut short")
    with pytest.raises(ValueError, match=r"controller\.safetensors is damaged"):
        ship("input_output", run, tmp_path / "shipped")
    assert {file.name: file.read_bytes() for file in target.iterdir()} == before
    with pytest.raises(
        ValueError, match="is where agents are shipped to: give the folder of a run"
    ):
        ship("input_output", target, tmp_path / "shipped")
    assert {file.name: file.read_bytes() for file in target.iterdir()} == before
    (run / "controller.safetensors").unlink()
    (run / "evolution.json").unlink()
    (target / ".ipynb_checkpoints").mkdir()  # JupyterLab's, and not ours to remove
    ship("input_output", run, tmp_path / "shipped")
    names = {"autoencoder.safetensors", "mdn_rnn.safetensors", "record.json", ".ipynb_checkpoints"}
    assert {file.name for file in target.iterdir()} == names
