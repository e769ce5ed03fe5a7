"""A batch of CarRacing episodes without pictures: tracks, random numbers and physics together."""

from collections.abc import Iterable, Sequence

import numpy as np
from gymnasium.utils import seeding

from stad_lab.envs import physics
from stad_lab.envs.track import Track, make_track

# Steering, gas and brake of Gymnasium's five discrete actions: nothing, right, left, gas, brake.
# The
# zeros of the steering are negative, since it is negated: Gymnasium's own come out as +0.
DISCRETE_ACTIONS = np.array(
    [[-0.0, 0, 0], [0.6, 0, 0], [-0.6, 0, 0], [-0.0, 0.2, 0], [-0.0, 0, 0.8]], np.float64
)


class Cars:
    """`count` independent cars, each on its own track, with the rules of Gymnasium's CarRacing-v3.

    Threads may call `reset` and `step` at once on different cars: nothing is shared between cars,
    and the compiled code releases the GIL. Ended episodes are not restarted.

    Args:
        count: number of cars.
        continuous: whether actions are float (n, 3), steering -1 to 1, gas and brake 0 to 1; else
            they are int (n,), 0 to 4.
        lap_complete_percent: as in Gymnasium, from 0 to 1. Since the car starts on tile 0, all
            tiles must be visited to finish a lap, unless this share is that of a few tiles only.
        domain_randomize: whether each episode has its own random colours.

    Attributes:
        cars: `physics.CAR` (count,), the state of each car; see there.
        roads: `physics.ROAD` (count,), the tiles of each car's track, and which are visited.
        tracks: the track of each car.
        randoms: the random generator of each car, Gymnasium's `np_random`.
        road_colors, background_colors, grass_colors: float64 (count, 3), 0 to 255.
    """

    def __init__(
        self,
        count: int,
        continuous: bool = True,
        lap_complete_percent: float = 0.95,
        domain_randomize: bool = False,
    ):
        self.continuous = continuous
        self.lap_complete_percent = lap_complete_percent
        self.domain_randomize = domain_randomize
        self.cars = np.zeros(count, physics.CAR)
        self.roads = np.zeros(count, physics.ROAD)
        self.tracks: list[Track | None] = [None] * count
        self.randoms = [seeding.np_random()[0] for _ in range(count)]
        self.road_colors = np.tile([102.0, 102, 102], (count, 1))
        self.background_colors = np.tile([102.0, 204, 102], (count, 1))
        self.grass_colors = np.tile([102.0, 230, 102], (count, 1))
        if domain_randomize:
            for car in range(count):
                self._draw_colors(car)

    def reset(
        self,
        seeds: Sequence[int | None] | None = None,
        which: Iterable[int] | None = None,
        randomize: bool = True,
    ) -> None:
        """Begin new episodes.

        Args:
            seeds: for each of these cars, its seed, or None to go on with its random numbers.
            which: numbers of the cars; all by default.
            randomize: whether to draw new colours, where `domain_randomize` is set.
        """
        which = list(range(len(self.cars)) if which is None else which)
        seeds = [None] * len(which) if seeds is None else seeds
        for car, seed in zip(which, seeds, strict=True):
            if seed is not None:
                self.randoms[car] = seeding.np_random(int(seed))[0]
            if self.domain_randomize and randomize:
                self._draw_colors(car)
            track = self.tracks[car] = make_track(self.randoms[car])
            physics.start_car(
                self.cars,
                self.roads,
                car,
                track.path,
                track.tiles,
                float(self.lap_complete_percent),
            )

    def step(self, actions: np.ndarray, part: slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        """Drive cars for one frame of 1/50 second.

        Args:
            actions: one for each of these cars, see the class.
            part: which cars, in steps of one; all by default.

        Returns:
            rewards: float64 (n,).
            terminated: bool (n,). `cars["ending"]` says whether by a finished lap or off the field.

        Raises:
            ValueError: an action that is not finite or not one of the five, or a wrong shape.
        """
        cars, roads = self.cars[part], self.roads[part]
        if self.continuous:
            actions = np.ascontiguousarray(actions, np.float64)
            if actions.shape != (len(cars), 3) or not np.isfinite(actions).all():
                raise ValueError(
                    f"actions of shape {actions.shape}: expected finite numbers ({len(cars)}, 3), "
                    "steering, gas and brake"
                )
        else:
            numbers = np.asarray(actions)
            if numbers.shape != (len(cars),) or not np.isin(numbers, range(5)).all():
                raise ValueError(f"actions {numbers}: expected {len(cars)} numbers, each 0 to 4")
            actions = DISCRETE_ACTIONS[numbers.astype(np.int64)]
        rewards = np.empty(len(cars))
        physics.step_cars(cars, roads, actions, rewards)
        return rewards, cars["ending"] != physics.DRIVING

    def _draw_colors(self, car: int) -> None:
        random = self.randoms[car]
        self.road_colors[car] = random.uniform(0, 210, size=3)
        self.background_colors[car] = random.uniform(0, 210, size=3)
        self.grass_colors[car] = self.background_colors[car]
        self.grass_colors[car, random.integers(3)] += 20
