"""Films of an agent driving: what the car shows, what changes, what V makes of it and what it dreams, side by side."""

import numpy as np
import torch
from tqdm.auto import tqdm

from stad_lab.agent import Agent
from stad_lab.envs.dream import dream_on
from stad_lab.envs.frames import earlier_frames
from stad_lab.evaluation.trajectories import (
    FRAMES_A_SECOND,
    Drive,
    Inside,
    look_inside,
    record_drive,
)
from stad_lab.models.vae import to_array, to_pictures, to_uint8
from stad_lab.viz.plots import (
    check_kind,
    difference_colors,
    moving_figure,
    moving_picture,
    plot_moment,
)

EVERY = 3  # of so many frames one is shown; a film runs at the real speed
NAP = 100  # frames of a dream, two seconds: long enough to see it leave the drive, short enough to compare


@torch.no_grad()
def film_agent(agent: Agent, track: int, first: int, frames: int) -> bytes:
    """An animated GIF of observation, difference image, reconstruction and dream while the agent drives.

    Args:
        track: seed of the track.
        first: first frame to show.
        frames: number of frames to cover.

    Raises:
        ValueError: the episode ends before `first`, or a number that is out of range.
    """
    drive = record_longer_drive(agent, track, first, frames)
    film = drive.frames(agent.crop_bar)
    earlier = earlier_frames(film, agent.stride)
    shown = slice(first, None, EVERY)
    frame, difference = to_pictures(film[shown], earlier[shown])
    columns = {
        "what the car shows": drive.observations[shown],
        "what changes": difference_colors(to_array(difference)),
        "what V makes of it": to_uint8(agent.autoencoder.reconstruct(frame, difference)[0]),
        "what it dreams": naps(agent, drive, first)[::EVERY],
    }
    return moving_picture(columns, fps=FRAMES_A_SECOND / EVERY)


def naps(agent: Agent, drive: Drive, first: int, length: int = NAP) -> np.ndarray:
    """The dreams of an agent that falls asleep at frame `first` of its own drive, and is woken every `length` frames.

    Returns:
        One picture for each frame from `first` on, uint8 (len(drive) - first, 64, 64, 3). While it sleeps, the agent
        drives in the dream, and every dream begins with what M expects to see next.
    """
    agent.reset()
    dreams = []
    for moment, observation in enumerate(drive.observations):
        agent.act(
            observation
        )  # as it did in the drive: this gives the agent its memory of that moment back
        if moment >= first and (moment - first) % length == 0:
            dreams.append(dream_on(agent, min(length, len(drive) - moment), seed=len(dreams))[0])
    return np.concatenate(dreams)


def film_viewer(agent: Agent, track: int, first: int, frames: int, kind: str = "gif") -> bytes:
    """The rollout viewer while the agent drives, as an animation; arguments as for `film_agent`.

    Args:
        kind: "gif" or "webp".

    Raises:
        ValueError: as `film_agent`, or another kind.
    """
    check_kind(kind)
    drive = record_longer_drive(agent, track, first, frames)
    inside = look_inside(agent.autoencoder, agent.mdn_rnn, drive, agent.stride, agent.crop_bar)
    return film_inside(drive, inside, first, kind)


def film_inside(drive: Drive, inside: Inside, first: int = 0, kind: str = "gif") -> bytes:
    """The rollout viewer as an animation, "gif" or "webp": one moment in EVERY, at the real speed."""
    moments = tqdm(range(first, len(drive), EVERY), "film", unit="picture")
    return moving_figure(
        (plot_moment(drive, inside, moment) for moment in moments), FRAMES_A_SECOND / EVERY, kind
    )


def record_longer_drive(agent: Agent, track: int, first: int, frames: int) -> Drive:
    """Record a drive of at most `first + frames` frames; raises as `film_agent`, before the drive where it can."""
    for name, value, least in (("track", track, 0), ("first", first, 0), ("frames", frames, 1)):
        if value < least:
            raise ValueError(f"{name}={value}: expected at least {least}")
    drive = record_drive(agent, track, first + frames)
    if len(drive) <= first:
        raise ValueError(
            f"first={first}, but on track {track} the episode ends after {len(drive)} frames"
        )
    return drive
