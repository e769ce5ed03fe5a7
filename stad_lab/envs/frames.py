"""Frames and difference images: from what CarRacing shows to what V sees.

A frame x_t is the observation, without its indicator bar or with it, shrunk to 64 x 64 pixels. The
difference image is d_t = x_t - x_(t-k) with a stride of k frames (STAD, section 3.1); where nothing
moved it is zero.
"""

from collections import deque

import numpy as np

FRAME_SIZE = 64  # pixels, width and height of a frame
OBSERVATION_SIZE = 96  # pixels, width and height of an observation
BAR_TOP = 84  # first row of the indicator bar: 5/40 of the height
OBSERVATION_SHAPE = (OBSERVATION_SIZE, OBSERVATION_SIZE, 3)


def to_frame(observation: np.ndarray, crop_bar: bool = True) -> np.ndarray:
    """Shrink an observation, uint8 (96, 96, 3), to a frame, uint8 (64, 64, 3).

    `crop_bar` cuts off the indicator bar first. The bar shows speed, wheel speeds, steering and yaw
    rate, so with it a single frame shows the motion. ValueError for another shape or dtype.
    """
    dtype = getattr(observation, "dtype", type(observation).__name__)
    shape = getattr(observation, "shape", "no shape")
    if dtype != np.uint8 or shape != OBSERVATION_SHAPE:
        raise ValueError(
            f"observation with dtype {dtype} and shape {shape}: expected uint8 and"
            f" {OBSERVATION_SHAPE}, as CarRacing-v3 gives it without wrappers that change it"
        )
    import cv2  # here, because our engine draws frames without it

    picture = observation[:BAR_TOP] if crop_bar else observation
    return cv2.resize(picture, (FRAME_SIZE, FRAME_SIZE), interpolation=cv2.INTER_AREA)


def normalise(frames: np.ndarray) -> np.ndarray:
    """Frames uint8 (...) -> float32 in [0, 1] of the same shape."""
    # In blocks that fit the cache: twice as fast as `astype`, and equal to the last bit.
    return np.divide(frames, np.float32(255), dtype=np.float32)


def difference_image(frame: np.ndarray, earlier: np.ndarray) -> np.ndarray:
    """d = frame - earlier: uint8 of one shape -> float32 in [-1, 1]. Raises as `to_pictures`."""
    return to_pictures(frame, earlier)[1]


def to_pictures(frames: np.ndarray, earlier: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What V sees: frames in [0, 1] and their difference images in [-1, 1], float32.

    `earlier` holds the frames `stride` before `frames`. Both are uint8 of one shape, for example
    (batch, 64, 64, 3); ValueError if not.
    """
    if frames.shape != earlier.shape or frames.dtype != np.uint8 or earlier.dtype != np.uint8:
        raise ValueError(
            f"frames of shape {frames.shape} {frames.dtype} and {earlier.shape} {earlier.dtype}:"
            " expected two uint8 arrays of one shape"
        )
    present = normalise(frames)
    return present, present - normalise(earlier)


def earlier_index(index: np.ndarray | int, stride: int) -> np.ndarray:
    """The frame to subtract from frame `index`: `stride` before it, or itself in the first frames.

    Until `stride` frames exist the difference image is zero. ValueError for a stride below 1.
    """
    check_stride(stride)
    index = np.asarray(index)
    return np.where(index >= stride, index - stride, index)


def earlier_frames(frames: np.ndarray, stride: int) -> np.ndarray:
    """For every frame of an episode (T, 64, 64, 3) the one to subtract from it, a copy."""
    return frames[earlier_index(np.arange(len(frames)), stride)]


def episode_differences(frames: np.ndarray, stride: int) -> np.ndarray:
    """All difference images of an episode: uint8 (T, 64, 64, 3) -> float32 in [-1, 1]."""
    return difference_image(frames, earlier_frames(frames, stride))


class FrameMemory:
    """The last frames of an episode, (64, 64, 3) or (cars, 64, 64, 3), for difference images."""

    def __init__(self, stride: int):
        check_stride(stride)
        self.frames: deque[np.ndarray] = deque(maxlen=stride + 1)

    def keep(self, cars: np.ndarray) -> None:
        """Continue with some of the cars, by their indices on the first axis."""
        self.frames = deque((frames[cars] for frames in self.frames), self.frames.maxlen)

    def push(self, frame: np.ndarray) -> np.ndarray:
        """Add the newest frame; returns the one `stride` before it, or itself at the start."""
        self.frames.append(frame)
        return self.frames[0] if len(self.frames) == self.frames.maxlen else frame


def check_stride(stride: int) -> None:
    """Raise ValueError unless a stride is at least 1 frame."""
    if stride < 1:
        raise ValueError(f"stride={stride}: expected at least 1 frame")
