"""Evaluation: an agent on tracks that neither training nor validation ever touches.

What we report is driven in Gymnasium's own CarRacing-v3 with its own renderer, whole episodes, on
`config.REPORTED_TRACKS`. Each track is named by its seed, so that anyone can drive it again.
"""

import shlex
import time
from concurrent.futures import Executor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from stad_lab.agent import Agent, load_agent, run_folder
from stad_lab.config import REPORTED_TRACKS, TRACK_RANGES
from stad_lab.envs.arguments import is_whole, shown
from stad_lab.evaluation.statistics import SOLVED, summarise
from stad_lab.io.files import (
    check_writable,
    checksum_of_arrays,
    checksum_of_tensors,
    load_json,
    save_json,
)
from stad_lab.io.weights import CONTROLLER_FILE, load_controller
from stad_lab.io.workers import run_tasks, worker_processes, worker_threads
from stad_lab.training.evolution import drive_group, hand_out
from stad_lab.training.pipeline import RUN_FILES
from stad_lab.training.record import MACHINE, PACKAGES, provenance

MOST_EPISODES = 10_000  # a bootstrap of more would need more than 2 GB
KIND, UNFINISHED = "evaluation", "unfinished evaluation"


def evaluate(
    source: str | Path,
    episodes: int = len(REPORTED_TRACKS),
    first_track: int = REPORTED_TRACKS.start,
    fast: bool = False,
    processes: int = 2,
    executor: Executor | None = None,
    unfinished: Path | None = None,
) -> dict:
    """Drive an agent on the tracks first_track, first_track + 1, ... and summarise the returns.

    Args:
        source: of the agent, as for `load_agent`.
        episodes: number of tracks, each driven once, to its end.
        fast: drive in our engine instead of Gymnasium's environment.
        processes: processes, or threads if `fast`; the numbers do not depend on them.
        executor: where episodes run; None for so many workers of this machine.
        unfinished: file that keeps what was driven, so that an interrupted evaluation continues.

    Returns:
        A dict for JSON: "variant", "renderer" ("gymnasium" or "fast"), "controller" (checksum of
        C), what `summarise` computes, "seconds", "made_with" (versions and machine), and
        "episodes": "track", "return" and "frames".

    Raises:
        ValueError: tracks outside the range for tests, a damaged file `unfinished`, or as
            `worker_processes`.
        FileNotFoundError, ValueError: as `load_agent`.
        TaskError: an episode failed.
    """
    check_tracks(episodes, first_track)
    agent, tracks = load_agent(source), list(range(first_track, first_track + episodes))
    identity = describe_agent(agent, fast)
    models = {"vae": agent.vae, "mdn_rnn": agent.mdn_rnn}
    # Of V and M as they are loaded: a shipped agent's may be of lower precision.
    weights = {name: checksum_of_tensors(model.state_dict()) for name, model in models.items()}
    command = f"python -m stad_lab evaluate --agent {shlex.quote(str(source))}"
    command += f" --episodes {episodes} --first-track {first_track}{' --fast' * fast}"
    made_with = provenance(command)  # before the work: it fails where a package is half installed
    asked = {**identity, "tracks": tracks, **weights}
    asked |= {name: made_with[name] for name in (*MACHINE, *PACKAGES)}  # the result names one
    driven, seconds = read_unfinished(unfinished, asked)
    begin = time.perf_counter() - seconds
    missing = [track for track in tracks if str(track) not in driven]
    workers = worker_threads if fast else worker_processes
    with workers(processes, executor) as executor:
        # One car at a time, so that each result is kept as soon as it is there.
        share = hand_out(executor, run_folder(source))
        tasks = [(share, agent.parameters, [track], fast) for track in missing]
        results = run_tasks(executor, drive_group, tasks)
        bar = {"total": len(tracks), "initial": len(driven), "unit": "episode"}
        for number, (returns, lengths) in tqdm(results, f"evaluate ({agent.vae.variant})", **bar):
            driven[str(missing[number])] = float(returns[0]), int(lengths[0])
            if unfinished:
                write_unfinished(unfinished, asked, driven, time.perf_counter() - begin)
    returns, lengths = zip(*(driven[str(track)] for track in tracks), strict=True)
    result = report(tracks, np.array(returns), np.array(lengths))
    seconds = time.perf_counter() - begin
    return {"kind": KIND, **identity, **result, "seconds": seconds, "made_with": made_with}


def read_unfinished(file: Path | None, asked: dict) -> tuple[dict, float]:
    """What an interrupted evaluation has driven, track -> (return, frames), and its seconds.

    Both are empty without such a file, or if agent, tracks, machine or a version is another.
    """
    known = {}
    if file and file.exists():
        known = load_json(file, "evaluate again", kind=UNFINISHED)
    return (known["driven"], known["seconds"]) if known.get("asked") == asked else ({}, 0.0)


def write_unfinished(file: Path, asked: dict, driven: dict, seconds: float) -> None:
    """Keep what was driven; with a full disk the evaluation goes on, but cannot be resumed."""
    now = {"kind": UNFINISHED, "asked": asked, "driven": driven, "seconds": seconds}
    with suppress(OSError):
        save_json(file, now)


def check_tracks(episodes: int, first_track: int) -> None:
    """Raise ValueError unless these tracks are in the range for tests."""
    low, high = TRACK_RANGES["test"]
    whole = is_whole(episodes) and is_whole(first_track)
    if not whole or not 1 <= episodes <= MOST_EPISODES or not low <= first_track <= high - episodes:
        raise ValueError(
            f"episodes={shown(episodes)} from first_track={shown(first_track)}: expected 1 to"
            f" {MOST_EPISODES} episodes, on tracks {low} to {high - 1}; others are for training"
        )


def describe_agent(agent: Agent, fast: bool) -> dict:
    """What an evaluation says about its agent and its renderer."""
    return {
        "variant": agent.vae.variant,
        "renderer": "fast" if fast else "gymnasium",
        "controller": checksum_of_arrays(parameters=agent.parameters),
    }


def report(tracks: list[int], returns: np.ndarray, lengths: np.ndarray) -> dict:
    """The summary of some returns, and every episode: its track, return and length in frames."""
    episodes = [
        {"track": track, "return": float(value), "frames": int(length)}
        for track, value, length in zip(tracks, returns, lengths, strict=True)
    ]
    return {**summarise(returns), "episodes": episodes}


def check_output(path: Path, kind: str) -> None:
    """Raise ValueError if a result would overwrite anything but one of its kind.

    OSError if the file cannot be written.
    """
    check_writable(path)
    if path.name in RUN_FILES:
        raise ValueError(f"{path} is the name of a run's own file: choose another name")
    if path.exists():
        try:
            found = load_json(path).get("kind")
        except ValueError:
            found = "damaged"
        if found != kind:
            raise ValueError(f"{path} exists and is no earlier {kind}: choose another name")


def load_evaluation(path: Path) -> dict:
    """Read an evaluation. Raises as `load_json`; ValueError if summary and episodes disagree."""
    found = load_json(path, "evaluate again", kind=KIND)
    episodes = found.get("episodes", [])
    tracks = {episode["track"] for episode in episodes}
    if not episodes or len(tracks) < len(episodes):
        raise ValueError(f"{path} has {len(episodes)} episodes on {len(tracks)} tracks")
    summary = summarise(np.array([episode["return"] for episode in episodes]))
    for name, value in summary.items():
        if not is_near(found.get(name), value):
            raise ValueError(f"{path} says {name}={found.get(name)}, its episodes give {value}")
    return found


def evaluations_of(folder: Path) -> dict[Path, dict]:
    """The evaluations in a folder by their files `evaluation*.json`, also of an earlier C."""
    return {file: load_evaluation(file) for file in sorted(folder.glob("evaluation*.json"))}


def is_of_agent(evaluation: dict, folder: Path) -> bool:
    """Whether an evaluation is of the C in `folder`."""
    if not (folder / CONTROLLER_FILE).exists():
        return False
    parameters, metadata = load_controller(folder / CONTROLLER_FILE)
    drove = checksum_of_arrays(parameters=parameters), metadata["variant"]
    return (evaluation.get("controller"), evaluation["variant"]) == drove


def is_near(found: Any, value: float | list[float]) -> bool:
    """Whether a number, or a list of them, is `value` but for the last bits of a sum."""
    try:
        alike = np.shape(found) == np.shape(value)
        return alike and np.allclose(found, value, rtol=1e-9, atol=0)
    except (TypeError, ValueError):  # no number
        return False


def describe(result: dict) -> str:
    """One paragraph of an evaluation, for the screen."""
    low, high = result["interval"]
    tracks = [episode["track"] for episode in result["episodes"]]
    return (
        f"{result['variant']}: mean return {result['mean']:.1f} over {len(tracks)} episodes (tracks"
        f" {tracks[0]} to {tracks[-1]}, renderer: {result['renderer']})\n"
        f"  standard deviation {result['standard_deviation']:.1f}, 95% interval of the mean"
        f" {low:.1f} to {high:.1f}, {100 * result['above_900']:.0f}% of the episodes above {SOLVED}"
    )
