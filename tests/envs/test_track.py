"""Tracks, side by side with Gymnasium's."""

import platform

import Box2D
import gymnasium
import numpy as np
import pytest
from gymnasium.utils import seeding

from stad_lab.envs import picture
from stad_lab.envs.cars import road_polygons
from stad_lab.envs.track import MAX_TILES, make_track, tile_colors

KERBS = {picture.WHITE: (255, 255, 255), picture.RED: (255, 0, 0)}
EXACT = platform.system() == "Linux" and platform.machine() == "x86_64"


@pytest.fixture(scope="module")
def world():
    return gymnasium.make("CarRacing-v3").unwrapped


def make_reference(world, random):
    """Let Gymnasium generate a track, with the loop of its `reset`."""
    world._np_random = random
    while True:
        world.world = Box2D.b2World((0, 0))  # new, since destroying tiles gets slower and slower
        world.road_poly = []
        if world._create_track():
            return


def compare_track(world, seed):
    """Compare every vertex and colour, and the random numbers that are left."""
    ours, theirs = seeding.np_random(seed)[0], seeding.np_random(seed)[0]
    track = make_track(ours)
    make_reference(world, theirs)
    assert ours.bit_generator.state == theirs.bit_generator.state
    if not EXACT:  # another C library: `sin` may differ in the last bit
        assert len(track.path) == len(world.track)
        np.testing.assert_allclose(track.path, world.track, atol=1e-6)
        return
    assert np.array_equal(track.path, world.track)
    kinds = [isinstance(color, np.ndarray) for _, color in world.road_poly]
    tiles = [pair for pair, tile in zip(world.road_poly, kinds, strict=True) if tile]
    kerbs = [pair for pair, tile in zip(world.road_poly, kinds, strict=True) if not tile]
    assert np.array_equal(track.tiles, [corners for corners, _ in tiles])
    colors = tile_colors(len(tiles), world.road_color)
    assert np.array_equal(colors, [color for _, color in tiles])
    assert len(track.kerbs) == len(kerbs)
    if kerbs:
        assert np.array_equal(track.kerbs, [corners for corners, _ in kerbs])
    painted = [KERBS[kind] for kind in road_polygons(track)[1].tolist() if kind in KERBS]
    assert painted == [tuple(color) for _, color in kerbs]
    before = np.cumsum(kinds)[~np.array(kinds)] - 1  # the last tile before each kerb
    assert np.array_equal(track.kerb_tiles, before)


def test_tracks_equal_gymnasiums(world):
    for seed in range(60):
        compare_track(world, seed)


@pytest.mark.long
def test_thousands_of_tracks_equal_gymnasiums(world):
    for seed in range(1000, 4000):
        compare_track(world, seed)


def test_tracks_are_far_from_the_largest_size():
    random = np.random.default_rng(0)
    counts = [len(make_track(random).path) for _ in range(300)]
    assert min(counts) > 150
    assert max(counts) < MAX_TILES / 4
