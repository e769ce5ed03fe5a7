"""The car's state as an observation: how it moves, where it is on the road, and the bends ahead."""

import itertools

import numpy as np

from stad_lab.envs.cars import Cars
from stad_lab.envs.track import STEP_LENGTH, TRACK_WIDTH

MOTION = {  # the first numbers of a state, with their units
    "forward speed": "world units per second",
    "slip speed": "world units per second, to the right",
    "yaw rate": "radians per second, to the left",
    "wheel angle": "radians, to the left",
    "road offset": "half road widths, to the right",
    "heading error": "radians, to the left",
}
AHEAD = (0, 5, 10, 20, 40)  # tiles from the car, between which the curvature is averaged
STATE = MOTION | {
    f"curvature, {near} to {far} tiles ahead": "radians per world unit, to the left"
    for near, far in itertools.pairwise(AHEAD)
}


def observe_state(cars: Cars, which: np.ndarray) -> np.ndarray:
    """The states of some cars, float32 (n, 10): the columns are the keys of STATE."""
    rows = [np.concatenate([true_motion(cars, car), curvature_ahead(cars, car)]) for car in which]
    return np.array(rows, np.float32)


def true_motion(cars: Cars, car: int = 0) -> np.ndarray:
    """A car's motion and its place on the road, from the engine: float32 (6,), see MOTION."""
    state, path = cars.cars[car], cars.tracks[car].path  # of a tile: progress, direction, x, y
    velocity, angle = state["velocity"][0], float(state["angle"][0])
    along = -np.sin(angle) * velocity[0] + np.cos(angle) * velocity[1]
    across = np.cos(angle) * velocity[0] + np.sin(angle) * velocity[1]
    x, y = state["position"][0]
    _, direction, tile_x, tile_y = path[nearest_tile(cars, car)]
    offset = (x - tile_x) * np.cos(direction) + (y - tile_y) * np.sin(direction)
    turned = (angle - direction + np.pi) % (2 * np.pi) - np.pi
    wheel = state["angle"][1] - state["angle"][0]
    motion = [along, across, velocity[2], wheel, offset / TRACK_WIDTH, turned]
    return np.array(motion, np.float32)


def nearest_tile(cars: Cars, car: int) -> int:
    """Index in `Track.path` of the point that is nearest to the car."""
    path, (x, y) = cars.tracks[car].path, cars.cars[car]["position"][0]
    return int(np.hypot(path[:, 2] - x, path[:, 3] - y).argmin())


def curvature_ahead(cars: Cars, car: int) -> np.ndarray:
    """Mean curvatures of the road between the distances of AHEAD: float64 (4,), see STATE."""
    heading = cars.tracks[car].path[:, 1]
    there = heading[(nearest_tile(cars, car) + np.arange(AHEAD[-1] + 1)) % len(heading)]
    turns = (np.diff(there) + np.pi) % (2 * np.pi) - np.pi  # from tile to tile
    sums = np.add.reduceat(turns, AHEAD[:-1])
    return sums / (np.diff(AHEAD) * STEP_LENGTH)
