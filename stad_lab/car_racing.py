"""The environment: Gymnasium's CarRacing-v3, and the same environment with a fast picture.

Gymnasium draws some 500 polygons into 1000 x 800 pixels for every observation and shrinks the result to 96 x 96; that
is 98% of its time. But the ground hardly changes within an episode. So `FastCarRacing` paints it once into one large
texture, and each frame needs only four things:

1. one affine warp of the texture to what the camera sees, at twice the size of the observation,
2. the car's polygons on top,
3. one area average down to 96 x 96,
4. the indicator bar, put together from small pictures that pygame draws once and that are then kept.

Physics, rewards, terminations, spaces and seeds are Gymnasium's own code, untouched: only `_render("state_pixels")` is
replaced. This file is for whoever wants to know how a picture is made; to drive, `make_env()` is enough.
"""

import functools
import math
import os

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # pygame greets on import, in every worker process

import cv2
import gymnasium as gym
import numpy as np
import pygame
from gymnasium.envs.box2d import car_dynamics
from gymnasium.envs.box2d import car_racing as reference

OBSERVATION_SIZE = 96  # pixels, width and height of an observation
BAR_TOP = 84  # the first row of the indicator bar: 5/40 of the height is bar
MAX_FRAMES = 1000  # Gymnasium's time limit for CarRacing, in frames
TRACK_WIDTH = reference.TRACK_WIDTH  # half the width of the road, world units

FAST_ID = "StadLab/CarRacing-v3"
SUPERSAMPLE = 2  # the picture is drawn this many times too large, then averaged down
TEXTURE_SCALE = 4.0  # texture pixels per world unit
SHIFT = 4  # OpenCV's fixed-point polygons: coordinates carry this many binary digits behind the point
DARKENING = 2  # pygame's smoothscale loses two levels of every channel to its fixed-point sums; so do we

# The car's polygons in its own coordinates (world units), from Gymnasium's car_dynamics.
HULL_POLYGONS = [
    np.array(polygon) * car_dynamics.SIZE
    for polygon in (
        car_dynamics.HULL_POLY1,
        car_dynamics.HULL_POLY2,
        car_dynamics.HULL_POLY3,
        car_dynamics.HULL_POLY4,
    )
]
WHEEL_POLYGON = (
    np.array([(-1, 1), (1, 1), (1, -1), (-1, -1)]) * (car_dynamics.WHEEL_W, car_dynamics.WHEEL_R) * car_dynamics.SIZE
)
HULL_COLOR = (204, 0, 0)
NOWHERE = np.full((4, 2), 1e4)  # world units from the car: never in the picture


def make_env(fast: bool = True, **kwargs) -> gym.Env:
    """Make a CarRacing-v3 environment.

    Both kinds share physics, rewards, terminations, spaces and seeds; they differ in how the observation is drawn.

    Args:
        fast: True for the fast picture (`FastCarRacing`), False for Gymnasium's own CarRacing-v3 as it is.
        **kwargs: passed to `gymnasium.make`, for example `render_mode="rgb_array"`.

    Returns:
        An environment with observations uint8 (96, 96, 3) and actions float32 (3,): steering in [-1, 1], gas and brake
        in [0, 1]. An episode is cut at 1,000 frames.
    """
    return gym.make(FAST_ID if fast else "CarRacing-v3", **kwargs)


class FastCarRacing(reference.CarRacing):
    """CarRacing-v3 with a fast observation; everything else, `render()` too, is Gymnasium's.

    Mean absolute difference to Gymnasium's observation: below 1 of 255 (tests/test_car_racing.py measures it).
    """

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """As Gymnasium's reset. The texture of the last episode is dropped, the new one is painted on first sight."""
        self._ground = None
        return super().reset(seed=seed, options=options)

    def step(self, action: np.ndarray | None):
        """As Gymnasium's step, but an action that is not finite is refused: a NaN once earned an instant 999 here."""
        if action is not None and not np.isfinite(action).all():
            raise ValueError(f"action {action}: expected finite numbers, steering, gas and brake")
        return super().step(action)

    def close(self):
        """As Gymnasium's close, and lets go of the texture (20 MB), which reference cycles would keep for long."""
        super().close()
        self._ground = None

    def _render(self, mode: str):
        if mode != "state_pixels":
            return super()._render(mode)
        if self._ground is None:
            self._ground = Ground(self)
        self._ground.repaint_visited_tiles(self)
        angle = self.car.hull.angle
        # The first second zooms in from the whole field to the car, as in Gymnasium.
        zoom = 0.1 * reference.SCALE * max(1 - self.t, 0) + reference.ZOOM * reference.SCALE * min(self.t, 1)
        picture = self._ground.look(self.car.hull.position, angle, zoom)
        draw_car(picture, self.car, zoom)
        view = cv2.resize(picture, (OBSERVATION_SIZE, BAR_TOP), interpolation=cv2.INTER_AREA)
        view = cv2.subtract(view, (DARKENING,) * 4)
        return np.concatenate([view, indicator_bar(self.car, self.reward)])


class Ground:
    """The playfield of one episode (ground, grass, road, kerbs) as a texture, and the camera that looks at it.

    `levels` holds the texture at full, 1/4 and 1/16 scale: the opening zoom sees the whole field at once, and a
    picture that shrinks the texture much must be read from a smaller copy, or thin roads would flicker.
    """

    def __init__(self, env: reference.CarRacing):
        size = round(2 * reference.PLAYFIELD * TEXTURE_SCALE)
        texture = np.full((size, size, 3), [int(c) for c in env.bg_color], np.uint8)
        grass = [int(c) for c in env.grass_color]
        side = reference.GRASS_DIM * TEXTURE_SCALE
        for row in range(0, 40, 2):
            for column in range(0, 40, 2):
                corner = (round(column * side), round(row * side))
                opposite = (round((column + 1) * side) - 1, round((row + 1) * side) - 1)
                cv2.rectangle(texture, corner, opposite, grass, cv2.FILLED)
        for polygon, color in env.road_poly:
            fill_road(texture, polygon, color)
        self.levels = [texture]
        for _ in range(2):
            self.levels.append(cv2.resize(self.levels[-1], None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA))
        self.tile_polygons = {
            tile.idx: polygon
            for tile, polygon in zip(env.road, (p for p, c in env.road_poly if isinstance(c, np.ndarray)), strict=True)
        }
        self.visited_count = 0
        self.repainted: set[int] = set()

    def repaint_visited_tiles(self, env: reference.CarRacing) -> None:
        """Give tiles that the car has touched the plain road colour: new tiles differ by up to 5 levels."""
        if env.tile_visited_count == self.visited_count:
            return
        self.visited_count = env.tile_visited_count
        touched = {tile.idx for wheel in env.car.wheels for tile in wheel.tiles}
        for index in touched - self.repainted:
            fill_road(self.levels[0], self.tile_polygons[index], env.road_color)
        self.repainted |= touched

    def look(self, position: tuple[float, float], angle: float, zoom: float) -> np.ndarray:
        """What the camera sees above the indicator bar, at twice the observation's size: uint8 (168, 192, 3).

        Args:
            position: of the hull, world units; it stands in the middle, a quarter of the height above the lower edge.
            angle: of the hull, radians; the camera turns with it.
            zoom: window pixels (of 1000 x 800) per world unit.
        """
        size = SUPERSAMPLE * OBSERVATION_SIZE
        step_x = reference.WINDOW_W / size / zoom  # world units from one pixel of the picture to the next
        step_y = reference.WINDOW_H / size / zoom
        level = min(2, max(0, int(math.log(max(step_x * TEXTURE_SCALE / 1.5, 1), 4) + 0.5)))
        texels = TEXTURE_SCALE / 4**level
        cos, sin = math.cos(angle), math.sin(angle)
        # Position of the picture's first pixel centre, relative to the hull, in the camera's axes (y points up).
        right = 0.5 * step_x - reference.WINDOW_W / 2 / zoom
        up = 0.75 * reference.WINDOW_H / zoom - 0.5 * step_y
        x = position[0] + cos * right - sin * up + reference.PLAYFIELD
        y = position[1] + sin * right + cos * up + reference.PLAYFIELD
        matrix = np.array(
            [
                [cos * step_x * texels, sin * step_y * texels, x * texels - 0.5],
                [sin * step_x * texels, -cos * step_y * texels, y * texels - 0.5],
            ]
        )
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        shape = (size, SUPERSAMPLE * BAR_TOP)
        return cv2.warpAffine(self.levels[level], matrix, shape, flags=flags, borderMode=cv2.BORDER_CONSTANT)


def fill_road(texture: np.ndarray, polygon: list[tuple[float, float]], color) -> None:
    """Fill one tile of road or kerb; `polygon` in world units."""
    points = to_fixed_point((np.array(polygon) + reference.PLAYFIELD) * TEXTURE_SCALE)
    cv2.fillConvexPoly(texture, points, [int(c) for c in color], cv2.LINE_8, SHIFT)


def draw_car(picture: np.ndarray, car: car_dynamics.Car, zoom: float) -> None:
    """Draw wheels, their light marks and the hull into `picture` (168, 192, 3), seen by the camera of `Ground.look`."""
    scale, middle = camera(zoom)
    turn = np.array([wheel.angle - car.hull.angle for wheel in car.wheels])
    cos, sin = np.cos(turn), np.sin(turn)
    rotation = np.array([[cos, -sin], [sin, cos]]).transpose(2, 0, 1)
    offset = np.array([car.hull.GetLocalPoint(wheel.position) for wheel in car.wheels])
    marks = [wheel_mark(wheel.phase) for wheel in car.wheels]
    corners = np.array([np.concatenate([WHEEL_POLYGON, mark]) for mark in marks])
    corners = corners @ rotation.transpose(0, 2, 1) + offset[:, None]
    for corner in to_fixed_point(corners * scale + middle):
        cv2.fillConvexPoly(picture, corner[:4], car_dynamics.WHEEL_COLOR, cv2.LINE_8, SHIFT)
        cv2.fillConvexPoly(picture, corner[4:], car_dynamics.WHEEL_WHITE, cv2.LINE_8, SHIFT)
    for polygon in hull_polygons(zoom):
        cv2.fillConvexPoly(picture, polygon, HULL_COLOR, cv2.LINE_8, SHIFT)


def camera(zoom: float) -> tuple[np.ndarray, np.ndarray]:
    """How hull coordinates (world units, y forward) become pixels of the picture: (factors, position of the hull)."""
    size = SUPERSAMPLE * OBSERVATION_SIZE
    scale = np.array([size / reference.WINDOW_W, -size / reference.WINDOW_H]) * zoom
    return scale, np.array([size / 2, 0.75 * size])


def to_fixed_point(points: np.ndarray) -> np.ndarray:
    """Pixel coordinates as OpenCV's polygons want them; its pixel (0, 0) has its centre there, ours at (0.5, 0.5)."""
    return np.round((points - 0.5) * 2**SHIFT).astype(np.int32)


@functools.lru_cache(maxsize=64)
def hull_polygons(zoom: float) -> list[np.ndarray]:
    """The hull as it stands in the picture: always the same but for the zoom, because the camera is fixed to it."""
    scale, middle = camera(zoom)
    return [to_fixed_point(polygon * scale + middle) for polygon in HULL_POLYGONS]


def wheel_mark(phase: float) -> np.ndarray:
    """The light stripe on a turning wheel, (4, 2) in the wheel's coordinates; outside the picture while underneath."""
    sin1, sin2 = math.sin(phase), math.sin(phase + 1.2)
    cos1, cos2 = math.cos(phase), math.cos(phase + 1.2)
    if sin1 > 0 and sin2 > 0:
        return NOWHERE
    if sin1 > 0:
        cos1 = math.copysign(1, cos1)
    if sin2 > 0:
        cos2 = math.copysign(1, cos2)
    corners = np.array([(-1, cos1), (1, cos1), (1, cos2), (-1, cos2)])
    return corners * (car_dynamics.WHEEL_W, car_dynamics.WHEEL_R) * car_dynamics.SIZE


def indicator_bar(car: car_dynamics.Car, reward: float) -> np.ndarray:
    """The lowest 12 rows, uint8 (12, 96, 3): score, speed, four wheel speeds, steering angle and yaw rate."""
    bar = score_picture(f"{reward:04.0f}").copy()
    speed = math.hypot(*car.hull.linearVelocity)
    blue, violet = (0, 0, 255), (51, 0, 255)
    gauges = [(5, 0.02 * speed, (255, 255, 255), True)]
    gauges += [
        (place, 0.01 * wheel.omega, blue if place < 9 else violet, True) for place, wheel in enumerate(car.wheels, 7)
    ]
    gauges.append((20, -10.0 * car.wheels[0].joint.angle, (0, 255, 0), False))
    gauges.append((30, -0.8 * car.hull.angularVelocity, (255, 0, 0), False))
    for place, value, color, vertical in gauges:
        unit = reference.WINDOW_H / 40 if vertical else reference.WINDOW_W / 40
        pixels = round(max(-40.0, min(40.0, value)) * unit)
        if pixels:
            left, patch = gauge_picture(place, pixels, color, vertical)
            area = bar[:, left : left + patch.shape[1]]
            np.maximum(area, patch, out=area)
    return bar


def _shrink_bar(surface: pygame.Surface) -> np.ndarray:
    """Shrink a 1000 x 100 drawing of the bar to uint8 (12, 96, 3), as Gymnasium shrinks its window."""
    small = pygame.transform.smoothscale(surface, (OBSERVATION_SIZE, OBSERVATION_SIZE - BAR_TOP))
    return pygame.surfarray.array3d(small).transpose(1, 0, 2)


def _bar_surface() -> pygame.Surface:
    # Depth 24 without alpha, as Gymnasium's window has where there is no display.
    return pygame.Surface((reference.WINDOW_W, reference.WINDOW_H // 8), depth=24)


@functools.lru_cache(maxsize=4096)
def score_picture(text: str) -> np.ndarray:
    """The bar with nothing but the score: uint8 (12, 96, 3), drawn by pygame once for each text."""
    pygame.font.init()
    surface = _bar_surface()
    label = pygame.font.Font(pygame.font.get_default_font(), 42).render(text, True, (255, 255, 255), (0, 0, 0))
    middle = reference.WINDOW_H * (5 - 2.5) / 40
    surface.blit(label, label.get_rect(center=(60, middle)))
    return _shrink_bar(surface)


@functools.lru_cache(maxsize=4096)
def gauge_picture(place: int, pixels: int, color: tuple[int, int, int], vertical: bool) -> tuple[int, np.ndarray]:
    """One gauge of the bar, `pixels` long in the window: (its first column, uint8 (12, columns, 3))."""
    surface = _bar_surface()
    s, h, bottom = reference.WINDOW_W / 40, reference.WINDOW_H / 40, reference.WINDOW_H / 8
    if vertical:
        x1, x2, y1, y2 = place * s, (place + 1) * s, bottom - h - pixels, bottom - h
    else:
        x1, x2, y1, y2 = place * s, place * s + pixels, bottom - 4 * h, bottom - 2 * h
    pygame.draw.polygon(surface, color, [(x1, y1), (x2, y1), (x2, y2), (x1, y2)])
    patch = _shrink_bar(surface)
    columns = np.flatnonzero(patch.any(axis=(0, 2)))
    if not len(columns):
        return 0, patch[:, :0]
    return int(columns[0]), np.ascontiguousarray(patch[:, columns[0] : columns[-1] + 1])


def place_car(env: gym.Env, tile: int, speed: float = 0.0, turn: float = 0.0, offset: float = 0.0) -> np.ndarray:
    """Put the car on a tile of the track, moving, with the opening zoom behind it.

    This is how a random driver comes to see more than the first bend: CarRacing itself always starts at rest on tile 0.

    Args:
        env: an environment that has been reset, from `make_env`.
        tile: index of the tile, taken modulo the number of tiles.
        speed: forward, world units per second (an unhurried lap has about 40, full gas on a straight about 100).
        turn: heading against the road's direction, radians, positive to the left.
        offset: distance from the centre line, in half road widths, positive to the right.

    Returns:
        The observation there, uint8 (96, 96, 3).
    """
    car_racing = env.unwrapped
    _, beta, x, y = car_racing.track[tile % len(car_racing.track)]
    x += offset * TRACK_WIDTH * math.cos(beta)
    y += offset * TRACK_WIDTH * math.sin(beta)
    heading = beta + turn
    car_racing.car.destroy()
    car_racing.car = car_dynamics.Car(car_racing.world, heading, x, y)
    for wheel, (x, y) in zip(car_racing.car.wheels, car_dynamics.WHEELPOS, strict=True):
        # Gymnasium's Car places its wheels as if it always faced north; the first step would jerk them into place.
        wheel.position = car_racing.car.hull.GetWorldPoint((x * car_dynamics.SIZE, y * car_dynamics.SIZE))
    for body in car_racing.car.drawlist:
        body.linearVelocity = (-math.sin(heading) * speed, math.cos(heading) * speed)
    for wheel in car_racing.car.wheels:
        wheel.omega = speed / wheel.wheel_rad
    car_racing.t = max(car_racing.t, 1.0)
    return car_racing._render("state_pixels")


gym.register(FAST_ID, entry_point=FastCarRacing, max_episode_steps=MAX_FRAMES, reward_threshold=900)
