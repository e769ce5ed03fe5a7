"""The race track: for every seed the closed road of Gymnasium's CarRacing-v3, compiled with Numba.

A track is made in four steps.

1. Twelve checkpoints are drawn around the origin, with random angle and radius.
2. A point moves in steps of fixed length from checkpoint to checkpoint, for about five laps. In
   each step it turns towards the next checkpoint, by at most `TURN_RATE`. The points it visits are
   the path.
3. One lap is cut out. If its two ends do not meet, the track is refused and drawn again.
4. Every two neighbouring points of the path span a road tile. Where the road bends sharply, a tile
   has a kerb on the inside of the bend.

The method and all constants are those of `CarRacing._create_track` in Gymnasium (Oleg Klimov). All
arithmetic is float64 in the same order of operations. So all vertices are equal to the last bit
where Python and Numba use the same C library for `sin`, `cos` and `atan2`.
"""

import math
from typing import NamedTuple

import numpy as np

from stad_lab.envs.compiling import compiled

SCALE = 6.0  # Gymnasium divides all sizes of the track by it
TRACK_RADIUS = 900 / SCALE  # world units; most checkpoints lie at 1/3 to 1 of it
STEP_LENGTH = 21 / SCALE  # world units from one point of the path to the next, the length of a tile
TURN_RATE = 0.31  # radians, the sharpest turn in one step
TRACK_WIDTH = 40 / SCALE  # half the width of the road, world units
KERB_WIDTH = 8 / SCALE  # world units
KERB_TILES = 4  # a kerb needs so many sharp turns in a row to the same side
CHECKPOINTS = 12
MAX_TILES = 2500  # the path is cut after so many steps, so no track has more tiles
START_ANGLE = 2 * math.pi * (-0.5) / CHECKPOINTS  # radians, where a lap begins


class Track(NamedTuple):
    """One track of `n` tiles and `k` kerbs. Lengths are in world units, angles in radians."""

    path: np.ndarray
    """float64 (n, 4): for each point of the centre line its angle seen from the origin, the
    heading of the road, x and y. The car starts at point 0. (Gymnasium's `env.track`.)
    """
    tiles: np.ndarray
    """float64 (n, 4, 2): corners of tile i, between the points i and i - 1 of the path."""
    kerbs: np.ndarray
    """float64 (k, 4, 2): corners of the kerbs."""
    kerb_tiles: np.ndarray
    """int64 (k,), increasing: the tile of each kerb, which is drawn after it, white or red."""


def make_track(random: np.random.Generator) -> Track:
    """Generate a track, drawing again until the road closes.

    Args:
        random: the environment's generator, `env.np_random`. It is left in the same state as by
        Gymnasium.
    """
    lows, highs = np.zeros((CHECKPOINTS, 2)), np.empty((CHECKPOINTS, 2))
    lows[:, 1] = TRACK_RADIUS / 3
    highs[:] = 2 * math.pi * 1 / CHECKPOINTS, TRACK_RADIUS
    while True:
        path = find_path(random.uniform(lows, highs))
        if len(path):
            return Track(path, *pave(path))


def tile_colors(count: int, road_color: np.ndarray) -> np.ndarray:
    """Colours of tiles that the car has not touched: three shades in turn, 0 to 255.

    Once the car touches a tile, Gymnasium paints it in `road_color` itself, the darkest of the
    three.

    Args:
        count: number of tiles.
        road_color: (3,).

    Returns:
        float64 (count, 3).
    """
    return road_color + (0.01 * (np.arange(count) % 3) * 255)[:, None]


@compiled
def find_path(draws):
    """Steps 1 to 3: the closed path from uniform random numbers.

    Args:
        draws: float64 (12, 2): for each checkpoint the random part of its angle, and its radius.

    Returns:
        float64 (n, 4) as `Track.path`; n = 0 if the path does not close.
    """
    track = walk(place_checkpoints(draws))
    first, last = find_lap(track)
    if first < 0:
        return track[:0].copy()
    track = track[first : last - 1].copy()
    # The gap between head and tail. Each component is weighted with the direction across the road.
    across_x, across_y = math.cos(track[0, 1]), math.sin(track[0, 1])
    gap_x = across_x * (track[0, 2] - track[-1, 2])
    gap_y = across_y * (track[0, 3] - track[-1, 3])
    if math.sqrt(gap_x * gap_x + gap_y * gap_y) > STEP_LENGTH:
        return track[:0].copy()
    return track


@compiled
def place_checkpoints(draws):
    """Step 1: float64 (12, 3) with angle, x and y of each checkpoint."""
    checkpoints = np.empty((CHECKPOINTS, 3))
    for c in range(CHECKPOINTS):
        alpha = 2 * math.pi * c / CHECKPOINTS + draws[c, 0]
        radius = draws[c, 1]
        if c == 0:
            alpha = 0.0
            radius = 1.5 * TRACK_RADIUS
        if c == CHECKPOINTS - 1:
            alpha = 2 * math.pi * c / CHECKPOINTS
            radius = 1.5 * TRACK_RADIUS
        checkpoints[c, 0] = alpha
        checkpoints[c, 1] = radius * math.cos(alpha)
        checkpoints[c, 2] = radius * math.sin(alpha)
    return checkpoints


@compiled
def walk(checkpoints):
    """Step 2: go from checkpoint to checkpoint; float64 (steps, 4) as `Track.path`."""
    track = np.empty((MAX_TILES, 4))
    x, y, beta = 1.5 * TRACK_RADIUS, 0.0, 0.0
    goal = np.int64(0)
    laps = 0
    visited_other_side = False
    steps = 0
    while True:
        alpha = math.atan2(y, x)
        if visited_other_side and alpha > 0:
            laps += 1
            visited_other_side = False
        if alpha < 0:
            visited_other_side = True
            alpha += 2 * math.pi
        goal, alpha = next_checkpoint(checkpoints, goal, alpha)
        goal_x, goal_y = checkpoints[goal % CHECKPOINTS, 1], checkpoints[goal % CHECKPOINTS, 2]

        # (side_x, side_y) points to the right; the projection says how far to the right the goal
        # lies.
        side_x, side_y = math.cos(beta), math.sin(beta)
        ahead_x, ahead_y = -side_y, side_x
        projection = side_x * (goal_x - x) + side_y * (goal_y - y)
        while beta - alpha > 1.5 * math.pi:
            beta -= 2 * math.pi
        while beta - alpha < -1.5 * math.pi:
            beta += 2 * math.pi
        previous_beta = beta
        projection *= SCALE
        if projection > 0.3:
            beta -= min(TURN_RATE, abs(0.001 * projection))
        if projection < -0.3:
            beta += min(TURN_RATE, abs(0.001 * projection))
        x += ahead_x * STEP_LENGTH
        y += ahead_y * STEP_LENGTH
        track[steps, 0], track[steps, 1] = alpha, previous_beta * 0.5 + beta * 0.5
        track[steps, 2], track[steps, 3] = x, y
        steps += 1
        if laps > 4 or steps == MAX_TILES:
            return track[:steps]


@compiled
def next_checkpoint(checkpoints, goal, alpha):
    """The next checkpoint beyond the angle `alpha`, and `alpha`, less a full turn after a lap."""
    while True:
        while True:
            if alpha <= checkpoints[goal % CHECKPOINTS, 0]:
                return goal, alpha
            goal += 1
            if goal % CHECKPOINTS == 0:
                break
        alpha -= 2 * math.pi


@compiled
def find_lap(track):
    """Step 3: the points where the last two laps begin, (-1, -1) if there are none."""
    last = -1
    for i in range(len(track) - 1, 0, -1):
        if track[i, 0] > START_ANGLE and track[i - 1, 0] <= START_ANGLE:
            if last >= 0:
                return i, last
            last = i
    return -1, -1


@compiled
def pave(path):
    """Step 4: the tiles and kerbs along a closed path, in the order of `Track`."""
    count = len(path)
    border = find_bends(path)
    tiles = np.empty((count, 4, 2))
    kerbs = np.empty((np.count_nonzero(border), 4, 2))
    kerb_tiles = np.empty(len(kerbs), np.int64)
    kerb = 0
    for i in range(count):
        span(path, i, -TRACK_WIDTH, TRACK_WIDTH, tiles[i])
        if border[i]:
            side = np.sign(path[i - 1, 1] - path[i, 1])
            span(path, i, side * TRACK_WIDTH, side * (TRACK_WIDTH + KERB_WIDTH), kerbs[kerb])
            kerb_tiles[kerb] = i
            kerb += 1
    return tiles, kerbs, kerb_tiles


@compiled
def span(path, i, left, right, corners):
    """Write the corners of a strip from point i back to i - 1, `left` to `right` of the centre."""
    for end in range(2):
        beta, x, y = path[i - end, 1], path[i - end, 2], path[i - end, 3]
        across_x, across_y = math.cos(beta), math.sin(beta)
        first, second = (0, 1) if end == 0 else (3, 2)
        corners[first, 0], corners[first, 1] = x + left * across_x, y + left * across_y
        corners[second, 0], corners[second, 1] = x + right * across_x, y + right * across_y


@compiled
def find_bends(path):
    """Whether each tile has a kerb: bool (n,)."""
    count = len(path)
    border = np.zeros(count, np.bool_)
    for i in range(count):
        good = True
        one_side = 0.0
        for back in range(KERB_TILES):
            turn = path[i - back, 1] - path[i - back - 1, 1]
            good &= abs(turn) > TURN_RATE * 0.2
            one_side += np.sign(turn)
        border[i] = good and abs(one_side) == KERB_TILES
    # A kerb begins some tiles before the bend. As in Gymnasium, what spreads from the first tiles
    # to the last ones spreads again when their turn comes.
    for i in range(count):
        if border[i]:
            for back in range(KERB_TILES):
                border[i - back] = True
    return border
