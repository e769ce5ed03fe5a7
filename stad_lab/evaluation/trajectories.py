"""Drives: episodes kept whole, with the true motion of the car beside what it shows, and what V and M make of them.

Training sees frames and actions only. Whoever asks what a latent knows about motion must know the motion: here it is
read from the simulator. The tracks are from a range of their own ("inspect"), so that V and M have never seen them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch

from stad_lab.agent import Agent
from stad_lab.config import Settings
from stad_lab.envs.car_racing import TRACK_WIDTH, make_env
from stad_lab.envs.frames import episode_differences, to_frame
from stad_lab.models.mdn_rnn import MDNRNN, Mixture, encode_frames
from stad_lab.models.vae import AutoEncoder, to_array, to_uint8
from stad_lab.training.dataset import begin_randomly

FRAMES_A_SECOND = 50  # of CarRacing's physics
MOTION = {  # the columns of `Drive.motion`, with their units
    "forward speed": "world units per second",
    "slip speed": "world units per second, to the right",
    "yaw rate": "radians per second, to the left",
    "wheel angle": "radians, to the left",
    "road offset": "half road widths, to the right",
    "heading error": "radians, to the left",
}


@dataclass(frozen=True)
class Drive:
    """One episode, T frames long; row t of each array belongs to the moment at which `observations[t]` is seen."""

    observations: np.ndarray
    """uint8 (T, 96, 96, 3)."""
    actions: np.ndarray
    """float32 (T, 3): what the driver did on seeing the observation."""
    rewards: np.ndarray
    """float32 (T,): what that action earned."""
    motion: np.ndarray
    """float32 (T, 6): the columns are the keys of MOTION."""

    def __len__(self) -> int:
        return len(self.actions)

    def frames(self, crop_bar: bool) -> np.ndarray:
        """What V sees of it: uint8 (T, 64, 64, 3). Whether without the indicator bar, is as V was trained."""
        return np.array([to_frame(observation, crop_bar) for observation in self.observations])


def true_motion(env: gym.Env) -> np.ndarray:
    """How the car moves and where it is on the road, from the simulator: float32 (6,), as MOTION names them."""
    car_racing = env.unwrapped
    hull, track = (
        car_racing.car.hull,
        np.array(car_racing.track),
    )  # of a tile: progress, direction, x, y
    along, across = (
        np.dot(hull.linearVelocity, hull.GetWorldVector(axis)) for axis in ((0, 1), (1, 0))
    )
    _, direction, x, y = track[
        np.hypot(track[:, 2] - hull.position.x, track[:, 3] - hull.position.y).argmin()
    ]
    offset = (hull.position.x - x) * np.cos(direction) + (hull.position.y - y) * np.sin(direction)
    turned = (hull.angle - direction + np.pi) % (2 * np.pi) - np.pi
    wheel_angle = car_racing.car.wheels[0].joint.angle
    return np.array(
        [along, across, hull.angularVelocity, wheel_angle, offset / TRACK_WIDTH, turned], np.float32
    )


def driven_path(motion: np.ndarray) -> np.ndarray:
    """Where the car went, by dead reckoning: float32 (T, 6) -> world units (T, 2), from (0, 0), first heading upward.

    The speeds along and across the car are turned by the heading, which is the sum of the yaw rates, and summed: what a
    car without a map knows of its own way. (Between two frames lie 1/50 seconds.)
    """
    forward, slip, yaw_rate = motion[:, :3].astype(float).T / FRAMES_A_SECOND
    heading = np.cumsum(yaw_rate) - yaw_rate
    east = slip * np.cos(heading) - forward * np.sin(heading)
    north = slip * np.sin(heading) + forward * np.cos(heading)
    return np.stack([np.cumsum(east) - east, np.cumsum(north) - north], axis=1)


def road_in_sight(motion: np.ndarray) -> np.ndarray:
    """Whether the car is within 3 half road widths of the centre line and heads along the road: bool (T,).

    Elsewhere a picture of grass is all there is, and no latent could tell where the road went.
    """
    names = list(MOTION)
    offset, turned = motion[:, names.index("road offset")], motion[:, names.index("heading error")]
    return (np.abs(offset) < 3) & (np.abs(turned) < np.pi / 2)


def record(
    env: gym.Env, observation: np.ndarray, act: Callable[[np.ndarray], np.ndarray], frames: int
) -> Drive:
    """Drive on from `observation` for at most so many frames, and close the environment.

    Args:
        act: observation -> action, float32 (3,).
    """
    rows, ended = [], False
    while len(rows) < frames and not ended:
        motion, action = true_motion(env), act(observation)
        following, reward, terminated, truncated, _ = env.step(action)
        rows.append((observation, action, reward, motion))
        observation, ended = following, terminated or truncated
    env.close()
    return to_drive(rows)


def to_drive(rows: list[tuple]) -> Drive:
    """Rows (observation, action, reward, motion), one for each frame, as a Drive. ValueError if there are none."""
    if not rows:
        raise ValueError("a drive without a frame: drive at least one frame before you look at it")
    observations, actions, rewards, motion = zip(*rows, strict=True)
    return Drive(
        np.array(observations), np.array(actions), np.array(rewards, np.float32), np.array(motion)
    )


def record_random_drive(settings: Settings, index: int) -> Drive:
    """A drive of the random driver, as `rollouts.drive_randomly` makes them, but on a track kept for inspection."""
    env, observation, driver = begin_randomly(settings, index, use="inspect")
    return record(env, observation, lambda _: driver.act(), settings.episode_frames)


def record_drive(agent: Agent, track: int, frames: int) -> Drive:
    """A drive of an agent from the start of a track, at most `frames` long."""
    env = make_env()
    observation, _ = env.reset(
        seed=int(track)
    )  # one that NumPy has chosen is NumPy's, which Gymnasium refuses
    agent.reset()
    return record(env, observation, agent.act, frames)


@dataclass(frozen=True)
class Inside:
    """What V and M make of a drive of T frames."""

    frames: np.ndarray
    """What V saw: uint8 (T, 64, 64, 3)."""
    differences: np.ndarray
    """The difference images: float32 (T, 64, 64, 3) in [-1, 1]."""
    drawn_frames: np.ndarray
    """The frames that V redraws from mu: uint8 (T, 64, 64, 3)."""
    drawn_differences: np.ndarray | None
    """The differences that V redraws: float32 (T, 64, 64, 3); None if its variant does not."""
    mu: np.ndarray
    """Means of z: float32 (T, latent_size)."""
    hidden: np.ndarray
    """M's memory before it sees the frame, which C is shown with z: float32 (T, hidden_size)."""
    mixture: Mixture
    """What M expects after the frame and the action: parts (1, T, latent_size, mixtures)."""


def encode_drive(
    autoencoder: AutoEncoder, drive: Drive, stride: int, crop_bar: bool
) -> tuple[np.ndarray, np.ndarray]:
    """What V makes of a drive: mu and logvar of z, float32 (T, latent_size) each; stride and bar as V was trained."""
    return tuple(encode_frames(autoencoder, drive.frames(crop_bar), stride))


@torch.no_grad()
def remember_drive(mdn_rnn: MDNRNN, latents: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """M's memory before every frame of a drive: mu (T, latent_size), actions (T, 3) -> float32 (T, hidden_size)."""
    return memory_before(remember_frames(mdn_rnn, latents, actions))


def remember_frames(mdn_rnn: MDNRNN, latents: np.ndarray, actions: np.ndarray) -> torch.Tensor:
    """M's memory after every frame of a drive: float32 (1, T, hidden_size)."""
    return mdn_rnn.remember(torch.from_numpy(latents)[None], torch.from_numpy(actions)[None], None)[
        0
    ]


def memory_before(after: torch.Tensor) -> np.ndarray:
    """M's memory before every frame, float32 (T, hidden_size), from that after it; before the first it is empty."""
    return torch.cat([torch.zeros_like(after[:, :1]), after[:, :-1]], dim=1)[0].numpy()


@torch.no_grad()
def look_inside(
    autoencoder: AutoEncoder, mdn_rnn: MDNRNN, drive: Drive, stride: int, crop_bar: bool
) -> Inside:
    """Show V and M a drive from its first frame on, and keep all they make of it; stride and bar as V was trained."""
    frames = drive.frames(crop_bar)
    mu, _ = encode_frames(autoencoder, frames, stride)
    after = remember_frames(mdn_rnn, mu, drive.actions)
    hidden, mixture = memory_before(after), mdn_rnn.mixture(after)
    drawn, changed = autoencoder.decode(torch.from_numpy(mu))
    changed = None if changed is None else to_array(changed)
    return Inside(
        frames, episode_differences(frames, stride), to_uint8(drawn), changed, mu, hidden, mixture
    )
