"""Tracks of your own: a closed road through checkpoints, given as an array or a small JSON file.

A smooth curve (a Catmull-Rom spline) leads through the checkpoints and back to the first, where the
car starts towards the second. It is cut into tiles as long as Gymnasium's, and paved like them.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stad_lab.envs.physics import PLAYFIELD
from stad_lab.envs.track import MAX_TILES, STEP_LENGTH, TRACK_WIDTH, TURN_RATE, Track, pave

LARGEST_FILE = 1_000_000  # bytes
FEWEST_TILES = 3  # with less, no tile has a direction; the bends of a lap need far more
SAMPLES = 64  # points of the curve between two checkpoints, before it is cut into tiles
CLOSEST = 2 * TRACK_WIDTH  # world units between two parts of the road
NEIGHBOURS = 12  # tiles along the road, which may be nearer than that

Checkpoints = str | Path | np.ndarray | Sequence[Sequence[float]]


def make_own_track(checkpoints: Checkpoints) -> Track:
    """The track through some checkpoints.

    Args:
        checkpoints: x and y of each in world units, (n, 2); or the name of a JSON file with the
            entry "checkpoints". The field reaches from -333 to 333; a road is 13.3 wide.

    Raises:
        ValueError: this is no list of points, or no lap is possible; the message says where.
        OSError: the file cannot be read.
    """
    if isinstance(checkpoints, str | Path):
        checkpoints = read_checkpoints(Path(checkpoints))
    try:
        points = np.array(checkpoints, float)
    except (TypeError, ValueError, OverflowError):
        points = np.empty(0)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3 or not np.isfinite(points).all():
        raise ValueError(
            f"checkpoints of shape {points.shape}: expected finite numbers (n, 2), x and y of three"
            " points at least"
        )
    path = find_own_path(points)
    check_lap(path)
    return Track(path, *pave(path))


def read_checkpoints(path: Path) -> list:
    """The entry "checkpoints" of a JSON file. ValueError if it has none; OSError without a file."""
    if not path.is_file():
        expected = "expected a JSON file of checkpoints"
        raise FileNotFoundError(f"track={str(path)!r} is no file: {expected}")
    size = path.stat().st_size
    try:
        found = json.loads(path.read_bytes()[:LARGEST_FILE])["checkpoints"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        remedy = 'a JSON file {"checkpoints": [[x, y], ...]} of at most 1 MB'
        raise ValueError(f"{path} ({size} bytes) is no track: expected {remedy}") from error
    return found


def find_own_path(points: np.ndarray) -> np.ndarray:
    """The centre line through checkpoints (n, 2): float64 (tiles, 4), as `Track.path`.

    ValueError if two neighbours are the same, or the lap is too short or too long.
    """
    if (np.hypot(*(points - np.roll(points, 1, axis=0)).T) < 1e-3).any():
        raise ValueError(
            "two neighbouring checkpoints are the same: leave one out, also at the end"
        )
    curve = catmull_rom(points)
    lengths = np.hypot(*np.diff(curve, axis=0).T)
    along = np.concatenate([[0], np.cumsum(lengths)])
    count = round(along[-1] / STEP_LENGTH)
    if not FEWEST_TILES <= count <= MAX_TILES:
        expected = " to ".join(f"{tiles * STEP_LENGTH:.0f}" for tiles in (FEWEST_TILES, MAX_TILES))
        raise ValueError(f"a lap of {along[-1]:.0f} world units: expected {expected}")
    places = np.arange(count) * along[-1] / count
    x, y = (np.interp(places, along, part) for part in curve.T)
    ahead_x, ahead_y = (np.roll(part, -1) - np.roll(part, 1) for part in (x, y))
    heading = np.unwrap(np.arctan2(-ahead_x, ahead_y))  # 0 is up, positive to the left
    return np.stack([np.arctan2(y, x), heading, x, y], axis=1)


def catmull_rom(points: np.ndarray) -> np.ndarray:
    """A closed spline through points (n, 2): (n * SAMPLES + 1, 2), the first again at its end."""
    before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
    slopes = (after - before) / 2
    following, t = np.roll(slopes, -1, axis=0), np.arange(SAMPLES)[:, None, None] / SAMPLES
    t2, t3 = t**2, t**3
    curve = (2 * t3 - 3 * t2 + 1) * points + (3 * t2 - 2 * t3) * after
    curve += (t3 - 2 * t2 + t) * slopes + (t3 - t2) * following
    curve = curve.transpose(1, 0, 2).reshape(-1, 2)
    return np.concatenate([curve, curve[:1]])


def check_lap(path: np.ndarray) -> None:
    """Raise ValueError where the road leaves the field, bends too sharply, or meets itself."""
    heading, places = path[:, 1], path[:, 2:]

    def refuse(bad: np.ndarray, reason: str) -> None:
        if bad.any():
            x, y = places[bad.argmax()]
            raise ValueError(f"no lap is possible: near ({x:.0f}, {y:.0f}) the road {reason}")

    limit = PLAYFIELD - CLOSEST
    refuse((np.abs(places) > limit).any(axis=1), f"leaves the field, beyond {limit:.0f}")
    turns = np.abs((heading - np.roll(heading, 1) + np.pi) % (2 * np.pi) - np.pi)
    radius = STEP_LENGTH / TURN_RATE
    refuse(turns > TURN_RATE, f"bends too sharply: the least radius is {radius:.0f} world units")
    number = np.arange(len(path))
    apart = np.abs(number[:, None] - number)
    apart = np.minimum(apart, len(path) - apart)  # tiles along the closed road
    near = np.hypot(*(places[:, None] - places).T) < CLOSEST
    refuse((near & (apart > NEIGHBOURS)).any(axis=1), "meets itself, and a tile would be of both")
