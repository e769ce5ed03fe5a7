"""A batch of CarRacing episodes: tracks, random numbers, physics and pictures together."""

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding

from stad_lab.envs import physics, picture
from stad_lab.envs.arguments import (
    car_numbers,
    choice,
    finite_number,
    is_whole,
    numbers,
    shown,
    whole_number,
)
from stad_lab.envs.compiling import announced
from stad_lab.envs.frames import FRAME_SIZE, OBSERVATION_SIZE
from stad_lab.envs.own_track import Checkpoints, make_own_track
from stad_lab.envs.track import MAX_TILES, TRACK_WIDTH, Track, make_track

# Steering, gas and brake of Gymnasium's five discrete actions: nothing, right, left, gas, brake.
# Steering is negated, so its zeros are negative: Gymnasium's own come out as +0.
DISCRETE_ACTIONS = np.array(
    [[-0.0, 0, 0], [0.6, 0, 0], [-0.6, 0, 0], [-0.0, 0.2, 0], [-0.0, 0, 0.8]], np.float64
)
MOST_CARS = 100_000  # 5 MB each
SIZES = {"observation": OBSERVATION_SIZE, "frame": FRAME_SIZE}  # of the pictures, pixels
COLORS = {"road": (102, 102, 102), "background": (102, 204, 102), "grass": (102, 230, 102)}


class Cars:
    """`count` independent cars, each on its own track, with the rules of Gymnasium's CarRacing-v3.

    Threads may work at once on different `Cars`; the compiled code releases the GIL. An episode
    that has ended is not restarted, and none ends by time.

    Args:
        count: number of cars, 1 to 100,000.
        shows: what `draw` draws: "observation", uint8 (96, 96, 3), or "frame", the agent's, uint8
            (64, 64, 3). Memory for the pictures, 5 MB a car, is taken at the first `draw`.
        bar: whether to draw the indicator bar. Without it the lowest rows of an observation are
            black, and a frame shows the rest.
        continuous: whether actions are float (n, 3), steering -1 to 1, gas and brake 0 to 1; or
            int (n,), 0 to 4.
        lap_complete_percent: as in Gymnasium, from 0 to 1.
        domain_randomize: whether each episode has its own random colours.
        track: checkpoints of a track for all episodes, see `own_track`; None for that of a seed.

    Raises:
        ValueError: another `count` or `shows`, or as `check_rules` and `make_own_track`.
        OSError: as `make_own_track`.

    Attributes:
        cars: `physics.CAR` (count,), the state of each car; see there.
        roads: `physics.ROAD` (count,), the tiles of each track, and which were visited.
        tracks: the Track of each car.
        randoms, seeds: the random generator of each car and its seed, Gymnasium's `np_random` and
            `np_random_seed`.
        ground: the painted tracks, a `picture.Ground`; None before the first `draw`.
        colors: "road", "background" and "grass", float64 (count, 3), 0 to 255.
    """

    def __init__(
        self,
        count: int,
        shows: str = "observation",
        bar: bool = True,
        continuous: bool = True,
        lap_complete_percent: float = 0.95,
        domain_randomize: bool = False,
        track: Checkpoints | None = None,
    ):
        check_rules(continuous, lap_complete_percent, domain_randomize, bar)
        count = whole_number("count", count, 1, MOST_CARS)
        choice("shows", shows, SIZES)
        warm_up()
        self.shows, self.bar, self.continuous = shows, bar, continuous
        self.lap_complete_percent = float(lap_complete_percent)
        self.domain_randomize = domain_randomize
        self.own_track = None if track is None else make_own_track(track)
        self.cars, self.roads = np.zeros(count, physics.CAR), np.zeros(count, physics.ROAD)
        self.tracks: list[Track] = [None] * count  # type: ignore[list-item]  # until reset
        randoms = [seeding.np_random() for _ in range(count)]
        self.randoms, self.seeds = map(list, zip(*randoms, strict=True))
        self.colors = {
            name: np.tile(np.array(one, float), (count, 1)) for name, one in COLORS.items()
        }
        self._tiles = np.zeros((count, MAX_TILES, 4, 2))
        self._painted, self._begun = np.zeros((2, count), bool)
        self.ground: picture.Ground | None = None
        for car in range(count if domain_randomize else 0):
            self._draw_colors(car)

    def __len__(self) -> int:
        return len(self.cars)

    def reset(
        self,
        seeds: Sequence[int | None] | None = None,
        which: Sequence[int] | np.ndarray | None = None,
        randomize: bool = True,
    ) -> None:
        """Begin new episodes.

        Args:
            seeds: for each of these cars a whole number from 0 on, or None to go on with its
                random numbers.
            which: numbers of the cars; all by default.
            randomize: whether to draw new colours, with `domain_randomize`.

        Raises:
            ValueError: other seeds, another number of them, or a car that is not there.
        """
        chosen = self._numbers(which).tolist()
        for car, seed in zip(chosen, check_seeds(seeds, len(chosen)), strict=True):
            if seed is not None:
                self.randoms[car], self.seeds[car] = seeding.np_random(seed)
            if self.domain_randomize and randomize:
                self._draw_colors(car)
            track = self.tracks[car] = self.own_track or make_track(self.randoms[car])
            share = self.lap_complete_percent
            physics.start_car(self.cars, self.roads, car, track.path, track.tiles, share)
            self._tiles[car, : len(track.tiles)] = track.tiles
            self._painted[car], self._begun[car] = False, True

    def step(
        self, actions: np.ndarray, which: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Drive cars for one frame of 1/50 second.

        Args:
            actions: one for each of these cars, see the class.
            which: int64 (n,), numbers of the cars; all by default.

        Returns:
            The rewards, float64 (n,), and whether the episodes have ended, bool (n,);
            `cars["ending"]` says how.

        Raises:
            ValueError: an action that is not finite or not one of the five, a wrong shape, or a car
                that is not there.
            RuntimeError: a car that no `reset` has given a track.
        """
        which = self._started(which)
        rewards, actions = np.empty(len(which)), self._checked(actions, len(which))
        physics.step_cars(self.cars, self.roads, which, actions, rewards)
        return rewards, self.cars["ending"][which] != physics.DRIVING

    def draw(self, which: np.ndarray | None = None) -> np.ndarray:
        """What cars see, uint8 (n, 96, 96, 3) or (n, 64, 64, 3); `which`, errors as for `step`."""
        which = self._started(which)
        if self.ground is None:
            self.ground = picture.make_ground(len(self))
        for car in which[~self._painted[which]]:
            self._paint(car)
        size = SIZES[self.shows]
        out = np.empty((len(which), size, size, 3), np.uint8)
        arrays = which, self.cars, self.roads, self._tiles
        picture.draw_cars(out, self.ground, picture.make_pictures(), *arrays, self.bar)
        return out

    def place(
        self, car: int, tile: int, speed: float = 0.0, turn: float = 0.0, offset: float = 0.0
    ) -> None:
        """Put a car on a tile of its track, moving, with the opening zoom behind it.

        From tile 0, where CarRacing starts, a random driver sees little more than the first bend.

        Args:
            tile: number of the tile, modulo their count.
            speed: forward, world units per second (a calm lap has about 40).
            turn: heading against the road's direction, radians, positive to the left.
            offset: from the centre line, in half road widths, positive to the right.

        Raises:
            ValueError: a car that is not there, a tile that is not a whole number, or another
                number that is not finite.
            RuntimeError: as for `step`.
        """
        car = whole_number("car", car, 0, len(self) - 1)
        self._started([car])
        pose = pose_on(self.tracks[car].path, tile, turn, offset)
        physics.place_car(self.cars, car, *pose, finite_number("speed", speed))

    def _numbers(self, which: Sequence[int] | np.ndarray | None) -> np.ndarray:
        return car_numbers(which, len(self))

    def _started(self, which: Sequence[int] | np.ndarray | None) -> np.ndarray:
        which = self._numbers(which)
        if not self._begun[which].all():
            raise RuntimeError("a car has no track yet: call reset first")
        return which

    def _checked(self, actions: np.ndarray, count: int) -> np.ndarray:
        if self.continuous:
            found = numbers("actions", actions, f"numbers of shape ({count}, 3)")
            actions = np.ascontiguousarray(found, np.float64)
            if actions.shape != (count, 3) or not np.isfinite(actions).all():
                raise ValueError(
                    f"actions {shown(actions)}: expected finite numbers of shape ({count}, 3),"
                    " steering, gas and brake"
                )
            return actions
        kinds = numbers("actions", actions, f"{count} numbers, each 0 to 4")
        if kinds.shape != (count,) or not np.isin(kinds, range(len(DISCRETE_ACTIONS))).all():
            raise ValueError(f"actions {shown(kinds)}: expected {count} numbers, each 0 to 4")
        return DISCRETE_ACTIONS[kinds.astype(np.int64)]

    def _paint(self, car: int) -> None:
        polygons, kinds = road_polygons(self.tracks[car])
        colors = [self.colors[name][car] for name in ("background", "grass", "road")]
        picture.paint(self.ground, car, polygons, kinds, picture.ground_colors(*colors))
        road = self.roads[car : car + 1]["darkened"]
        road[road == 2] = 1  # what an earlier picture of this episode had painted
        self._painted[car] = True

    def _draw_colors(self, car: int) -> None:
        random = self.randoms[car]
        self.colors["road"][car] = random.uniform(0, 210, size=3)
        self.colors["background"][car] = random.uniform(0, 210, size=3)
        self.colors["grass"][car] = self.colors["background"][car]
        self.colors["grass"][car, random.integers(3)] += 20


def check_rules(
    continuous: bool = True,
    lap_complete_percent: float = 0.95,
    domain_randomize: bool = False,
    bar: bool = True,
) -> None:
    """Raise ValueError for another share of a lap than 0 to 1, or a switch that is no bool."""
    switches = {"continuous": continuous, "domain_randomize": domain_randomize, "bar": bar}
    for name, value in switches.items():
        if not isinstance(value, bool | np.bool_):
            raise ValueError(f"{name}={shown(value)}: expected True or False")
    number = isinstance(lap_complete_percent, int | float | np.number)
    if isinstance(lap_complete_percent, bool) or not number or not 0 <= lap_complete_percent <= 1:
        raise ValueError(f"lap_complete_percent={shown(lap_complete_percent)}: expected 0 to 1")


def seeds_of(seed: int | Sequence[int | None] | None, count: int) -> list[int | None]:
    """The seeds of `count` cars: n means n, n + 1, ...; others as `check_seeds`."""
    if is_whole(seed):
        first = whole_number("seed", seed)
        return list(range(first, first + count))
    return check_seeds(seed, count)


def check_seeds(seeds: Any, count: int) -> list[int | None]:
    """A seed for each of `count` cars, or None. ValueError for another number or kind of them."""
    if seeds is None:
        return [None] * count
    if isinstance(seeds, np.ndarray) and seeds.ndim:
        seeds = list(seeds)
    if not isinstance(seeds, Sequence) or isinstance(seeds, str | bytes):
        raise ValueError(f"seeds={shown(seeds)}: expected {count} seeds, one for each car")
    if len(seeds) != count:
        raise ValueError(f"{len(seeds)} seeds for {count} cars: expected one for each")
    return [None if seed is None else whole_number("seed", seed) for seed in seeds]


def pose_on(
    path: Sequence | np.ndarray, tile: int, turn: float, offset: float
) -> tuple[float, float, float]:
    """Heading, x and y of a car that `Cars.place` puts on a tile of a track's centre line."""
    if not is_whole(tile):
        raise ValueError(f"tile={shown(tile)}: expected a whole number")
    turn = finite_number("turn", turn)
    _, beta, x, y = path[tile % len(path)]
    across = finite_number("offset", offset) * TRACK_WIDTH
    x, y = x + across * np.cos(beta), y + across * np.sin(beta)
    return float(beta + turn), float(x), float(y)


def road_polygons(track: Track) -> tuple[np.ndarray, np.ndarray]:
    """Tiles and kerbs in the order in which Gymnasium draws them: a kerb follows its tile.

    Returns:
        Corners, float64 (n, 4, 2), and kinds for `picture.paint`, uint8 (n,).
    """
    tiles, kerbs = np.arange(len(track.tiles)), track.kerb_tiles
    order = np.argsort(np.concatenate([tiles, kerbs + 0.5]))
    kinds = [picture.ROAD + tiles % picture.ROAD_SHADES]
    kinds.append(np.where(kerbs % 2, picture.RED, picture.WHITE))
    polygons = np.concatenate([track.tiles, track.kerbs])[order]
    return polygons, np.concatenate(kinds)[order].astype(np.uint8)


def warm_up() -> None:
    """Compile the engine, or load what was compiled before, once in this process."""
    global _warm
    with _warming:
        if _warm:
            return
        _warm = True  # for the cars below, which come back here
        with announced("from stad_lab.envs import cars; cars.compile_pictures()") as others:
            cars = Cars(1)
            cars.reset()
            cars.place(0, 0)
            cars.step(np.zeros((1, 3)))
            others.wait()
            compile_pictures()


def compile_pictures() -> None:
    """Compile what paints tracks and draws pictures, or load what was compiled before."""
    road, kinds = np.empty((0, 4, 2)), np.empty(0, np.uint8)
    ground, out = picture.make_ground(1), np.empty((1, FRAME_SIZE, FRAME_SIZE, 3), np.uint8)
    colors = picture.ground_colors(*np.array(list(COLORS.values()), float))
    picture.paint(ground, 0, road, kinds, colors)
    cars, roads = np.zeros(1, physics.CAR), np.zeros(1, physics.ROAD)
    arrays = np.arange(1), cars, roads, np.zeros((1, MAX_TILES, 4, 2))
    picture.draw_cars(out, ground, picture.make_pictures(), *arrays, True)


_warming, _warm = threading.RLock(), False
