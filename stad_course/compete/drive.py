"""A competition: every submission drives the hidden tracks, and its results are kept as they come.

An episode in which a submission fails scores LOST. A batch with a failure is driven again one track
at a time, so that the others are not lost; after MOST_FAILURES the remaining tracks are.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from stad_course.compete.limits import Limits
from stad_course.compete.process import Failure, Submission
from stad_lab.agent import PRETRAINED, rollout
from stad_lab.envs.cars import Cars
from stad_lab.io.files import checksum, checksum_of_json, load_json, save_json
from stad_lab.io.workers import run_tasks, worker_threads

KIND = "competition"
LOST = -100.0  # points; what leaving the field costs
MOST_FAILURES = 3
BATCH = 10  # tracks at once
STARTER = Path(__file__).parent / "starter"
BASELINES = {"random": STARTER / "random_agent.py", "gentle": STARTER / "gentle_agent.py"}
BASELINES |= {name: PRETRAINED / name for name in ("frame", "input", "output", "input_output")}


def find_submissions(folder: Path) -> dict[str, Path]:
    """The submissions in a folder by name: Python files, and folders.

    ValueError if there are none, or two of one name.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} is no folder: expected one with submissions")
    found = {}
    for path in sorted(folder.iterdir()):
        if path.name[0] in "._" or not (path.is_dir() or path.suffix == ".py"):
            continue
        if path.stem in found:
            raise ValueError(f"{folder} has two submissions {path.stem!r}: rename one")
        found[path.stem] = path
    if not found:
        raise ValueError(f"{folder} has no submissions: expected Python files or runs' folders")
    return found


def compete(
    entries: dict[str, Path],
    tracks: list[int],
    folder: Path,
    limits: Limits,
    processes: int = 2,
    hidden: tuple[Path, ...] = (),
) -> list[dict]:
    """Let every submission drive the tracks; the same call continues after an interrupt.

    Args:
        entries: paths by name.
        tracks: their seeds.
        folder: of the results, one file for each submission.
        hidden: files and folders that no submission may see.
    """
    tasks = [
        (name, path, tracks, folder / f"{name}.json", limits, hidden)
        for name, path in entries.items()
    ]
    with worker_threads(processes) as executor:
        for number, result in run_tasks(executor, drive_submission, tasks, patience=86_400.0):
            mean, errors = np.mean(result["returns"]), result["failures"]
            said = f"  {errors[0]}" if errors else ""
            print(f"{tasks[number][0]:<24} {mean:8.1f}{said}", flush=True)
    return [load_json(task[3], kind=KIND) | {"name": task[0]} for task in tasks]


def drive_submission(
    name: str, path: Path, tracks: list[int], file: Path, limits: Limits, hidden: tuple[Path, ...]
) -> dict:
    """Drive all tracks with one submission, from where the file of its results ends."""
    asked: dict[str, Any] = {"submission": fingerprint(path), "tracks": checksum_of_json(tracks)}
    asked |= {"limits": asdict(limits)}
    result: dict[str, Any] = {
        "kind": KIND,
        **asked,
        "returns": [],
        "failures": [],
        "seconds": 0.0,
        "laps": {},
    }
    if file.exists():
        known = load_json(file, "delete it, to drive again", kind=KIND)
        if all(known.get(key) == value for key, value in asked.items()):
            result = known
    while (done := len(result["returns"])) < len(tracks):
        drive_batch(path, tracks[done : done + BATCH], result, limits, hidden)
        save_json(file, result)
    return result


def drive_batch(
    path: Path, tracks: list[int], result: dict, limits: Limits, hidden: tuple[Path, ...]
) -> None:
    """Drive some tracks together, or each alone if that fails; adds to the result."""
    if (unresolved := len(result["failures"])) >= MOST_FAILURES:
        result["returns"] += [LOST] * len(tracks)
        return
    try:
        with Submission(path, limits, result["seconds"], hidden) as driver:
            try:
                returns, actions = drive_recorded(driver, tracks)
            finally:
                result["seconds"] = driver.used
    except Failure as failure:
        result["failures"].append(str(failure))
        if len(tracks) == 1 or unresolved + 1 >= MOST_FAILURES:
            result["returns"] += [LOST] * len(tracks)
            return
        for track in tracks:
            drive_batch(path, [track], result, limits, hidden)
        return
    first = len(result["returns"])
    result["returns"] += returns.tolist()
    keep_laps(result, first, actions)


def drive_recorded(driver: Submission, tracks: list[int]) -> tuple[np.ndarray, list[list]]:
    """Returns float64 (tracks,), and the actions of every episode."""
    cars = Cars(len(tracks))
    actions: list[list] = [[] for _ in tracks]
    cars.reset(tracks)

    def note(driving: np.ndarray, _, chosen: np.ndarray) -> None:
        for car, action in zip(driving, chosen, strict=True):
            actions[car].append(action.tolist())

    return rollout(driver, cars, observe=note).returns, actions


def keep_laps(result: dict, first: int, actions: list[list]) -> None:
    """Keep the actions of the best and the worst episode so far, by the number of the track."""
    laps = result["laps"] | {str(first + place): own for place, own in enumerate(actions)}
    order = sorted(laps, key=lambda number: result["returns"][int(number)])
    result["laps"] = {number: laps[number] for number in {order[0], order[-1]}}


def replay(track: int, actions: list[list], every: int) -> list[np.ndarray]:
    """What a car saw in an episode, at intervals: uint8 (96, 96, 3) each."""
    cars, pictures = Cars(1), []
    cars.reset([track])
    for number, action in enumerate(actions):
        if number % every == 0:
            pictures.append(cars.draw()[0])
        cars.step(np.array([action]))
    return pictures


def fingerprint(path: Path) -> str:
    """A checksum of a submission's files."""
    if path.is_file():
        return checksum(path.read_bytes())
    files = sorted(
        file for file in path.rglob("*") if file.is_file() and "__pycache__" not in file.parts
    )
    return checksum_of_json(
        [[str(one.relative_to(path)), checksum(one.read_bytes())] for one in files]
    )


def check_submission(path: Path, limits: Limits, tracks: tuple[int, ...] = (0, 1, 2)) -> str:
    """Drive a few public tracks with a submission; one line on how it went."""
    result: dict[str, Any] = {"returns": [], "failures": [], "seconds": 0.0, "laps": {}}
    drive_batch(path, list(tracks), result, limits, ())
    if result["failures"]:
        return f"FAILED: {result['failures'][0]}"
    returns = ", ".join(f"{one:.0f}" for one in result["returns"])
    return f"ok: returns {returns}; {result['seconds']:.1f} s of answering"
