"""Checks of the exercises to notebook 04. Each takes the student's function."""

from collections.abc import Callable

import numpy as np

from stad_course.checks.answers import (
    BY_SAMPLE,
    WrongAnswer,
    ask,
    check,
    check_interval,
    to_numpy,
)


def right_weights(size: int) -> np.ndarray:
    """The weights of the better half of a population."""
    raw = np.log((size + 1) / 2) - np.log(np.arange(1, size // 2 + 1))
    return raw / raw.sum()


def weights_of_ranks(weights: Callable) -> None:
    """The weights of populations of 10 and of 7 points."""
    for size in (10, 7):
        what, half = f"weights({size})", size // 2
        right, ranks = right_weights(size), np.arange(1, size // 2 + 1)
        found = ask(what, weights, size)
        array = to_numpy(found)
        real = array.shape == (half,) and array.dtype.kind == "f"
        if real and not np.isfinite(array).all():
            remedy = "ranks count from 1, np.arange(1, mu + 1)"
            raise WrongAnswer(what, "ln 0 is minus infinity", remedy)
        raw = np.log((size + 1) / 2) - np.log(ranks)
        every = np.log((size + 1) / 2) - np.log(np.arange(1, size + 1))
        longer = np.log(half + 1) - np.log(ranks)
        soft = "a softmax makes other weights: divide the differences of logarithms by their sum"
        mistakes = {
            "they do not sum to 1: divide by their sum": raw,
            "there are as many as points: keep the better half only": np.append(
                right, np.zeros(size - half)
            ),
            "these weigh all points, the worse half negatively: keep the better half": every,
            "the last counts most: i = 1 is the best": right[::-1],
            "all are equal: the best should count most": np.full(half, 1 / half),
            soft: np.exp(raw) / np.exp(raw).sum(),
            f"{soft}, not those of ranks": np.exp(-ranks) / np.exp(-ranks).sum(),
            "this is ln(mu + 1): the formula has ln((size + 1) / 2)": longer / longer.sum(),
            "mu + 1 stands for (size + 1) / 2, and they do not sum to 1: read the formula": longer,
        }
        if size % 2:
            even = np.log(half + 0.5) - np.log(ranks)
            mistakes["mu + 1/2 is (size + 1) / 2 for an even size only"] = even / even.sum()
            mistakes["mu was rounded up: it is size // 2"] = np.append(right, 0.0)
        check(what, found, right, mistakes, tolerance=1e-3)


def new_means(new_mean: Callable) -> None:
    """The mean of the better half of ten points, and of seven."""
    source = np.random.default_rng(1)
    for size in (10, 7):
        population, cost = source.standard_normal((size, 3)), 1.0 * source.permutation(size)
        order, w, half = np.argsort(cost), right_weights(size), size // 2
        best = population[order]
        mistakes = {
            "this is the mean of the worst: low is good here": w @ best[::-1][:half],
            "this is the plain mean of the better half: weigh it": best[:half].mean(axis=0),
            "this is the mean of all points: selection is missing": population.mean(axis=0),
            "the population was not sorted: take the rows in the order of their cost": w
            @ population[:half],
            "these are the rows at the ranks: argsort once, the best come first": w
            @ population[np.argsort(order)[:half]],
            "the weights are turned round: the best point has the first": w[::-1] @ best[:half],
            "this is the best point alone: one chance score would steer CMA-ES": best[0],
        }
        what = f"new_mean of {size} points"
        found = ask(what, new_mean, population, cost)
        check(what, found, w @ best[:half], mistakes, tolerance=1e-3)


def ablated(ablate: Callable) -> None:
    """The parameters of C without h, and without three single columns."""
    given, position = np.random.default_rng(2).standard_normal(867), np.arange(867)
    columns, weights, without_h = position % 288, position < 864, None
    for asked, gone, transposed in (
        (slice(32, None), columns >= 32, position // 3 >= 32),
        (np.array([0, 5, 287]), np.isin(columns, [0, 5, 287]), np.isin(position // 3, [0, 5, 287])),
    ):
        what = f"ablate(parameters, {'slice(32, None)' if without_h is None else asked})"
        right = np.where(weights & gone, 0, given)
        mistakes = {
            "rows and columns are exchanged: reshape to (3, 288), not (288, 3)": np.where(
                weights & transposed, 0, given
            ),
            "the biases went, too: the last three numbers belong to no column": np.where(
                weights, right, 0
            ),
            "these columns were kept, and the others zeroed: zero the named ones": np.where(
                weights & ~gone, 0, given
            ),
            "only the row of steering was changed: zero the column in all three": np.append(
                right[:288], given[288:]
            ),
            "these are places of the flat list: reshape the weights to (3, 288) first": np.where(
                np.isin(position, position[asked]), 0, given
            ),
            "nothing was changed: assign into a view of your copy, whose shape is (3, ...)": given,
        }
        if without_h is not None:
            mistakes["columns is not used: 32 and on were zeroed"] = without_h
        without_h = right
        check(what, ask(what, ablate, given, asked), right, mistakes)


def expected_bests(expected_best: Callable) -> None:
    """The largest of two dice, and of one."""
    dice = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    mistakes = {
        "this is the mean of the samples, not of their largest: take the largest of each": 3.5,
        "this is the largest of all: take the mean over many samples": 6.0,
        "without replacement: put the die back before you throw again": 14 / 3,
        "this is the mean of the smallest: take the largest": 91 / 36,
    }
    what = "expected_best of two dice"
    found = ask(what, expected_best, dice, 2, np.random.default_rng(0))
    check(what, found, 161 / 36, mistakes, 0.01, BY_SAMPLE)
    what = "expected_best of one die"
    mistakes = {
        "size is not used: sample `size` of the returns": 161 / 36,
        "this is the largest of all: take the mean over many samples": 6.0,
    }
    found = ask(what, expected_best, dice, 1, np.random.default_rng(0))
    check(what, found, 3.5, mistakes, 0.02, BY_SAMPLE)


def difference_intervals(difference_interval: Callable) -> None:
    """The interval of a paired difference on thirty tracks."""
    chance = np.linspace(0.0, 90.0, 30)  # easy and hard tracks
    skew = 15 * np.log(30 / (np.arange(30) * 7 % 30 + 0.5)) ** 1.5
    own = "each agent drew tracks of its own: sample tracks once, and compare on the same"
    place = "these are percentiles of the differences, which say where a track lies: resample"
    formula = "this is the formula with 1.96, which is symmetric, and these differences are not"
    bounds = {
        own: (4.0, 34.5),
        place: (0.14, 90.56),
        "this is a 90% interval: take the percentiles 2.5 and 97.5": (11.9, 28.0),
        "nearly a point: draw with replacement": (skew.mean(), skew.mean()),
        "the sign is turned round: a minus b": (-29.85, -10.75),
        f"{formula}: draw": (9.5, 29.1),
    }
    given = chance + skew, chance, np.random.default_rng(0)
    what = "difference_interval"
    check_interval(what, difference_interval, given, (10.75, 29.85), bounds, 0.025)
