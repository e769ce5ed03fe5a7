"""What a car may observe beside its usual picture: other sizes, its state, the whole track."""

import gymnasium as gym
import numpy as np
import pygame

from stad_lab.envs.arguments import choice, whole_number
from stad_lab.envs.cars import Cars
from stad_lab.envs.frames import BAR_TOP, OBSERVATION_SIZE
from stad_lab.envs.state import STATE, observe_state
from stad_lab.envs.window import Window, road_of

VIEWS = ("picture", "state", "above")
SIZES = (32, 512)  # smallest and largest picture, pixels
FINER = 2  # a picture from above is drawn so many times larger, and scaled down
MARGIN = 0.04  # of it around the track
CAR_COLOR, CAR_SHARE = (204, 0, 0), 0.014  # of the car from above: radius, share of the picture


class View:
    """How cars see: "picture", "state" or "above", and how large; see `CarRacing`.

    Attributes:
        space: of the observations of one car.

    Raises:
        ValueError: another view, or a size that is not 32 to 512.
    """

    def __init__(self, observes: str, size: int, bar: bool = True):
        choice("observes", observes, VIEWS)
        self.observes, self.size, self.bar = observes, whole_number("size", size, *SIZES), bar
        self.window: Window | None = None
        self.space: gym.Space = gym.spaces.Box(0, 255, (self.size, self.size, 3), np.uint8)
        if observes == "state":
            self.space = gym.spaces.Box(-np.inf, np.inf, (len(STATE),), np.float32)

    def look(self, cars: Cars, which: np.ndarray | None = None) -> np.ndarray:
        """The observations of some cars, or of all, one to a row; see `space`."""
        if self.observes == "picture" and self.size == OBSERVATION_SIZE:
            return cars.draw(which)
        which = np.arange(len(cars)) if which is None else which
        if self.observes == "state":
            return observe_state(cars, which)
        if self.observes == "above":
            return np.stack([draw_above(cars, car, self.size) for car in which.tolist()])
        return np.stack([self._draw(cars, car) for car in which.tolist()])

    def close(self) -> None:
        """Release the window that pictures of other sizes are drawn in."""
        if self.window is not None:
            self.window.close()
            self.window = None

    def _draw(self, cars: Cars, car: int) -> np.ndarray:
        self.window = self.window or Window("state_pixels")
        picture = self.window.picture(cars, car, self.size)
        if not self.bar:
            picture[self.size * BAR_TOP // OBSERVATION_SIZE :] = 0
        return picture


def draw_above(cars: Cars, car: int, size: int) -> np.ndarray:
    """A car, in red, and its whole track from above: uint8 (size, size, 3), north is up."""
    polygons, whole = road_of(cars, car), FINER * size
    corners = np.concatenate([corners for corners, _ in polygons])
    low, high = corners.min(axis=0), corners.max(axis=0)
    scale = whole * (1 - 2 * MARGIN) / (high - low).max()

    def place(points: np.ndarray) -> np.ndarray:
        return whole / 2 + (np.asarray(points) - (low + high) / 2) * scale * (1, -1)

    surface = pygame.Surface((whole, whole), depth=24)
    surface.fill(cars.colors["background"][car].astype(int).tolist())
    for shape, color in polygons:
        pygame.draw.polygon(surface, np.asarray(color, int).tolist(), place(shape).tolist())
    state = cars.cars[car]
    centre, radius = place(state["position"][0]), max(2.0, CAR_SHARE * whole)
    nose = np.array([-np.sin(state["angle"][0]), -np.cos(state["angle"][0])])
    left = np.array([nose[1], -nose[0]])
    shape = [centre + 2 * radius * nose, centre - radius * (nose + left)]
    shape.append(centre - radius * (nose - left))
    pygame.draw.polygon(surface, CAR_COLOR, np.array(shape).tolist())
    small = pygame.transform.smoothscale(surface, (size, size))
    return pygame.surfarray.array3d(small).transpose(1, 0, 2).copy()
