"""Failures: where an episode goes wrong, and what follows."""

from types import SimpleNamespace

import numpy as np
import pytest

from stad_lab.envs.cars import Cars
from stad_study.failures import HEADING, find_failures, longest_row, reached, what_follows

ANGLES = np.linspace(0, 2 * np.pi, 200, endpoint=False)
ROAD = 100 * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)  # a circle of 200 tiles


class Straight:
    """Drives straight on with full gas, and sees nothing."""

    world_model = SimpleNamespace(crop_bar=False)

    def reset(self):
        """Forget nothing."""

    def keep(self, which):
        """Go on with some cars."""

    def act_batch(self, seen):
        """One action for each car."""
        return np.tile(np.array([0, 1, 0], np.float32), (len(seen), 1))


def test_a_car_that_drives_straight_on_fails_at_the_first_bend_and_does_not_come_back():
    for one in find_failures(Straight(), [1, 2, 3]):
        cars = Cars(1)
        cars.reset([one.track])
        road = cars.tracks[0].path[:, 2:]
        ahead = np.cumsum(np.linalg.norm(np.diff(road, axis=0), axis=1))[one.tile - 1]
        straight = np.linalg.norm(road[one.tile] - road[0])
        assert straight > 0.8 * ahead  # so far the road has hardly turned
        assert abs(one.bend) > 15 and 0 <= one.speed < 110
        assert one.missed == one.tiles - one.tile
        assert one.then in ("leaves the field", "stays off the road")


def rows_of(positions, heading):
    """Motion and position of a car, (frames, 8)."""
    motion = np.zeros((len(positions), 6))
    motion[:, HEADING] = heading
    return np.hstack([motion, positions])


@pytest.mark.parametrize(
    ("positions", "heading", "expected"),
    [
        (ROAD[20:80], 0.1, "drives on"),
        (ROAD[25::-1], 3.0, "drives back"),
        (1.3 * ROAD[20:80], 0.1, "stays off the road"),
        (
            np.concatenate([ROAD[15:21], np.linspace(ROAD[20], ROAD[120], 80), ROAD[120:180]]),
            0.1,
            "crosses the grass to another part of the road",
        ),
    ],
)
def test_what_follows_a_mistake_is_told_from_the_path(positions, heading, expected):
    assert what_follows(rows_of(positions, heading), ROAD, 20) == expected


def test_the_place_is_the_longest_row_of_missed_tiles_and_the_last_one_reached_before():
    missed = np.array([0, 1, 0, 0, 1, 1, 1, 0, 1], bool)
    assert longest_row(missed) == 4 and longest_row(np.zeros(5, bool)) == 0
    first = np.array([0, -1, 12, 15, -1, -1])
    assert [reached(first, tile) for tile in (-1, 0, 1, 2, 5)] == [0, 0, 0, 12, 15]
