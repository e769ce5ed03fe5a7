"""What CarRacing does not have: other observations, own tracks, frames that are not drawn."""

import json
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from PIL import Image

from stad_lab.envs import views
from stad_lab.envs.car_racing import make_env
from stad_lab.envs.cars import Cars
from stad_lab.envs.own_track import make_own_track
from stad_lab.envs.state import STATE
from stad_lab.envs.track import STEP_LENGTH, TURN_RATE
from stad_lab.envs.vector import CarRacingVector

TURNS = np.arange(24) * np.pi / 12
RING = 100 * np.stack([np.cos(TURNS), np.sin(TURNS)], axis=1)  # anticlockwise, radius 100


def drive(env, steps=40, gas=0.3):
    """Straight on: the observations and the rewards."""
    seen, rewards = [env.reset(seed=3)[0]], []
    for _ in range(steps):
        observation, reward, *_ = env.step(np.array([0, gas, 0], np.float32))
        seen.append(observation)
        rewards.append(reward)
    return seen, rewards


OPTIONS = [
    {"observes": "state"},
    {"observes": "above", "size": 64},
    {"size": 32},
    {"size": 200, "bar": False},
    {"frame_skip": 4},
    {"track": RING},
]


@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: "-".join(options))
def test_every_option_is_a_sound_environment_in_a_batch_and_after_pickling(options):
    env = make_env(**options)
    check_env(env.unwrapped, skip_render_check=True)
    seen, rewards = drive(env, 12)
    assert all(one in env.observation_space for one in seen)
    copy = drive(pickle.loads(pickle.dumps(env.unwrapped)), 12)
    envs = CarRacingVector(2, **options)
    batch = [envs.reset(seed=[3, 4])[0]]
    action = np.array([[0, 0.3, 0]] * 2, np.float32)
    steps = [envs.step(action) for _ in range(12)]
    batch += [step[0] for step in steps]
    for alone, together, again in zip(seen, batch, copy[0], strict=True):
        assert np.array_equal(alone, together[0]) and np.array_equal(alone, again)
    assert rewards == copy[1] == [step[1][0] for step in steps]
    env.close(), envs.close()


def test_what_a_car_observes_changes_nothing_of_its_drive():
    expected = drive(make_env())[1]
    for options in ({"observes": "state"}, {"observes": "above", "size": 32}, {"size": 32}):
        assert drive(make_env(**options), 40)[1] == expected


def test_a_state_has_documented_units():
    env = make_env(observes="state", track=RING)
    env.reset(seed=1)
    names, cars = list(STATE), env.unwrapped.cars
    seen = env.unwrapped.place(10, speed=40.0, turn=0.1, offset=0.5)
    state = dict(zip(names, seen.tolist(), strict=True))
    assert state["forward speed"] == pytest.approx(40, abs=0.1)
    assert state["heading error"] == pytest.approx(0.1, abs=0.02)
    assert state["road offset"] == pytest.approx(0.5, abs=0.05)
    for name in names[6:]:  # a circle to the left
        assert state[name] == pytest.approx(1 / 100, rel=0.05)
    before = float(cars.cars["angle"][0, 0])
    state = dict(zip(names, env.step(np.array([0.5, 0, 0], np.float32))[0].tolist(), strict=True))
    assert state["wheel angle"] < 0  # steering above 0 is to the right
    turned = float(cars.cars["angle"][0, 0]) - before
    assert state["yaw rate"] == pytest.approx(turned * 50, rel=0.01, abs=1e-3)


def test_a_skipped_frame_is_driven_and_not_drawn(monkeypatch):
    whole, rewards = drive(make_env(), 40)
    draw, drawn = Cars.draw, []
    monkeypatch.setattr(Cars, "draw", lambda *given: drawn.append(1) or draw(*given))
    seen, sums = drive(make_env(frame_skip=4), 10)
    assert len(drawn) == 11
    assert all(np.array_equal(*pair) for pair in zip(seen, whole[::4], strict=True))
    assert np.allclose(sums, np.reshape(rewards, (10, 4)).sum(axis=1))
    envs = CarRacingVector(1, max_episode_steps=5, frame_skip=4)
    envs.reset(seed=3)
    ended = [envs.step(np.zeros((1, 3)))[3][0] for _ in range(5)]
    assert ended == [False] * 4 + [True]


def test_a_picture_of_another_size_shows_what_the_usual_one_shows():
    sizes = ({}, {"size": 288}, {"size": 32})
    usual, large, small = (make_env(frame_skip=20, **options) for options in sizes)
    seen = [drive(env, 3)[0][-1].astype(float) for env in (usual, large, small)]
    for other, size in ((seen[1], 288), (seen[2], 32)):
        assert other.shape == (size, size, 3)
        scaled = Image.fromarray(seen[0].astype(np.uint8)).resize((size, size), Image.BOX)
        assert np.abs(np.asarray(scaled, float) - other).mean() < 12


def test_the_track_from_above_shows_the_road_and_the_car_where_it_is():
    env = make_env(observes="above", size=128, track=RING)
    picture = env.reset()[0].astype(int)
    road = (np.abs(picture - 104) < 12).all(axis=2)
    assert 0.1 < road.mean() < 0.3
    assert not road[54:74, 54:74].any()  # inside the ring is grass
    red = np.argwhere(picture[..., 0] - picture[..., 1] > 100)
    assert red[:, 1].mean() > 110 and abs(red[:, 0].mean() - 64) < 6  # at (100, 0), in the east


def test_a_calm_driver_completes_a_lap_of_an_own_track_from_a_file(tmp_path):
    (tmp_path / "ring.json").write_text(json.dumps({"checkpoints": RING.tolist()}))
    env = make_env(observes="state", track=str(tmp_path / "ring.json"), lap_complete_percent=0.9)
    state, total, names = env.reset()[0], 0.0, list(STATE)
    for _ in range(1000):
        speed, offset, error = (
            state[names.index(name)] for name in ("forward speed", "road offset", "heading error")
        )
        action = [error - 0.3 * offset - 0.05, 0.4 * (speed < 40), 0]
        state, reward, ended, stopped, info = env.step(np.clip(action, [-1, 0, 0], 1))
        total += reward
        if ended or stopped:
            break
    assert info.get("lap_finished") and total > 800


@pytest.mark.parametrize(
    ("checkpoints", "message"),
    [
        ([[0, 0], [1, 1]], "three points at least"),
        ([[0, 0], [1, np.nan], [3, 3]], "expected finite numbers"),
        ("words", "no track|is no file"),
        ([[0, 0], [0, 0], [50, 50]], "neighbouring checkpoints are the same"),
        (RING / 20, "no lap is possible: near .* bends too sharply: the least radius is 11"),
        (RING * 4, "no lap is possible: near .* leaves the field"),
        (RING[[0, 12, 3, 15, 6, 18]], "no lap is possible: near .* the road"),
        ([[-99, -9], [99, 9], [99, -9], [-99, 9]], "no lap is possible: near .* the road"),
        ([[-9e9, 0], [9e9, 0], [0, 9e9]], "a lap of .*: expected 10 to "),
        ([[0, 0], [2, 0], [0, 2]], "a lap of .*: expected 10 to "),
        ([["a", 0], [1, 0], [0, 1]], "three points at least"),
        ([[0, 0, 0]] * 3, "three points at least"),
    ],
)
def test_a_track_on_which_no_lap_is_possible_is_refused_with_the_reason(checkpoints, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        make_own_track(checkpoints)


def test_an_own_track_has_tiles_as_long_as_gymnasium_s_and_closes():
    path = make_own_track(RING).path
    steps = np.hypot(*(path[:, 2:] - np.roll(path[:, 2:], 1, axis=0)).T)
    assert np.allclose(steps, STEP_LENGTH, rtol=0.01)
    assert np.abs(np.diff(path[:, 1])).max() < TURN_RATE
    assert np.allclose(path[0, 2:], RING[0])


@pytest.mark.parametrize(
    "options",
    [{"observes": "smell"}, {"size": 31}, {"size": 96.0}, {"size": 513}, {"frame_skip": 0}],
)
def test_an_option_out_of_range_is_named(options):
    for make in (make_env, lambda **named: CarRacingVector(1, **named)):
        with pytest.raises(ValueError, match=f"{next(iter(options))}="):
            make(**options)


def test_gymnasium_makes_them_by_name():
    name = "stad_lab:StadLab/CarRacing-v3"
    assert gym.make(name, observes="state").observation_space.shape == (len(STATE),)
    assert views.VIEWS[0] == "picture"
