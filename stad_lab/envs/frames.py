"""Frames and difference images: from what CarRacing shows to what V sees.

A frame x_t is the observation without its indicator bar, shrunk to 64 x 64. The difference image is
d_t = x_t - x_(t-k) with a stride of k frames (paper, section 3.1): where nothing moved it is zero.
"""

from collections import deque

import cv2
import numpy as np

from stad_lab.envs.car_racing import BAR_TOP, OBSERVATION_SIZE

FRAME_SIZE = 64  # pixels, width and height of a frame
OBSERVATION_SHAPE = (OBSERVATION_SIZE, OBSERVATION_SIZE, 3)


def check_observation(observation: np.ndarray) -> None:
    """Raise ValueError unless `observation` is a uint8 array (96, 96, 3), as CarRacing makes them."""
    dtype, shape = (
        getattr(observation, "dtype", type(observation).__name__),
        getattr(observation, "shape", "no shape"),
    )
    if dtype != np.uint8 or shape != OBSERVATION_SHAPE:
        raise ValueError(
            f"observation with dtype {dtype} and shape {shape}: expected uint8 and {OBSERVATION_SHAPE}, as"
            " CarRacing-v3 gives it; do not wrap the environment in something that changes its pictures"
        )


def to_frame(observation: np.ndarray, crop_bar: bool = True) -> np.ndarray:
    """Turn an observation into a frame.

    Args:
        observation: uint8 (96, 96, 3).
        crop_bar: cut off the indicator bar first. It shows speed, wheel speeds, steering and yaw rate: with the bar a
            single frame tells the motion in print, without it only the road is left.

    Returns:
        uint8 (64, 64, 3).

    Raises:
        ValueError: wrong shape or dtype.
    """
    check_observation(observation)
    picture = observation[:BAR_TOP] if crop_bar else observation
    return cv2.resize(picture, (FRAME_SIZE, FRAME_SIZE), interpolation=cv2.INTER_AREA)


def difference_image(frame: np.ndarray, earlier: np.ndarray) -> np.ndarray:
    """d = frame - earlier, float32 in [-1, 1], of two uint8 arrays of equal shape (paper, section 3.1).

    Raises:
        ValueError: shapes that differ, or a dtype other than uint8.
    """
    check_pair(frame, earlier)
    return (frame.astype(np.float32) - earlier.astype(np.float32)) / 255


def check_pair(frame: np.ndarray, earlier: np.ndarray) -> None:
    """Raise ValueError unless frames and those before them are two uint8 arrays of one shape."""
    if frame.shape != earlier.shape or frame.dtype != np.uint8 or earlier.dtype != np.uint8:
        raise ValueError(
            f"frames of shape {frame.shape} {frame.dtype} and {earlier.shape} {earlier.dtype}:"
            " expected two uint8 arrays of one shape"
        )


def check_stride(stride: int) -> None:
    """Raise ValueError unless a stride is at least 1: every frame minus itself is zero, and the future is not known."""
    if stride < 1:
        raise ValueError(f"stride={stride}: expected at least 1 frame")


def earlier_index(index: np.ndarray | int, stride: int) -> np.ndarray:
    """The frame to subtract from frame `index` of an episode: `stride` before it, or itself in the first frames.

    Until `stride` frames exist the car is taken not to have moved, so its difference image is zero. Raises ValueError
    for a stride below 1.
    """
    check_stride(stride)
    index = np.asarray(index)
    return np.where(index >= stride, index - stride, index)


def earlier_frames(frames: np.ndarray, stride: int) -> np.ndarray:
    """For every frame of an episode the one to subtract from it: uint8 (frames, 64, 64, 3), a copy."""
    return frames[earlier_index(np.arange(len(frames)), stride)]


def episode_differences(frames: np.ndarray, stride: int) -> np.ndarray:
    """All difference images of an episode: uint8 (frames, 64, 64, 3) -> float32 in [-1, 1] of the same shape."""
    return difference_image(frames, earlier_frames(frames, stride))


class FrameMemory:
    """The last few frames of one car or of many cars in step: what a driver needs to form difference images.

    Frames may have any shape, for example (64, 64, 3) or (cars, 64, 64, 3). A new episode begins with a new memory.
    """

    def __init__(self, stride: int):
        check_stride(stride)
        self.frames: deque[np.ndarray] = deque(maxlen=stride + 1)

    def keep(self, cars: np.ndarray) -> None:
        """Go on with some of the cars only, by their indices on the first axis."""
        self.frames = deque((frames[cars] for frames in self.frames), self.frames.maxlen)

    def push(self, frame: np.ndarray) -> np.ndarray:
        """Take in the newest frame and return the one to subtract from it: `stride` ago, or itself at the start."""
        self.frames.append(frame)
        return self.frames[0] if len(self.frames) == self.frames.maxlen else frame
