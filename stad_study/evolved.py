"""Runs that evolve one C in a kept world and score it: what studies 2 and 5 have in common.

A world is the V and M of one seed and variant, in 16 bits. In the folder of a study each run has a
folder of its own name, with the log of CMA-ES and the score. Whatever is there is not done again. A
finished run is added to the tables, and its C to `networks` beside them.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas
import torch

from stad_lab.config import Config
from stad_lab.evaluation.statistics import FAILED
from stad_lab.io.files import (
    checksum,
    checksum_of_arrays,
    copy_file,
    load_json,
    load_tensors,
    locked,
    save_json,
    save_tensors,
)
from stad_lab.training.evolution import LOG, evolve, read_log, resume
from stad_lab.training.record import provenance
from stad_study import tables
from stad_study.networks import NETWORKS
from stad_study.senses import Sense
from stad_study.study import (
    SCORE,
    STUDIES,
    WAIT,
    Run,
    claimed,
    fixed_threads,
    groups_of,
    select,
    without_finished,
)

CHECKSUMS = ("log", "controller", "returns")


class EvolvedRun(Run, Protocol):
    """One C: a NamedTuple of a seed and what the study varies."""

    @property
    def config(self) -> Config:
        """Its configuration."""

    def _asdict(self) -> dict: ...


@dataclass(frozen=True)
class Evolved:
    """A study of such runs."""

    name: str  # of its folder, its tables and its folder of networks
    parts: Callable[[Path], dict[str, list]]  # tables -> part -> runs, in the order of running
    prepare: Callable[[Any, Path, Path], Sense]  # run, folder of the study, networks -> drives
    keeps_logs: bool = False  # of runs that take hours, so that they can be continued elsewhere

    @property
    def key(self) -> list[str]:
        """The columns that name a run in the tables."""
        return tables.TABLES[f"{self.name}_runs"][0]


def find_runs(
    study: Evolved,
    seeds: Sequence[int] | None = None,
    only: Sequence[str] | None = None,
    to: Path = tables.DATA,
) -> list[Any]:
    """The runs of a study, part by part. ValueError for an unknown seed or name."""
    found = [run for runs in study.parts(to).values() for run in runs]
    return select(study.name, found, seeds, only)


def count_runs(study: Evolved, to: Path = tables.DATA) -> dict[str, tuple[int, int]]:
    """Part -> how many of its runs are in the tables, and how many there are to be."""
    table = tables.read_or_empty(f"{study.name}_runs", to)
    done = set(table[study.key].itertuples(index=False, name=None))
    return {
        part: (sum(tuple(run) in done for run in runs), len(runs))
        for part, runs in study.parts(to).items()
    }


def describe_counts(study: Evolved, to: Path = tables.DATA) -> dict[str, dict[str, int]]:
    """Claims on progress: "runs" that are done and "planned" ones, each by part."""
    counts = count_runs(study, to)
    return {
        name: {part: both[index] for part, both in counts.items()}
        for index, name in enumerate(("runs", "planned"))
    }


def describe_progress(study: Evolved, to: Path = tables.DATA) -> str:
    """How many runs of each part are in the tables."""
    told = [f"{part} {done} of {count}" for part, (done, count) in count_runs(study, to).items()]
    return f"{study.name}: {', '.join(told)} runs are done"


def run_evolved(
    study: Evolved,
    folder: str | Path,
    seeds: Sequence[int] | None = None,
    only: Sequence[str] | None = None,
    to: Path = tables.DATA,
    networks: Path = NETWORKS,
) -> None:
    """Run what is missing, in `folder/NAME`, and add each run to the tables in `to`.

    After an interruption the same call continues. A run that another process does is left to it, so
    several processes may share a folder; each computes on one thread. With `only`, runs that the
    tables have are run, too, and compared. ValueError as `find_runs`, and if the folder
    already has all that `only` names, and the tables, too.
    """
    root = Path(folder) / study.name
    tried: set[str] = set()
    if only:
        asked = find_runs(study, seeds, only, to)
        left = without_finished(root, asked, lambda run: recorded(study, run, to))
        tried = {run.name for run in asked} - {run.name for run in left}
    # What is found may grow with the tables: a gate decides what follows it.
    while runs := [run for run in find_runs(study, seeds, only, to) if run.name not in tried]:
        tried.add(runs[0].name)
        do_run(study, runs[0], root, to, networks, repeat=bool(only))
    print(describe_progress(study, to))


def do_run(
    study: Evolved, run: EvolvedRun, root: Path, to: Path, networks: Path, repeat: bool
) -> None:
    """Run and add what is not in the tables; with `repeat` run what is there, too, and compare."""
    if recorded(study, run, to) and not repeat:
        return
    with claimed(root / run.name) as ours:
        was = recorded(study, run, to)
        if not ours or (was and not repeat):  # another process has just finished it
            return
        print(f"{run.name}: {describe_progress(study, to)}", flush=True)
        run_one(study, run, root, networks, repeat=was is not None)
        if was:
            print(f"{run.name}: {compare_run(run, was, root)}", flush=True)
            return
        add_run(study, run, root, to)
        # Not its score: no arm is to be seen before the last run of its part.
        print(f"{run.name}: is finished and in the tables", flush=True)


def run_one(
    study: Evolved, run: EvolvedRun, root: Path, networks: Path = NETWORKS, repeat: bool = False
) -> None:
    """Do what is missing of a run, and write its score. A repetition uses no kept log."""
    folder, kept = root / run.name, networks / study.name / run.name
    if (folder / SCORE).exists():
        return
    made_with = provenance(
        f"python -m stad_study replicate {study.name} --only {run.name} --out ..."
    )
    begin, keeps = time.perf_counter(), study.keeps_logs and not repeat
    with fixed_threads():
        sense = study.prepare(run, root, networks)
        if keeps and (kept / LOG).exists() and not (folder / LOG).exists():
            print(f"{run.name}: goes on from {kept / LOG}", flush=True)
            copy_file(kept / LOG, folder)

        def keep_log(generations: list[dict]) -> None:
            if keeps and "validation" in generations[-1]:
                copy_file(folder / LOG, kept)

        evolve(run.config, folder, watch=keep_log, drives=sense)  # type: ignore[arg-type]
        log = read_log(run.config, folder, sense)  # type: ignore[arg-type]
        controller = resume(run.config, folder, sense, log).controller().astype(np.float16)
        score = score_controller(sense, controller)
    seconds = time.perf_counter() - begin
    save_json(
        folder / SCORE, {"kind": "score", "made_with": made_with, **score, "seconds": seconds}
    )


def score_controller(sense: Sense, controller: np.ndarray) -> dict:
    """Drive C, float16 (parameters,), on the tracks of study 1's score, in groups as there."""
    tracks, limits = list(STUDIES["study1"].tracks), {"max_frames": STUDIES["study1"].max_frames}
    parameters = controller.astype(np.float64)
    driven = [sense.drive(parameters, own, **limits).returns for own in groups_of(tracks)]
    returns = np.concatenate(driven)
    return {
        "mean": float(returns.mean()),
        "returns": returns.tolist(),
        "controller": controller.astype(float).tolist(),
    }


def add_run(study: Evolved, run: EvolvedRun, root: Path, to: Path) -> None:
    """Add a finished run to the tables: its line of runs, and its returns rounded to cents."""
    score, key = load_json(root / run.name / SCORE, kind="score"), run._asdict()
    tracks = STUDIES["study1"].tracks
    returns = {str(t): round(one, 2) for t, one in zip(tracks, score["returns"], strict=True)}
    line = pandas.DataFrame([key | describe_run(run, root)])
    networks = to.parent / NETWORKS.name / study.name
    with locked(to, WAIT):
        if recorded(study, run, to):
            raise ValueError(f"{run.name} came into {to} from another folder: nothing was added")
        add_controller(study, run, np.array(score["controller"]), networks)
        tables.replace_lines(f"{study.name}_returns", pandas.DataFrame([key | returns]), to)
        tables.replace_lines(f"{study.name}_runs", line, to)


def describe_run(run: EvolvedRun, root: Path) -> dict:
    """The line of runs: score, learning curve, machine, seconds and checksums."""
    score = load_json(root / run.name / SCORE, kind="score")
    log = load_json(root / run.name / LOG)
    returns = np.array(score["returns"])
    line = {"mean": score["mean"], "below_800": float((returns < FAILED).mean())}
    for entry in log["generations"]:
        if "validation" in entry:
            line[f"validation.{entry['generation']}"] = round(entry["validation"]["mean"], 2)
    made = score["made_with"]
    line |= {name: made[name] for name in ("commit", "processor", "numpy", "numba")}
    line |= {"seconds": round(score["seconds"], 1)}  # since the last start
    line["frames"] = sum(entry["frames"] for entry in log["generations"])
    line["log"] = checksum((root / run.name / LOG).read_bytes())
    line["controller"] = checksum_of_arrays(parameters=np.array(score["controller"], np.float16))
    return line | {"returns": checksum_of_arrays(returns=returns)}


def add_controller(study: Evolved, run: EvolvedRun, controller: np.ndarray, folder: Path) -> None:
    """Add a C to the file of its seed: float16 (parameters,) under the name of the run."""
    path = folder / f"seed{run.seed}.safetensors"
    tensors = load_tensors(path)[0] if path.exists() else {}
    tensors[run.name] = torch.from_numpy(controller.astype(np.float16))
    save_tensors(path, dict(sorted(tensors.items())), kind="controllers", study=study.name)


def recorded(study: Evolved, run: EvolvedRun, to: Path = tables.DATA) -> dict | None:
    """The line of a run in the table of runs; None if it is not there."""
    return tables.line_of(f"{study.name}_runs", tuple(run._asdict().values()), to)


def compare_run(run: EvolvedRun, was: dict, root: Path) -> str:
    """Whether a run that was repeated is, bit by bit, the one in the tables."""
    now = describe_run(run, root)
    differs = [name for name in CHECKSUMS if was[name] != now[name]]
    if not differs:
        return "bit-identical to the recorded one, all returns, too"
    where = f"recorded on {was['processor']}, here {now['processor']}"
    return (
        f"differs in {', '.join(differs)}: mean {was['mean']:.1f}, here {now['mean']:.1f}; {where}"
    )
