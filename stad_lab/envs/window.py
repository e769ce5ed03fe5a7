"""Gymnasium's own window for the cars of our engine: any size of picture, and films."""

import numpy as np
from gymnasium.envs.box2d import car_dynamics
from gymnasium.envs.box2d import car_racing as reference

from stad_lab.envs import picture
from stad_lab.envs.cars import Cars, road_polygons
from stad_lab.envs.track import tile_colors


class Window:
    """Draws a car in the window of Gymnasium's own environment, without skid marks."""

    def __init__(self, mode: str):
        self.mode = mode
        self.env = reference.CarRacing(render_mode=mode)
        self.env.car = None

    def draw(self, cars: Cars, car: int = 0) -> np.ndarray | None:
        """Draw the state of a car with Gymnasium's code, and return what its `render` returns."""
        env, state = self.env, cars.cars[car]
        env.t, env.reward = float(state["time"]), float(state["reward"])
        env.road_color, env.bg_color, env.grass_color = (
            cars.colors[name][car] for name in ("road", "background", "grass")
        )
        env.road_poly = road_of(cars, car)
        if env.car is None:
            env.car = car_dynamics.Car(env.world, 0.0, 0.0, 0.0)
        for body, (position, angle) in zip(
            [env.car.hull, *env.car.wheels],
            zip(state["position"].tolist(), state["angle"].tolist(), strict=True),
            strict=True,
        ):
            body.position, body.angle = position, angle
        env.car.hull.linearVelocity = state["velocity"][0, :2].tolist()
        env.car.hull.angularVelocity = float(state["velocity"][0, 2])
        for wheel, omega, phase in zip(
            env.car.wheels, state["omega"].tolist(), state["phase"].tolist(), strict=True
        ):
            wheel.omega, wheel.phase = omega, phase
        return env._render(self.mode)

    def picture(self, cars: Cars, car: int, size: int) -> np.ndarray:
        """What Gymnasium shows of a car, uint8 (size, size, 3); the mode is "state_pixels"."""
        self.draw(cars, car)
        return self.env._create_image_array(self.env.surf, (size, size))

    def close(self) -> None:
        """Release the window."""
        self.env.close()


def road_of(cars: Cars, car: int = 0) -> list[tuple]:
    """Polygons and colours of the road of a car, as Gymnasium's `road_poly`."""
    track, road, color = cars.tracks[car], cars.roads[car], cars.colors["road"][car]
    colors = tile_colors(len(track.tiles), color)
    colors[road["darkened"][: len(colors)] > 0] = color
    polygons, kinds = road_polygons(track)
    kerbs, tiles = {picture.WHITE: (255, 255, 255), picture.RED: (255, 0, 0)}, iter(colors.tolist())
    return [
        (corners, kerbs.get(kind) or next(tiles))
        for corners, kind in zip(polygons.tolist(), kinds.tolist(), strict=True)
    ]
