"""A race against the agent: its own lap of a track, which stands beside the human's."""

from dataclasses import dataclass

import numpy as np

from stad_course.play.session import pose_of
from stad_lab.agent import Agent, rollout
from stad_lab.envs.cars import Cars
from stad_lab.evaluation.trajectories import FRAMES_A_SECOND


@dataclass(frozen=True)
class Ghost:
    """An agent's episode of T frames on a track."""

    track: int
    poses: np.ndarray  # float64 (T, 3): position in world units, and heading in radians
    tiles: np.ndarray  # visited so far, int (T,)
    score: float  # of the whole episode

    def behind(self, tiles: int, frames: int) -> float:
        """Seconds since the agent had visited so many tiles; negative if it comes later."""
        return (frames - int(np.searchsorted(self.tiles, tiles))) / FRAMES_A_SECOND


def drive_ghost(agent: Agent, track: int) -> Ghost:
    """Let a copy of the agent drive an episode on a track; takes a second or two."""
    cars, poses, tiles = Cars(1), [], []
    cars.reset([track])

    def observe(*_) -> None:
        poses.append(pose_of(cars.cars[0]))
        tiles.append(int(cars.cars["tiles_visited"][0]))

    driven = rollout(Agent(agent.world_model, agent.parameters), cars, observe=observe)
    return Ghost(track, np.array(poses), np.array(tiles), float(driven.returns[0]))
