"""A session: smoothed keys, two drivers, two worlds, and a recording that is a Trajectory."""

import numpy as np
import pytest
import torch

from stad_course.play.session import Hand, Session
from stad_lab import load_agent
from stad_lab.evaluation.trajectories import FRAMES_A_SECOND, record_trajectory
from stad_lab.features import remember_episode
from stad_lab.models.mdn_rnn import to_state


@pytest.fixture
def session():
    """A session with the agent that comes with stad_lab, on track 3."""
    return Session(load_agent("input"), track=3)


def drive(session, *script):
    """Hold keys for some frames: ("gas left", 20), ..."""
    for keys, frames in script:
        session.hand.hold(*keys.split())
        for _ in range(frames):
            session.step()


def test_a_held_key_moves_the_action_smoothly_and_a_released_one_lets_it_fall_back():
    hand = Hand()
    hand.hold("left", "gas")
    actions = np.array([hand.act() for _ in range(40)])
    assert np.all(np.diff(actions[:10, 0]) < 0) and np.abs(np.diff(actions, axis=0)).max() < 0.11
    assert actions[-1] == pytest.approx([-1, 0.7, 0])
    hand.hold()
    assert [hand.act() for _ in range(20)][-1] == pytest.approx([0, 0, 0])
    hand.hold("left", "right")
    assert hand.act()[0] == 0


def test_before_the_first_frame_the_path_is_empty(session):
    session.begin(1)
    assert session.path().shape == (0, 2) and session.by_hand().shape == (0,)


def test_an_agent_drives_in_a_session_exactly_as_alone(session):
    session.give("agent")
    drive(session, ("", 40))
    alone = record_trajectory(load_agent("input"), track=3, frames=40)
    for name in ("observations", "actions", "rewards", "motion"):
        assert np.array_equal(getattr(session.trajectory(), name), getattr(alone, name))
    assert not session.by_hand().any() and session.score == pytest.approx(alone.rewards.sum())


def test_m_remembers_the_actions_of_the_human(session):
    seen = []
    for _ in range(30):
        seen.append(session.agent.latents[0])
        drive(session, ("gas", 1))
    assert session.by_hand().all()
    done = np.concatenate([session.trajectory().actions, np.zeros((1, 3), np.float32)])
    hidden = remember_episode(
        session.agent.mdn_rnn, np.array([*seen, session.agent.latents[0]]), done
    )
    assert np.allclose(session.before[0, 0], hidden[-1], atol=1e-5)


def test_a_dream_begins_with_the_present_frame_and_the_real_car_waits(session):
    session.give("agent")
    drive(session, ("", 20))
    before, score = session.observation, session.score
    session.enter("dream")
    session.dream.temperature = 0.5
    drive(session, ("", 15))
    session.give("hand")
    drive(session, ("brake", 5))
    dream = session.dream_trajectory()
    assert np.array_equal(dream.latents[0], session.agent.latents[0])
    assert (
        dream.frames.shape == (20, 64, 64, 3)
        and dream.by_hand.tolist() == [False] * 15 + [True] * 5
    )
    assert session.picture().shape == (64, 64, 3) and session.score == score
    session.enter("real")
    assert np.array_equal(session.picture(), before) and len(session.trajectory()) == 20
    drive(session, ("", 1))
    assert len(session.trajectory()) == 21


def test_the_human_takes_over_smoothly_from_the_agents_last_action(session):
    session.give("agent")
    drive(session, ("", 25))
    session.give("hand")
    drive(session, ("left", 3))
    actions = session.trajectory().actions[24:]
    assert np.abs(np.diff(actions, axis=0))[:, :2].max() < 0.17
    assert session.by_hand().tolist() == [False] * 25 + [True] * 3


def test_an_ended_episode_cannot_go_on(session):
    session.begin(np.int64(4))
    drive(session, ("", 2))
    session.real_ended = True
    with pytest.raises(RuntimeError, match="the episode has ended"):
        session.step()
    session.enter("dream")
    assert not session.ended
    session.step()


def test_what_does_not_exist_is_refused(session):
    with pytest.raises(ValueError, match="track=-1: expected a whole number from 0 to 999,999"):
        session.begin(-1)
    with pytest.raises(ValueError, match="driver='dog': choose one of hand, agent"):
        session.give("dog")
    with pytest.raises(ValueError, match="world='mars': choose one of real, dream"):
        session.enter("mars")
    with pytest.raises(ValueError, match="pedal='clutch'"):
        session.hand.hold("gas", "clutch")
    with pytest.raises(ValueError, match="at least one frame first"):
        session.trajectory()
    with pytest.raises(ValueError, match="nothing was driven in a dream"):
        session.dream_trajectory()


def driven_path(motion):
    """The car's path by dead reckoning, from (0, 0) and upward: world units (T, 2)."""
    forward, slip, yaw_rate = motion[:, :3].astype(float).T / FRAMES_A_SECOND
    heading = np.cumsum(yaw_rate) - yaw_rate
    east = slip * np.cos(heading) - forward * np.sin(heading)
    north = slip * np.sin(heading) + forward * np.cos(heading)
    return np.stack([np.cumsum(east) - east, np.cumsum(north) - north], axis=1)


def test_dead_reckoning_from_the_recorded_motion_follows_the_car(session):
    car = session.env.unwrapped.cars.cars[0]
    start, angle = car["position"][0].astype(float), float(car["angle"][0])
    drive(session, ("gas", 60), ("left", 40))
    moved = car["position"][0] - start
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    assert np.linalg.norm(
        driven_path(session.trajectory().motion)[-1] - turn @ moved
    ) < 0.1 * np.linalg.norm(moved)


def test_a_dream_begins_with_m_s_memory_from_before_the_present_frame(session):
    session.give("agent")
    drive(session, ("", 12))
    session.enter("dream")
    assert session.dream.hidden.any()
    assert np.array_equal(session.dream.hidden, session.agent.hidden[0])
    session.step()
    done, seen = (
        torch.from_numpy(part)[None]
        for part in (session.dream_trajectory().actions, session.agent.latents)
    )
    with torch.no_grad():
        after, _ = session.agent.mdn_rnn.remember(seen, done, to_state(session.before))
    assert np.allclose(session.dream.hidden, after[0, 0], atol=1e-5)


def test_a_second_episode_is_driven_as_if_it_were_the_first(session):
    session.give("agent")
    drive(session, ("", 10))
    session.begin(4)
    drive(session, ("", 10))
    assert np.array_equal(
        session.trajectory().actions,
        record_trajectory(load_agent("input"), track=4, frames=10).actions,
    )
