"""Study 4 of docs/protocol.md: the strongest recipe, whole, for four variants and three seeds.

In the folder of the study::

    seed400/dataset/          of the random driver, for all variants of the seed
    seed400/frame/first/      the first iteration: V, M and C
    seed400/frame/second/     the second, with a dataset of its own
    seed400/frame/tuned/      V and M of the second, and C after fine-tuning
    seed400/frame/agent/      the same in half precision, as an agent is shipped
    seed400/frame/score.json

Whatever is there is not done again. A finished run is added to the tables. Of each variant the
agent with the best validation is kept in `networks/study4`, to be shipped. After the last run the
agents that are shipped now drive on the same tracks: they are replaced if they score less; and the
failures of the kept agents are listed. That is done without `--only`, which does what it names.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas

from stad_lab.agent import PRETRAINED, load_agent
from stad_lab.config import VARIANTS, Config
from stad_lab.evaluation.statistics import FAILED
from stad_lab.io.files import checksum_of_arrays, load_json, locked, save_json
from stad_lab.io.weights import CONTROLLER_FILE, load_controller
from stad_lab.io.workers import TaskError
from stad_lab.training.evolution import LOG
from stad_lab.training.fine_tuning import fine_tune
from stad_lab.training.pipeline import train
from stad_lab.training.record import RECORD, provenance, starts, total_budget
from stad_study import tables
from stad_study.experiments import EXPERIMENTS
from stad_study.failures import find_failures
from stad_study.networks import NETWORKS
from stad_study.ship import copy_in_half
from stad_study.study import (
    COLLECTING,
    MADE_WITH,
    SCORE,
    STUDIES,
    WAIT,
    claimed,
    drive_tracks,
    fixed_threads,
    select,
    without_finished,
)

NAME = "study4"
SEEDS = range(400, 403)
TRACKS = range(6000, 6400)  # of the score, with the fast renderer
VALIDATION = 64  # tracks of a validation in the fine-tuning, by which agents are chosen
STAGES = ("first", "second", "tuned")
SHIPPED = "study4_shipped"  # the table of the agents that were shipped before
FAILURES = "study4_failures"  # the table of where the kept agents fail


class Run(NamedTuple):
    """One agent; its name is also its folder."""

    seed: int
    variant: str

    @property
    def name(self) -> str:
        """For example "seed400/frame"."""
        return f"seed{self.seed}/{self.variant}"

    @property
    def configs(self) -> dict[str, Config]:
        """The configuration of each stage."""
        base = EXPERIMENTS[f"two_iterations_{self.variant}"]
        tuned = EXPERIMENTS[f"fine_tuned_{self.variant}"].config
        tuned = tuned.replace(evolution={"validation_tracks": VALIDATION})
        own = {"seed": self.seed, "processes": 1, "evolution": {"seed": self.seed}}
        found = zip(STAGES, (base.first, base.config, tuned), strict=True)
        return {stage: config.replace(**own) for stage, config in found if config}


def find_runs(seeds: Sequence[int] | None = None, only: Sequence[str] | None = None) -> list[Run]:
    """All runs, of some seeds, or some by name. ValueError for an unknown seed or name."""
    found = [Run(seed, variant) for seed in SEEDS for variant in VARIANTS]
    return select(NAME, found, seeds, only)


def run_study4(
    folder: str | Path,
    seeds: Sequence[int] | None = None,
    only: Sequence[str] | None = None,
    to: Path = tables.DATA,
) -> None:
    """Run what the tables in `to` lack, in `folder/study4`, and add each run to them.

    After an interruption the same call continues. A run that another process does is left to it;
    each computes on one thread. With `only`, recorded runs are run, too, and compared. ValueError
    as `find_runs`, if the folder already has all that `only` names, and the tables, too, and at the
    end for runs that failed: a run of hours does not wait for another's mistake.
    """
    root, wanted, failed = Path(folder) / NAME, find_runs(seeds, only), []
    if only:
        wanted = without_finished(root, wanted, lambda run: recorded(run, to))
    for run in wanted:
        try:
            do_run(run, root, to, repeat=bool(only))
        except (OSError, ValueError, FloatingPointError, TaskError) as error:
            print(f"{run.name}: {error}", flush=True)
            failed.append(run.name)
    print(f"{NAME}: {describe_progress(to)}")
    if failed:
        raise ValueError(f"{', '.join(failed)}: not finished, for the reasons above")
    if not only and all(recorded(run, to) for run in find_runs()):
        score_shipped(root, to)
        list_failures(root, to)


def do_run(run: Run, root: Path, to: Path, repeat: bool) -> None:
    """Run and add what is not in the tables; with `repeat` run what is there, too, and compare."""
    with claimed(root / run.name) as ours:
        was = recorded(run, to)
        if not ours or (was and not repeat):
            return
        print(f"{run.name}: {describe_progress(to)}", flush=True)
        score = run_one(run, root)
        if was:
            found = f"mean return {score['mean']:.1f}, recorded {was['mean']:.1f}"
            print(f"{run.name}: {found} on {was['processor']}", flush=True)
            return
        add_run(run, root, to)
        # Not its score: the agents are chosen by validation.
        print(f"{run.name}: is finished and in the tables", flush=True)


def run_one(run: Run, root: Path) -> dict:
    """Do what is missing of a run; returns its score."""
    folder = root / run.name
    if (folder / SCORE).exists():
        return load_json(folder / SCORE, kind="score")
    first, second, tuned = (folder / stage for stage in STAGES)
    configs, data = run.configs, root / f"seed{run.seed}"
    made_with = provenance(f"python -m stad_study replicate {NAME} --only {run.name} --out ...")
    with fixed_threads():
        with locked(data, COLLECTING):
            shared = configs["first"].replace(variant="frame")
            train(shared, data, until="dataset")
        train(configs["first"], first, data / "dataset")
        train(configs["second"], second, earlier=first)
        fine_tune(configs["tuned"], second, tuned)
        copy_in_half(tuned, folder / "agent")
        begin = time.perf_counter()
        score = score_agent(folder / "agent", run.name)
    seconds = time.perf_counter() - begin
    told = {"kind": "score", "variant": run.variant, "made_with": made_with}
    save_json(folder / SCORE, {**told, **score, "seconds": seconds})
    return score


def score_agent(source: str | Path, label: str) -> dict:
    """Drive an agent on the tracks of the score."""
    limits = {"max_frames": STUDIES["study1"].max_frames}
    return drive_tracks(load_agent(source), TRACKS, processes=1, label=label, limits=limits)


def score_shipped(root: Path, to: Path) -> None:
    """Score the shipped agents that the table of them in `to` lacks, and add each to it.

    Once there, an agent is not scored again: those of study 4 may be shipped meanwhile.
    """
    for variant in VARIANTS:
        with claimed(root / "shipped" / variant) as ours:
            if not ours or tables.line_of(SHIPPED, [variant], to):
                continue
            made_with = provenance(f"python -m stad_study replicate {NAME} --out ...")
            with fixed_threads():
                score = score_agent(variant, f"shipped {variant}")
            line = {"variant": variant} | controller_of(PRETRAINED / variant)
            line |= {name: made_with[name] for name in ("commit", "processor", "numba")}
            with locked(to, WAIT):
                lines = pandas.DataFrame([line | returns_by_track(score)])
                tables.replace_lines(SHIPPED, lines, to)


def list_failures(root: Path, to: Path) -> None:
    """List the failures of the kept agents in their table in `to`, but for those that it has."""
    for variant, own in tables.read_or_empty(f"{NAME}_runs", to).groupby("variant"):
        best = own.loc[own["validation"].idxmax()]
        expected = round(best["below_800"] * len(TRACKS))
        with claimed(root / "failures" / variant) as ours, fixed_threads():
            known = tables.read_or_empty(FAILURES, to)
            if not ours or not expected or variant in set(known["variant"]):
                continue
            agent = load_agent(to.parent / NETWORKS.name / NAME / variant)
            failures = find_failures(agent, TRACKS)
            if len(failures) != expected:  # as on another kind of processor
                found = f"{len(failures)} failures here, {expected} in its score"
                print(f"{variant}: {found}: not listed", flush=True)
                continue
            lines = pandas.DataFrame(failures).assign(seed=best["seed"], variant=variant)
            with locked(to, WAIT):
                tables.replace_lines(FAILURES, lines, to)


def returns_by_track(score: dict) -> dict[str, float]:
    """The returns of a score for a table, a column for each track; rounded to cents."""
    return {str(one["track"]): round(one["return"], 2) for one in score["episodes"]}


def controller_of(folder: Path) -> dict[str, str]:
    """The checksum of an agent's C, for a table."""
    parameters, _ = load_controller(folder / CONTROLLER_FILE)
    return {"controller": checksum_of_arrays(parameters=parameters)}


def describe_run(folder: Path, score: dict) -> dict:
    """The line of runs: score, validation by which agents are chosen, machines, seconds, budget.

    "processors" of a stage has all on which it was started or continued.
    """
    returns = np.array([episode["return"] for episode in score["episodes"]])
    records = {stage: load_json(folder / stage / RECORD) for stage in STAGES}
    made, log = records["tuned"]["made_with"], load_json(folder / "tuned" / LOG)
    line: dict = {"mean": float(returns.mean()), "minimum": float(returns.min())}
    line["below_800"] = float((returns < FAILED).mean())
    line["validation"], line["generation"] = log["best"]["validation"], log["best"]["generation"]
    line |= {name: made[name] for name in ("commit", "processor", "torch", "numpy")}
    dataset = load_json(folder.parent / RECORD)
    line |= {f"world_model.{name}": records["second"]["made_with"][name] for name in MADE_WITH}
    line |= {f"score.{name}": score["made_with"][name] for name in ("processor", "numba")}
    for stage, record in {"dataset": dataset, **records}.items():
        used = dict.fromkeys(start["processor"] for start in starts(record))
        line[f"processors.{stage}"] = "; ".join(used)
        line[f"seconds.{stage}"] = round(sum(record["seconds"].values()), 1)
    line["seconds.score"] = round(score["seconds"], 1)
    return line | total_budget(records["tuned"]) | controller_of(folder / "agent")


def add_run(run: Run, root: Path, to: Path) -> None:
    """Add a finished run to the tables, and keep its agent if it is the best of its variant."""
    score, key = load_json(root / run.name / SCORE, kind="score"), run._asdict()
    returns = returns_by_track(score)
    line = key | describe_run(root / run.name, score)
    with locked(to, WAIT):
        if recorded(run, to):
            raise ValueError(f"{run.name} came into {to} from another folder: nothing was added")
        before = tables.read_or_empty(f"{NAME}_runs", to)
        others = before[before["variant"] == run.variant]["validation"]
        if others.empty or line["validation"] > others.max():
            kept = to.parent / NETWORKS.name / NAME / run.variant
            copy_in_half(root / run.name / "agent", kept)
        tables.replace_lines(f"{NAME}_returns", pandas.DataFrame([key | returns]), to)
        tables.replace_lines(f"{NAME}_runs", pandas.DataFrame([line]), to)


def recorded(run: Run, to: Path = tables.DATA) -> dict | None:
    """The line of a run in the table of runs; None if it is not there."""
    return tables.line_of(f"{NAME}_runs", run, to)


def describe_progress(to: Path = tables.DATA) -> str:
    """How many runs are in the tables."""
    done = len(tables.read_or_empty(f"{NAME}_runs", to))
    return f"{done} of {len(find_runs())} runs are done"
