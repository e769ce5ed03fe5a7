"""The motion probe: how much of the car's true motion can a linear model read off the latents?

The paper claims that difference images give a better representation of the vehicle's motion, but
does not measure it. A probe does: a ridge regression from z, or from z and M's memory h, to one
quantity that the simulator knows. Its R2 on episodes that it was not fitted on is the share of the
quantity's variance that the latents carry: 1 is all of it, 0 is no better than the mean. C is
linear before its tanh, too, so a probe measures what C can use directly.
"""

import numpy as np

from stad_lab.training.ridge import fit_ridge

PENALTIES = np.logspace(-1, 5, 7)  # of the ridge, for features of variance 1
HELDOUT = 0.4  # share of the episodes on which R2 is measured
TRIAL = 0.25  # share of the other episodes on which the penalty is chosen
FEWEST = 10  # episodes


def probe(
    features: np.ndarray,
    targets: np.ndarray,
    episodes: np.ndarray,
    seed: int = 0,
    resamples: int = 1000,
) -> dict[str, np.ndarray]:
    """Fit a linear probe on some episodes and measure it on the others.

    Args:
        features: (n, features), for example z of every frame.
        targets: (n, targets), for example the motion of the car.
        episodes: (n,), the episode of each row. Rows of one episode are alike, so episodes are
            never split.
        seed: of the split and of the bootstrap.
        resamples: of the bootstrap over held-out episodes.

    Returns:
        "r2" (targets,), "low" and "high" (targets,): its 95% interval.

    Raises:
        ValueError: unequal numbers of rows, numbers that are not finite, a constant target, or
            fewer than 10 episodes.
    """
    check_rows(features, targets, episodes)
    rng = np.random.default_rng(seed)
    first, others = split_episodes(episodes, rng)
    heldout = np.isin(episodes, first)
    trial = np.isin(episodes, others[: max(1, round(TRIAL * len(others)))])
    penalties = choose_penalties(features, targets, ~heldout & ~trial, trial)
    predicted = predict(features, targets, ~heldout, penalties, heldout)
    true = targets[heldout].astype(np.float64)
    sums = sums_of_episodes(true, predicted, episodes[heldout])
    chosen = rng.integers(len(sums), size=(resamples, len(sums)))
    again = np.array([r2_of_sums(sums[resample]) for resample in chosen])
    low, high = np.percentile(again, [2.5, 97.5], axis=0)
    return {"r2": r2_of_sums(sums), "low": low, "high": high}


def split_episodes(episodes: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """The episodes that are held out, and the others, in random order."""
    names = rng.permutation(np.unique(episodes))
    return np.split(names, [round(HELDOUT * len(names))])


def choose_penalties(
    features: np.ndarray, targets: np.ndarray, fit: np.ndarray, trial: np.ndarray
) -> np.ndarray:
    """The penalty of the smallest error for each target (targets,), fitted on the rows `fit`."""
    errors = [
        ((targets[trial] - predict(features, targets, fit, penalty, trial)) ** 2).mean(axis=0)
        for penalty in PENALTIES
    ]
    return PENALTIES[np.argmin(errors, axis=0)]


def predict(
    features: np.ndarray,
    targets: np.ndarray,
    fit: np.ndarray,
    penalty: float | np.ndarray,
    shown: np.ndarray,
) -> np.ndarray:
    """Fit a ridge regression on the rows `fit`; returns its predictions for the rows `shown`."""
    fitted = features[fit].astype(np.float64)
    mean, scale = fitted.mean(axis=0), fitted.std(axis=0)
    scale[scale == 0] = 1  # a constant feature
    weights, intercept = fit_ridge((fitted - mean) / scale, targets[fit], penalty)
    return (features[shown] - mean) / scale @ weights + intercept


def sums_of_episodes(
    targets: np.ndarray, predicted: np.ndarray, episodes: np.ndarray
) -> np.ndarray:
    """Rows, sum, sum of squares and squared error of every episode: (episodes, 4, targets)."""
    error = (targets - predicted) ** 2
    parts = np.stack([np.ones_like(targets), targets, targets**2, error], axis=1)
    return np.stack([parts[episodes == one].sum(axis=0) for one in np.unique(episodes)])


def r2_of_sums(sums: np.ndarray) -> np.ndarray:
    """R2 = 1 - squared error / variance around the mean, over these episodes: (targets,)."""
    rows, total, squares, error = sums.sum(axis=0)
    return 1 - error / (squares - total**2 / rows)


def check_rows(features: np.ndarray, targets: np.ndarray, episodes: np.ndarray) -> None:
    """Raise ValueError unless a probe can be fitted to these."""
    if not len(features) == len(targets) == len(episodes):
        raise ValueError(
            f"{len(features)} rows of features, {len(targets)} of targets, {len(episodes)} of"
            " episodes: expected equal numbers"
        )
    finite = np.isfinite(features).all(axis=1) & np.isfinite(targets).all(axis=1)
    if not finite.all():
        raise ValueError(f"{(~finite).sum()} rows that are not finite: leave those rows out")
    if constant := np.flatnonzero(np.ptp(targets, axis=0) == 0).tolist():
        raise ValueError(f"targets {constant} are constant: leave them out")
    if (count := len(np.unique(episodes))) < FEWEST:
        raise ValueError(f"{count} episodes: expected at least {FEWEST}, to fit and to measure on")
