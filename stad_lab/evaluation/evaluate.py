"""Evaluation: an agent on official, unseen tracks. These are the numbers of the table.

Official means Gymnasium's own CarRacing-v3 with its own renderer, whole episodes, on tracks from a range that neither
training nor validation ever touches. Each track is named by its seed, so anyone can drive it again.
"""

import time
from concurrent.futures import Executor
from contextlib import suppress
from pathlib import Path

import numpy as np
from tqdm.auto import tqdm

from stad_lab.agent import CONTROLLER, load_agent, run_folder
from stad_lab.io.files import checksum, load_json, save_json
from stad_lab.io.workers import run_tasks, worker_processes
from stad_lab.training.dataset import TRACK_RANGES
from stad_lab.training.evolution import drive_group, hand_out

SOLVED = 900  # CarRacing counts as solved at a mean return of 900 over 100 tracks
RESAMPLES = 10_000  # of a bootstrap
MOST_EPISODES = 10_000  # of an evaluation: the bootstrap of more would need more than 2 GB


def evaluate(
    variant: str,
    path: str | Path | None = None,
    episodes: int = 100,
    first_track: int = 0,
    fast: bool = False,
    processes: int = 2,
    executor: Executor | None = None,
    unfinished: Path | None = None,
) -> dict:
    """Drive an agent on the tracks first_track, first_track + 1, ... and sum up.

    Args:
        variant: of the agent.
        path: the folder of a run; None for the agent that comes with stad_lab.
        episodes: number of tracks, each driven once, to its end.
        first_track: seed of the first track.
        fast: draw with the fast renderer instead of Gymnasium's own.
        processes: worker processes; the numbers do not depend on it.
        executor: who drives; None for so many processes of this machine.
        unfinished: file that keeps what has been driven, so that an interrupted evaluation goes on from there. It may
            go when the result has been saved. None keeps nothing.

    Returns:
        A dict for JSON: "variant", "renderer" ("official" or "fast"), "controller_sha256" of C's file, "mean",
        "standard_deviation", "interval" (95%, of the mean), "above_900" (share of episodes), "seconds" that it took,
        and "episodes": the "track", "return" and "frames" of each.

    Raises:
        ValueError: tracks outside the range that is kept for tests, or an agent that cannot be loaded.
        FileNotFoundError: no such agent.
        TaskError: an episode failed.
    """
    low, high = TRACK_RANGES["test"]
    if not 1 <= episodes <= MOST_EPISODES or not low <= first_track <= high - episodes:
        raise ValueError(
            f"episodes={episodes} from first_track={first_track}: expected 1 to {MOST_EPISODES} episodes, on tracks"
            f" {low} to {high - 1}; those above are for training and validation"
        )
    agent, folder, read = load_agent(variant, path), run_folder(variant, path), None
    while read != (
        now := checksum((folder / CONTROLLER).read_bytes())
    ):  # a search may save a better one meanwhile
        agent, read = load_agent(variant, path), now
    identity = {
        "variant": variant,
        "renderer": "fast" if fast else "official",
        "controller_sha256": read,
    }
    tracks = list(range(first_track, first_track + episodes))
    known = load_json(unfinished, "evaluate again") if unfinished and unfinished.exists() else {}
    weights = [
        checksum((folder / f"{part}.safetensors").read_bytes())
        for part in ("autoencoder", "mdn_rnn")
    ]
    asked = identity | {
        "tracks": tracks,
        "weights": weights,
    }  # V and M may be the same but for their precision
    driven = known["driven"] if known.get("identity") == asked else {}
    begin = time.perf_counter() - (known["seconds"] if driven else 0)
    missing = [track for track in tracks if str(track) not in driven]
    with worker_processes(processes, executor) as executor:
        # One car at a time: in a batch the last bits differ, and a script that drives alone should get these numbers.
        source = hand_out(executor, folder, variant)
        tasks = [(source, variant, agent.parameters, [track], fast, None) for track in missing]
        found = run_tasks(executor, drive_group, tasks)
        begun = len(tracks) - len(missing)
        for number, (returns, lengths) in tqdm(
            found, f"evaluate ({variant})", len(tracks), initial=begun, unit="episode"
        ):
            driven[str(missing[number])] = float(returns[0]), int(lengths[0])
            if unfinished:
                told = {"identity": asked, "driven": driven, "seconds": time.perf_counter() - begin}
                with suppress(OSError):  # a full disk costs the right to go on, not the result
                    save_json(unfinished, told)
    returns, lengths = (
        np.array(part) for part in zip(*(driven[str(track)] for track in tracks), strict=True)
    )
    return {**identity, **report(tracks, returns, lengths), "seconds": time.perf_counter() - begin}


def report(tracks: list[int], returns: np.ndarray, lengths: np.ndarray) -> dict:
    """What `summarise` says of the returns, float (n,), and every episode: its track, return and length in frames."""
    episodes = [
        {"track": track, "return": float(value), "frames": int(length)}
        for track, value, length in zip(tracks, returns, lengths, strict=True)
    ]
    return {**summarise(returns), "episodes": episodes}


def summarise(returns: np.ndarray) -> dict:
    """Mean, deviation, 95% interval of the mean and share above 900 of returns, float (tracks,) or (seeds, tracks)."""
    return {
        "mean": float(returns.mean()),
        "standard_deviation": float(returns.std(ddof=1)) if returns.size > 1 else 0.0,
        "interval": bootstrap(np.atleast_2d(returns)),
        "above_900": float((returns > SOLVED).mean()),
    }


def bootstrap(returns: np.ndarray, resamples: int = RESAMPLES) -> list[float]:
    """95% interval of the mean of returns (seeds, tracks), by a bootstrap of the seeds and of the tracks.

    All seeds drive the same tracks, so a track is drawn for all of them together. From three seeds the
    interval may be too narrow (notebook 05, step 7). Agarwal et al., 2021, argue for bootstraps where runs are few.
    """
    means = resampled_means(returns, *draw_tracks(returns, resamples))
    return middle_95(means)


def draw_tracks(returns: np.ndarray, resamples: int) -> tuple[np.random.Generator, np.ndarray]:
    """The Generator of a bootstrap, and the tracks of each resample, int (resamples, 1, tracks)."""
    rng, tracks = np.random.default_rng(0), returns.shape[1]
    return rng, rng.integers(tracks, size=(resamples, 1, tracks))


def resampled_means(
    returns: np.ndarray, rng: np.random.Generator, tracks: np.ndarray
) -> np.ndarray:
    """The mean return of each resample, float64 (resamples,), with seeds drawn here."""
    seeds = rng.integers(len(returns), size=(len(tracks), len(returns), 1))
    return returns[seeds, tracks].mean(axis=(1, 2))


def middle_95(samples: np.ndarray) -> list[float]:
    """Between which two values the middle 95% of the samples, float (n,), lie: [low, high]."""
    return [float(bound) for bound in np.percentile(samples, [2.5, 97.5])]


def describe(result: dict) -> str:
    """One paragraph of an evaluation, for the screen."""
    low, high = result["interval"]
    count = len(result["episodes"])
    tracks = f"tracks {result['episodes'][0]['track']} to {result['episodes'][-1]['track']}"
    return (
        f"{result['variant']}: mean return {result['mean']:.1f} over {count} episodes ({tracks},"
        f" {result['renderer']} renderer)\n"
        f"  standard deviation {result['standard_deviation']:.1f}, 95% interval of the mean {low:.1f} to {high:.1f},"
        f" {100 * result['above_900']:.0f}% of the episodes above {SOLVED}"
    )
