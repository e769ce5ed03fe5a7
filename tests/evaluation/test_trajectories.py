"""Trajectories hold the true motion of the car; V and M see them as they do step by step."""

import numpy as np
import pytest
import torch

from stad_lab import make_env
from stad_lab.config import TRACK_RANGES, Config, track_seeds
from stad_lab.envs.cars import Cars
from stad_lab.envs.track import TRACK_WIDTH
from stad_lab.evaluation.trajectories import (
    MOTION,
    Recorder,
    encode_trajectory,
    record_random_trajectory,
    record_trajectory,
    road_in_sight,
    true_motion,
)
from stad_lab.features import encode_episode, remember_episode
from stad_lab.training.dataset import drive_randomly

CONFIG = Config.preset("quick", seed=3, data={"random_starts": 1.0})


@pytest.fixture(scope="module")
def random_trajectory():
    """One short episode of the random driver."""
    return record_random_trajectory(CONFIG, 0)


@pytest.fixture
def cars():
    """One car on a track."""
    cars = Cars(1)
    cars.reset([5])
    return cars


def motion_of(cars):
    return dict(zip(MOTION, true_motion(cars).tolist(), strict=True))


@pytest.mark.parametrize(
    ("tile", "speed", "turn", "offset"), [(0, 0, 0, 0), (40, 50, 0.2, 0.5), (120, 20, -0.3, -0.6)]
)
def test_the_motion_is_that_which_the_car_was_given(tile, speed, turn, offset, cars):
    cars.place(0, tile, speed, turn, offset)
    motion = motion_of(cars)
    assert motion["forward speed"] == pytest.approx(speed, abs=0.01)
    assert motion["slip speed"] == pytest.approx(0, abs=0.01)
    assert motion["yaw rate"] == 0
    assert motion["road offset"] == pytest.approx(offset, abs=0.1)  # of the next tile, perhaps
    assert motion["heading error"] == pytest.approx(turn, abs=0.15)


def test_speed_along_and_across_are_separate_and_left_is_positive(cars):
    cars.place(0, 30, speed=40)
    angle = cars.cars["angle"][0, 0]
    ahead, right = (-np.sin(angle), np.cos(angle)), (np.cos(angle), np.sin(angle))
    cars.cars["velocity"][0, 0, :2] = 3 * np.array(ahead) + 4 * np.array(right)
    speeds = [motion_of(cars)[name] for name in ("forward speed", "slip speed")]
    assert speeds == pytest.approx([3, 4], abs=1e-4)
    for _ in range(12):
        cars.step(np.array([[-1, 0.2, 0]]))  # steering to the left
    motion = motion_of(cars)
    assert motion["yaw rate"] > 0.1 and motion["wheel angle"] > 0.1


def test_the_road_is_in_sight_near_it_and_along_it_only():
    rows = np.zeros((4, len(MOTION)), np.float32)
    rows[1, 4], rows[2, 4], rows[3, 5] = 2.9, -3.1, 2.0
    assert road_in_sight(rows).tolist() == [True, True, False, False]
    assert list(MOTION)[4:] == ["road offset", "heading error"] and TRACK_WIDTH > 6


def test_a_random_trajectory_is_as_in_the_dataset_but_on_a_track_of_its_own(
    random_trajectory, noted_tracks
):
    frames, actions, _ = drive_randomly(CONFIG, 0)
    count = len(random_trajectory)
    assert count == len(random_trajectory.motion) == len(random_trajectory.rewards)
    assert np.array_equal(random_trajectory.actions[: len(actions)], actions[:count])
    assert not np.array_equal(random_trajectory.frames(True)[0], frames[0])  # another track
    with noted_tracks() as tracks:
        again = record_random_trajectory(CONFIG, 0)
    assert np.array_equal(again.observations, random_trajectory.observations)
    assert tracks == track_seeds("inspect", CONFIG.data.episodes, CONFIG.seed)[:1]
    assert TRACK_RANGES["inspect"][0] <= tracks[0] < TRACK_RANGES["inspect"][1]


def test_an_agent_s_trajectory_is_recorded_as_it_was_driven(agent):
    trajectory = record_trajectory(agent, track=4, frames=20)
    env = make_env()
    observation, _ = env.reset(seed=4)
    agent.reset()
    for t in range(20):
        assert np.array_equal(trajectory.observations[t], observation)
        action = agent.act(observation)
        assert np.array_equal(trajectory.actions[t], action)
        observation, reward, *_ = env.step(action)
        assert trajectory.rewards[t] == np.float32(reward)
    again = record_trajectory(agent, track=4, frames=20)
    assert np.array_equal(trajectory.actions, again.actions)


def test_a_trajectory_without_a_frame_is_refused():
    with pytest.raises(ValueError, match="without a frame: drive at least one frame"):
        Recorder(Cars(1)).trajectory([])


def test_m_s_memory_before_a_frame_does_not_depend_on_it(agent, random_trajectory):
    mu = np.random.default_rng(0).standard_normal((len(random_trajectory), 32), np.float32)
    hidden = remember_episode(agent.mdn_rnn, mu, random_trajectory.actions)
    changed = mu.copy()
    changed[20:] += 1
    after = remember_episode(agent.mdn_rnn, changed, random_trajectory.actions)
    assert np.array_equal(hidden[:21], after[:21]) and not np.allclose(hidden[21], after[21])
    assert torch.count_nonzero(torch.from_numpy(hidden[0])) == 0


def test_a_trajectory_shows_the_bar_and_v_sees_it_as_it_was_trained(agent, random_trajectory):
    assert random_trajectory.observations[:, 84:].any(axis=(1, 2, 3)).all()
    for crop_bar in (True, False):
        found = encode_trajectory(agent.vae, random_trajectory, 2, crop_bar)
        expected = encode_episode(agent.vae, random_trajectory.frames(crop_bar), 2)
        assert np.array_equal(found, expected)
