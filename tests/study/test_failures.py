"""Failures: where an episode goes wrong, and what follows."""

from types import SimpleNamespace

import numpy as np
import pytest

from stad_lab.envs.cars import Cars
from stad_study.failures import HEADING, bends_of, find_failures, lost_at, what_follows

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
    found = find_failures(Straight(), [1, 2, 3])
    assert [one.track for one in found] == [1, 2, 3]
    for one in found:
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
        (ROAD[[20, 21, 21, 21]], 0.1, "stands still"),
        (
            np.concatenate([ROAD[15:21], np.linspace(ROAD[20], ROAD[120], 80), ROAD[120:180]]),
            0.1,
            "crosses the grass to another part of the road",
        ),
    ],
)
def test_what_follows_a_mistake_is_told_from_the_path(positions, heading, expected):
    assert what_follows(rows_of(positions, heading), ROAD, 20) == expected


def test_the_place_is_where_a_car_is_longest_without_a_new_tile_even_if_it_comes_back_later():
    first = np.array([0, 0, 5, 9, -1, -1, 60, 62, -1])  # it comes back over later tiles
    assert lost_at(first, 70, left=False) == (9, 4)
    assert lost_at(first, 70, left=True) == (62, 8)
    assert lost_at(np.array([0, 2, 4]), 90, left=False) == (4, 0)


def test_a_bend_over_the_start_line_is_measured():
    turned = bends_of(ANGLES + 0.3)
    assert np.allclose(turned, 20 * 2 * np.pi / 200)
    assert np.allclose(bends_of(-ANGLES), -turned)
