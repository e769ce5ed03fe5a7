"""Statistics of returns: summaries, and bootstrap intervals over seeds and tracks."""

import numpy as np

SOLVED = 900  # CarRacing counts as solved at a mean return of 900 over 100 tracks
RESAMPLES = 10_000  # of a bootstrap


def summarise(returns: np.ndarray) -> dict:
    """Mean, standard deviation, 95% interval of the mean and share above 900.

    Args:
        returns: float (tracks,) or (seeds, tracks).
    """
    return {
        "mean": float(returns.mean()),
        "standard_deviation": float(returns.std(ddof=1)) if returns.size > 1 else 0.0,
        "interval": bootstrap(np.atleast_2d(returns)),
        "above_900": float((returns > SOLVED).mean()),
    }


def bootstrap(returns: np.ndarray, resamples: int = RESAMPLES) -> list[float]:
    """95% interval of the mean of returns (seeds, tracks), resampling seeds and tracks.

    All seeds drive the same tracks, so a track is resampled for all of them together (Agarwal et
    al., 2021). From three seeds the interval may be too narrow.
    """
    return middle_95(resampled_means(returns, *draw_tracks(returns, resamples)))


def draw_tracks(returns: np.ndarray, resamples: int) -> tuple[np.random.Generator, np.ndarray]:
    """The Generator of a bootstrap, and the tracks of each resample, int (resamples, 1, tracks)."""
    rng, tracks = np.random.default_rng(0), returns.shape[1]
    return rng, rng.integers(tracks, size=(resamples, 1, tracks))


def resampled_means(
    returns: np.ndarray, rng: np.random.Generator, tracks: np.ndarray
) -> np.ndarray:
    """The mean return of each resample, float64 (resamples,); seeds are resampled here."""
    seeds = rng.integers(len(returns), size=(len(tracks), len(returns), 1))
    return returns[seeds, tracks].mean(axis=(1, 2))


def middle_95(samples: np.ndarray) -> list[float]:
    """The 2.5th and the 97.5th percentile of samples, float (n,)."""
    return [float(bound) for bound in np.percentile(samples, [2.5, 97.5])]
