"""Checks of the exercises to notebook 01. Each takes the student's function."""

from collections.abc import Callable

import numpy as np

from stad_course.checks.answers import WrongAnswer, agree, ask, check, check_interval, to_numpy
from stad_lab.envs.frames import earlier_index, episode_differences


def differences_values(differences: Callable) -> None:
    """All difference images of nine random frames, at stride 4."""
    film = np.random.default_rng(1).integers(0, 256, (9, 64, 64, 3), dtype=np.uint8)
    check_differences(differences, film, 4)


def differences_start(differences: Callable) -> None:
    """The first frames, which have no earlier one, and all others, at strides 1 and 2."""
    film = np.random.default_rng(2).integers(0, 256, (5, 64, 64, 3), dtype=np.uint8)
    for stride in (1, 2):
        found = check_differences(differences, film, stride)
        if found.dtype != np.float32:
            what, wrong = f"differences(film, {stride})", f"dtype {found.dtype}: expected float32"
            raise WrongAnswer(what, wrong, "NumPy divides in float64 unless told")


def check_differences(differences: Callable, film: np.ndarray, stride: int) -> np.ndarray:
    """Check the difference images of a film; returns the student's."""
    right, scaled = episode_differences(film, stride), film.astype(np.float32)
    before = film[earlier_index(np.arange(len(film)), stride)]
    rolled = (scaled - np.roll(scaled, stride, axis=0)) / 255
    mistakes = {
        "uint8 has no negative numbers, 3 - 5 is 254: convert to float first": (film - before)
        / 255,
        "the sign is turned round: subtract the earlier frame from the later": -right,
        "this is |d|, which has lost its sign: subtract, and take no absolute value": np.abs(right),
        "the frames are not scaled to [0, 1]: divide by 255": 255 * right,
        "you divided by 256: the largest value of a uint8 is 255": right * (255 / 256),
        "film[t - k] with t < k counts from the film's end, as np.roll does: d = 0 there": rolled,
        "the first k frames are missing: keep them, with d = 0": right[stride:],
        "before frame k film[0] was subtracted, as if it were earlier: d = 0 there": (
            scaled - scaled[np.maximum(np.arange(len(film)) - stride, 0)]
        )
        / 255,
    }
    if stride != 1:
        wrong = episode_differences(film, 1)
        mistakes["this is the stride k = 1: subtract film[t - stride]"] = wrong
    if stride != 4:
        wrong = episode_differences(film, 4)
        mistakes["the stride is not used: subtract film[t - stride]"] = wrong
    what = f"differences(film, {stride})"
    found = ask(what, differences, film, stride)
    later = slice(stride, None)  # a mistake there is named, whatever the first frames are
    array = to_numpy(found)
    if array.shape == right.shape and not agree(array[later], right[later], 1e-4):
        late = {hint: one[later] for hint, one in mistakes.items() if one.shape == right.shape}
        check(f"{what}[{stride}:]", array[later], right[later], late)
    check(what, found, right, mistakes)
    return found


def ask_motion(what: str, find_motion: Callable, *given: np.ndarray) -> np.ndarray:
    """The student's (turn, forward), an array (2,); WrongAnswer if they are not two numbers."""
    answer = ask(what, find_motion, *given)
    found = to_numpy(answer)
    if found.shape != (2,) or found.dtype.kind not in "iuf":
        raise WrongAnswer(what, f"it returned {answer!r}", "expected two numbers, (turn, forward)")
    return found


def find_motion_made_up(find_motion: Callable, move: Callable, earlier: np.ndarray) -> None:
    """The motion between a frame and the same frame, moved by the notebook's `move`."""
    turns, forwards = np.linspace(-0.2, 0.2, 9), np.linspace(-4, 4, 9)
    shade = np.where(np.arange(64) < 32, 10, -10)[None, :, None]  # lighter left, darker right
    moved = move(earlier, turns[6], forwards[7]).astype(int) + shade
    moved = np.clip(moved, 0, 255).astype(np.uint8)
    moved[48:] = earlier[48:]  # as the car, which stays where it is
    pairs = {
        "the order is turned round: return (turn, forward)": (forwards[7], turns[6]),
        "these are places in the grid: return turns[i] and forwards[j]": (6, 7),
        "this is the way back: move the earlier frame, and compare with the later one": (
            turns[2],
            forwards[1],
        ),
        "this is the first pair: subtract in float, and compare with the smallest so far": (
            turns[0],
            forwards[0],
        ),
        "the rows from 48 on were compared, too, and do not move: leave them out": (
            turns[6],
            forwards[4],
        ),
        "in uint8, 3 - 5 is 254, or you kept the largest error: subtract in float": (
            turns[0],
            forwards[8],
        ),
        "3 - 5 is 254 in uint8, or you kept the largest error: subtract in float, then square": (
            turns[8],
            forwards[8],
        ),
    }
    what = "find_motion of a picture moved by 0.1 and 3"
    found = ask_motion(what, find_motion, moved, earlier, turns, forwards)
    mistakes = {hint: np.array(pair) for hint, pair in pairs.items()}
    check(what, found, np.array([turns[6], forwards[7]]), mistakes)


def find_motion_real(find_motion: Callable, ride: Callable) -> None:
    """The motion of the real car in two bends and on a straight.

    Args:
        find_motion: the student's.
        ride: the notebook's; steering -> two frames, and the true speed and yaw rate.
    """
    turns, forwards = np.linspace(-0.32, 0.32, 33), np.linspace(0, 6, 25)
    print("steering   yaw rate found   true   speed found   true")
    for steering in (-0.8, 0.0, 0.6):
        frame, earlier, (speed, yaw) = ride(steering)
        what = f"find_motion with steering {steering}"
        found = ask_motion(what, find_motion, frame, earlier, turns, forwards) / 0.08
        print(f"{steering:8.1f} {found[0]:16.2f} {yaw:6.2f} {found[1]:13.1f} {speed:6.1f}")
        hint = "convert to float before you subtract, and leave out the rows from 48 on"
        if not abs(found[0] - yaw) < 0.5:
            wrong = f"yaw rate {found[0]:.2f} radians per second, truth {yaw:.2f}"
            raise WrongAnswer(what, wrong, hint)
        if not abs(found[1] - speed) < 5:
            raise WrongAnswer(what, f"speed {found[1]:.1f}, truth {speed:.1f}", hint)


def interval(correlation_interval: Callable) -> None:
    """The interval of a correlation, where units are alike inside, and where they differ."""
    source, unit = np.random.default_rng(5), np.repeat(np.arange(12), 20)
    labels = 10 * unit + 3  # names of the units: they need not count from 0
    x = source.standard_normal(240)
    y = 0.7 * x + 1.5 * source.standard_normal(12)[unit] * x + 0.3 * source.standard_normal(240)
    mixed = source.permutation(240)  # the rows of a unit need not follow each other
    bounds = {
        "far too narrow: you drew rows, but rows of one unit are alike; draw whole units": (
            0.20,
            0.53,
        ),
        "too narrow: these are the percentiles of a 90% interval; take 2.5 and 97.5": (-0.06, 0.73),
        "the interval is a point: draw with replacement, or each draw is all the units again": (
            0.376,
            0.376,
        ),
        "a unit that was drawn twice counts once, as with np.isin: take its rows twice": (
            -0.01,
            0.75,
        ),
    }
    given = x[mixed], y[mixed], labels[mixed], np.random.default_rng(0), 10_000
    check_interval(
        "correlation_interval", correlation_interval, given, (-0.14, 0.788), bounds, 0.04
    )
    source = np.random.default_rng(6)  # as on the tiles: a straight line on each, each another one
    x = source.uniform(0, 1, 240)
    y = source.gamma(3.0, 1.0, 12)[unit] * x + 0.05 * source.standard_normal(240)
    bounds = {
        "this is the mean of every unit's own correlation: take one, of all rows drawn": (
            0.987,
            0.998,
        ),
        "far too narrow: you drew rows, but rows of one unit are alike; draw whole units": (
            0.588,
            0.704,
        ),
    }
    what = "correlation_interval, where units differ"
    given = x, y, labels, np.random.default_rng(0), 4000
    check_interval(what, correlation_interval, given, (0.534, 0.811), bounds, 0.02)
