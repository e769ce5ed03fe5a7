"""Our environment for one car equals Gymnasium's CarRacing-v3, and behaves as Gymnasium asks."""

import copy
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import FrameStackObservation, RecordVideo
from test_physics import assert_equal

from stad_lab import make_env
from stad_lab.envs.car_racing import MAX_FRAMES, place_car
from stad_lab.envs.frames import BAR_TOP
from stad_lab.training.dataset import RandomDriver
from stad_study.parity import AREAS, compare_pictures

GAS = np.array([0, 1, 0], np.float32)


@pytest.mark.parametrize("fast", [True, False])
def test_an_unknown_option_is_refused_in_one_line_that_says_where_a_seed_belongs(fast):
    with pytest.raises(ValueError, match=r"unknown seed; choose from .*env.reset\(seed=1\)"):
        make_env(fast, seed=1)


def drive_both(actions, seed, **kwargs):
    """The same episode in both environments: two lists of what `reset` and `step` returned."""
    found = []
    for env in (make_env(**kwargs), make_env(fast=False, **kwargs)):
        steps = [env.reset(seed=seed)]
        for action in actions:
            steps.append(env.step(action))
            if any(steps[-1][2:4]):
                break
        found.append(steps)
        env.close()
    return found


def assert_close(ours, theirs, limit=1):
    """Rewards, endings and infos are equal; observations differ by less than `limit` of 255."""
    assert [step[1:] for step in ours] == [step[1:] for step in theirs]
    for one, other in zip(ours, theirs, strict=True):
        assert np.abs(one[0].astype(int) - other[0]).mean() < limit


def random_actions(number, count):
    driver = RandomDriver(np.random.default_rng(number))
    return [driver.act() for _ in range(count)]


@pytest.mark.parametrize("seed", [0, 1])
def test_a_random_drive_equals_gymnasium_s(seed):
    assert_close(*drive_both(random_actions(seed, 60), seed))


def test_discrete_actions_equal_gymnasium_s():
    actions = np.random.default_rng(0).integers(0, 5, 60).tolist()
    assert_close(*drive_both(actions, 2, continuous=False))


def test_random_colours_equal_gymnasium_s():
    ours, theirs = drive_both([GAS] * 30, 3, domain_randomize=True)
    assert_close(ours, theirs)
    plain = make_env().reset(seed=3)[0]
    assert np.abs(plain.astype(int) - ours[0][0]).mean() > 5


def test_the_colours_stay_if_a_reset_asks_for_it():
    env = make_env(domain_randomize=True)
    colors = []
    for randomize in (True, False, True):
        env.reset(options={"randomize": randomize})
        colors.append(env.unwrapped.cars.colors["road"].copy())
    assert np.array_equal(colors[0], colors[1])
    assert not np.array_equal(colors[1], colors[2])


def test_an_episode_ends_after_1000_frames_as_gymnasium_s():
    env = make_env()
    env.reset(seed=1)
    ends = [env.step(np.zeros(3, np.float32))[2:4] for _ in range(MAX_FRAMES)]
    assert ends == [(False, False)] * (MAX_FRAMES - 1) + [(False, True)]
    assert env.spec.max_episode_steps == make_env(fast=False).spec.max_episode_steps == MAX_FRAMES


@pytest.mark.parametrize("number", range(2))
def test_pictures_and_frames_are_close_to_gymnasium_s(number):
    errors, equal = compare_pictures(number, frames=20)
    assert errors.shape == (21, len(AREAS)) and equal
    assert errors[:, 0].mean() < 0.5 and errors.max() < 3
    assert errors.mean(axis=0).max() < 1.5


def test_place_puts_the_car_where_gymnasium_s_would_be():
    ours, theirs = make_env(), make_env(fast=False)
    for env in (ours, theirs):
        env.reset(seed=24)
    car = ours.unwrapped.cars.cars[0]
    where = [(40, 0, 0, 0), (90, 50, 0.3, 0.6), (180, 90, -1.2, -1.5), (5000, 20, 3.0, 0.9)]
    for tile, speed, turn, offset in where:
        seen = ours.unwrapped.place(tile, speed=speed, turn=turn, offset=offset)
        other = place_car(theirs, tile, speed, turn, offset)
        for action in random_actions(tile, 20):
            assert np.abs(seen.astype(int) - other).mean() < 1
            steps = [env.step(action) for env in (ours, theirs)]
            assert steps[0][1:] == steps[1][1:]
            seen, other = steps[0][0], steps[1][0]
        bodies = [theirs.unwrapped.car.hull, *theirs.unwrapped.car.wheels]
        theirs_now = np.array([b.position for b in bodies], np.float32)
        assert_equal(car["position"], theirs_now, f"tile {tile}")


def test_check_env_passes():
    check_env(make_env(render_mode="rgb_array").unwrapped)


def test_spaces_are_gymnasium_s():
    for continuous in (True, False):
        ours, theirs = (make_env(fast=fast, continuous=continuous) for fast in (True, False))
        assert ours.observation_space == theirs.observation_space
        assert ours.action_space == theirs.action_space


@pytest.mark.parametrize(("mode", "shape"), [("rgb_array", (400, 600)), ("state_pixels", (96, 96))])
def test_render_gives_gymnasium_s_window(mode, shape):
    envs = [make_env(fast=fast, render_mode=mode) for fast in (True, False)]
    for env in envs:
        env.reset(seed=27)
        for _ in range(40):
            env.step(np.array([0.1, 0.4, 0], np.float32))
    rendered = [env.render() for env in envs]
    assert rendered[0].shape == (*shape, 3)
    assert np.array_equal(*rendered)
    envs[0].reset(seed=37)  # another track
    assert not np.array_equal(envs[0].render(), rendered[0])


def test_render_with_random_colours_gives_gymnasium_s_window():
    settings = {"render_mode": "rgb_array", "domain_randomize": True}
    envs = [make_env(fast=fast, **settings) for fast in (True, False)]
    for env in envs:
        env.reset(seed=1)
    assert np.array_equal(*(env.render() for env in envs))


def test_an_episode_can_be_recorded(tmp_path):
    pytest.importorskip("moviepy")
    with RecordVideo(make_env(render_mode="rgb_array"), str(tmp_path)) as env:
        env.reset(seed=0)
        for _ in range(5):
            env.step(GAS)
    assert list(tmp_path.glob("*.mp4"))


def test_observations_can_be_stacked():
    env, plain = FrameStackObservation(make_env(), 4), make_env()
    env.reset(seed=0)
    seen = [plain.reset(seed=0)[0], *(plain.step(GAS)[0] for _ in range(5))]
    for _ in range(5):
        stacked = env.step(GAS)[0]
    assert np.array_equal(stacked, seen[-4:])


def test_a_seed_gives_the_same_episode_and_none_another_track():
    env = make_env()
    first = env.reset(seed=1)[0]
    second = env.reset()[0]
    assert not np.array_equal(first, second)
    assert np.array_equal(env.reset(seed=1)[0], first)
    assert np.array_equal(env.reset()[0], second)


def test_without_the_bar_only_the_bar_is_missing():
    pairs = zip(
        *([env.reset(seed=29)[0]] for env in (make_env(), make_env(bar=False))), strict=True
    )
    for whole, cropped in pairs:
        assert np.array_equal(whole[:BAR_TOP], cropped[:BAR_TOP])
        assert whole[BAR_TOP:].any() and not cropped[BAR_TOP:].any()


def test_an_observation_may_be_changed_by_its_receiver():
    env, other = make_env(), make_env()
    env.reset(seed=30)[0][:] = 0
    other.reset(seed=30)
    for _ in range(5):
        observation = env.step(GAS)[0]
        assert np.array_equal(observation, other.step(GAS)[0])
        observation[:] = 0


@pytest.mark.parametrize("action", [[0, np.nan, 0], [0, 0], [np.inf, 0, 0], 3])
def test_an_action_that_is_not_three_finite_numbers_is_refused(action):
    env = make_env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="expected finite numbers"):
        env.unwrapped.step(np.array(action))


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("name", ["continuous", "domain_randomize"])
def test_a_switch_that_is_no_bool_is_refused(name, fast):
    with pytest.raises(ValueError, match=f"{name}='no': expected True or False"):
        make_env(fast=fast, **{name: "no"})


@pytest.mark.parametrize("share", [95, -0.1, np.nan, True])
def test_a_share_of_a_lap_that_is_none_is_refused(share):
    with pytest.raises(ValueError, match=f"lap_complete_percent={share}: expected 0 to 1"):
        make_env(lap_complete_percent=share)


@pytest.mark.parametrize("how", [{"tile": 2.5}, {"tile": 3, "speed": np.nan}])
def test_a_place_that_is_no_number_is_refused_and_the_car_stays(how):
    env = make_env().unwrapped
    env.reset(seed=0)
    before = env.cars.cars.copy()
    with pytest.raises(ValueError, match=r"expected a (whole|finite) number"):
        env.place(**how)
    assert np.array_equal(before, env.cars.cars)


def test_a_step_before_the_reset_or_after_close_is_refused():
    env = make_env(render_mode="rgb_array").unwrapped
    uses = {"step": lambda: env.step(GAS), "render": env.render, "place": lambda: env.place(3)}
    uses["track"] = lambda: env.track
    for name, use in uses.items():
        with pytest.raises(RuntimeError, match=rf"^{name} before reset: call reset\(\) to begin"):
            use()
    env.reset(seed=0)
    env.close()
    env.close()
    for call in (env.reset, *uses.values()):
        with pytest.raises(RuntimeError, match=r"^the environment is closed: make a new one$"):
            call()


@pytest.mark.parametrize("again", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_is_made_with_the_same_arguments(again):
    other = again(make_env(bar=False, domain_randomize=True).unwrapped)
    assert other.cars.domain_randomize
    assert not other.reset(seed=0)[0][BAR_TOP:].any()


def in_a_fresh_process(code):
    """What a new Python prints."""
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    return process.stdout.strip()


def test_stad_lab_can_be_imported_without_a_working_gymnasium():
    code = """
import sys
sys.modules["gymnasium"] = None
import stad_lab
print(stad_lab.Config.preset("quick").seed)
"""
    assert in_a_fresh_process(code) == "0"


@pytest.mark.long
def test_stable_baselines3_learns_on_it():
    sb3 = pytest.importorskip("stable_baselines3")
    env = gym.wrappers.ResizeObservation(make_env(), (64, 64))
    model = sb3.PPO("CnnPolicy", env, n_steps=64, batch_size=32, n_epochs=1, device="cpu")
    model.learn(128)
    assert model.num_timesteps == 128
