"""A competition: every submission drives the hidden tracks, and its results are kept as they come.

An episode in which a submission fails scores LOST. A batch with a failure is driven again one track
at a time, so that the others are not lost; after MOST_FAILURES the remaining tracks are. If it then
drives all of them, the batch itself counts as a failure: nobody shall break down for a second try.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from stad_course.compete.limits import Limits
from stad_course.compete.process import (
    LARGEST_SUBMISSION,
    Failure,
    Submission,
    can_isolate,
    files_of,
    size_of,
)
from stad_lab.agent import PRETRAINED, rollout
from stad_lab.envs.cars import Cars
from stad_lab.io.files import checksum, checksum_of_json, load_json, save_json
from stad_lab.io.workers import run_tasks, worker_threads

KIND = "competition"
LOST = -100.0  # points; what leaving the field costs
MOST_FAILURES = 3
BATCH = 10  # tracks at once
BASELINE = "baseline-"  # before the names of our own agents
STARTER = Path(__file__).parent / "starter"
BASELINES = {"random": STARTER / "random_agent.py", "gentle": STARTER / "gentle_agent.py"}
BASELINES |= {name: PRETRAINED / name for name in ("frame", "input", "output", "input_output")}


def find_submissions(folder: Path) -> dict[str, Path]:
    """The submissions in a folder by name: Python files, and folders.

    ValueError if there are none, two of one name, or one of a name that is kept for baselines.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} is no folder: expected one with submissions")
    found = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith((".", "__")) or not (path.is_dir() or path.suffix == ".py"):
            continue
        name = path.name if path.is_dir() else path.stem
        if not name.isprintable():  # such as bytes that are not UTF-8
            raise ValueError(f"{str(path)!a} has a name that cannot be shown: rename it")
        if name in found:
            raise ValueError(f"{folder} has two submissions {name!r}: rename one")
        if name.startswith(BASELINE):
            raise ValueError(f"{path}: names with {BASELINE!r} are those of our agents: rename it")
        found[name] = path
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
    for name in entries:
        check_conditions(folder / f"{name}.json", tracks, limits)
    results = {}
    with worker_threads(processes) as executor:
        for number, result in run_tasks(executor, drive_submission, tasks, patience=86_400.0):
            results[number] = result | {"name": tasks[number][0]}
            mean, errors = np.mean(result["returns"]), result["failures"]
            said = f"  {errors[0]}" if errors else ""
            print(f"{tasks[number][0]:<24} {mean:8.1f}{said}", flush=True)
    return [results[number] for number in range(len(tasks))]


def conditions(tracks: list[int], limits: Limits) -> dict[str, Any]:
    """What all results of a competition have in common."""
    return {"tracks": checksum_of_json(tracks), "limits": asdict(limits)}


def check_conditions(file: Path, tracks: list[int], limits: Limits) -> None:
    """Raise ValueError if results that are there were driven on other tracks or with other limits.

    A submission that was changed drives again; results under other conditions are not replaced.
    """
    if file.exists():
        known = load_json(file, "drive again", kind=KIND)
        for name, asked in conditions(tracks, limits).items():
            if known.get(name) != asked:
                found = f"{file} was driven with other {name}"
                raise ValueError(f"{found}: ask for the same, or choose another folder with --out")


def drive_submission(
    name: str, path: Path, tracks: list[int], file: Path, limits: Limits, hidden: tuple[Path, ...]
) -> dict:
    """Drive all tracks with one submission, from where the file of its results ends."""
    asked = {"submission": fingerprint(path)} | conditions(tracks, limits)
    result: dict[str, Any] = {
        "kind": KIND,
        **asked,
        "returns": [],
        "failures": [],
        "seconds": 0.0,
        "laps": {},
    }
    if file.exists():
        known = load_json(file, "drive again", kind=KIND)
        if all(known.get(key) == value for key, value in asked.items()):
            result = known
    while (done := len(result["returns"])) < len(tracks):
        result["isolated"] = can_isolate() and result.get("isolated", not done)
        drive_batch(path, tracks[done : done + BATCH], result, limits, hidden)
        save_json(file, result)
    return result


def drive_batch(
    path: Path, tracks: list[int], result: dict, limits: Limits, hidden: tuple[Path, ...]
) -> None:
    """Drive some tracks together, or each alone if that fails; adds to the result."""
    if len(result["failures"]) >= MOST_FAILURES:
        result["returns"] += [LOST] * len(tracks)
        return
    try:
        with Submission(path, limits, result["seconds"], hidden) as driver:
            try:
                returns, actions = drive_recorded(driver, tracks)
            finally:
                result["seconds"] = driver.used
    except Failure as failure:
        if len(tracks) == 1:
            result["failures"].append(str(failure))
            result["returns"].append(LOST)
        else:
            before = len(result["failures"])
            for track in tracks:
                drive_batch(path, [track], result, limits, hidden)
            if len(result["failures"]) == before:
                result["failures"].append(f"only with {len(tracks)} cars at once: {failure}")
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
    """A checksum of a submission's files, or their size if that is too large to read them."""
    if (size := size_of(path)) > LARGEST_SUBMISSION:
        return f"{size} bytes"
    if path.is_file():
        return checksum(path.read_bytes())
    files = sorted(file for file in files_of(path) if "__pycache__" not in file.parts)
    read = {one: bytes(one.readlink()) if one.is_symlink() else one.read_bytes() for one in files}
    return checksum_of_json(
        [[str(one.relative_to(path)), checksum(content)] for one, content in read.items()]
    )


def check_submission(path: Path, limits: Limits, tracks: tuple[int, ...] = (0, 1, 2)) -> str:
    """Drive a few public tracks with a submission; one line on how it went.

    FileNotFoundError if there is none of this name.
    """
    if not path.exists():
        expected = "a Python file with make_agent(), or the folder of a run"
        raise FileNotFoundError(f"{path} does not exist: expected {expected}")
    result: dict[str, Any] = {"returns": [], "failures": [], "seconds": 0.0, "laps": {}}
    drive_batch(path, list(tracks), result, limits, ())
    if result["failures"]:
        return f"FAILED: {result['failures'][0]}"
    returns = ", ".join(f"{one:.0f}" for one in result["returns"])
    return f"ok: returns {returns}; {result['seconds']:.1f} s of answering"
