"""The environment: Gymnasium's CarRacing-v3, and the same environment with a fast picture.

For every observation Gymnasium turns some 800 polygons, draws those in sight on 1000 x 800 pixels and shrinks the
result to 96 x 96; that is 98% of its time. But the ground hardly changes within an episode. So `FastCarRacing` paints
it once into one large texture, and each frame needs only three things:

1. one affine warp of the texture to what the camera sees (`Ground.look`),
2. the car on top, blended from four small pictures with a wheel each (`draw_car`),
3. the indicator bar, put together from a picture of the score and one of each gauge (`draw_bar`).

The small pictures are drawn when they are first needed, and kept: the camera is fixed to the car, so that a wheel looks
the same whenever its angle and its rotation are.

Physics, rewards, terminations, spaces and seeds are Gymnasium's own code, untouched: only `_render("state_pixels")` is
replaced. This file is for whoever wants to know how a picture is made; to drive, `make_env()` is enough.
"""

import functools
import itertools
import math
import os
from collections.abc import Iterable

os.environ.setdefault(
    "PYGAME_HIDE_SUPPORT_PROMPT", "1"
)  # pygame greets on import, in every worker process

import cv2
import gymnasium as gym
import numpy as np
import pygame
from gymnasium.envs.box2d import car_dynamics
from gymnasium.envs.box2d import car_racing as reference

from stad_lab.envs.frames import BAR_TOP, OBSERVATION_SIZE

MAX_FRAMES = 1000  # Gymnasium's time limit for CarRacing, in frames
TRACK_WIDTH = reference.TRACK_WIDTH  # half the width of the road, world units

FAST_ID = "StadLab/CarRacing-v3"
DARKENING = (
    2  # pygame's smoothscale loses two levels of every channel to its fixed-point sums; so do we
)
TEXTURE_SCALE = (
    3.0  # texture pixels (texels) per world unit: nearly two to a pixel of the observation
)
TEXTURE_SIZE = round(2 * reference.PLAYFIELD * TEXTURE_SCALE)  # texels, width and height
LEVELS = (1, 2, 4, 8, 16)  # how many times smaller each copy of the texture is
TEXELS = (
    1.3  # the copy to look at has at least so many texels to a pixel, and less than twice as many
)
SHIFT = (
    4  # OpenCV's fixed-point polygons: coordinates carry this many binary digits behind the point
)

# The car stands still in the picture, for the camera is fixed to it: the pixel corner where the hull's origin lies,
# and the size of a quarter of the car, in pixels.
HULL_ROW, HULL_COLUMN = 72, 48
QUARTER_ROWS, QUARTER_COLUMNS = 6, 4
CAR_AREA = (
    slice(HULL_ROW - QUARTER_ROWS, HULL_ROW + QUARTER_ROWS),
    slice(HULL_COLUMN - QUARTER_COLUMNS, HULL_COLUMN + QUARTER_COLUMNS),
)
QUARTERS = [
    (slice(None), slice(row, row + QUARTER_ROWS), slice(column, column + QUARTER_COLUMNS))
    for row in (0, QUARTER_ROWS)
    for column in (0, QUARTER_COLUMNS)
]
FINE = 8  # a quarter is drawn so many times larger, then averaged down
TURN_STEPS, PHASE_STEPS = (
    24,
    32,
)  # a wheel's angle to the hull and its rotation are drawn in steps of 1/24 and 2 pi/32

HULL_POLYGONS = [
    np.array(polygon) * car_dynamics.SIZE  # world units
    for polygon in (
        car_dynamics.HULL_POLY1,
        car_dynamics.HULL_POLY2,
        car_dynamics.HULL_POLY3,
        car_dynamics.HULL_POLY4,
    )
]
HULL_COLOR = (204, 0, 0)
WHEEL_HALF_WIDTH, WHEEL_RADIUS = (
    car_dynamics.WHEEL_W * car_dynamics.SIZE,
    car_dynamics.WHEEL_R * car_dynamics.SIZE,
)

# The gauges of the indicator bar: place in fortieths of the width, colour, and whether they grow upward or sideways.
GAUGES = [(5, (255, 255, 255), True)]
GAUGES += [
    (7, (0, 0, 255), True),
    (8, (0, 0, 255), True),
    (9, (51, 0, 255), True),
    (10, (51, 0, 255), True),
]
GAUGES += [(20, (0, 255, 0), False), (30, (255, 0, 0), False)]
GAUGE_UNITS = [
    (reference.WINDOW_H if vertical else reference.WINDOW_W) / 40 for _, _, vertical in GAUGES
]


def make_env(fast: bool = True, **kwargs) -> gym.Env:
    """Make a CarRacing-v3 environment.

    Both kinds share physics, rewards, terminations, spaces and seeds; they differ in how the observation is drawn.

    Args:
        fast: True for the fast picture (`FastCarRacing`), False for Gymnasium's own CarRacing-v3 as it is.
        **kwargs: passed to `gymnasium.make`, for example `render_mode="rgb_array"`, or, for the fast picture only,
            `bar=False` to leave out the indicator bar.

    Returns:
        An environment with observations uint8 (96, 96, 3) and actions float32 (3,): steering in [-1, 1], gas and brake
        in [0, 1]. An episode is cut at 1,000 frames.
    """
    return gym.make(FAST_ID if fast else "CarRacing-v3", **kwargs)


class FastCarRacing(reference.CarRacing):
    """CarRacing-v3 with a fast observation; everything else, `render()` too, is Gymnasium's.

    Mean absolute difference to Gymnasium's observation: below 0.5 of 255 (tests/test_car_racing.py measures it).

    Args:
        bar: whether to draw the indicator bar. Without it the lowest 12 rows are black: for agents that crop it.
        **kwargs: as for Gymnasium's CarRacing.
    """

    def __init__(self, *args, bar: bool = True, **kwargs):
        super().__init__(*args, **kwargs)
        gym.utils.EzPickle.__init__(self, *args, bar=bar, **kwargs)  # what a copy is made with
        self._bar = bar
        self.ground = Ground()

    def reset(
        self, *, seed: int | None = None, options: dict | None = None
    ) -> tuple[np.ndarray, dict]:
        """As Gymnasium's reset; the new track is painted on first sight."""
        self.ground.painted = False
        return super().reset(seed=seed, options=options)

    def step(self, action: np.ndarray | None) -> tuple[np.ndarray, float, bool, bool, dict]:
        """As Gymnasium's step, but an action that is not finite is refused: a NaN once earned an instant 999 here."""
        if action is not None and not np.isfinite(action).all():
            raise ValueError(f"action {action}: expected finite numbers, steering, gas and brake")
        return super().step(action)

    def close(self) -> None:
        """As Gymnasium's close, and lets go of the texture and the track, which would be kept for long, or for good."""
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
        hull = self.car.hull
        self.ground.look(view, hull.position, hull.angle, zoom)
        draw_car(view, self.car, zoom)
        if self._bar:
            draw_bar(observation[BAR_TOP:], self.car, self.reward)
        else:
            observation[BAR_TOP:] = 0
        return observation


def camera_zoom(t: float) -> float:
    """Window pixels (of 1000 x 800) for a world unit, t seconds after the start: the first second zooms in."""
    return 0.1 * reference.SCALE * max(1 - t, 0) + reference.ZOOM * reference.SCALE * min(t, 1)


class Ground:
    """The playfield of an episode (ground, grass, road, kerbs) as a texture, and the camera that looks at it.

    `levels` holds the texture at full size and, down to a sixteenth, at half the size of the level before: the opening
    zoom sees the whole field at once, and a picture that skips texels would let thin roads flicker.
    """

    def __init__(self):
        self.painted = False
        self.levels: list[np.ndarray] = []  # 16 MB, so only when there is something to paint

    def paint(self, env: reference.CarRacing) -> None:
        """Paint the track of a new episode over the last one."""
        if not self.levels:
            sizes = [TEXTURE_SIZE // shrink for shrink in LEVELS]
            self.levels = [np.empty((size, size, 3), np.uint8) for size in sizes]
        texture = self.levels[0]
        np.copyto(
            texture, empty_field(tuple(darkened(env.bg_color)), tuple(darkened(env.grass_color)))
        )
        points = on_texture(np.array([polygon for polygon, _ in env.road_poly]))
        for polygon, (_, color) in zip(points, env.road_poly, strict=True):
            cv2.fillConvexPoly(texture, polygon, darkened(color), cv2.LINE_8, SHIFT)
        for large, small in itertools.pairwise(self.levels):
            cv2.resize(large, small.shape[:2], small, interpolation=cv2.INTER_AREA)
        tiles = [
            isinstance(color, np.ndarray) for _, color in env.road_poly
        ]  # the others are kerbs
        self.tile_points = points[tiles]
        self.tiles_seen = 0
        self.painted = True

    def repaint_visited_tiles(self, env: reference.CarRacing) -> None:
        """Give tiles that the car has touched the plain road colour: new tiles differ by up to 5 levels."""
        if env.tile_visited_count != self.tiles_seen:
            self.tiles_seen = env.tile_visited_count
            for index in {tile.idx for wheel in env.car.wheels for tile in wheel.tiles}:
                cv2.fillConvexPoly(
                    self.levels[0],
                    self.tile_points[index],
                    darkened(env.road_color),
                    cv2.LINE_8,
                    SHIFT,
                )

    def look(
        self, view: np.ndarray, position: tuple[float, float], angle: float, zoom: float
    ) -> None:
        """Draw what the camera sees into `view`, uint8 (84, 96, 3): the observation above the indicator bar.

        Args:
            position: of the hull, world units; it stands in the middle, a quarter of the height above the lower edge.
            angle: of the hull, radians; the camera turns with it.
            zoom: window pixels (of 1000 x 800) per world unit.
        """
        step_x = (
            reference.WINDOW_W / OBSERVATION_SIZE / zoom
        )  # world units from one pixel to the next
        step_y = reference.WINDOW_H / OBSERVATION_SIZE / zoom
        level = min(len(LEVELS) - 1, int(math.log2(max(1, step_x * TEXTURE_SCALE / TEXELS))))
        texels = TEXTURE_SCALE / LEVELS[level]
        cos, sin = math.cos(angle) * texels, math.sin(angle) * texels
        # From the first pixel's centre to the hull, in the camera's axes.
        right, up = (0.5 - HULL_COLUMN) * step_x, (HULL_ROW - 0.5) * step_y
        x = (position[0] + reference.PLAYFIELD) * texels + cos * right - sin * up - 0.5
        y = (position[1] + reference.PLAYFIELD) * texels + sin * right + cos * up - 0.5
        matrix = np.array(((cos * step_x, sin * step_y, x), (sin * step_x, -cos * step_y, y)))
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        cv2.warpAffine(self.levels[level], matrix, (OBSERVATION_SIZE, BAR_TOP), view, flags)


def darkened(color: Iterable[float]) -> list[int]:
    """A colour of Gymnasium's as it comes out of pygame's smoothscale."""
    return [max(0, int(c) - DARKENING) for c in color]


def on_texture(polygons: np.ndarray) -> np.ndarray:
    """Polygons (..., 2) in world units as OpenCV wants them on the texture."""
    return to_fixed_point((polygons + reference.PLAYFIELD) * TEXTURE_SCALE)


@functools.lru_cache(maxsize=1)
def empty_field(ground: tuple[int, ...], grass: tuple[int, ...]) -> np.ndarray:
    """Ground and grass without a road."""
    texture = np.full((TEXTURE_SIZE, TEXTURE_SIZE, 3), ground, np.uint8)
    side = reference.GRASS_DIM * TEXTURE_SCALE
    for row in range(0, 40, 2):
        for column in range(0, 40, 2):
            corner = (round(column * side), round(row * side))
            opposite = (round((column + 1) * side) - 1, round((row + 1) * side) - 1)
            cv2.rectangle(texture, corner, opposite, grass, cv2.FILLED)
    return texture


def draw_car(view: np.ndarray, car: car_dynamics.Car, zoom: float) -> None:
    """Draw the car into `view` (84, 96, 3), four quarters with a wheel each, as the camera of `Ground.look` sees it."""
    angle = car.hull.angle
    overlay = np.empty((2, 2 * QUARTER_ROWS, 2 * QUARTER_COLUMNS, 3), np.float32)
    for place, wheel in enumerate(car.wheels):
        turn = round((wheel.angle - angle) * TURN_STEPS)
        phase = math.floor(wheel.phase * PHASE_STEPS / math.tau) % PHASE_STEPS
        overlay[QUARTERS[place]] = quarter_picture(place, turn, phase, zoom)
    area = view[CAR_AREA]
    area[:] = area * overlay[0] + overlay[1]


def rectangle(half_width: float, low: float, high: float) -> np.ndarray:
    """Corners of a rectangle around the y axis, (4, 2)."""
    return np.array(
        [(-half_width, high), (half_width, high), (half_width, low), (-half_width, low)]
    )


@functools.lru_cache(maxsize=10_000)  # pictures of 0.6 kB
def quarter_picture(place: int, turn: int, phase: int, zoom: float) -> np.ndarray:
    """A quarter of the car with one wheel.

    Args:
        place: of the wheel: front left, front right, rear left, rear right.
        turn: its angle to the hull in 1/24 radian, positive to the left.
        phase: its rotation in 1/32 of a turn.
        zoom: as in `Ground.look`.

    Returns:
        float32 (2, 6, 4, 3): by what to multiply the ground, and what to add to it.
    """
    angle = turn / TURN_STEPS
    rotation = np.array([(math.cos(angle), math.sin(angle)), (-math.sin(angle), math.cos(angle))])
    middle = np.array(car_dynamics.WHEELPOS[place]) * car_dynamics.SIZE
    shapes = [
        (
            rectangle(WHEEL_HALF_WIDTH, -WHEEL_RADIUS, WHEEL_RADIUS) @ rotation + middle,
            car_dynamics.WHEEL_COLOR,
        )
    ]
    mark = wheel_mark((phase + 0.5) * math.tau / PHASE_STEPS)
    if mark:
        shapes.append(
            (rectangle(WHEEL_HALF_WIDTH, *mark) @ rotation + middle, car_dynamics.WHEEL_WHITE)
        )
    shapes += [(polygon, HULL_COLOR) for polygon in HULL_POLYGONS]
    rows, columns = FINE * QUARTER_ROWS, FINE * QUARTER_COLUMNS
    scale = zoom * FINE * OBSERVATION_SIZE / np.array([reference.WINDOW_W, -reference.WINDOW_H])
    corner = np.array([columns * (place % 2 == 0), rows * (place < 2)])
    canvas = np.zeros(
        (rows, columns, 4), np.uint8
    )  # red, green, blue, and how much of the ground is covered
    for polygon, color in shapes:
        cv2.fillConvexPoly(
            canvas,
            to_fixed_point(polygon * scale + corner),
            [*darkened(color), 255],
            cv2.LINE_8,
            SHIFT,
        )
    small = cv2.resize(
        canvas, (QUARTER_COLUMNS, QUARTER_ROWS), interpolation=cv2.INTER_AREA
    ).astype(np.float32)
    return np.stack(
        [np.repeat(1 - small[..., 3:] / 255, 3, axis=2), small[..., :3] + 0.5]
    )  # + 0.5: rounds, not cuts


def wheel_mark(phase: float) -> tuple[float, float] | None:
    """The light stripe on a turning wheel, from where to where along the wheel; None while it is underneath."""
    sin1, sin2 = math.sin(phase), math.sin(phase + 1.2)
    cos1, cos2 = math.cos(phase), math.cos(phase + 1.2)
    if sin1 > 0 and sin2 > 0:
        return None
    if sin1 > 0:
        cos1 = math.copysign(1, cos1)
    if sin2 > 0:
        cos2 = math.copysign(1, cos2)
    return cos2 * WHEEL_RADIUS, cos1 * WHEEL_RADIUS


def to_fixed_point(points: np.ndarray) -> np.ndarray:
    """Pixel coordinates as OpenCV's polygons want them; its pixel (0, 0) has its centre there, ours at (0.5, 0.5)."""
    return np.round((points - 0.5) * 2**SHIFT).astype(np.int32)


def draw_bar(bar: np.ndarray, car: car_dynamics.Car, reward: float) -> None:
    """Draw the score and seven gauges into `bar`, uint8 (12, 96, 3): speed, wheel speeds, steering angle, yaw rate."""
    values = [0.02 * math.hypot(*car.hull.linearVelocity)]
    values += [0.01 * wheel.omega for wheel in car.wheels]
    values += [-10.0 * car.wheels[0].joint.angle, -0.8 * car.hull.angularVelocity]
    bar[:] = score_picture(f"{reward:04.0f}")
    for number, (value, unit) in enumerate(zip(values, GAUGE_UNITS, strict=True)):
        np.maximum(bar, gauge_picture(number, round(max(-40.0, min(40.0, value)) * unit)), out=bar)


def shrink_bar(surface: pygame.Surface) -> np.ndarray:
    """Shrink a 1000 x 100 drawing of the bar to uint8 (12, 96, 3), as Gymnasium shrinks its window."""
    small = pygame.transform.smoothscale(surface, (OBSERVATION_SIZE, OBSERVATION_SIZE - BAR_TOP))
    return np.ascontiguousarray(pygame.surfarray.array3d(small).transpose(1, 0, 2))


def bar_surface() -> pygame.Surface:
    """The bar in Gymnasium's window; depth 24 without alpha, as the window has where there is no display."""
    return pygame.Surface((reference.WINDOW_W, reference.WINDOW_H // 8), depth=24)


@functools.lru_cache(maxsize=4096)
def score_picture(text: str) -> np.ndarray:
    """The bar with nothing but the score: uint8 (12, 96, 3)."""
    pygame.font.init()
    surface = bar_surface()
    label = pygame.font.Font(pygame.font.get_default_font(), 42).render(
        text, True, (255, 255, 255), (0, 0, 0)
    )
    middle = reference.WINDOW_H * (5 - 2.5) / 40
    surface.blit(label, label.get_rect(center=(60, middle)))
    return shrink_bar(surface)


@functools.lru_cache(maxsize=4096)
def gauge_picture(number: int, length: int) -> np.ndarray:
    """The bar with nothing but gauge `number`, `length` pixels long in the window: uint8 (12, 96, 3)."""
    place, color, vertical = GAUGES[number]
    surface = bar_surface()
    s, h, bottom = reference.WINDOW_W / 40, reference.WINDOW_H / 40, reference.WINDOW_H / 8
    if vertical:
        x1, x2, y1, y2 = place * s, (place + 1) * s, bottom - h - length, bottom - h
    else:
        x1, x2, y1, y2 = place * s, place * s + length, bottom - 4 * h, bottom - 2 * h
    if length:
        pygame.draw.polygon(surface, color, [(x1, y1), (x2, y1), (x2, y2), (x1, y2)])
    return shrink_bar(surface)


def place_car(
    env: gym.Env, tile: int, speed: float = 0.0, turn: float = 0.0, offset: float = 0.0
) -> np.ndarray:
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
        wheel.position = car_racing.car.hull.GetWorldPoint(
            (x * car_dynamics.SIZE, y * car_dynamics.SIZE)
        )
    for body in car_racing.car.drawlist:
        body.linearVelocity = (-math.sin(heading) * speed, math.cos(heading) * speed)
    for wheel in car_racing.car.wheels:
        wheel.omega = speed / wheel.wheel_rad
    car_racing.t = max(car_racing.t, 1.0)
    return car_racing._render("state_pixels")


gym.register(FAST_ID, entry_point=FastCarRacing, max_episode_steps=MAX_FRAMES, reward_threshold=900)
