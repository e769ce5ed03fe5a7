"""The dream: a Gymnasium environment, repeatable for a seed, in which an agent drives."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.utils.env_checker import check_env

from stad_lab.agent import PRETRAINED, Agent
from stad_lab.dreaming import dream_on, make_dream
from stad_lab.envs.dream import DreamEnv
from stad_lab.evaluation.trajectories import record_trajectory
from stad_lab.models.controller import control
from stad_lab.viz.video import repeated_dreams

ACTION = np.array([0.1, 0.5, 0], np.float32)


@pytest.fixture
def dream(agent):
    """A short dream with pictures."""
    return DreamEnv(agent.vae, agent.mdn_rnn, max_frames=20, render_mode="rgb_array")


def dream_along(env, seed, frames=10, **options):
    """The latents of one dream under a constant action, (frames + 1, latent_size)."""
    latents = [env.reset(seed=seed, options=options)[0]]
    latents += [env.step(ACTION)[0] for _ in range(frames)]
    return np.array(latents)


def test_check_env_passes(dream):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # z has no bounds, and no spec was registered
        check_env(dream)


def test_the_same_seed_gives_the_same_dream_and_another_seed_another_one(dream):
    start = {"latents": np.zeros(32, np.float32)}  # so that they differ in the seed alone
    first, other = (dream_along(dream, seed=seed, **start) for seed in (1, 2))
    assert np.array_equal(dream_along(dream, seed=1, **start), first)
    assert not np.isclose(other[1:], first[1:]).all(axis=1).any()
    assert np.isfinite(first).all()
    assert not np.isclose(
        dream.reset(seed=1)[0], dream.reset(seed=2)[0]
    ).all()  # the first z differs, too


def test_the_action_changes_the_dream(dream):
    straight = dream_along(dream, seed=1)
    dream.reset(seed=1)
    turned = [dream.step(np.array([-1, 0, 1], np.float32))[0] for _ in range(10)]
    assert not np.allclose(straight[1:], turned, atol=1e-4)


def test_a_colder_dream_is_calmer(dream):
    calm = []
    for temperature in (0.01, 1.0):
        dream.temperature = temperature
        steps = dream_along(dream, seed=3, frames=19, latents=np.zeros(32, np.float32))
        calm.append(np.abs(np.diff(steps[1:], axis=0)).mean())
    assert calm[0] < 0.5 * calm[1]


def test_a_dream_is_cut_after_max_frames_and_never_rewarded(dream):
    dream.reset(seed=0)
    steps = [dream.step(ACTION) for _ in range(20)]
    assert [step[1:4] for step in steps] == [(0.0, False, False)] * 19 + [(0.0, False, True)]


def test_a_dream_renders_what_v_decodes_from_its_latents(dream):
    dream.reset(seed=0, options={"latents": np.zeros(32, np.float32)})
    first = dream.render()
    assert first.shape == (64, 64, 3)
    assert first.dtype == np.uint8
    dream.reset(seed=5, options={"latents": np.zeros(32, np.float32)})
    assert np.array_equal(dream.render(), first)
    dream.step(ACTION)
    assert not np.array_equal(dream.render(), first)
    dream.render_mode = None
    assert dream.render() is None


def test_the_info_of_a_dream_holds_m_s_memory(dream, agent):
    _, info = dream.reset(seed=0)
    assert info["hidden"].shape == (agent.mdn_rnn.hidden_size,)
    assert not info["hidden"].any()
    assert dream.step(ACTION)[4]["hidden"].any()


@pytest.mark.parametrize("action", [[np.nan, 0, 0], [0, np.inf, 0], [0, 0], [[0, 0, 0]]])
def test_an_action_that_is_not_three_finite_numbers_is_refused(action, dream):
    dream.reset(seed=0)
    with pytest.raises(ValueError, match=r"action .*: expected .*, steering, gas and brake"):
        dream.step(np.array(action, np.float32))


def test_latents_that_do_not_fit_are_refused(dream):
    with pytest.raises(
        ValueError,
        match=r"latents of shape \(5,\), 5 of them finite: expected \(32,\) finite numbers",
    ):
        dream.reset(options={"latents": np.zeros(5)})
    with pytest.raises(
        ValueError, match=r"\(32,\), 0 of them finite: expected \(32,\) finite numbers"
    ):
        dream.reset(options={"latents": np.full(32, np.nan)})


@pytest.mark.parametrize(("cars", "value"), [(3, 0.0), (1, np.nan)])
def test_a_memory_that_does_not_fit_is_refused(cars, value, dream):
    state = (torch.full((1, cars, dream.mdn_rnn.hidden_size), value),) * 2
    with pytest.raises(
        ValueError, match=rf"memory of shape \(1, {cars}, .*: expected \(1, 1, .*, h and c"
    ):
        dream.reset(options={"state": state})


def test_a_memory_may_be_given_as_arrays(dream):
    state = (np.full((1, 1, dream.mdn_rnn.hidden_size), 0.5, np.float32),) * 2
    _, info = dream.reset(options={"state": state})
    assert np.array_equal(info["hidden"], state[0][0, 0])


@pytest.mark.parametrize("temperature", [0, -1, 1e-7, float("nan"), float("inf")])
def test_a_temperature_that_cannot_be_sampled_is_refused(temperature, agent):
    with pytest.raises(ValueError, match=f"temperature={temperature}: expected a finite number"):
        DreamEnv(agent.vae, agent.mdn_rnn, temperature)


def test_a_refused_state_begins_no_dream(agent):
    dream = DreamEnv(agent.vae, agent.mdn_rnn)
    with pytest.raises(ValueError, match="expected M's memory"):
        dream.reset(options={"state": 3})
    with pytest.raises(RuntimeError, match="step before reset: call reset"):
        dream.step(np.zeros(3, np.float32))


def test_another_render_mode_is_refused(agent):
    with pytest.raises(ValueError, match="render_mode='human': choose one of None, rgb_array"):
        DreamEnv(agent.vae, agent.mdn_rnn, render_mode="human")


def test_a_picture_before_reset_is_refused(agent):
    with pytest.raises(RuntimeError, match="render before reset: call reset"):
        DreamEnv(agent.vae, agent.mdn_rnn, render_mode="rgb_array").render()


def test_an_agent_is_not_changed_by_its_dream(agent, observations):
    for observation in observations[:10]:
        agent.act(observation)
    before = agent.state.copy(), agent.latents.copy()
    with pytest.raises(ValueError, match="frames=1001: expected a whole number from 1 to"):
        dream_on(agent, 1001)
    pictures, actions = dream_on(agent, 12, temperature=0.8, seed=3)
    assert pictures.shape == (12, 64, 64, 3)
    assert pictures.dtype == np.uint8
    assert actions.shape == (12, 3)
    assert actions.dtype == np.float32
    assert len({picture.tobytes() for picture in pictures}) == 12  # something moves
    assert np.array_equal(before[0], agent.state)
    assert np.array_equal(before[1], agent.latents)
    again = dream_on(agent, 12, temperature=0.8, seed=3)
    assert np.array_equal(again[0], pictures)
    assert np.array_equal(again[1], actions)
    assert not np.array_equal(dream_on(agent, 12, temperature=0.8, seed=4)[0], pictures)


@torch.no_grad()
def test_a_cold_dream_continues_an_episode_step_by_step_with_m_s_memory(agent, observations):
    for observation in observations[:10]:
        agent.act(observation)
    pictures, actions = dream_on(agent, 4, temperature=1e-6)
    state = tuple(torch.from_numpy(part)[None] for part in agent.state)
    mixture = agent.mdn_rnn.mixture(state[0])
    for picture, action in zip(
        pictures, actions, strict=True
    ):  # by hand, with the likeliest z of every step
        z = mixture.mean.gather(-1, mixture.logpi.argmax(-1, keepdim=True))[0, 0, :, 0]
        decoded = agent.vae.decode(z[None])[0][0].permute(1, 2, 0).numpy()
        assert np.abs(decoded - picture / 255).max() < 0.02
        seen = np.concatenate([z.numpy(), state[0][0, 0].numpy()])
        assert control(agent.parameters, seen[None])[0] == pytest.approx(action, abs=1e-2)
        mixture, state = agent.mdn_rnn(z[None, None], torch.from_numpy(action)[None, None], state)
    dream = DreamEnv(agent.vae, agent.mdn_rnn, 1e-6)
    latents, _ = dream.reset(options={"latents": z.numpy(), "state": state})
    for _ in range(3):
        latents, _, _, _, info = dream.step(action)
        _, state = agent.mdn_rnn(z[None, None], torch.from_numpy(action)[None, None], state)
        z = torch.from_numpy(latents)
        assert info["hidden"] == pytest.approx(state[0][0, 0].numpy(), abs=1e-5)


def test_a_dream_in_a_film_predicts_the_frame_beside_it_and_begins_again_every_length_frames(agent):
    trajectory = record_trajectory(agent, track=np.int64(3), frames=25)
    dreams = repeated_dreams(agent, trajectory, first=6, length=8)
    assert dreams.shape == (len(trajectory) - 6, 64, 64, 3)
    for number, moment in enumerate((6, 14, 22)):
        agent.reset()
        for observation in trajectory.observations[:moment]:
            action = agent.act(observation)
        assert np.array_equal(action, trajectory.actions[moment - 1])
        length = min(8, len(trajectory) - moment)
        dream, _ = dream_on(agent, length, seed=number)
        assert np.array_equal(dreams[moment - 6 :][:length], dream)


def test_an_agent_that_has_not_acted_cannot_dream(agent):
    with pytest.raises(ValueError, match="has not acted yet: let it drive some real frames first"):
        dream_on(agent, 5)


def test_a_dream_of_no_frame_is_refused(agent, observations):
    agent.reset()
    agent.act(observations[0])
    with pytest.raises(ValueError, match="frames=0: expected a whole number from 1"):
        dream_on(agent, 0)


def test_one_car_dreams_with_its_own_c_and_several_cannot(agent, observations):
    rows = np.stack([agent.parameters, -agent.parameters])
    many, alone = (Agent(agent.world_model, c) for c in (rows, rows[1]))
    many.act_batch(observations[:2])
    with pytest.raises(ValueError, match=r"drives 2 cars, expected one: use agent\.keep"):
        dream_on(many, 5)
    many.keep(np.array([1]))
    alone.act(observations[1])
    assert np.allclose(dream_on(many, 3)[1], dream_on(alone, 3)[1], atol=1e-4)
    alone.parameters = rows[0]
    assert not np.allclose(dream_on(many, 3)[1], dream_on(alone, 3)[1], atol=1e-2)


def test_a_dream_is_made_of_a_name_or_a_folder():
    env = gym.make("StadLab/Dream-v0", agent=PRETRAINED / "input", max_frames=3)
    assert env.unwrapped.vae.variant == "input" and env.unwrapped.max_frames == 3
    assert make_dream("output").vae.variant == "output"
    with pytest.raises(FileNotFoundError):
        make_dream("no_such_run")


def make_dreams(**options):
    """Three dreams of a shipped agent at once."""
    how = {"num_envs": 3, "vectorization_mode": "vector_entry_point", "agent": "frame"}
    return gym.make_vec("stad_lab:StadLab/Dream-v0", **how, **options)


def test_many_dreams_at_once_are_those_of_single_environments():
    envs = make_dreams(temperature=0.7, max_frames=5, render_mode="rgb_array")
    single = [make_dream("frame", 0.7, max_frames=5, render_mode="rgb_array") for _ in range(3)]
    found, info = envs.reset(seed=4)
    expected = [env.reset(seed=4 + number) for number, env in enumerate(single)]
    rng = np.random.default_rng(0)
    for step in range(14):
        assert np.allclose(found, [one[0] for one in expected], atol=1e-4)
        assert np.allclose(info["hidden"], [one[-1]["hidden"] for one in expected], atol=1e-4)
        actions = rng.uniform(0, 1, (3, 3)).astype(np.float32)
        found, rewards, terminated, truncated, info = envs.step(actions)
        if step % 6 == 5:  # the step after an end begins anew
            expected = [env.reset() for env in single]
        else:
            expected = [env.step(action) for env, action in zip(single, actions, strict=True)]
        assert truncated.all() == (step % 6 == 4) and not terminated.any() and not rewards.any()
    pictures = [env.render().astype(int) for env in single]
    assert np.abs(np.array(envs.render()) - pictures).max() <= 1


def test_the_action_of_an_ended_dream_is_ignored_and_each_dream_has_a_seed_of_its_own():
    envs = make_dreams(max_frames=1)
    envs.reset(seed=7)
    assert envs.np_random_seed == (7, 8, 9)
    random = [one.bit_generator.state for one in envs.np_random]
    envs.reset(seed=7)
    assert random == [one.bit_generator.state for one in envs.np_random]
    envs.step(np.zeros((3, 3)))  # all have ended
    assert not envs.step(np.full((3, 3), np.nan))[3].any()


def test_dreams_that_are_not_begun_closed_or_given_nonsense_say_so():
    envs = make_dreams(max_frames=1, autoreset_mode="Disabled", render_mode="rgb_array")
    for act in (lambda: envs.step(np.zeros((3, 3))), envs.render):
        with pytest.raises(ResetNeeded):
            act()
    envs.reset(seed=0)
    for actions in (np.zeros((2, 3)), np.full((3, 3), np.nan)):
        with pytest.raises(ValueError, match="expected finite numbers of shape"):
            envs.step(actions)
    envs.step(np.zeros((3, 3)))
    with pytest.raises(RuntimeError, match="have ended: call reset"):
        envs.step(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="one at least"):
        envs.reset(options={"reset_mask": np.zeros(3, bool)})
    envs.reset(options={"reset_mask": np.array([True, True, True])})
    envs.close()
    with pytest.raises(ClosedEnvironmentError):
        envs.reset()
    for options in ({"autoreset_mode": "SameStep"}, {"temperature": 0}):
        with pytest.raises(ValueError, match=next(iter(options))):
            make_dreams(**options)
