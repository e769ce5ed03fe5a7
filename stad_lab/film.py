"""Films of an agent driving: what the car shows, what changes, and what V makes of it, side by side."""

import torch
from tqdm.auto import tqdm

from stad_lab.agent import Agent
from stad_lab.autoencoder import to_pictures
from stad_lab.dream import to_uint8
from stad_lab.drives import Drive, Inside, record_drive
from stad_lab.frames import earlier_frames
from stad_lab.plots import difference_colors, moving_figure, moving_picture, plot_moment


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
    drive = record_drive(agent, track, first + frames)
    if len(drive) <= first:
        raise ValueError(f"first={first}, but on track {track} the episode ends after {len(drive)} frames")
    film = drive.frames(agent.crop_bar)
    earlier = earlier_frames(film, agent.stride)
    shown = slice(first, None, every)
    frame, difference = to_pictures(film[shown], earlier[shown])
    columns = {
        "what the car shows": drive.observations[shown],
        "what changes": difference_colors(difference.permute(0, 2, 3, 1).numpy()),
        "what V makes of it": to_uint8(agent.autoencoder.reconstruct(frame, difference)[0]),
    }
    return moving_picture(columns, fps=50 / every)


def film_inside(drive: Drive, inside: Inside, every: int = 3, kind: str = "gif") -> bytes:
    """The rollout viewer as an animation, "gif" or "webp": one moment in `every`, at the real speed."""
    moments = tqdm(range(0, len(drive), every), "film", unit="picture")
    return moving_figure((plot_moment(drive, inside, moment) for moment in moments), 50 / every, kind)
