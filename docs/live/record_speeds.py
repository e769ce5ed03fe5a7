"""Record the data of the live page *The three speeds*: `python docs/live/record_speeds.py`.

On each of some places of a track the car is drawn where it is now, and where a car that drives
straight on at constant speed was some frames before. So the last frame is the same for all speeds.
Takes seconds; the track is from the range "inspect". Writes docs/live/data:

    speeds.webp    a row for each place: the frame now, then for each moving car its earlier frames
    speeds.json    what is in which column
"""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from stad_lab.config import track_seeds
from stad_lab.envs import physics
from stad_lab.envs.cars import Cars, pose_on
from stad_lab.evaluation.trajectories import FRAMES_A_SECOND

DATA = Path(__file__).parent / "data"
TRACK = track_seeds("inspect", 1, 43)[0]
PLACES = 8  # evenly spaced tiles
TURN, OFFSET = 0.12, 0.15  # not quite along the road, nor in its middle, to the left and the right
SPEEDS = (30, 90)  # world units per second
STRIDES = (1, 2, 4, 8)


def frame_at(cars: Cars, heading: float, x: float, y: float) -> np.ndarray:
    """The frame of a car that stands at a pose, uint8 (64, 64, 3)."""
    physics.place_car(cars.cars, 0, heading, x, y, 0.0)
    return cars.draw()[0]


def place_row(cars: Cars, number: int) -> np.ndarray:
    """All frames of one place side by side, uint8 (64, 64 * columns, 3)."""
    sign = 1 if number % 2 else -1
    tile = len(cars.tracks[0].path) * (number + 0.5) / PLACES
    heading, x, y = pose_on(cars.tracks[0].path, int(tile), sign * TURN, sign * OFFSET)
    ahead = np.array([-np.sin(heading), np.cos(heading)])
    back = [0.0] + [speed * k / FRAMES_A_SECOND for speed in SPEEDS for k in STRIDES]
    frames = [frame_at(cars, heading, *((x, y) - ahead * way)) for way in back]
    return np.concatenate(frames, axis=1)


def main() -> None:
    """Draw and write."""
    cars = Cars(1, "frame", bar=False)
    cars.reset([TRACK])
    sheet = np.concatenate([place_row(cars, number) for number in range(PLACES)])
    DATA.mkdir(exist_ok=True)
    Image.fromarray(sheet).save(DATA / "speeds.webp", lossless=True, quality=100, method=6)
    found = {"track": TRACK, "places": PLACES, "speeds": SPEEDS, "strides": STRIDES}
    (DATA / "speeds.json").write_text(json.dumps(found) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
