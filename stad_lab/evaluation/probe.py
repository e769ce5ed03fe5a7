"""The motion probe: how much of the car's true motion can be read off a latent by a straight line?

The paper claims that difference images give a better representation of the vehicle's motion, and measures none. A probe
does: it is a linear model (ridge regression) from z, or from z and M's memory h, to one number that the simulator
knows. Its R2 on drives that it was not fitted on says what share of that number's variance the latent tells: 1 is all
of it, 0 is no better than the average, and less than 0 is worse. C is linear too, before its tanh, so a probe is a fair
measure of what C can use directly, on drives like these.
"""

import numpy as np

PENALTIES = np.logspace(-1, 5, 7)  # of the ridge, for features of variance 1
HELDOUT = 0.4  # share of the drives on which R2 is measured
TRIAL = 0.25  # share of the other drives on which the penalty is chosen


def probe(
    features: np.ndarray,
    targets: np.ndarray,
    drives: np.ndarray,
    seed: int = 0,
    resamples: int = 1000,
) -> dict[str, np.ndarray]:
    """Fit a linear probe on some drives and measure it on the others.

    Args:
        features: (n, features), for example z of every frame.
        targets: (n, targets), for example the motion of the car.
        drives: (n,), the drive that each row is from. Rows of one drive are alike, so drives are never split.
        seed: of the split and of the bootstrap.
        resamples: of the bootstrap over held-out drives.

    Returns:
        "r2" (targets,), "low" and "high" (targets,): its 95% interval.

    Raises:
        ValueError: rows that do not agree in number or are not finite, a target that never changes, or fewer than 10
            drives.
    """
    check_rows(features, targets, drives)
    rng = np.random.default_rng(seed)
    names = rng.permutation(np.unique(drives))
    heldout = np.isin(drives, names[: round(HELDOUT * len(names))])
    others = names[round(HELDOUT * len(names)) :]
    trial = np.isin(drives, others[: max(1, round(TRIAL * len(others)))])
    penalties = choose_penalties(features, targets, ~heldout & ~trial, trial)
    predicted = fit_ridge(features, targets, ~heldout, penalties, heldout)
    sums = sums_of_drives(targets[heldout].astype(np.float64), predicted, drives[heldout])
    chosen = rng.integers(len(sums), size=(resamples, len(sums)))
    again = np.array([r2_of_sums(sums[drawn]) for drawn in chosen])
    low, high = np.percentile(again, [2.5, 97.5], axis=0)
    return {"r2": r2_of_sums(sums), "low": low, "high": high}


def choose_penalties(
    features: np.ndarray, targets: np.ndarray, fit: np.ndarray, trial: np.ndarray
) -> np.ndarray:
    """The penalty that does best for each target (targets,), fitted on the rows `fit` and tried on the rows `trial`."""
    errors = [
        ((targets[trial] - fit_ridge(features, targets, fit, p, trial)) ** 2).mean(axis=0)
        for p in PENALTIES
    ]
    return PENALTIES[np.argmin(errors, axis=0)]


def fit_ridge(
    features: np.ndarray,
    targets: np.ndarray,
    fit: np.ndarray,
    penalty: float | np.ndarray,
    shown: np.ndarray,
) -> np.ndarray:
    """Fit a ridge regression on the rows `fit`, and predict the targets of the rows `shown`: (rows, targets)."""
    # Here, because it takes a second, and every command and every worker process imports this room.
    from sklearn.linear_model import Ridge
    from sklearn.preprocessing import StandardScaler

    scaler = StandardScaler().fit(features[fit])
    ridge = Ridge(penalty).fit(scaler.transform(features[fit]), targets[fit])
    return ridge.predict(scaler.transform(features[shown])).reshape(-1, targets.shape[1])


def sums_of_drives(targets: np.ndarray, predicted: np.ndarray, drives: np.ndarray) -> np.ndarray:
    """Of every drive what R2 is made of: rows, sum, sum of squares and squared error; (drives, 4, targets)."""
    parts = np.stack(
        [np.ones_like(targets), targets, targets**2, (targets - predicted) ** 2], axis=1
    )
    return np.stack([parts[drives == drive].sum(axis=0) for drive in np.unique(drives)])


def r2_of_sums(sums: np.ndarray) -> np.ndarray:
    """R2 = 1 - squared error / variance around the mean, over all these drives together: (targets,)."""
    rows, total, squares, error = sums.sum(axis=0)
    return 1 - error / (squares - total**2 / rows)


def check_rows(features: np.ndarray, targets: np.ndarray, drives: np.ndarray) -> None:
    """Raise ValueError unless a probe can be fitted to these."""
    if not len(features) == len(targets) == len(drives):
        raise ValueError(
            f"{len(features)} rows of features, {len(targets)} of targets, {len(drives)} of drives: unequal"
        )
    finite = np.isfinite(features).all(axis=1) & np.isfinite(targets).all(axis=1)
    if not finite.all():
        raise ValueError(
            f"{(~finite).sum()} rows of features or targets that are not finite: leave those rows out"
        )
    constant = np.flatnonzero(np.ptp(targets, axis=0) == 0).tolist()
    if constant:
        raise ValueError(
            f"targets {constant} have one value throughout: a probe can tell nothing of them, leave them out"
        )
    count = len(np.unique(drives))
    if count < 10:
        raise ValueError(
            f"{count} drives: expected at least 10, to fit on some and to measure on the others"
        )
