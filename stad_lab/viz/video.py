"""Animations: pictures that move, and an agent at the wheel beside its dreams."""

import io

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from stad_lab.agent import Agent
from stad_lab.dreaming import dream_on
from stad_lab.envs.frames import earlier_frames, to_pictures
from stad_lab.evaluation.trajectories import (
    FRAMES_A_SECOND,
    Trajectory,
    record_trajectory,
)
from stad_lab.models.vae import to_tensor, to_uint8
from stad_lab.viz.plots import difference_colors

FILM = {"track": 5, "first": 60, "frames": 150}  # of a run, by `film_agent`: after the zoom
EVERY = 3  # one of so many frames is shown, at the real speed
DREAM = 100  # frames of a dream in which C drives: two seconds


def animate_pictures(columns: dict[str, np.ndarray], fps: float = 25) -> bytes:
    """An animated GIF of square pictures side by side: title -> uint8 (frames, H, H, 3).

    Raises ValueError for no pictures, or columns of different lengths.
    """
    lengths = {title: len(pictures) for title, pictures in columns.items()}
    if len(set(lengths.values())) != 1 or 0 in lengths.values():
        raise ValueError(f"columns of lengths {lengths}: expected one length, at least one picture")
    size, header, gap = 192, 20, 6  # pixels
    font, pages = ImageFont.load_default(13), []
    for pictures in zip(*columns.values(), strict=True):
        page = Image.new("RGB", (len(columns) * (size + gap) - gap, size + header), "white")
        draw = ImageDraw.Draw(page)
        for place, (title, picture) in enumerate(zip(columns, pictures, strict=True)):
            left = place * (size + gap)
            draw.text((left + size / 2, header / 2), title, fill="black", font=font, anchor="mm")
            page.paste(enlarged(picture, size), (left, header))
        pages.append(page)
    # One palette for all pages, or colours would flicker; "maximum coverage" keeps rare ones, for
    # example the car's red.
    sample = np.concatenate([np.asarray(page) for page in pages[:: max(1, len(pages) // 8)]])
    palette = Image.fromarray(sample).quantize(256, Image.Quantize.MAXCOVERAGE)
    pages = [page.quantize(palette=palette, dither=Image.Dither.NONE) for page in pages]
    return save_pages(pages, fps, "gif")


def save_pages(pages: list[Image.Image], fps: float, kind: str) -> bytes:
    """Pages as an endless animation, "gif" or "webp"."""
    buffer, pause = io.BytesIO(), round(1000 / fps)  # milliseconds
    pages[0].save(buffer, kind, save_all=True, append_images=pages[1:], duration=pause, loop=0)
    return buffer.getvalue()


def enlarged(picture: np.ndarray, size: int) -> Image.Image:
    """A square picture, uint8 (H, W, 3), with `size` pixels on each side."""
    return Image.fromarray(picture).resize((size, size), Image.Resampling.NEAREST)


@torch.no_grad()
def film_agent(agent: Agent, track: int, first: int, frames: int) -> bytes:
    """An animated GIF of observation, difference image, reconstruction and dream.

    It shows one in EVERY of `frames` frames from `first` on, fewer if the episode ends. Raises
    ValueError if it ends before `first`, or for a number that is out of range.
    """
    trajectory, world_model = record_longer(agent, track, first, frames), agent.world_model
    seen, shown = trajectory.frames(world_model.crop_bar), slice(first, None, EVERY)
    earlier = earlier_frames(seen, world_model.stride)
    frame, difference = to_pictures(seen[shown], earlier[shown])
    reconstruction, _ = agent.vae.reconstruct(to_tensor(frame), to_tensor(difference))
    columns = {
        "observation": trajectory.observations[shown],
        "difference image": difference_colors(difference),
        "V's reconstruction": to_uint8(reconstruction),
        "dream": repeated_dreams(agent, trajectory, first)[::EVERY],
    }
    return animate_pictures(columns, fps=FRAMES_A_SECOND / EVERY)


def repeated_dreams(
    agent: Agent, trajectory: Trajectory, first: int, length: int = DREAM
) -> np.ndarray:
    """Dreams of `length` frames, each from where the trajectory then is; `first` is at least 1.

    Returns a picture for each frame from `first` on, uint8 (len(trajectory) - first, 64, 64, 3).
    """
    agent.reset()
    dreams: list[np.ndarray] = []
    for moment, observation in enumerate(trajectory.observations):
        if moment >= first and (moment - first) % length == 0:
            frames = min(length, len(trajectory) - moment)
            dreams.append(dream_on(agent, frames, seed=len(dreams))[0])
        agent.act(observation)  # as in the episode, so that M has its memory of that moment
    return np.concatenate(dreams)


def record_longer(agent: Agent, track: int, first: int, frames: int) -> Trajectory:
    """An episode of at most `first + frames` frames; raises as `film_agent`."""
    for name, value, least in (("track", track, 0), ("first", first, 1), ("frames", frames, 1)):
        if value < least:
            raise ValueError(f"{name}={value}: expected at least {least}")
    trajectory = record_trajectory(agent, track, first + frames)
    if (length := len(trajectory)) <= first:
        raise ValueError(f"first={first}: on track {track} the episode ends after {length} frames")
    return trajectory
