"""Our engine and Gymnasium's own CarRacing-v3 side by side: the same episode in both."""

import numpy as np

from stad_lab.config import track_seeds
from stad_lab.envs.car_racing import MAX_FRAMES, CarRacing, make_env, place_car
from stad_lab.envs.cars import Cars
from stad_lab.envs.frames import BAR_TOP, to_frame
from stad_lab.envs.picture import HULL_COLUMN, HULL_ROW
from stad_lab.training.dataset import RandomDriver

CAR_WINDOW = (slice(HULL_ROW - 12, HULL_ROW + 12), slice(HULL_COLUMN - 12, HULL_COLUMN + 12))
AREAS = ["whole picture", "window of 24 x 24 around the car", "indicator bar"] + [
    f"{frame} against to_frame of {seen} observation"
    for frame in ("cropped frame", "frame")
    for seen in ("our", "Gymnasium's")
]


def compare_pictures(number: int, frames: int = MAX_FRAMES) -> tuple[np.ndarray, bool]:
    """One random episode in both environments, the odd ones from a random tile.

    Returns:
        Mean absolute differences (pictures, 7), as in AREAS; and whether all rewards and endings
        were bit-identical.
    """
    rng, envs = np.random.default_rng(number), [make_env(), make_env(fast=False)]
    seed, fast, driver = track_seeds("test", 20)[number], envs[0].unwrapped, RandomDriver(rng)
    assert isinstance(fast, CarRacing)
    seen, equal, ended = [env.reset(seed=seed)[0] for env in envs], True, False
    if number % 2:
        start = int(rng.integers(10_000)), rng.uniform(0, 90), 0.15 * rng.standard_normal()
        seen = [place_car(env, *start) for env in envs]
    errors = [measure_differences(fast.cars, *seen)]
    while len(errors) <= frames and not ended:
        action = driver.act()
        steps = [env.step(action) for env in envs]
        equal &= steps[0][1:] == steps[1][1:]
        ended = any(step[2] or step[3] for step in steps)
        errors.append(measure_differences(fast.cars, steps[0][0], steps[1][0]))
    return np.array(errors), equal


def measure_differences(cars: Cars, ours: np.ndarray, theirs: np.ndarray) -> list[float]:
    """Differences between observations of a car, and from its frames, in the order of AREAS."""
    places = (..., CAR_WINDOW, slice(BAR_TOP, None))
    pairs = [(ours[place], theirs[place]) for place in places]
    for bar in (False, True):
        cars.shows, cars.bar = "frame", bar
        frame = cars.draw()[0]
        pairs += [(frame, to_frame(seen, crop_bar=not bar)) for seen in (ours, theirs)]
    cars.shows = "observation"
    return [float(np.abs(one.astype(np.int16) - other).mean()) for one, other in pairs]
