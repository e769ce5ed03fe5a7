"""The environment: Gymnasium's CarRacing-v3, and the same environment with a faster renderer.

Gymnasium draws some 800 polygons on 1000 x 800 pixels for every observation and shrinks the result
to 96 x 96, which takes 98% of its time. `FastCarRacing` paints the ground of an episode once, into
a texture. Each frame then needs one affine warp of the texture (`Ground.warp`), and small cached
pictures of the car (`draw_car`) and of the indicator bar (`draw_bar`). Only
`_render("state_pixels")` is replaced: all else is Gymnasium's own code.
"""

import functools
import itertools
import math
import os
from collections.abc import Callable, Iterable

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # pygame prints a greeting on import

import Box2D
import cv2
import gymnasium as gym
import numpy as np
import pygame
from gymnasium.envs.box2d import car_dynamics
from gymnasium.envs.box2d import car_racing as reference

from stad_lab.envs.frames import BAR_TOP, OBSERVATION_SIZE

FAST_ID = "StadLab/CarRacing-v3"  # registered in stad_lab/__init__.py
MAX_FRAMES = 1000  # Gymnasium's time limit for CarRacing, in frames
TRACK_WIDTH = reference.TRACK_WIDTH  # half the width of the road, world units

TEXTURE_SCALE = 3.0  # texture pixels (texels) per world unit
TEXTURE_SIZE = round(2 * reference.PLAYFIELD * TEXTURE_SCALE)  # texels, width and height
LEVELS = (1, 2, 4, 8, 16)  # how many times smaller each copy of the texture is
TEXELS = 1.3  # the camera uses a copy with 1.3 to 2.6 texels to a pixel
SHIFT = 4  # binary digits behind the point in the coordinates of OpenCV's polygons

HULL_ROW, HULL_COLUMN = 72, 48  # pixel corner of the hull's origin: the camera follows the car
QUARTER_ROWS, QUARTER_COLUMNS = 6, 4  # size of a quarter of the car, pixels
FINE = 8  # a quarter is drawn so many times larger, then averaged down
TURN_STEPS, PHASE_STEPS = 24, 32  # steps of a wheel's angle (1/24 radian) and rotation (2 pi / 32)
HULLS = [getattr(car_dynamics, f"HULL_POLY{number}") for number in (1, 2, 3, 4)]
HULL_POLYGONS = [np.array(polygon) * car_dynamics.SIZE for polygon in HULLS]  # world units
HULL_COLOR = (204, 0, 0)
WHEEL_HALF_WIDTH = car_dynamics.WHEEL_W * car_dynamics.SIZE
WHEEL_RADIUS = car_dynamics.WHEEL_R * car_dynamics.SIZE

# The indicators: place in fortieths of the width, colour, and whether they grow upward or sideways.
BLUE, VIOLET = (0, 0, 255), (51, 0, 255)
INDICATORS = [(5, (255, 255, 255), True), (7, BLUE, True), (8, BLUE, True), (9, VIOLET, True)]
INDICATORS += [(10, VIOLET, True), (20, (0, 255, 0), False), (30, (255, 0, 0), False)]


def make_env(fast: bool = True, **kwargs) -> gym.Env:
    """Make CarRacing-v3: observations uint8 (96, 96, 3), actions float32 (3,), 1,000 frames.

    Args:
        fast: True for the fast renderer (`FastCarRacing`), False for Gymnasium's own CarRacing-v3.
        **kwargs: passed to `gymnasium.make`, for example `render_mode="rgb_array"`, or, for the
            fast renderer only, `bar=False` to leave out the indicator bar.
    """
    return gym.make(FAST_ID if fast else "CarRacing-v3", **kwargs)


class FastCarRacing(reference.CarRacing):
    """CarRacing-v3 with an observation that differs from Gymnasium's by less than 0.5 of 255.

    Args:
        bar: whether to draw the indicator bar; without it the lowest 12 rows are black.
        **kwargs: as for Gymnasium's CarRacing.
    """

    def __init__(self, *args, bar: bool = True, **kwargs):
        super().__init__(*args, **kwargs)
        gym.utils.EzPickle.__init__(self, *args, bar=bar, **kwargs)  # the arguments of a copy
        self._bar = bar
        self.ground = Ground()

    def reset(self, **kwargs) -> tuple[np.ndarray, dict]:
        """As Gymnasium's reset; the new track is painted with its first observation."""
        self.ground.painted = False
        return super().reset(**kwargs)

    def step(self, action: np.ndarray | None) -> tuple[np.ndarray, float, bool, bool, dict]:
        """As Gymnasium's step. ValueError for an action that is not finite: NaN once earned 999."""
        if action is not None and not np.isfinite(action).all():
            raise ValueError(f"action {action}: expected finite numbers, steering, gas and brake")
        return super().step(action)

    def close(self) -> None:
        """As Gymnasium's close; also frees the texture and the track, which nothing else frees."""
        super().close()
        self._destroy()
        self.ground = Ground()

    def _render(self, mode: str):
        if mode != "state_pixels":
            return super()._render(mode)
        if not self.ground.painted:
            self.ground.paint(self)
        self.ground.repaint_visited_tiles(self)
        zoom = camera_zoom(self.t)
        observation = np.empty((OBSERVATION_SIZE, OBSERVATION_SIZE, 3), np.uint8)
        view = observation[:BAR_TOP]
        self.ground.warp(view, self.car.hull, zoom)
        draw_car(view, self.car, zoom)
        observation[BAR_TOP:] = 0
        if self._bar:
            draw_bar(observation[BAR_TOP:], self.car, self.reward)
        return observation


def camera_zoom(t: float) -> float:
    """Window pixels (of 1000 x 800) per world unit, t seconds after the start, which zooms in."""
    return 0.1 * reference.SCALE * max(1 - t, 0) + reference.ZOOM * reference.SCALE * min(t, 1)


class Ground:
    """The playfield of an episode (grass, road, kerbs) as a texture, and the camera."""

    def __init__(self):
        self.painted = False
        # The texture (16 MB), and smaller copies: in the opening zoom skipped texels would flicker.
        self.levels: list[np.ndarray] = []

    def paint(self, env: reference.CarRacing) -> None:
        """Paint the track of a new episode over the last one."""
        if not self.levels:
            sizes = [TEXTURE_SIZE // shrink for shrink in LEVELS]
            self.levels = [np.empty((size, size, 3), np.uint8) for size in sizes]
        grounds = (tuple(darkened(color)) for color in (env.bg_color, env.grass_color))
        np.copyto(self.levels[0], empty_field(*grounds))
        polygons = np.array([polygon for polygon, _ in env.road_poly])
        points = to_fixed_point((polygons + reference.PLAYFIELD) * TEXTURE_SCALE)
        for polygon, (_, color) in zip(points, env.road_poly, strict=True):
            fill(self.levels[0], polygon, darkened(color))
        for large, small in itertools.pairwise(self.levels):
            cv2.resize(large, small.shape[:2], small, interpolation=cv2.INTER_AREA)
        # The colours of tiles are arrays, those of kerbs are tuples.
        self.tile_points = points[[isinstance(color, np.ndarray) for _, color in env.road_poly]]
        self.tiles_seen = 0
        self.painted = True

    def repaint_visited_tiles(self, env: reference.CarRacing) -> None:
        """Give visited tiles the plain road colour; new tiles differ from it by up to 5 levels."""
        if env.tile_visited_count != self.tiles_seen:
            self.tiles_seen = env.tile_visited_count
            for index in {tile.idx for wheel in env.car.wheels for tile in wheel.tiles}:
                fill(self.levels[0], self.tile_points[index], darkened(env.road_color))

    def warp(self, view: np.ndarray, hull: Box2D.b2Body, zoom: float) -> None:
        """Draw what the camera above the hull sees into `view`, uint8 (84, 96, 3)."""
        step_x = reference.WINDOW_W / OBSERVATION_SIZE / zoom  # world units per pixel
        step_y = reference.WINDOW_H / OBSERVATION_SIZE / zoom
        level = min(len(LEVELS) - 1, int(math.log2(max(1, step_x * TEXTURE_SCALE / TEXELS))))
        texels = TEXTURE_SCALE / LEVELS[level]
        cos, sin = math.cos(hull.angle) * texels, math.sin(hull.angle) * texels
        # From the first pixel's centre to the hull, along the camera's axes.
        right, up = (0.5 - HULL_COLUMN) * step_x, (HULL_ROW - 0.5) * step_y
        x = (hull.position[0] + reference.PLAYFIELD) * texels + cos * right - sin * up - 0.5
        y = (hull.position[1] + reference.PLAYFIELD) * texels + sin * right + cos * up - 0.5
        matrix = np.array(((cos * step_x, sin * step_y, x), (sin * step_x, -cos * step_y, y)))
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        cv2.warpAffine(self.levels[level], matrix, (OBSERVATION_SIZE, BAR_TOP), view, flags)


def darkened(color: Iterable[float]) -> list[int]:
    """A colour as it comes out of pygame's smoothscale, which loses two levels."""
    return [max(0, int(c) - 2) for c in color]


def to_fixed_point(points: np.ndarray) -> np.ndarray:
    """Pixel coordinates for OpenCV's polygons, whose pixel centres are whole numbers."""
    return np.round((points - 0.5) * 2**SHIFT).astype(np.int32)


def fill(picture: np.ndarray, polygon: np.ndarray, color: Iterable[int]) -> None:
    """Fill a convex polygon, corners from `to_fixed_point`."""
    cv2.fillConvexPoly(picture, polygon, color, cv2.LINE_8, SHIFT)


@functools.lru_cache(maxsize=1)
def empty_field(ground: tuple[int, ...], grass: tuple[int, ...]) -> np.ndarray:
    """Ground and grass without a road."""
    texture = np.full((TEXTURE_SIZE, TEXTURE_SIZE, 3), ground, np.uint8)
    side = reference.GRASS_DIM * TEXTURE_SCALE
    for row, column in itertools.product(range(0, 40, 2), repeat=2):
        corner = (round(column * side), round(row * side))
        opposite = (round((column + 1) * side) - 1, round((row + 1) * side) - 1)
        cv2.rectangle(texture, corner, opposite, grass, cv2.FILLED)
    return texture


def draw_car(view: np.ndarray, car: car_dynamics.Car, zoom: float) -> None:
    """Draw the car into `view`, uint8 (84, 96, 3), as four quarters with a wheel each."""
    overlay = np.empty((2, 2 * QUARTER_ROWS, 2 * QUARTER_COLUMNS, 3), np.float32)
    for place, wheel in enumerate(car.wheels):
        turn = round((wheel.angle - car.hull.angle) * TURN_STEPS)
        phase = math.floor(wheel.phase * PHASE_STEPS / math.tau) % PHASE_STEPS
        row, column = place // 2 * QUARTER_ROWS, place % 2 * QUARTER_COLUMNS
        quarter = overlay[:, row : row + QUARTER_ROWS, column : column + QUARTER_COLUMNS]
        quarter[:] = quarter_picture(place, turn, phase, zoom)
    top, left = HULL_ROW - QUARTER_ROWS, HULL_COLUMN - QUARTER_COLUMNS
    area = view[top : top + 2 * QUARTER_ROWS, left : left + 2 * QUARTER_COLUMNS]
    area[:] = area * overlay[0] + overlay[1]


def wheel_shape(low: float, high: float) -> np.ndarray:
    """Corners of a rectangle as wide as a wheel, (4, 2)."""
    x = WHEEL_HALF_WIDTH
    return np.array([(-x, high), (x, high), (x, low), (-x, low)])


@functools.lru_cache(maxsize=10_000)  # pictures of 0.6 kB
def quarter_picture(place: int, turn: int, phase: int, zoom: float) -> np.ndarray:
    """A quarter of the car with a wheel: float32 (2, 6, 4, 3), the ground's factor and summand.

    Args:
        place: of the wheel: front left, front right, rear left, rear right.
        turn: its angle to the hull in 1/24 radian, positive to the left.
        phase: its rotation in 1/32 of a turn.
        zoom: as `camera_zoom` returns it.
    """
    cos, sin = math.cos(turn / TURN_STEPS), math.sin(turn / TURN_STEPS)
    rotation = np.array([(cos, sin), (-sin, cos)])
    middle = np.array(car_dynamics.WHEELPOS[place]) * car_dynamics.SIZE
    wheel = wheel_shape(-WHEEL_RADIUS, WHEEL_RADIUS) @ rotation + middle
    shapes = [(wheel, car_dynamics.WHEEL_COLOR)]
    if mark := wheel_mark((phase + 0.5) * math.tau / PHASE_STEPS):
        stripe = wheel_shape(*mark) @ rotation + middle
        shapes.append((stripe, car_dynamics.WHEEL_WHITE))
    shapes += [(polygon, HULL_COLOR) for polygon in HULL_POLYGONS]
    rows, columns = FINE * QUARTER_ROWS, FINE * QUARTER_COLUMNS
    scale = zoom * FINE * OBSERVATION_SIZE / np.array([reference.WINDOW_W, -reference.WINDOW_H])
    corner = np.array([columns * (place % 2 == 0), rows * (place < 2)])
    canvas = np.zeros((rows, columns, 4), np.uint8)  # red, green, blue, coverage of the ground
    for polygon, color in shapes:
        fill(canvas, to_fixed_point(polygon * scale + corner), [*darkened(color), 255])
    size = (QUARTER_COLUMNS, QUARTER_ROWS)
    small = cv2.resize(canvas, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    uncovered = np.repeat(1 - small[..., 3:] / 255, 3, axis=2)
    return np.stack([uncovered, small[..., :3] + 0.5])  # + 0.5: uint8 rounds instead of cutting


def wheel_mark(phase: float) -> tuple[float, float] | None:
    """From where to where the light stripe on a wheel is seen; None while it is underneath."""
    sin1, sin2 = math.sin(phase), math.sin(phase + 1.2)
    cos1, cos2 = math.cos(phase), math.cos(phase + 1.2)
    if sin1 > 0 and sin2 > 0:
        return None
    cos1 = math.copysign(1, cos1) if sin1 > 0 else cos1
    cos2 = math.copysign(1, cos2) if sin2 > 0 else cos2
    return cos2 * WHEEL_RADIUS, cos1 * WHEEL_RADIUS


def draw_bar(bar: np.ndarray, car: car_dynamics.Car, reward: float) -> None:
    """Draw the score, speed, wheel speeds, steering angle and yaw rate: uint8 (12, 96, 3)."""
    values = [0.02 * math.hypot(*car.hull.linearVelocity)]
    values += [0.01 * wheel.omega for wheel in car.wheels]
    values += [-10.0 * car.wheels[0].joint.angle, -0.8 * car.hull.angularVelocity]
    bar[:] = score_picture(f"{reward:04.0f}")
    for number, value in enumerate(values):
        unit = (reference.WINDOW_H if INDICATORS[number][2] else reference.WINDOW_W) / 40
        length = round(max(-40.0, min(40.0, value)) * unit)
        np.maximum(bar, indicator_picture(number, length), out=bar)


def bar_picture(draw: Callable[[pygame.Surface], object]) -> np.ndarray:
    """A drawing on the 1000 x 100 bar, shrunk as Gymnasium does: uint8 (12, 96, 3)."""
    size = (reference.WINDOW_W, reference.WINDOW_H // 8)
    surface = pygame.Surface(size, depth=24)  # as Gymnasium's window where there is no display
    draw(surface)
    small = pygame.transform.smoothscale(surface, (OBSERVATION_SIZE, OBSERVATION_SIZE - BAR_TOP))
    return np.ascontiguousarray(pygame.surfarray.array3d(small).transpose(1, 0, 2))


@functools.lru_cache(maxsize=4096)
def score_picture(text: str) -> np.ndarray:
    """The bar with the score alone: uint8 (12, 96, 3)."""
    pygame.font.init()
    font = pygame.font.Font(pygame.font.get_default_font(), 42)
    label = font.render(text, True, (255, 255, 255), (0, 0, 0))
    place = label.get_rect(center=(60, reference.WINDOW_H * (5 - 2.5) / 40))
    return bar_picture(lambda surface: surface.blit(label, place))


@functools.lru_cache(maxsize=4096)
def indicator_picture(number: int, length: int) -> np.ndarray:
    """The bar with one indicator alone, `length` window pixels long: uint8 (12, 96, 3)."""
    place, color, vertical = INDICATORS[number]
    s, h, bottom = reference.WINDOW_W / 40, reference.WINDOW_H / 40, reference.WINDOW_H / 8
    x1, x2, y1, y2 = place * s, place * s + length, bottom - 4 * h, bottom - 2 * h
    if vertical:
        x1, x2, y1, y2 = place * s, (place + 1) * s, bottom - h - length, bottom - h
    corners = [(x1, y1), (x2, y1), (x2, y2), (x1, y2)]
    return bar_picture(lambda surface: length and pygame.draw.polygon(surface, color, corners))


def place_car(
    env: gym.Env, tile: int, speed: float = 0.0, turn: float = 0.0, offset: float = 0.0
) -> np.ndarray:
    """Put the car on a tile of the track, moving, so that a random driver sees all of it.

    Args:
        env: an environment that has been reset, from `make_env`.
        tile: index of the tile, modulo the number of tiles.
        speed: forward, world units per second (40 in a slow lap, 100 with full gas on a straight).
        turn: heading against the road's direction, radians, positive to the left.
        offset: distance from the centre line, in half road widths, positive to the right.

    Returns:
        The observation there, uint8 (96, 96, 3), without the opening zoom.
    """
    car_racing = env.unwrapped
    _, beta, x, y = car_racing.track[tile % len(car_racing.track)]
    x += offset * TRACK_WIDTH * math.cos(beta)
    y += offset * TRACK_WIDTH * math.sin(beta)
    heading = beta + turn
    car_racing.car.destroy()
    car = car_racing.car = car_dynamics.Car(car_racing.world, heading, x, y)
    for wheel, (x, y) in zip(car.wheels, car_dynamics.WHEELPOS, strict=True):
        # Gymnasium's Car places its wheels as if it faced north; the first step would jerk them.
        wheel.position = car.hull.GetWorldPoint((x * car_dynamics.SIZE, y * car_dynamics.SIZE))
        wheel.omega = speed / wheel.wheel_rad
    for body in car.drawlist:
        body.linearVelocity = (-math.sin(heading) * speed, math.cos(heading) * speed)
    car_racing.t = max(car_racing.t, 1.0)
    return car_racing._render("state_pixels")
