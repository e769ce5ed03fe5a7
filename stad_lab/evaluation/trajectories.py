"""Trajectories: recorded episodes with the true motion of the car.

Training sees frames and actions only. To ask what a latent encodes of the car's motion, one must
know the motion: here it is read from the simulator. The tracks are from a range of their own,
"inspect", so that V and M have never seen them.
"""

from dataclasses import dataclass

import numpy as np

from stad_lab.agent import Agent, Driver, rollout
from stad_lab.config import Config
from stad_lab.envs.cars import Cars
from stad_lab.envs.frames import to_frame
from stad_lab.envs.state import MOTION, true_motion
from stad_lab.features import encode_episode
from stad_lab.models.vae import VAE
from stad_lab.training.dataset import random_start

FRAMES_A_SECOND = 50  # of CarRacing's physics


@dataclass(frozen=True)
class Trajectory:
    """One episode of T frames; row t of each array belongs to `observations[t]`."""

    observations: np.ndarray  # uint8 (T, 96, 96, 3)
    actions: np.ndarray  # on these observations, float32 (T, 3)
    rewards: np.ndarray  # of these actions, float32 (T,)
    motion: np.ndarray  # float32 (T, 6): the columns are the keys of MOTION

    def __len__(self) -> int:
        return len(self.actions)

    def frames(self, crop_bar: bool) -> np.ndarray:
        """What V sees: uint8 (T, 64, 64, 3), without the indicator bar or with it."""
        return np.array([to_frame(observation, crop_bar) for observation in self.observations])


class Recorder:
    """Keeps what a trajectory of one car needs, as `observe` of `rollout`."""

    def __init__(self, cars: Cars):
        self.cars = cars
        self.rows: list[tuple] = []

    def __call__(self, _: np.ndarray, seen: np.ndarray, actions: np.ndarray) -> None:
        """Keep one moment."""
        self.rows.append((seen[0], actions[0], true_motion(self.cars)))

    def trajectory(self, rewards: list[float]) -> Trajectory:
        """The trajectory so far. ValueError if there is no frame."""
        if not self.rows:
            raise ValueError("a trajectory without a frame: drive at least one frame first")
        observations, actions, motion = map(np.array, zip(*self.rows, strict=True))
        return Trajectory(observations, actions, np.array(rewards, np.float32), motion)


def road_in_sight(motion: np.ndarray) -> np.ndarray:
    """Whether the car is within 3 half road widths of the centre and heads forward: bool (T,).

    Elsewhere the picture shows only grass, and no latent could encode where the road is.
    """
    columns = dict(zip(MOTION, np.abs(motion).T, strict=True))
    return (columns["road offset"] < 3) & (columns["heading error"] < np.pi / 2)


def record(driver: Driver, cars: Cars, frames: int) -> Trajectory:
    """Drive one car, which shows observations, for at most this number of frames."""
    recorder = Recorder(cars)
    episodes = rollout(driver, cars, max_frames=frames, observe=recorder)
    return recorder.trajectory(episodes.rewards[0])


def record_random_trajectory(config: Config, index: int) -> Trajectory:
    """An episode of the random driver as in the dataset, but on a track kept for inspection."""
    cars, driver = random_start(config, index, use="inspect", shows="observation")
    return record(driver, cars, config.data.episode_frames)


def record_trajectory(agent: Agent, track: int, frames: int) -> Trajectory:
    """An episode of an agent from the start of a track, at most `frames` long."""
    cars = Cars(1)
    cars.reset([track])
    return record(agent, cars, frames)


def encode_trajectory(
    vae: VAE, trajectory: Trajectory, stride: int, crop_bar: bool
) -> tuple[np.ndarray, np.ndarray]:
    """V's mu and logvar, float32 (T, latent_size) each; stride and bar as V was trained."""
    return tuple(encode_episode(vae, trajectory.frames(crop_bar), stride))
