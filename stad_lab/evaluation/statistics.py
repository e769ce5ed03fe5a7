"""Statistics of returns: functions of arrays, whose rows are runs (seeds) and columns tracks."""

from collections.abc import Sequence

import numpy as np
from scipy import stats

SOLVED = 900  # points; CarRacing counts as solved at a mean return of 900 over 100 tracks
FAILED = 800  # points; an episode below has left the road or missed tiles
RESAMPLES = 10_000  # of a bootstrap
CHUNK = 100  # resamples that are in memory together


def summarise(returns: np.ndarray) -> dict:
    """Mean, deviation, interval of the mean and share above 900: (tracks,) or (seeds, tracks)."""
    return {
        "mean": float(returns.mean()),
        "standard_deviation": float(returns.std(ddof=1)) if returns.size > 1 else 0.0,
        "interval": bootstrap(np.atleast_2d(returns)),
        "above_900": float((returns > SOLVED).mean()),
    }


def describe_tail(returns: np.ndarray) -> dict:
    """Minimum, tenth percentile, share and number of the episodes below 800."""
    return {
        "minimum": float(returns.min()),
        "tenth_percentile": float(np.percentile(returns, 10)),
        "below_800": float((returns < FAILED).mean()),
        "failed": int((returns < FAILED).sum()),
    }


def bootstrap(returns: np.ndarray, resamples: int = RESAMPLES) -> list[float]:
    """95% interval of the mean of returns (seeds, tracks), resampling seeds and tracks.

    A track is drawn for all seeds together. With fewer than five seeds the interval is too narrow;
    with one it holds the variance between tracks alone. Of paired differences, it is an interval
    of the mean difference.
    """
    return middle_95(resampled_means(returns, *draw_tracks(returns, resamples)))


def bootstrap_difference(before: np.ndarray, after: np.ndarray) -> list[float]:
    """95% interval of mean(after) - mean(before): seeds drawn for each, tracks once for both."""
    rng, tracks = draw_tracks(before, RESAMPLES)
    return middle_95(resampled_means(after, rng, tracks) - resampled_means(before, rng, tracks))


def draw_tracks(returns: np.ndarray, resamples: int) -> tuple[np.random.Generator, np.ndarray]:
    """The Generator of a bootstrap, and the tracks of each resample, int (resamples, 1, tracks)."""
    rng, tracks = np.random.default_rng(0), returns.shape[1]
    return rng, rng.integers(tracks, size=(resamples, 1, tracks))


def resampled_means(
    returns: np.ndarray, rng: np.random.Generator, tracks: np.ndarray
) -> np.ndarray:
    """The mean return of each resample, float64 (resamples,); seeds are drawn here."""
    seeds = rng.integers(len(returns), size=(len(tracks), len(returns), 1))
    rows = [slice(start, start + CHUNK) for start in range(0, len(tracks), CHUNK)]
    return np.concatenate([returns[seeds[own], tracks[own]].mean(axis=(1, 2)) for own in rows])


def middle_95(samples: np.ndarray) -> list[float]:
    """The 2.5th and the 97.5th percentile of samples, float (n,)."""
    return [float(bound) for bound in np.percentile(samples, [2.5, 97.5])]


def welch_p(one: Sequence[float], other: Sequence[float]) -> float:
    """Two-sided p-value of Welch's t-test for the means of two groups of runs."""
    return float(stats.ttest_ind(one, other, equal_var=False).pvalue)


def pooled_interval(groups: Sequence[Sequence[float]], before: int, after: int) -> list[float]:
    """95% interval of mean(groups[after]) - mean(groups[before]), by Student's t.

    The variance within groups is pooled over all of them: two runs alone estimate it poorly.
    """
    free = sum(len(group) - 1 for group in groups)
    variance = sum(np.var(group) * len(group) for group in groups) / free
    error = np.sqrt(variance * (1 / len(groups[before]) + 1 / len(groups[after])))
    difference = np.mean(groups[after]) - np.mean(groups[before])
    return [float(difference + t * error) for t in stats.t.ppf([0.025, 0.975], free)]


def paired_p(differences: Sequence[float]) -> float:
    """Two-sided p-value of the paired t-test, from the difference of each pair."""
    return float(stats.ttest_1samp(differences, 0.0).pvalue)


def mean_interval(values: Sequence[float]) -> list[float]:
    """95% interval of the mean of at least two values, by Student's t."""
    error = stats.sem(values)
    return [
        float(np.mean(values) + t * error) for t in stats.t.ppf([0.025, 0.975], len(values) - 1)
    ]


def holm(p_values: Sequence[float]) -> list[float]:
    """P-values adjusted for their number, after Holm (1979), in the given order."""
    adjusted, largest = np.empty(len(p_values)), 0.0
    for rank, place in enumerate(np.argsort(p_values)):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[place]))
        adjusted[place] = largest
    return adjusted.tolist()


def interquartile_mean(values: np.ndarray) -> float:
    """Mean of the values without the lowest and the highest quarter."""
    return float(stats.trim_mean(values, 0.25, axis=None))


def pairs_that_decide(deviation: float, margin: float, tests: int) -> int:
    """The smallest number of pairs, at least 2, whose paired t-test is sure to decide.

    Whatever the mean: either Holm's p over so many tests is below 0.05, or the 95% interval lies
    within +-margin. If p is not, the mean is within the wider half-width of the level 0.05 / tests,
    and the end of the interval is further by the half-width of 95%: both together must fit into the
    margin. `deviation`: of the paired differences.
    """
    for pairs in range(2, 100_000):
        both = stats.t.ppf([0.975, 1 - 0.025 / tests], pairs - 1).sum()
        if both * deviation / np.sqrt(pairs) <= margin:
            return pairs
    raise ValueError(f"deviation={deviation}: expected a finite number below {100 * margin:.0f}")
