"""Films of an agent driving: what the car shows, what changes, and what V makes of it, side by side."""

import numpy as np
import torch

from stad_lab.agent import Agent
from stad_lab.autoencoder import to_pictures
from stad_lab.car_racing import make_env
from stad_lab.dream import to_uint8
from stad_lab.frames import earlier_frames, to_frame
from stad_lab.plots import difference_colors, moving_picture


def record_drive(agent: Agent, track: int, frames: int, fast: bool = True) -> np.ndarray:
    """Let an agent drive one episode, at most `frames` long: its observations, uint8 (frames, 96, 96, 3)."""
    env = make_env(fast)
    observation, _ = env.reset(seed=track)
    agent.reset()
    film, ended = [observation], False
    while len(film) < frames and not ended:
        observation, _, terminated, truncated, _ = env.step(agent.act(observation))
        film.append(observation)
        ended = terminated or truncated
    env.close()
    return np.array(film)


@torch.no_grad()
def film_agent(agent: Agent, track: int, first: int, frames: int, every: int = 3) -> bytes:
    """An animated GIF of observation, difference image and reconstruction while the agent drives.

    Args:
        track: seed of the track.
        first: first frame to show.
        frames: number of frames to cover.
        every: show one frame in so many; the film runs at the real speed, 50 frames a second.

    Raises:
        ValueError: the episode ends before `first`.
    """
    observations = record_drive(agent, track, first + frames)
    if len(observations) <= first:
        raise ValueError(f"first={first}, but on track {track} the episode ends after {len(observations)} frames")
    film = np.array([to_frame(observation, agent.crop_bar) for observation in observations])
    earlier = earlier_frames(film, agent.stride)
    shown = slice(first, None, every)
    frame, difference = to_pictures(film[shown], earlier[shown])
    columns = {
        "what the car shows": observations[shown],
        "what changes": difference_colors(difference.permute(0, 2, 3, 1).numpy()),
        "what V makes of it": to_uint8(agent.autoencoder.reconstruct(frame, difference)[0]),
    }
    return moving_picture(columns, fps=50 / every)
