"""A batch of cars: each drives and looks as it would alone, whatever the others do."""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stad_lab.envs import picture
from stad_lab.envs.cars import SIZES, Cars, compile_pictures, road_polygons
from stad_lab.envs.frames import to_frame

ACTION = np.array([0.1, 0.5, 0.0])


def drive(cars, frames=10):
    for _ in range(frames):
        cars.step(np.tile(ACTION, (len(cars), 1)))
    return cars


@pytest.mark.parametrize("shows", ["observation", "frame"])
def test_a_car_of_a_batch_drives_and_looks_as_alone(shows):
    batch = Cars(3, shows)
    batch.reset([4, 5, 6])
    pictures = drive(batch).draw()
    for number, seed in enumerate((4, 5, 6)):
        alone = Cars(1, shows)
        alone.reset([seed])
        assert np.array_equal(drive(alone).draw()[0], pictures[number])
        assert alone.cars[0] == batch.cars[number]


def test_only_the_chosen_cars_step_draw_and_begin_anew():
    cars = Cars(3)
    cars.reset([1, 2, 3])
    rewards, ended = cars.step(ACTION[None], np.array([1]))
    assert (rewards.shape, ended.tolist()) == ((1,), [False])
    assert cars.cars["frames"].tolist() == [0, 1, 0]
    assert np.array_equal(cars.draw(np.array([2, 0])), cars.draw()[[2, 0]])
    before = cars.cars.copy()
    cars.reset([7], [1])
    assert np.array_equal(cars.cars[[0, 2]], before[[0, 2]])
    assert cars.cars["frames"][1] == 0


def test_drawing_late_or_twice_gives_the_same_picture():
    often, once = Cars(1), Cars(1)
    for cars in (often, once):
        cars.reset([3])
    for _ in range(30):
        drive(often, 1).draw()
        drive(once, 1)
    assert np.array_equal(often.draw(), often.draw())
    assert np.array_equal(often.draw(), once.draw())


@pytest.mark.parametrize("bar", [True, False])
def test_the_frame_is_the_prepared_observation_closely(bar):
    seen, frames = Cars(1, "observation"), Cars(1, "frame", bar=bar)
    for cars in (seen, frames):
        cars.reset([8])
        cars.place(0, 60, speed=40)
        drive(cars, 20)
    expected = to_frame(seen.draw()[0], crop_bar=not bar)
    assert np.abs(frames.draw()[0].astype(int) - expected).mean() < 0.5


@pytest.mark.parametrize("again", [copy.deepcopy, lambda cars: pickle.loads(pickle.dumps(cars))])
def test_a_copy_goes_on_as_the_original(again):
    cars = Cars(2)
    cars.reset([1, 2])
    drive(cars).draw()
    other = again(cars)
    for one in (cars, other):
        drive(one)
    assert np.array_equal(cars.cars, other.cars)
    assert np.array_equal(cars.draw(), other.draw())
    for one in (cars, other):
        one.reset()
    assert np.array_equal(cars.tracks[1].path, other.tracks[1].path)


def test_threads_drive_and_draw_batches_of_their_own():
    def work(seed):
        cars = Cars(2, "frame")
        cars.reset([seed, seed + 1])
        return drive(cars, 30).draw()

    with ThreadPoolExecutor(4) as pool:
        several = list(pool.map(work, range(4)))
    assert all(np.array_equal(work(seed), found) for seed, found in enumerate(several))


@pytest.mark.parametrize("action", [-1, 5, 0.5])
def test_a_discrete_action_that_does_not_exist_is_refused(action):
    cars = Cars(1, continuous=False)
    cars.reset([0])
    with pytest.raises(ValueError, match="expected 1 numbers, each 0 to 4"):
        cars.step(np.array([action]))


def test_a_kerb_is_painted_after_its_tile():
    cars = Cars(1)
    cars.reset([0])
    track = cars.tracks[0]
    polygons, kinds = road_polygons(track)
    assert len(polygons) == len(kinds) == len(track.tiles) + len(track.kerbs)
    for kerb, tile in zip(track.kerbs, track.kerb_tiles, strict=True):
        before = np.flatnonzero((polygons == track.tiles[tile]).all(axis=(1, 2)))[0]
        assert np.array_equal(polygons[before + 1], kerb)


def test_what_is_compiled_beforehand_is_what_draws():
    compile_pictures()
    compiled = [len(function.signatures) for function in (picture.paint, picture.draw_cars)]
    for shows in SIZES:
        cars = Cars(1, shows)
        cars.reset([0])
        cars.draw()
    assert compiled == [len(function.signatures) for function in (picture.paint, picture.draw_cars)]
    assert compiled == [1, 1]
