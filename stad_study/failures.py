"""Where an agent fails: its episodes below 800 points, where they go wrong, and what follows.

The place is where the car begins to be longest without a new tile.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stad_lab.agent import Agent, rollout
from stad_lab.envs.cars import Cars
from stad_lab.envs.state import MOTION, true_motion
from stad_lab.envs.track import TRACK_WIDTH
from stad_lab.evaluation.statistics import FAILED
from stad_study.study import STUDIES, groups_of

BEND = 20  # tiles, over which a bend is measured
BEFORE = 30  # tiles before the place, from which on a bend may have caused the failure
ELSEWHERE = 30  # tiles away, from which on a part of the road is another one
LEFT = -50.0  # a reward below this is that of leaving the field
SPEED, HEADING = map(list(MOTION).index, ("forward speed", "heading error"))


class Failure(NamedTuple):
    """One failed episode, and its place."""

    track: int
    points: float
    tiles: int  # of the track
    missed: int  # of these
    tile: int  # the place: the one after the last that the car reached
    bend: float  # the sharpest one there or just before, degrees to the left
    speed: float  # with which the car came to this bend, world units per second
    then: str  # what the car does next, see `what_follows`


class Notes:
    """Keeps of each car of a batch, as `observe` of `rollout`, where it was and how it moved."""

    def __init__(self, cars: Cars):
        self.cars = cars
        # A row for each frame: motion (6,) and position (2,), for each car.
        self.rows: list[list[np.ndarray]] = [[] for _ in range(len(cars))]
        self.first = np.full(cars.roads["visited"].shape, -1)  # the frame of a tile's first visit

    def __call__(self, driving: np.ndarray, _: np.ndarray, __: np.ndarray) -> None:
        """Keep one moment of the cars that still drive."""
        new = (self.cars.roads["visited"] > 0) & (self.first < 0)
        self.first[new] = max(map(len, self.rows))
        for car in driving:
            place = self.cars.cars["position"][car, 0]
            self.rows[car].append(np.concatenate([true_motion(self.cars, car), place]))


def find_failures(agent: Agent, tracks: Sequence[int]) -> list[Failure]:
    """Drive an agent as the studies score it, and describe each failure."""
    failures: list[Failure] = []
    limit = STUDIES["study1"].max_frames
    for group in groups_of(tracks):
        cars = Cars(len(group), "frame", bar=not agent.world_model.crop_bar)
        cars.reset(group)
        notes = Notes(cars)
        episodes = rollout(agent, cars, limit, observe=notes)
        for car in np.flatnonzero(episodes.returns < FAILED).tolist():
            left = episodes.rewards[car][-1] < LEFT
            failures.append(describe(notes, car, group[car], episodes.returns[car], left))
    return failures


def describe(notes: Notes, car: int, track: int, points: float, left: bool) -> Failure:
    """The place of a car's failure, and what follows; `left`: whether it left the field."""
    path = notes.cars.tracks[car].path  # of a tile: progress, direction, x, y
    first, rows = notes.first[car, : len(path)], np.array(notes.rows[car])
    leaves, tile = lost_at(first, len(rows), left)
    turned = bends_of(path[:, 1])
    begins = np.arange(max(0, tile - BEFORE), tile + 1)
    bend = begins[np.abs(turned[begins]).argmax()]
    visits = first[: bend + 1]
    arrives = visits[(visits >= 0) & (visits <= leaves)].max()
    return Failure(
        track=track,
        points=round(float(points), 1),
        tiles=len(path),
        missed=int((notes.cars.roads["visited"][car, : len(path)] == 0).sum()),
        tile=tile,
        bend=round(float(np.degrees(turned[bend])), 1),
        speed=round(float(rows[arrives, SPEED]), 1),
        then="leaves the field" if left else what_follows(rows[leaves:], path[:, 2:], tile),
    )


def lost_at(first: np.ndarray, frames: int, left: bool) -> tuple[int, int]:
    """Where a car is longest without a new tile: the frame in which this begins, and the next tile.

    Args:
        first: the frame of the first visit of each tile, int (tiles,), or -1.
        frames: of the episode.
        left: whether the car left the field, which ends the episode: then the last such frame.
    """
    times = np.unique(first[first >= 0])
    leaves = int(times[-1 if left else np.diff(times, append=frames).argmax()])
    return leaves, (int(np.flatnonzero(first == leaves).max()) + 1) % len(first)


def bends_of(direction: np.ndarray) -> np.ndarray:
    """How far the road turns from each tile on within BEND tiles, radians to the left (tiles,)."""
    heading = np.unwrap(direction)
    step = (heading[0] - heading[-1] + np.pi) % (2 * np.pi) - np.pi  # over the start line
    again = heading + heading[-1] + step - heading[0]
    return np.append(heading, again)[BEND : BEND + len(heading)] - heading


def what_follows(rows: np.ndarray, road: np.ndarray, tile: int) -> str:
    """What a car does after its mistake: the first of these that is true.

    It drives on also where only its time has run out.

    Args:
        rows: motion and position in every frame from then on (frames, 8).
        road: centres of the tiles, world units (tiles, 2).
        tile: where the mistake was.
    """
    apart = np.linalg.norm(rows[:, None, -2:] - road, axis=2)
    off = apart.min(axis=1) > TRACK_WIDTH
    tiles = apart.argmin(axis=1)[~off]  # in the frames on the road, one after another
    steps = np.abs(np.diff(tiles, prepend=tile))
    if (np.minimum(steps, len(road) - steps) > ELSEWHERE).any():
        return "crosses the grass to another part of the road"
    if off.mean() > 0.5:
        return "stays off the road"
    if len(np.unique(tiles)) < 3:
        return "stands still"
    back = np.abs(rows[~off, HEADING]) > np.pi / 2
    return "drives back" if back.mean() > 0.5 else "drives on"
