"""The compiled pictures equal Gymnasium's, and the frame the prepared observation, closely."""

import threading

import numpy as np
import pygame
import pytest

from stad_lab.envs import physics, picture
from stad_lab.envs.car_racing import make_env, place_car
from stad_lab.envs.frames import BAR_TOP, to_frame
from stad_lab.envs.track import MAX_TILES
from stad_lab.training.dataset import RandomDriver
from stad_study.parity import CAR_WINDOW


class Painter:
    """Draws with the compiled functions what a Gymnasium environment shows."""

    def __init__(self, env):
        self.env = env.unwrapped
        self.ground = picture.make_ground(1)
        self.cars, self.roads = np.zeros(1, physics.CAR), np.zeros(1, physics.ROAD)
        self.tiles = np.zeros((1, MAX_TILES, 4, 2))

    def paint(self):
        """Paint the environment's track as it was before the car touched a tile."""
        env = self.env
        road = np.array([polygon for polygon, _ in env.road_poly])
        is_tile = np.array([isinstance(color, np.ndarray) for _, color in env.road_poly])
        white = np.array([color[1] == 255 for _, color in env.road_poly])
        shades = picture.ROAD + (np.cumsum(is_tile) - 1) % 3
        kinds = np.where(is_tile, shades, np.where(white, picture.WHITE, picture.RED))
        colors = picture.ground_colors(env.bg_color, env.grass_color, env.road_color)
        picture.paint(self.ground, 0, road, kinds.astype(np.uint8), colors)
        self.roads["tiles"], self.roads["darkened"] = is_tile.sum(), 0
        self.tiles[0, : is_tile.sum()] = road[is_tile]

    def copy_state(self):
        """Copy what the picture shows of the car and of visited tiles into the records."""
        env, car, road = self.env, self.cars[0], self.roads[0]
        bodies = [env.car.hull, *env.car.wheels]
        car["position"] = [body.position for body in bodies]
        car["angle"] = [body.angle for body in bodies]
        car["velocity"][0] = *env.car.hull.linearVelocity, env.car.hull.angularVelocity
        car["phase"] = [wheel.phase for wheel in env.car.wheels]
        car["omega"] = [wheel.omega for wheel in env.car.wheels]
        car["reward"], car["time"] = env.reward, env.t
        visited = np.array([tile.road_visited for tile in env.road], bool)
        darkened = road["darkened"][: len(visited)]
        darkened[visited & (darkened == 0)] = 1

    def draw(self, size, bar=True):
        """The observation (size 96) or the agent's frame (size 64) of this moment."""
        self.copy_state()
        return self.draw_records(size, bar)

    def draw_records(self, size, bar=True):
        """The same, of the state in the records."""
        out = np.empty((1, size, size, 3), np.uint8)
        draw(out, self, bar)
        return out[0]


def draw(out, painter, bar):
    """Draw all cars of a painter."""
    which, pictures = np.arange(len(out)), picture.make_pictures()
    arrays = painter.cars, painter.roads, painter.tiles
    picture.draw_cars(out, painter.ground, pictures, which, *arrays, bar)


@pytest.fixture(scope="module")
def painter():
    """Painter of an environment of Gymnasium's own, with its own renderer."""
    painter = Painter(make_env(fast=False))
    painter.shown = []
    render = painter.env._render

    def render_both(mode):
        # Within `step`, as Gymnasium: the reward shown is that before this step's -0.1.
        if not painter.env.t < 0.03 and painter.skip:
            return np.zeros((96, 96, 3), np.uint8)
        official = render(mode)
        if painter.env.t < 0.03:
            painter.paint()
        ours = painter.draw(96), painter.draw(64, bar=False), painter.draw(64)
        painter.shown.append((official, *ours))
        return official

    painter.skip = False
    painter.env._render = render_both
    return painter


def drive(painter, number, frames, every=1):
    """Drive randomly, odd episodes from a random tile; returns the pictures shown.

    Returns:
        Gymnasium's observations, ours, our frames without and with the bar.
    """
    rng, env = np.random.default_rng([5, number]), painter.env
    painter.shown = []
    env.reset(seed=number)
    if number % 2:
        tile, speed = int(rng.integers(10_000)), rng.uniform(0, 90)
        place_car(env, tile, speed, 0.15 * rng.standard_normal())
    driver = RandomDriver(rng)
    for frame in range(frames):
        painter.skip = frame >= 50 and frame % every > 0
        if env.step(driver.act())[2]:
            break
    painter.skip = False
    return [np.array(pictures) for pictures in zip(*painter.shown, strict=True)]


def difference(one, other):
    """Mean absolute difference of each pair of pictures."""
    return np.abs(one.astype(int) - other.astype(int)).mean(axis=(1, 2, 3))


def frames_of(observations, crop_bar):
    """Observations prepared for the agent."""
    return np.array([to_frame(observation, crop_bar) for observation in observations])


def check_pictures(painter, episodes, frames, every):
    shown = [drive(painter, number, frames, every) for number in range(episodes)]
    official, ours, cropped, whole = (
        np.concatenate(pictures) for pictures in zip(*shown, strict=True)
    )
    assert difference(official, ours).mean() <= 0.2
    assert difference(official, ours).max() <= 1
    assert difference(official[:, *CAR_WINDOW], ours[:, *CAR_WINDOW]).mean() <= 0.4
    assert difference(official[:, BAR_TOP:], ours[:, BAR_TOP:]).mean() <= 0.1
    for frame, crop_bar in ((cropped, True), (whole, False)):
        assert difference(frame, frames_of(ours, crop_bar)).mean() <= 0.3
        assert difference(frame, frames_of(ours, crop_bar)).max() <= 2
        assert difference(frame, frames_of(official, crop_bar)).mean() <= 0.4


def test_observation_is_gymnasium_s_to_a_fifth_of_a_level_and_the_frame_to_two_fifths(painter):
    check_pictures(painter, episodes=2, frames=150, every=3)


@pytest.mark.long
def test_pictures_of_20_whole_episodes_are_gymnasium_s_to_a_fifth_of_a_level(painter):
    check_pictures(painter, episodes=20, frames=1000, every=4)


def test_beyond_the_edge_of_the_field_the_picture_is_black_as_gymnasium_s(painter):
    env = painter.env
    env.reset(seed=3)
    for x, y, angle in ((320, 0, 0.3), (-325, 325, 2.0), (10, -400, -1.0), (5000, 5000, 0.0)):
        env.car.hull.position, env.car.hull.angle = (x, y), angle
        for wheel in env.car.wheels:
            wheel.position, wheel.angle = (x, y), angle
        painter.shown = []
        env.t = 2.0
        env._render("state_pixels")
        official, ours, _, _ = (picture[None] for picture in painter.shown[0])
        assert difference(official[:, :60], ours[:, :60])[0] <= 1


@pytest.mark.parametrize("bar", [True, False])
def test_every_car_of_a_batch_gets_the_picture_it_would_get_alone(painter, bar):
    batch = repeat(painter, 3)
    alone = {size: [] for size in (96, 64)}
    for car, seed in enumerate((4, 5, 6)):
        painter.env.reset(seed=seed)
        for _ in range(10 * car):
            painter.env.step(np.array([0.1, 0.5, 0]))
        for size, pictures in alone.items():
            pictures.append(painter.draw(size, bar))
        for array, own in zip(arrays_of(batch), arrays_of(painter), strict=True):
            array[car] = own[0]
    for size, pictures in alone.items():
        out = np.empty((3, size, size, 3), np.uint8)
        draw(out, batch, bar)
        assert np.array_equal(out, pictures)


def arrays_of(painter):
    """All arrays with an axis for the cars."""
    return [*painter.ground[:-1], painter.cars, painter.roads, painter.tiles]


def repeat(painter, count):
    """A painter with copies of a car, each on a ground of its own."""
    arrays = [np.repeat(array, count, 0) for array in arrays_of(painter)]
    batch = Painter(painter.env)
    batch.ground = picture.Ground(*arrays[:-3], painter.ground.pattern)
    batch.cars, batch.roads, batch.tiles = arrays[-3:]
    return batch


def test_a_track_painted_over_another_looks_as_if_painted_on_fresh_ground(painter):
    painter.env.reset(seed=8)
    for _ in range(20):
        painter.env.step(np.array([0, 1, 0]))
    painter.env.reset(seed=9)
    painter.paint()  # once more, for reset has visited a tile
    used = [array.copy() for array in painter.ground]
    painter.ground = picture.make_ground(1)
    painter.paint()
    for array, fresh in zip(used[1:], painter.ground[1:], strict=True):
        assert np.array_equal(array, fresh)
    mask = picture.KIND_AND_SHADE  # a NEAR flag too many costs a little time and changes nothing
    assert np.array_equal(used[0] & mask, painter.ground.texels & mask)


def test_flags_tell_exactly_where_texels_differ_in_kind(painter):
    painter.env.reset(seed=10)
    texels = painter.ground.texels[0]
    kinds = texels & picture.KIND
    inner = slice(8, picture.SIZE - 8)

    def differs(steps):
        shifted = [
            kinds[8 + dy : picture.SIZE - 8 + dy, 8 + dx : picture.SIZE - 8 + dx]
            for dy in steps
            for dx in steps
        ]
        return np.any([kind != kinds[inner, inner] for kind in shifted], axis=0)

    assert np.array_equal((texels[inner, inner] & picture.EDGE) > 0, differs((0, 1)))
    near = (texels[inner, inner] & picture.NEAR) > 0
    assert near[differs((-1, 0, 1, 2))].all()
    assert (near & ~differs((-1, 0, 1, 2))).mean() < 1e-3


def test_a_visited_tile_changes_its_shade_and_leaves_kerbs_alone(painter):
    painter.env.reset(seed=11)
    before = painter.ground.texels[0].copy()
    for tile in painter.tiles[0, : painter.roads["tiles"][0]]:
        picture.visit(painter.ground, 0, tile)
    after = painter.ground.texels[0]
    road = (before & picture.KIND) == picture.ROAD
    assert np.array_equal(before[~road], after[~road])
    shade = after[road] & picture.KIND_AND_SHADE
    assert (shade == picture.ROAD).mean() > 0.99


def test_random_colours_reach_the_picture():
    painter = Painter(make_env(fast=False, domain_randomize=True))
    for seed in (1, 2):
        official = painter.env.reset(seed=seed)[0]
        painter.paint()
        assert difference(official[None], painter.draw(96)[None])[0] <= 1


@pytest.mark.parametrize("reward", [-999, -100.5, -23.4, -0.6, -0.4, -0.0, 0.4, 0.5, 7.5, 999.6])
def test_the_score_is_the_text_that_python_prints(reward):
    pictures = picture.make_pictures()
    font = pygame.font.Font(pygame.font.get_default_font(), 42)
    expected = picture.score_picture(font, f"{reward:04.0f}")
    assert np.array_equal(pictures.score[picture.score_index(float(reward))], expected)
    assert expected.any()


@pytest.mark.parametrize("number", [float("nan"), float("inf"), 1e30])
def test_a_lost_car_gives_a_black_picture(number):
    painter = Painter(make_env(fast=False))
    painter.env.reset(seed=1)
    painter.paint()
    painter.copy_state()
    painter.cars["time"], painter.cars["position"], painter.cars["angle"] = 2.0, number, number
    assert not painter.draw_records(96)[:60].any()
    for name in ("phase", "omega", "reward"):
        painter.cars[name] = number
    painter.draw_records(96)


def test_threads_draw_the_same_pictures(painter):
    painter.env.reset(seed=12)
    expected = painter.draw(64)
    batch, outs = repeat(painter, 20), [np.empty((20, 64, 64, 3), np.uint8) for _ in range(4)]
    threads = [threading.Thread(target=draw, args=(out, batch, True)) for out in outs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(out[i], expected) for out in outs for i in range(20))
