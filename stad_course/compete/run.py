"""From a folder of submissions to a leaderboard, and the kit of a first agent."""

import shlex
import shutil
import sys
from pathlib import Path

from stad_course.compete.drive import (
    BASELINE,
    BASELINES,
    STARTER,
    compete,
    find_submissions,
)
from stad_course.compete.limits import Limits
from stad_course.compete.page import leaderboard
from stad_course.compete.process import PACKAGE
from stad_course.compete.ranking import rank
from stad_course.compete.tracks import load_tracks
from stad_lab.io.files import locked, write_bytes


def run(
    submissions: Path,
    secret: Path,
    out: Path,
    limits: Limits,
    processes: int = 2,
    reveal: bool = False,
    baselines: bool = True,
) -> Path:
    """Drive all submissions and the baselines, and write the leaderboard; returns its path."""
    if out.resolve().is_relative_to(submissions.resolve()):
        raise ValueError(f"--out {out} lies in the folder of submissions: choose another")
    for folder in (submissions, out):
        check_hidden(folder)
    tracks, commitment = load_tracks(secret)
    ours = BASELINES if baselines else {}
    entries = {f"{BASELINE}{name}": path for name, path in ours.items()}
    entries |= find_submissions(submissions)
    with locked(out):
        hidden = secret, out, submissions
        results = compete(entries, tracks, out / "results", limits, processes, hidden)
        table = rank(results)
        table["baseline"] = table["name"].str.startswith(BASELINE)
        table["name"] = table["name"].str.removeprefix(BASELINE)
        seeds = secret.read_text(encoding="utf-8") if reveal else None
        isolated = all(one.get("isolated") for one in results)
        facts = {"isolated": isolated, "revealed": seeds}
        file = out / "leaderboard.html"
        write_bytes(file, leaderboard(table, tracks, commitment, facts).encode())
    return file


def check_hidden(folder: Path) -> None:
    """Raise ValueError for a folder that no submission can do without."""
    for needed in (PACKAGE, *(Path(one).resolve() for one in (sys.prefix, sys.base_prefix))):
        if needed.is_relative_to(folder.resolve()):
            reason = f"holds {needed}, which submissions need, and is hidden from them"
            raise ValueError(f"{folder} {reason}: choose another folder")


def write_kit(file: Path) -> str:
    """Write a first agent to a file that does not exist yet; says how to try it."""
    if file.suffix != ".py":
        raise ValueError(f"{file}: expected a name that ends in .py")
    if file.exists():
        raise FileExistsError(f"{file} exists: choose another name")
    file.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(STARTER / "my_agent.py", file)
    return f"written to {file}; try it: python -m stad_course check {shlex.quote(str(file))}"
