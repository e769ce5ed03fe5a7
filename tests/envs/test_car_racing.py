"""The fast environment equals Gymnasium's CarRacing-v3: bit for bit, and nearly in its pictures."""

import copy
import math
import subprocess
import sys

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from stad_lab import make_env
from stad_lab.benchmark import compare_pictures
from stad_lab.envs.car_racing import BAR_TOP, MAX_FRAMES, place_car

STRAIGHT = np.array([0, 1, 0], np.float32)


def follow_road(env, speed=45):
    """Steer to a tile ahead, from the true track."""
    car, track = env.unwrapped.car, env.unwrapped.track
    tiles = np.array([tile[2:4] for tile in track])
    nearest = np.argmin(((tiles - car.hull.position) ** 2).sum(axis=1))
    dx, dy = tiles[(nearest + 6) % len(tiles)] - car.hull.position
    cos, sin = math.cos(car.hull.angle), math.sin(car.hull.angle)
    steering = math.atan2(cos * dx + sin * dy, cos * dy - sin * dx)
    moving = math.hypot(*car.hull.linearVelocity)
    return np.array(
        [np.clip(steering, -1, 1), 0.5 * (moving < speed), 0.3 * (moving > speed + 15)], np.float32
    )


def leave_field(env):
    """Full gas, holding the heading of the start, over grass and off the field."""
    hull, start = env.unwrapped.car.hull, env.unwrapped.track[0][1]
    return np.array(
        [np.clip(3 * (hull.angle - start) + 0.5 * hull.angularVelocity, -1, 1), 1, 0], np.float32
    )


def wild(env):
    """Whatever the action space has: soon off the road, spinning and sliding."""
    return env.action_space.sample()


def drive_both(driver, seed, frames=MAX_FRAMES, pictures=True):
    """Repeat a drive in Gymnasium's environment: two lists of what `step` returned.

    Without pictures Gymnasium's renderer is left out, which is 98% of its time.
    """
    steps = []
    fast, official = make_env(fast=True), make_env(fast=False)
    fast.action_space.seed(seed)
    if not pictures:
        official.unwrapped._render = lambda mode: np.zeros((96, 96, 3), np.uint8)
    fast.reset(seed=seed)
    official.reset(seed=seed)
    for _ in range(frames):
        action = driver(fast)
        steps.append((fast.step(action), official.step(action)))
        if any(steps[-1][0][2:4]) or any(steps[-1][1][2:4]):
            break
    fast.close()
    official.close()
    return [step[0] for step in steps], [step[1] for step in steps]


@pytest.fixture(scope="module")
def long_drive():
    """Four hundred frames on the road, with unmodified Gymnasium."""
    return drive_both(follow_road, 26, 400)


def assert_bit_identical(fast, official):
    """Rewards, terminations, truncations and infos."""
    assert [step[1:] for step in fast] == [step[1:] for step in official]


def differences(fast, official, rows=slice(None)):
    """Mean absolute difference of each pair of pictures."""
    return [
        np.abs(a[rows].astype(int) - b[rows].astype(int)).mean()
        for a, b in zip(fast, official, strict=True)
    ]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rewards_bit_identical_on_the_road(seed):
    fast, official = drive_both(follow_road, seed, 120, pictures=False)
    assert sum(step[1] for step in fast) > 40  # it was on the road
    assert_bit_identical(fast, official)


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_rewards_bit_identical_off_the_road(seed):
    fast, official = drive_both(wild, seed, 120, pictures=False)
    assert_bit_identical(fast, official)


def test_rewards_bit_identical_in_a_long_episode_of_unmodified_gymnasium(long_drive):
    fast, official = long_drive
    assert len(fast) == 400
    assert_bit_identical(fast, official)


@pytest.mark.parametrize("seed", [6, 11])
def test_rewards_bit_identical_off_the_field(seed):
    fast, official = drive_both(leave_field, seed, pictures=False)
    assert fast[-1][1:4] == (-100, True, False)
    assert fast[-1][4] == {"lap_finished": False}
    assert_bit_identical(fast, official)


@pytest.mark.parametrize("driver", [follow_road, wild])
def test_rewards_bit_identical_to_the_frame_limit(driver):
    fast, official = drive_both(driver, 1, pictures=False)
    assert len(fast) == MAX_FRAMES
    assert fast[-1][2:4] == (False, True)
    assert_bit_identical(fast, official)


def test_rewards_bit_identical_to_the_end_of_a_lap():
    fast, official = drive_both(lambda env: follow_road(env, speed=60), 1, pictures=False)
    assert fast[-1][4] == {"lap_finished": True}
    assert_bit_identical(fast, official)


def test_pictures_of_20_episodes_differ_by_half_a_level_and_around_the_car_by_four():
    episodes = [compare_pictures(number, frames=20) for number in range(20)]
    assert all(equal for _, equal in episodes)
    whole, window, bar = np.concatenate([errors for errors, _ in episodes]).mean(axis=0)
    assert whole <= 0.5
    assert window <= 4
    assert bar <= 0.5


def test_pictures_differ_by_less_than_one_level_in_the_opening_zoom(long_drive):
    fast, official = (steps[:50] for steps in long_drive)
    errors = differences([step[0] for step in fast], [step[0] for step in official])
    assert max(errors) <= 1


@pytest.mark.parametrize("where", ["on the road", "off the road"])
def test_pictures_differ_by_less_than_one_level_on_average_on_and_off_the_road(where, long_drive):
    fast, official = long_drive if where == "on the road" else drive_both(wild, 23, 160)
    assert_bit_identical(fast, official)
    fast, official = [step[0] for step in fast], [step[0] for step in official]
    assert np.mean(differences(fast, official)) <= 1
    assert max(differences(fast, official)) <= 1.5
    assert np.mean(differences(fast, official, slice(BAR_TOP, None))) <= 1
    assert max(differences(fast, official, slice(BAR_TOP, None))) <= 1.5


def test_pictures_differ_by_less_than_one_level_near_the_edge_of_the_field():
    fast, official = drive_both(leave_field, 16)
    assert fast[-1][1:4] == (-100, True, False)
    assert_bit_identical(fast, official)
    fast, official = [step[0] for step in fast[-60:]], [step[0] for step in official[-60:]]
    assert max(differences(fast, official)) <= 1


def test_pictures_differ_by_less_than_one_level_after_place_car():
    fast, official = make_env(fast=True), make_env(fast=False)
    fast.reset(seed=24)
    official.reset(seed=24)
    for tile, speed, turn, offset in [
        (40, 0, 0, 0),
        (90, 50, 0.3, 0.6),
        (180, 90, -1.2, -1.5),
        (250, 20, 3.0, 0.9),
    ]:
        pictures = [[place_car(env, tile, speed, turn, offset)] for env in (fast, official)]
        for _ in range(5):
            for env, seen in zip((fast, official), pictures, strict=True):
                seen.append(env.step(STRAIGHT)[0])
        assert max(differences(*pictures)) <= 1


def test_pictures_differ_by_less_than_one_level_in_random_colours():
    fast, official = (
        make_env(fast=True, domain_randomize=True),
        make_env(fast=False, domain_randomize=True),
    )
    plain = make_env(fast=True).reset(seed=25)[0]
    for options in (None, {"randomize": True}):
        pictures = [[env.reset(seed=25, options=options)[0]] for env in (fast, official)]
        for _ in range(30):
            for env, seen in zip((fast, official), pictures, strict=True):
                seen.append(env.step(STRAIGHT)[0])
        assert np.mean(differences(*pictures)) <= 1
        assert differences([plain], [pictures[0][0]])[0] > 5  # the colours did change


def test_visited_tiles_change_colour_as_in_gymnasium(long_drive):
    behind = (slice(78, BAR_TOP), slice(30, 66))  # road that the car has just passed
    fast, official = (np.array([step[0][behind] for step in steps[60:100]]) for steps in long_drive)
    visited = (official == official[0, -1, 20]).all(axis=-1)
    assert visited.mean() > 0.5
    assert (fast[visited] == official[visited]).mean() > 0.98


@pytest.mark.parametrize("fast", [True, False])
def test_check_env_passes(fast):
    check_env(make_env(fast=fast, render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize("fast", [True, False])
def test_spaces_are_those_of_car_racing(fast):
    env = make_env(fast=fast)
    observation, _ = env.reset(seed=0)
    assert observation.shape == (96, 96, 3)
    assert observation.dtype == np.uint8
    assert env.observation_space.contains(observation)
    assert env.action_space.low.tolist() == [-1, 0, 0]
    assert env.action_space.high.tolist() == [1, 1, 1]
    assert env.spec.max_episode_steps == MAX_FRAMES


def test_without_the_bar_only_the_bar_is_missing():
    whole, cropped = make_env(), make_env(bar=False)
    pictures = [
        [env.reset(seed=29)[0], *(env.step(STRAIGHT)[0] for _ in range(20))]
        for env in (whole, cropped)
    ]
    for with_bar, without in zip(*pictures, strict=True):
        assert np.array_equal(with_bar[:BAR_TOP], without[:BAR_TOP])
        assert with_bar[BAR_TOP:].any()
        assert not without[BAR_TOP:].any()


def test_an_observation_may_be_changed_by_its_receiver():
    env, other = make_env(), make_env()
    env.reset(seed=30)
    other.reset(seed=30)
    for _ in range(5):
        observation = env.step(STRAIGHT)[0]
        assert np.array_equal(observation, other.step(STRAIGHT)[0])
        observation[:] = 0  # must not reach the pictures that the environment keeps


def test_a_closed_environment_holds_no_track_and_can_be_reset_again():
    env = make_env()
    first = env.reset(seed=30)[0]
    env.close()
    env.close()
    assert env.unwrapped.road == [] and env.unwrapped.ground.levels == []
    assert env.unwrapped.world.bodies == []
    assert np.array_equal(env.reset(seed=30)[0], first)


def test_a_copy_is_made_with_the_same_arguments():
    other = copy.deepcopy(make_env(bar=False, domain_randomize=True).unwrapped)
    assert other.domain_randomize
    assert not other.reset(seed=0)[0][BAR_TOP:].any()


def test_two_environments_do_not_paint_over_each_other():
    alone = make_env()
    expected = [alone.reset(seed=31)[0], *(alone.step(STRAIGHT)[0] for _ in range(60))]
    one, two = make_env(), make_env()
    seen = [one.reset(seed=31)[0]]
    two.reset(seed=32)
    for _ in range(60):
        seen.append(one.step(STRAIGHT)[0])
        two.step(STRAIGHT)
    assert np.array_equal(seen, expected)


def test_render_gives_the_same_large_picture():
    rendered = []
    for fast in (True, False):
        env = make_env(fast=fast, render_mode="rgb_array")
        env.reset(seed=27)
        for _ in range(5):
            env.step(STRAIGHT)
        rendered.append(env.render())
    assert rendered[0].shape == (400, 600, 3)
    assert rendered[0].std() > 10
    assert np.array_equal(*rendered)


def test_a_second_episode_is_drawn_on_its_own_track():
    env = make_env()
    first = env.reset(seed=1)[0]
    other = env.reset(seed=2)[0]
    assert not np.array_equal(first, other)
    assert np.array_equal(env.reset(seed=1)[0], first)


@pytest.mark.parametrize("fast", [True, False])
def test_place_car_puts_the_moving_car_on_the_tile(fast):
    env = make_env(fast=fast)
    env.reset(seed=28)
    track = env.unwrapped.track
    picture = place_car(env, tile=len(track) + 50, speed=40, turn=0.25)
    _, beta, x, y = track[50]
    car = env.unwrapped.car
    assert picture.shape == (96, 96, 3)
    assert tuple(car.hull.position) == pytest.approx((x, y), abs=1e-3)
    assert car.hull.angle == pytest.approx(beta + 0.25, abs=1e-5)
    ahead = (-math.sin(beta + 0.25), math.cos(beta + 0.25))
    assert tuple(car.hull.linearVelocity) == pytest.approx((40 * ahead[0], 40 * ahead[1]), abs=1e-3)
    for wheel in car.wheels:
        assert wheel.omega * wheel.wheel_rad == pytest.approx(40)
    env.step(np.zeros(3, np.float32))
    assert math.hypot(*car.hull.linearVelocity) == pytest.approx(40, rel=0.1)
    assert env.unwrapped.tile_visited_count >= 1


def test_place_car_moves_the_car_sideways():
    env = make_env()
    env.reset(seed=28)
    _, beta, x, y = env.unwrapped.track[50]
    place_car(env, tile=50, offset=1.0)
    dx, dy = np.array(env.unwrapped.car.hull.position) - (x, y)
    half_road = 40 / 6
    assert dx * math.cos(beta) + dy * math.sin(beta) == pytest.approx(half_road, abs=1e-3)
    assert -dx * math.sin(beta) + dy * math.cos(beta) == pytest.approx(0, abs=1e-3)


def test_an_action_that_is_not_finite_is_refused():
    env = make_env()
    env.reset(seed=0)
    with pytest.raises(
        ValueError, match=r"action \[.*nan.*\]: expected finite numbers, steering, gas and brake"
    ):
        env.step(np.array([0, np.nan, 0]))


def in_a_fresh_process(code):
    """What a new Python prints."""
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    return process.stdout.strip()


def test_gymnasium_makes_the_fast_environment_by_its_name_in_a_fresh_process():
    code = """
import gymnasium
env = gymnasium.make("stad_lab:StadLab/CarRacing-v3", bar=False)
print(env.reset(seed=1)[0].shape, env.spec.max_episode_steps, type(env.unwrapped).__name__)
"""
    assert in_a_fresh_process(code) == "(96, 96, 3) 1000 FastCarRacing"


def test_the_controller_loads_neither_torch_nor_pygame():
    code = """
import sys
import stad_lab.models.controller
print([name for name in ("torch", "pygame", "Box2D", "cv2", "filelock") if name in sys.modules])
"""
    assert in_a_fresh_process(code) == "[]"


def test_stad_lab_can_be_imported_without_a_working_gymnasium():
    code = """
import sys
sys.modules["gymnasium"] = None
import stad_lab
print(stad_lab.Config.preset("quick").seed)
"""
    assert in_a_fresh_process(code) == "0"
