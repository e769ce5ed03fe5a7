"""Physics, rewards and endings, side by side with Gymnasium's CarRacing-v3 and Box2D.

On Linux x86-64 every number must be equal to the last bit. On other platforms compilers and C
libraries round differently, so there only the first frames are compared, within a tolerance.
"""

import platform
from concurrent.futures import ThreadPoolExecutor

import gymnasium
import numpy as np
import pytest

from stad_lab.envs import physics
from stad_lab.envs.cars import Cars

EXACT = platform.system() == "Linux" and platform.machine() == "x86_64"
FRAMES = 1000 if EXACT else 20  # to compare in an episode
LEFT_RIGHT = np.array([-1.0, 1.0])


def pursue(car, x, y, gas, brake=0.0):
    """Steer towards a point; slow down in sharp bends."""
    angle = car["angle"][0] + np.pi / 2
    dx, dy = x - car["position"][0, 0], y - car["position"][0, 1]
    error = (np.arctan2(dy, dx) - angle + np.pi) % (2 * np.pi) - np.pi
    speed = np.hypot(*car["velocity"][0, :2])
    too_fast = speed > 70 / (1 + 4 * abs(error))
    return [np.clip(-2 * error, -1, 1), 0 if too_fast else gas, 0.3 if too_fast else brake]


def follow(car, track, ahead, gas):
    """Steer towards the point of the path so many tiles ahead of the nearest."""
    path = track.path[:, 2:]
    nearest = np.argmin(np.sum((path - car["position"][0]) ** 2, axis=1))
    return pursue(car, *path[(nearest + ahead) % len(path)], gas)


def smooth(frame, random, car, track):
    steering = np.sin(frame / 17 + random.normal() * 0.1)
    return [steering, 0.3 * (frame % 200 < 150), 0.4 * (frame % 200 >= 150)]


# From the number of a frame, random numbers, the car's record and the track to an action.
DRIVERS = {
    "random": lambda frame, random, car, track: random.uniform([-1, 0, 0], 1),
    "smooth": smooth,
    "full gas": lambda frame, random, car, track: [0, 1, 0],
    "full brake": lambda frame, random, car, track: [0.2, frame < 80, frame >= 80],
    "spinning on grass": lambda frame, random, car, track: [1 - 2 * (frame // 300 % 2), 1, 0],
    "standing still": lambda frame, random, car, track: [0, frame > 600, 0.0],
    "one wheel to the other": lambda frame, random, car, track: [
        random.choice(LEFT_RIGHT),
        random.choice(2),
        random.choice([0, 0, 0.5, 0.9]),
    ],
    "beyond the bounds": lambda frame, random, car, track: random.uniform(-3, 3, 3),
    "lap": lambda frame, random, car, track: follow(car, track, 5, 0.6),
    "lap backwards": lambda frame, random, car, track: follow(car, track, -5, 0.4),
    "off the field": lambda frame, random, car, track: pursue(car, 1000.0, 0.0, 0.5),
}


class Reference:
    """Gymnasium's environment without its picture."""

    def __init__(self, **kwargs):
        self.env = gymnasium.make("CarRacing-v3", **kwargs)
        self.world = self.env.unwrapped
        self.world._render = lambda mode: np.zeros((96, 96, 3), np.uint8)

    def bodies(self):
        """Float32 (5, 8): centre, angle, velocity, spin and position of the hull and the wheels."""
        bodies = [self.world.car.hull, *self.world.car.wheels]
        return np.array(
            [
                [*b.worldCenter, b.angle, *b.linearVelocity, b.angularVelocity, *b.position]
                for b in bodies
            ],
            np.float32,
        )

    def wheels(self):
        """Float64 (4, 7): what Gymnasium keeps about the wheels, and whether they are on a tile."""
        return np.array(
            [
                [w.omega, w.phase, w.gas, w.brake, w.steer, w.joint.angle, len(w.tiles) > 0]
                for w in self.world.car.wheels
            ]
        )


def bodies_of(car):
    return np.column_stack([car["center"], car["angle"], car["velocity"], car["position"]])


def wheels_of(car):
    joint_angle = car["angle"][1:] - car["angle"][0]
    names = ["omega", "phase", "gas", "brake", "steer"]
    return np.column_stack([car[name] for name in names] + [joint_angle, car["on_road"]])


def assert_equal(ours, theirs, what):
    """To the last bit, also the sign of a zero; elsewhere within a tolerance."""
    if EXACT:
        same = np.asarray(ours).tobytes() == np.asarray(theirs).tobytes()
        assert same, f"{what}: {ours} is not {theirs}"
    else:
        np.testing.assert_allclose(ours, theirs, atol=1e-3, err_msg=what)


def run_episode(reference, cars, driver, seed, frames=FRAMES, options=None):
    """Drive one episode in both; return the frames, the return and `ending`."""
    random = np.random.default_rng(1 if seed is None else seed)
    reference.env.reset(seed=seed, options=options)
    cars.reset([seed], randomize=(options or {}).get("randomize", True))
    car, road, total = cars.cars[0], cars.roads[0], 0.0
    done, frame = False, 0
    while not done and frame < frames:
        action = driver(frame, random, car, cars.tracks[0])
        if cars.continuous:
            action = np.array(action, np.float32)
        _, reward, terminated, truncated, info = reference.env.step(action)
        rewards, ended = cars.step(np.array([action]))
        where = f"frame {frame} of seed {seed}"
        if EXACT:
            assert rewards[0] == reward, where
            assert ended[0] == terminated, where
            assert (car["frames"] >= 1000) == truncated, where
            finished = info.get("lap_finished")
            assert {None: 0, True: 1, False: 2}[finished] == car["ending"], where
        assert_equal(bodies_of(car), reference.bodies(), where)
        assert_equal(wheels_of(car), reference.wheels(), where)
        total, frame, done = total + reward, frame + 1, terminated or truncated
    assert_equal(car["time"], reference.world.t, "time")
    if EXACT:
        compare_tiles(reference.world, cars, road)
    return frame, total, int(car["ending"])


def compare_tiles(world, cars, road):
    """Which tiles are visited, and which have changed colour."""
    count = len(world.road)
    assert road["tiles"] == count
    assert np.array_equal(road["visited"][:count], [tile.road_visited for tile in world.road])
    shaded = np.arange(count) % 3 > 0  # tiles whose first colour is not the road's
    darkened = [np.array_equal(tile.color, world.road_color) for tile in world.road]
    assert np.array_equal(road["darkened"][:count][shaded], np.array(darkened)[shaded])


@pytest.fixture(scope="module")
def reference():
    return Reference()


@pytest.fixture(scope="module")
def cars():
    return Cars(1)


@pytest.mark.parametrize("name", DRIVERS)
def test_an_episode_equals_gymnasiums_to_the_last_bit(name, reference, cars):
    # The environments are used again and again, so this tests resets, too.
    frames, total, ending = run_episode(reference, cars, DRIVERS[name], seed=3)
    assert frames == FRAMES or ending
    if EXACT and name == "lap":
        assert (ending, total > 850) == (physics.LAP_FINISHED, True)
    if EXACT and name == "off the field":
        assert ending == physics.LEFT_FIELD
        assert total < -50


@pytest.mark.long
@pytest.mark.parametrize("name", DRIVERS)
def test_two_hundred_episodes_equal_gymnasiums_to_the_last_bit(name, reference, cars):
    for seed in range(1000, 1019):
        run_episode(reference, cars, DRIVERS[name], seed)


def test_bodies_at_rest_fall_asleep_as_in_box2d(reference, cars):
    run_episode(reference, cars, DRIVERS["standing still"], seed=5, frames=40)
    car = cars.cars[0]
    if EXACT:
        assert np.all(car["rest"] < 0.5)
    assert np.abs(car["velocity"]).max() < 1e-3


def test_masses_and_polygons_are_box2ds(reference):
    reference.env.reset(seed=1)
    hull, wheel = reference.world.car.hull, reference.world.car.wheels[0]
    masses = [1 / np.float32(hull.mass), 1 / np.float32(wheel.mass)]
    assert_equal([physics.HULL_INV_MASS, physics.WHEEL_INV_MASS], masses, "1 / mass")
    assert_equal(np.array(physics.HULL_CENTER), np.array(hull.localCenter, np.float32), "centre")
    fixtures = [*hull.fixtures, *wheel.fixtures]
    for fixture, shape in zip(fixtures, [*physics.HULL_SHAPES, physics.WHEEL_SHAPE], strict=True):
        assert np.array_equal(np.array(fixture.shape.vertices, np.float32), shape)


def test_a_reset_without_a_seed_goes_on_with_the_random_numbers(reference, cars):
    run_episode(reference, cars, DRIVERS["random"], seed=8, frames=5)
    run_episode(reference, cars, DRIVERS["random"], seed=None, frames=5)
    assert np.array_equal(cars.tracks[0].path, np.array(reference.world.track))


def test_discrete_actions():
    cars, reference = Cars(1, continuous=False), Reference(continuous=False)
    for seed in range(3):
        run_episode(
            reference, cars, lambda frame, random, car, track: random.integers(5), seed, FRAMES // 2
        )


def test_domain_randomize():
    cars, reference = Cars(1, domain_randomize=True), Reference(domain_randomize=True)
    for seed, options in [(4, None), (None, None), (None, {"randomize": False})]:
        run_episode(reference, cars, DRIVERS["smooth"], seed, 100, options)
        assert np.array_equal(cars.colors["road"][0], reference.world.road_color)
        assert np.array_equal(cars.colors["background"][0], reference.world.bg_color)
        assert np.array_equal(cars.colors["grass"][0], reference.world.grass_color)


@pytest.mark.parametrize("share", [0.0, 0.005, 1.0])  # 0.005: more than one tile, less than two
def test_lap_complete_percent(share):
    cars = Cars(1, lap_complete_percent=share)
    reference = Reference(lap_complete_percent=share)
    frames, _, ending = run_episode(reference, cars, DRIVERS["lap"], seed=11)
    if EXACT:
        assert ending == physics.LAP_FINISHED
        assert (frames == 1) == (share < 1)


def test_a_batch_equals_single_cars_on_any_number_of_threads():
    random = np.random.default_rng(0)
    actions = random.uniform([-1, 0, 0], 1, (60, 6, 3))

    def drive(threads):
        cars = Cars(6)
        parts = np.split(np.arange(6), threads)

        def work(part):
            cars.reset(part.tolist(), part.tolist())
            return [cars.step(action[part], part)[0] for action in actions]

        with ThreadPoolExecutor(threads) as pool:
            return cars, np.concatenate(list(pool.map(work, parts)), axis=1)

    one, rewards = drive(1)
    for threads in (2, 6):
        several, same_rewards = drive(threads)
        assert np.array_equal(rewards, same_rewards)
        assert np.array_equal(one.cars, several.cars)
