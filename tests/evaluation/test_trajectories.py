"""Drives know the true motion of the car, and what V and M make of it is what they would make step by step."""

import dataclasses

import numpy as np
import pytest
import torch

from stad_lab.config import Settings
from stad_lab.envs.car_racing import TRACK_WIDTH, make_env, place_car
from stad_lab.evaluation.trajectories import (
    MOTION,
    encode_drive,
    look_inside,
    record_drive,
    record_random_drive,
    remember_drive,
    road_in_sight,
    true_motion,
)
from stad_lab.models.mdn_rnn import encode_frames
from stad_lab.training.dataset import TRACK_RANGES, drive_randomly, track_seeds

SETTINGS = Settings.preset("quick", seed=3, random_starts=1.0)


@pytest.fixture(scope="module")
def random_drive():
    """One short drive of the random driver."""
    return record_random_drive(SETTINGS, 0)


def motion_of(env):
    return dict(zip(MOTION, true_motion(env).tolist(), strict=True))


@pytest.mark.parametrize(
    ("tile", "speed", "turn", "offset"), [(0, 0, 0, 0), (40, 50, 0.2, 0.5), (120, 20, -0.3, -0.6)]
)
def test_the_motion_is_that_which_the_car_was_given(tile, speed, turn, offset):
    env = make_env()
    env.reset(seed=5)
    place_car(env, tile, speed, turn, offset)
    motion = motion_of(env)
    assert motion["forward speed"] == pytest.approx(speed, abs=0.01)
    assert motion["slip speed"] == pytest.approx(0, abs=0.01) and motion["yaw rate"] == 0
    assert motion["road offset"] == pytest.approx(
        offset, abs=0.1
    )  # the nearest tile may be the next one
    assert motion["heading error"] == pytest.approx(turn, abs=0.15)
    env.close()


def test_speed_ahead_and_aside_are_told_apart_and_left_is_positive():
    env = make_env()
    env.reset(seed=5)
    place_car(env, 30, speed=40)
    hull = env.unwrapped.car.hull
    hull.linearVelocity = 3 * hull.GetWorldVector((0, 1)) + 4 * hull.GetWorldVector((1, 0))
    assert [motion_of(env)[name] for name in ("forward speed", "slip speed")] == pytest.approx(
        [3, 4], abs=1e-4
    )
    for _ in range(12):
        env.step(np.array([-1, 0.2, 0], np.float32))  # steering to the left
    motion = motion_of(env)
    assert motion["yaw rate"] > 0.1 and motion["wheel angle"] > 0.1
    env.close()


def test_the_road_is_in_sight_near_it_and_along_it_only():
    rows = np.zeros((4, len(MOTION)), np.float32)
    rows[1, 4], rows[2, 4], rows[3, 5] = 2.9, -3.1, 2.0
    assert road_in_sight(rows).tolist() == [True, True, False, False]
    assert list(MOTION)[4:] == ["road offset", "heading error"] and TRACK_WIDTH > 6


def test_a_random_drive_is_that_of_the_rollouts_on_a_track_of_its_own(random_drive):
    frames, actions, _ = drive_randomly(SETTINGS, 0)
    assert (
        len(random_drive)
        == len(random_drive.frames(True))
        == len(random_drive.motion)
        == len(random_drive.rewards)
    )
    assert np.array_equal(random_drive.actions[: len(actions)], actions[: len(random_drive)])
    assert not np.array_equal(random_drive.frames(True)[0], frames[0])  # another track
    again = record_random_drive(SETTINGS, 0)
    assert np.array_equal(again.observations, random_drive.observations)


def test_a_random_drive_s_track_is_one_for_inspection(noted_tracks):
    with noted_tracks() as tracks:
        record_random_drive(dataclasses.replace(SETTINGS, episode_frames=30, m_sequence=9), 1)
    assert tracks == [track_seeds("inspect", SETTINGS.episodes, SETTINGS.seed)[1]]
    assert TRACK_RANGES["inspect"][0] <= tracks[0] < TRACK_RANGES["inspect"][1]


def test_an_agent_s_drive_is_recorded_as_it_was_driven(agent):
    drive = record_drive(agent, track=4, frames=20)
    env = make_env()
    observation, _ = env.reset(seed=4)
    agent.reset()
    for t in range(20):
        assert np.array_equal(drive.observations[t], observation)
        action = agent.act(observation)
        assert np.array_equal(drive.actions[t], action)
        observation, reward, *_ = env.step(action)
        assert drive.rewards[t] == np.float32(reward)
    env.close()


def test_the_inside_of_a_drive_is_what_the_agent_saw(agent):
    drive = record_drive(agent, track=4, frames=12)
    inside = look_inside(agent.autoencoder, agent.mdn_rnn, drive, agent.stride, agent.crop_bar)
    agent.reset()
    for t in range(12):
        agent.act(drive.observations[t])
        assert np.allclose(inside.mu[t], agent.latents[0], atol=1e-4)
        assert np.allclose(inside.hidden[t], agent.hidden[0], atol=1e-4)
    assert inside.drawn_frames.shape == inside.frames.shape == inside.differences.shape
    assert inside.drawn_differences.shape == inside.differences.shape
    assert inside.mixture.logpi.shape[:3] == (1, 12, 32)
    assert np.abs(inside.differences[: agent.stride]).max() == 0


def test_m_s_memory_before_a_frame_does_not_know_it(agent, random_drive):
    mu, _ = encode_drive(agent.autoencoder, random_drive, agent.stride, agent.crop_bar)
    hidden = remember_drive(agent.mdn_rnn, mu, random_drive.actions)
    changed = mu.copy()
    changed[20:] += 1
    after = remember_drive(agent.mdn_rnn, changed, random_drive.actions)
    assert np.array_equal(hidden[:21], after[:21]) and not np.allclose(hidden[21], after[21])
    assert torch.count_nonzero(torch.from_numpy(hidden[0])) == 0


def test_an_agent_can_be_recorded_twice(agent):
    first, again = (record_drive(agent, track=4, frames=8) for _ in range(2))
    assert np.array_equal(first.actions, again.actions)


def test_a_drive_for_inspection_shows_the_bar_and_v_sees_it_as_it_was_trained(agent):
    drive = record_random_drive(Settings.preset("quick", seed=3, random_starts=1.0), 0)
    assert drive.observations[:, 84:].any(axis=(1, 2, 3)).all()
    for crop_bar in (True, False):
        mu, _ = encode_drive(agent.autoencoder, drive, 2, crop_bar)
        assert np.array_equal(mu, encode_frames(agent.autoencoder, drive.frames(crop_bar), 2)[0])
