"""The agent: observations of CarRacing-v3 in, actions out, the same for one car as for many."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from stad_lab import Agent, load_agent, make_env
from stad_lab.agent import PRETRAINED, drive, load_world_model, rollout, run_folder, shipped_agents
from stad_lab.config import VARIANTS, Config
from stad_lab.envs.cars import Cars
from stad_lab.envs.frames import to_frame
from stad_lab.features import encode_episode, features_of, remember_episode
from stad_lab.io.weights import WorldModel, load_controller, load_vae, save_controller
from stad_lab.models.controller import initial_parameters, parameter_count
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE
from stad_lab.training.dataset import Dataset
from stad_lab.training.pipeline import train
from stad_study.ship import ship


def make_agent(variant="input_output", cars=None, stride=4):
    """An untrained agent whose actions depend on all it sees; with `cars`, a C for each."""
    torch.manual_seed(0)
    vae, mdn_rnn = VAE(variant, 32, 4).eval(), MDNRNN(32, 16, 3).eval()
    vae.encoder[-1].weight.data *= 10
    size = (parameter_count(32, 16),) if cars is None else (cars, parameter_count(32, 16))
    parameters = 0.3 * np.random.default_rng(0).standard_normal(size)
    return Agent(WorldModel(vae, mdn_rnn, stride, True, {}), parameters)


def constant_agent(gas, brake):
    """An agent that ignores what it sees."""
    agent = make_agent()
    agent.parameters = np.zeros_like(agent.parameters)
    agent.parameters[-2:] = gas, brake
    return agent


def act_along(agent, observations):
    """The actions of one car, (frames, 3)."""
    agent.reset()
    return np.array([agent.act(observation) for observation in observations])


def test_actions_are_float32_within_bounds(agent, observations):
    actions = act_along(agent, observations[:10])
    assert (actions.dtype, actions.shape) == (np.float32, (10, 3))
    assert (actions >= [-1, 0, 0]).all() and (actions <= 1).all()


@pytest.mark.parametrize("variant", [*VARIANTS, None])
def test_a_batch_of_cars_acts_like_single_ones(variant, observations, agent):
    def make():
        return make_agent(variant) if variant else agent

    starts = 0, 20, 40
    alone = [act_along(make(), observations[start : start + 12]) for start in starts]
    together = make()
    together.reset()
    batches = [np.stack([observations[start + t] for start in starts]) for t in range(12)]
    actions = [together.act_batch(batch) for batch in batches]
    assert np.allclose(np.stack(alone, axis=1), actions, atol=1e-5)
    assert not variant or np.std(alone[0], axis=0).max() > 1e-3  # the actions are not all the same


def test_each_car_may_have_a_controller_of_its_own(observations):
    many = make_agent(cars=3)
    together = np.array([many.act_batch([observation] * 3) for observation in observations[:8]])
    for car in range(3):
        single = make_agent()
        single.parameters = many.parameters[car]
        assert np.allclose(together[:, car], act_along(single, observations[:8]), atol=1e-5)
    assert not np.allclose(together[:, 0], together[:, 1], atol=1e-3)


@pytest.mark.parametrize("cars", [[0, 2], [True, False, True]])
def test_keep_continues_with_some_of_the_cars(cars, observations):
    agent, all_cars, starts = make_agent(cars=3), make_agent(cars=3), (0, 20, 40)
    for t in range(8):
        for one in (agent, all_cars):
            one.act_batch([observations[start + t] for start in starts])
    agent.keep(np.array(cars))
    for t in range(8, 14):
        expected = all_cars.act_batch([observations[start + t] for start in starts])
        kept = agent.act_batch([observations[start + t] for start in (0, 40)])
        assert np.allclose(kept, expected[[0, 2]], atol=1e-5)


def test_an_agent_that_has_not_acted_says_so():
    agent = make_agent(cars=3)
    with pytest.raises(ValueError, match="has not acted yet"):
        agent.keep(np.array([0]))
    with pytest.raises(ValueError, match="has not acted yet"):
        agent.remember(np.zeros((3, 3), np.float32), None)


@pytest.mark.parametrize("actions", [np.zeros((1, 2)), np.zeros((2, 3)), np.full((1, 3), np.nan)])
def test_m_remembers_no_actions_of_another_shape_or_that_are_not_finite(observations, actions):
    agent = make_agent()
    agent.act(observations[0])
    with pytest.raises(ValueError, match="one row for each car"):
        agent.remember(actions.astype(np.float32), None)


def test_m_remembers_actions_of_another_dtype(observations):
    agent = make_agent()
    states = []
    for dtype in (np.float32, np.float64):
        agent.act(observations[0])
        agent.remember(np.full((1, 3), 0.5, dtype), None)
        states.append(agent.state)
        agent.reset()
    assert np.array_equal(*states)


def test_reset_forgets_the_past(observations):
    agent = make_agent()
    first = act_along(agent, observations[:8])
    agent.act(observations[50])
    assert not np.allclose(agent.act(observations[0]), first[0], atol=1e-5)
    assert np.array_equal(act_along(agent, observations[:8]), first)


def test_reset_brings_every_car_back(observations):
    agent = make_agent(cars=2)
    for _ in range(2):
        assert len(agent.act_batch(observations[:2])) == 2
        agent.keep(np.array([1]))
        agent.reset()


@pytest.mark.parametrize("stride", [1, 4])
def test_the_difference_is_zero_until_stride_frames_were_seen(stride, observations):
    sees, blind = make_agent(stride=stride), make_agent(stride=stride)
    encode = blind.inference.encode
    blind.inference.encode = lambda frames, earlier: encode(frames, frames)
    for t in range(stride + 3):
        same = np.array_equal(sees.act(observations[t]), blind.act(observations[t]))
        assert np.array_equal(sees.latents, blind.latents) == same == (t < stride)


def test_c_sees_the_mean_of_z_and_the_memory_before_this_frame(observations):
    agent = make_agent()
    agent.act(observations[0])
    assert agent.latents.shape == (1, 32)
    assert not agent.hidden.any()
    memory = agent.state[0]
    agent.act(observations[1])
    assert agent.hidden.shape == (1, 16)
    assert np.array_equal(agent.hidden, memory)
    assert memory.any()


def test_the_features_of_a_whole_episode_are_what_c_sees_frame_by_frame(observations):
    agent, frames = make_agent(), np.array([to_frame(one) for one in observations[:9]])
    actions, seen = [], []
    for observation in observations[:9]:
        actions.append(agent.act(observation))
        seen.append(np.concatenate([agent.latents[0], agent.hidden[0]]))
    features = features_of(agent.world_model, frames, np.array(actions))
    assert np.allclose(features, seen, atol=1e-5)
    assert np.array_equal(features[:, :32], encode_episode(agent.vae, frames, 4)[0])
    hidden = remember_episode(agent.mdn_rnn, features[:, :32].copy(), np.array(actions))
    assert np.array_equal(features[:, 32:], hidden)


def test_a_fresh_script_dreams_by_a_name_and_drives_with_load_agent(quick_run, tmp_path):
    script = f"""
import gymnasium
env = gymnasium.make("stad_lab:StadLab/Dream-v0", agent="frame", render_mode="rgb_array")
env.reset(seed=0)
env.step(env.action_space.sample())
print(env.render().shape, env.unwrapped.vae.variant)
from stad_lab import load_agent
env = gymnasium.make("CarRacing-v3")
agent = load_agent({str(quick_run)!r})
observation, _ = env.reset(seed=5)
agent.reset()
for _ in range(5):
    observation, *_ = env.step(agent.act(observation))
print("drove")
"""
    (tmp_path / "script.py").write_text(script)
    command = [sys.executable, tmp_path / "script.py"]
    process = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert process.stdout == "(64, 64, 3) frame\ndrove\n", process.stderr


def test_cars_in_a_batch_end_one_by_one_with_the_returns_of_single_ones():
    tracks, limits = [3, 11, 19], {"max_frames": 120, "patience": 30}
    agent = make_agent(cars=3)
    together = drive(agent, tracks, **limits)
    assert len(set(together.lengths)) > 1
    for car, track in enumerate(tracks):
        single = make_agent()
        single.parameters = agent.parameters[car]
        alone = drive(single, [track], **limits)
        assert together.lengths[car] == alone.lengths[0] == len(together.rewards[car])
        assert together.returns[car] == pytest.approx(alone.returns[0], abs=1e-6)
        assert together.rewards[car] == pytest.approx(alone.rewards[0], abs=1e-6)


def test_an_observer_sees_every_frame_and_action_before_the_step():
    seen, agent = [], make_agent(cars=2)
    drive(agent, [3, 11], max_frames=5, observe=lambda *given: seen.append(given))
    assert [cars.tolist() for cars, *_ in seen] == [[0, 1]] * 5
    cars = Cars(1, "frame", bar=not agent.world_model.crop_bar)
    cars.reset([3])
    for _, frames, actions in seen:
        assert np.array_equal(frames[0], cars.draw()[0])
        cars.step(actions[:1])


def test_a_lost_car_ends_after_so_many_frames_without_a_new_tile():
    agent = constant_agent(gas=-20, brake=20)
    episodes = drive(agent, [4], patience=25, max_frames=80)
    env = make_env()
    env.reset(seed=4)
    rewards = [env.step(np.array([0, 0, 1], np.float32))[1] for _ in range(80)]
    last_tile = max((t for t, reward in enumerate(rewards, 1) if reward > 0), default=0)
    assert episodes.lengths[0] == last_tile + 25
    assert episodes.returns[0] == pytest.approx(sum(rewards[: episodes.lengths[0]]))
    assert drive(agent, [4], patience=0, max_frames=80).lengths[0] == 80


@pytest.mark.parametrize(
    "observation",
    [
        np.zeros((64, 64, 3), np.uint8),
        np.zeros((1, 96, 96, 3), np.uint8),
        np.zeros((96, 96, 3), np.float64),
    ],
)
def test_an_observation_of_another_shape_or_dtype_is_refused(observation, agent):
    message = r"expected uint8 and \(96, 96, 3\), as CarRacing-v3 gives.*without wrappers"
    with pytest.raises(ValueError, match=message) as error:
        agent.act(observation)
    assert str(observation.shape) in str(error.value)
    assert str(observation.dtype) in str(error.value)


def test_a_frame_whose_numbers_are_not_bytes_is_refused(agent):
    with pytest.raises(ValueError, match=r"dtype int64 .*expected uint8"):
        agent.act_batch(np.full((1, 64, 64, 3), 1000))


def test_another_number_of_cars_is_refused(agent, observations):
    agent.act_batch(observations[:3])
    with pytest.raises(ValueError, match=r"2 observations, expected 3: .*call agent.reset"):
        agent.act_batch(observations[:2])
    for count in (1, 2):
        with pytest.raises(ValueError, match=rf"\b{count} observations, expected 4"):
            make_agent(cars=4).act_batch(observations[:count])


def test_a_first_step_that_is_refused_leaves_the_number_of_cars_open(agent, observations):
    agent.reset()
    with pytest.raises(ValueError, match="0 observations, expected at least 1"):
        agent.act_batch([])
    with pytest.raises(ValueError, match="expected uint8"):
        agent.act(observations[0][:64])
    assert agent.act_batch(observations[:3]).shape == (3, 3)


def test_tracks_may_be_numpy_s_integers_none_is_below_zero_and_there_is_one(agent):
    found = [drive(agent, tracks, max_frames=3).returns for tracks in ([1, 2], np.array([1, 2]))]
    assert np.array_equal(*found)
    with pytest.raises(ValueError, match="track=-1: expected a whole number from 0"):
        drive(agent, [3, -1])
    with pytest.raises(ValueError, match=r"track=1\.5: expected a whole number from 0"):
        drive(agent, [1.5])
    with pytest.raises(ValueError, match="patience=-1: expected a whole number from 0"):
        drive(agent, [1], patience=-1)
    with pytest.raises(ValueError, match=r"tracks=\[\]: expected the seed"):
        drive(agent, [])


def test_an_episode_without_a_frame_is_refused(agent):
    with pytest.raises(ValueError, match="max_frames=0: expected a whole number from 1"):
        rollout(agent, Cars(1), max_frames=0)


def test_v_m_c_and_the_agent_share_the_stride_of_the_configuration(
    quick_run, observations, tmp_path
):
    dataset, weights = quick_run / "dataset", {}
    for stride in (4, 2):
        changes = {"vae": {"stride": stride, "steps": 2}, "mdn_rnn": {"steps": 1}}
        config, run = Config.preset("quick", **changes), tmp_path / str(stride)
        train(config, run, dataset, until="mdn_rnn")
        weights[stride] = load_vae(run / "vae.safetensors")[0].state_dict()
    # V saw other differences.
    assert not all(torch.equal(weights[2][name], weights[4][name]) for name in weights[2])
    world_model = load_world_model(run)
    first = initial_parameters(*world_model.sizes)
    named = {"variant": "input_output", **world_model.checksums}
    save_controller(run / "controller.safetensors", first, **named)
    agent = load_agent(run)
    frames, actions = Dataset(dataset).frames[0], Dataset(dataset).actions[0]
    expected = encode_episode(agent.vae, frames, 2)[0]
    assert np.array_equal(features_of(world_model, frames, actions)[:, :32], expected)
    act_along(agent, observations[:4])
    frames = np.array([to_frame(one, config.data.crop_bar) for one in observations[:4]])
    assert np.allclose(agent.latents[0], encode_episode(agent.vae, frames, 2)[0][-1], atol=1e-5)


def test_a_nan_action_never_reaches_the_car(observations):
    agent = make_agent()
    agent.mdn_rnn.lstm.bias_ih_l0.data.fill_(float("nan"))
    agent = Agent(agent.world_model, agent.parameters)
    agent.act(observations[0])
    message = r"action \[.*nan.*\]: expected finite numbers; check z, h and C"
    with pytest.raises(ValueError, match=message):
        agent.act(observations[1])


def test_parameters_of_another_size_are_refused():
    with pytest.raises(ValueError, match=r"shape \(867,\), expected \(147,\).*another size"):
        Agent(make_agent().world_model, np.zeros(867))


def test_an_agent_that_is_not_there_is_an_error_that_names_the_choices(tmp_path):
    # V and M of cropped_frame are shipped without a C.
    for source in ("both", tmp_path, tmp_path / "nowhere", "cropped_frame", "", ".", ".."):
        message = (
            "no trained agent named .*: expected .*frame, input, .*, or the folder of a finished"
        )
        with pytest.raises(FileNotFoundError, match=message):
            load_agent(source)
    with pytest.raises(ValueError, match="agent None: expected a shipped agent's name or"):
        load_agent(None)


def test_a_name_is_a_shipped_agent_and_a_path_is_a_folder(tmp_path, monkeypatch):
    (tmp_path / "frame").mkdir()
    monkeypatch.chdir(tmp_path)
    assert run_folder("frame") == PRETRAINED / "frame"
    assert run_folder(Path("frame")) == Path("frame")
    assert run_folder("runs/mine") == Path("runs/mine")
    assert {*VARIANTS} < {*shipped_agents()}


def test_weights_that_stad_lab_did_not_write_are_refused(quick_run, tmp_path):
    run = shutil.copytree(quick_run, tmp_path / "run")
    save_file({"parameters": torch.zeros(195)}, run / "controller.safetensors")
    message = r"controller.safetensors was not written by stad_lab: give a file of `python"
    with pytest.raises(ValueError, match=message):
        load_agent(run)


def test_a_controller_of_another_world_model_is_refused(quick_run, tmp_path):
    run = shutil.copytree(quick_run, tmp_path / "run")
    file = run / "controller.safetensors"
    parameters, metadata = load_controller(file)
    metadata.pop("kind")
    save_controller(file, parameters, **metadata | {"mdn_rnn": "another"})
    with pytest.raises(ValueError, match="made with another mdn_rnn than the one beside it"):
        load_agent(run)
    assert np.array_equal(load_controller(file)[0], parameters)
    with pytest.raises(ValueError, match="made with another vae"):
        load_agent("frame", run_folder("input") / "controller.safetensors")
    own = load_agent("frame", run_folder("frame") / "controller.safetensors")
    assert np.array_equal(own.parameters, load_agent("frame").parameters)


def test_a_folder_that_is_made_again_is_read_again(tmp_path):
    for name in ("cropped_input", "input"):
        shutil.copytree(PRETRAINED / name, tmp_path / "run", dirs_exist_ok=True)
        for file in (tmp_path / "run").iterdir():
            file.touch()
        found = load_world_model(tmp_path / "run")
        assert found.crop_bar is (name == "cropped_input")
        assert load_world_model(tmp_path / "run") is found


@pytest.fixture
def pretrained(tmp_path, monkeypatch):
    """An empty folder for shipped agents."""
    for module in ("stad_lab.agent", "stad_study.ship"):
        monkeypatch.setattr(f"{module}.PRETRAINED", tmp_path / "shipped")
    return tmp_path / "shipped"


def test_a_shipped_agent_acts_almost_like_the_run_it_comes_from(
    quick_run, agent, observations, pretrained
):
    folder = ship(quick_run, "mine")
    shipped = load_agent("mine")
    assert folder == pretrained / "mine" and shipped_agents() == ["mine"]
    both = (act_along(one, observations[:12]) for one in (shipped, agent))
    assert np.allclose(*both, atol=1e-3)
    sizes = [(place / "vae.safetensors").stat().st_size for place in (folder, quick_run)]
    assert sizes[0] < 0.6 * sizes[1]


def test_a_damaged_run_is_not_shipped_and_one_without_c_leaves_none_of_before(
    quick_run, tmp_path, pretrained
):
    run, target = shutil.copytree(quick_run, tmp_path / "run"), ship(quick_run, "mine")
    (target / "evaluation.json").write_text("{}")  # of the agent that was shipped
    (target / "README.md").write_text("its model card")
    before = {file.name: file.read_bytes() for file in target.iterdir()}
    (run / "controller.safetensors").write_bytes(b"cut short")
    for folder, name, message in (
        (run, "mine", r"controller\.safetensors is damaged"),
        (target, "mine", "expected a name of letters"),
        (quick_run, "../mine", "expected a name of letters"),
    ):
        with pytest.raises(ValueError, match=message):
            ship(folder, name)
        assert {file.name: file.read_bytes() for file in target.iterdir()} == before
    (run / "controller.safetensors").unlink()
    (run / "evolution.json").unlink()
    (target / ".ipynb_checkpoints").mkdir()  # JupyterLab's, and not ours to remove
    ship(run, "mine")
    kept = {"vae.safetensors", "mdn_rnn.safetensors", "record.json", "README.md"}
    assert {file.name for file in target.iterdir()} == {*kept, ".ipynb_checkpoints"}
