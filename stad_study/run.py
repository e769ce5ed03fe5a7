"""Runs the experiments of the replication, each by one command.

`replicate` trains V and M once, runs CMA-ES once for each seed, and evaluates every C on the tracks
0 to 99. In the folder of an experiment::

    first/      in a recipe of two iterations: the whole first run
    world/      dataset, V and M
    seed0/ ...  V, M and C of one CMA-ES run, with its log, record.json and evaluation.json

A fine-tuning experiment has neither a first run nor a world model of its own, because it continues
the seeds of another experiment. In a `retrained` experiment each seed is a whole run. Whatever is
there is not done again.
"""

import filecmp
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

from stad_lab.agent import rollout
from stad_lab.config import Config, random_stream
from stad_lab.envs.cars import Cars
from stad_lab.evaluation.evaluate import KIND, evaluate, load_evaluation, report
from stad_lab.evaluation.statistics import summarise
from stad_lab.io.files import checksum_of_arrays, copy_file, save_json
from stad_lab.io.weights import CONTROLLER_FILE, MDN_RNN_FILE, VAE_FILE, load_controller
from stad_lab.io.workers import run_in_order, worker_threads
from stad_lab.models.controller import squash
from stad_lab.training.dataset import RandomDriver
from stad_lab.training.fine_tuning import fine_tune
from stad_lab.training.pipeline import train
from stad_lab.training.record import RECORD, provenance
from stad_lab.training.subspace import COMPONENTS_FILE, START_FILE
from stad_study import tables
from stad_study.experiments import (
    BASELINE_DRIVERS,
    EXPERIMENTS,
    Experiment,
    find_experiment,
)
from stad_study.tables import TRACKS

EVALUATION = "evaluation.json"
Seeds = Sequence[int] | None
"""Some seeds of an experiment; None for all."""


def replicate(
    name: str, folder: str | Path, executor: Executor | None = None, seeds: Seeds = None
) -> dict:
    """Run what is missing of an experiment in `folder/name`; returns the summary of its returns.

    `executor` drives; None for processes of this machine. Raises ValueError for an unknown
    experiment or seed, and for a folder with something else in it.
    """
    own = Path(folder) / name
    if is_baseline(name, seeds):
        drive_baseline(name, own / "seed0", executor)
        return summary([own / "seed0"])
    experiment, folder = find_experiment(name, seeds), Path(folder)
    folders = {seed: own / f"seed{seed}" for seed in experiment.seeds}
    if not (experiment.base or experiment.retrained):
        source = experiment.world_model or name
        first, world = train_world_model(EXPERIMENTS[source], folder / source, executor)
    for seed, run in folders.items():
        config = experiment.config_of(seed)
        if experiment.base:
            base = folder / experiment.base / run.name
            if not (base / EVALUATION).exists():
                replicate(experiment.base, folder, executor, [seed])
            fine_tune(config, base, run, executor)
        elif experiment.retrained:
            train(config, run, executor=executor)
        else:
            share_world_model(config, run, world)
            train(config, run, world / "dataset", executor=executor, earlier=first)
        evaluate_run(run, executor)
    return summary(list(folders.values()))


def summary(folders: list[Path]) -> dict:
    """The summary of the returns of some runs."""
    evaluations = [load_evaluation(folder / EVALUATION) for folder in folders]
    returns = [[episode["return"] for episode in one["episodes"]] for one in evaluations]
    return {"seeds": len(folders), **summarise(np.array(returns))}


def is_baseline(name: str, seeds: Seeds = None) -> bool:
    """Whether an experiment is a baseline driver; ValueError if that is given seeds."""
    if name in BASELINE_DRIVERS and seeds:
        raise ValueError(f"{name!r} is no training and has no seeds: leave them out")
    return name in BASELINE_DRIVERS


def drive_baseline(name: str, folder: Path, executor: Executor | None) -> None:
    """Drive the tracks of the evaluation blindly; writes the evaluation and a record."""
    if (folder / EVALUATION).exists():
        return
    made_with = provenance(f"python -m stad_study replicate {name} --out ...")  # before the work
    begin, tracks = time.perf_counter(), list(range(TRACKS))
    with worker_threads(Config().processes, executor) as executor:
        tasks = [(name, track) for track in tracks]
        returns, lengths = zip(*run_in_order(executor, drive_blindly, tasks, name), strict=True)
    found = {"kind": KIND, "variant": name, "renderer": "none"}
    found |= report(tracks, np.array(returns), np.array(lengths))
    record = {"kind": "record", "variant": name, "made_with": made_with, "budget": {}}
    save_json(folder / RECORD, record)
    save_json(folder / EVALUATION, found | {"seconds": time.perf_counter() - begin})


class ConstantDriver(RandomDriver):
    """Drives straight on with the gas of the first controller of CMA-ES."""

    def act(self) -> np.ndarray:
        """The next action, float32 (3,)."""
        return squash(np.array([0.0, Config().evolution.initial_gas, 0.0])).astype(np.float32)


def drive_blindly(name: str, track: int) -> tuple[float, int]:
    """Drive a track as a baseline driver: (return, frames). Runs in a worker."""
    kind = RandomDriver if name == "random_driver" else ConstantDriver
    driver, cars = kind(random_stream("random driver", 0, track)), Cars(1, "frame")
    cars.reset([track])
    episodes = rollout(driver, cars)
    return float(episodes.returns[0]), int(episodes.lengths[0])


def train_world_model(
    experiment: Experiment, folder: Path, executor: Executor | None
) -> tuple[Path | None, Path]:
    """Make an experiment's dataset, V and M, and before them its first run: both folders."""
    first, world = None, folder / "world"
    if experiment.first:
        first = folder / "first"
        train(experiment.first, first, executor=executor)
    train(experiment.config, world, until="mdn_rnn", executor=executor, earlier=first)
    return first, world


def share_world_model(config: Config, run: Path, world: Path) -> None:
    """Copy V and M (V alone if M is not trained), and components and first C of a like seed."""
    run.mkdir(parents=True, exist_ok=True)
    trained = (VAE_FILE, MDN_RNN_FILE) if config.mdn_rnn.steps else (VAE_FILE,)
    for other in [world, *run.parent.glob("seed*")]:
        if filecmp.cmpfiles(other, world, trained, shallow=False)[0] == list(trained):
            for name in (*trained, COMPONENTS_FILE, START_FILE):
                if (other / name).exists() and not (run / name).exists():
                    copy_file(other / name, run)


def evaluate_run(folder: Path, executor: Executor | None) -> None:
    """Evaluate a run's C with Gymnasium's renderer, unless its evaluation is of this C."""
    path, (parameters, _) = folder / EVALUATION, load_controller(folder / CONTROLLER_FILE)
    own = checksum_of_arrays(parameters=parameters)
    if path.exists() and load_evaluation(path)["controller"] == own:
        return
    unfinished = folder / f"unfinished-{EVALUATION}"
    save_json(path, evaluate(folder, TRACKS, executor=executor, unfinished=unfinished))
    unfinished.unlink(missing_ok=True)


def keep(name: str, folder: str | Path, seeds: Seeds = None, to: Path = tables.DATA) -> list[str]:
    """Add the finished seeds of an experiment to the tables; returns their names.

    Its first run and its world model are added under the lowest of these seeds.
    """
    own = Path(folder) / name
    wanted = [0] if is_baseline(name, seeds) else find_experiment(name, seeds).seeds
    finished = [seed for seed in wanted if (own / f"seed{seed}" / EVALUATION).exists()]
    for part, role in (("first", "first_iteration"), ("world", "world_model")):
        if finished and (own / part / RECORD).exists():
            tables.add_run(own / part, name, min(finished), to, role)
    for seed in finished:
        tables.add_run(own / f"seed{seed}", name, seed, to)
    return [tables.key(name, seed) for seed in finished]


def describe_time(name: str, seeds: Seeds = None) -> str:
    """One line on how long an experiment took us, with everything that it builds on."""
    if is_baseline(name, seeds):
        minutes = recorded_minutes(name, 1)
    else:
        experiment = find_experiment(name, seeds)
        minutes = recorded_minutes(name, len(experiment.seeds))
        minutes += recorded_minutes(experiment.base, len(experiment.seeds))
        minutes += recorded_minutes(experiment.world_model, 0)
    return f"{name}: about {minutes:.0f} minutes with two processes, if nothing of it is there"


def recorded_minutes(name: str | None, runs: int) -> float:
    """How long so many runs of an experiment took us, with the training of a shared V and M."""
    table = tables.read("runs").query("experiment == @name")
    seconds = table.filter(like="seconds.").sum(axis=1)
    own = table["role"] == "run"
    return (seconds[~own].sum() + runs * seconds[own].mean()) / 60 if own.any() else 0.0


def describe(name: str, found: dict) -> str:
    """One line on an experiment that was run."""
    low, high = found["interval"]
    return (
        f"{name}: {found['mean']:.1f} on {TRACKS} tracks, {found['seeds']} seeds, 95% interval of"
        f" the mean {low:.0f} to {high:.0f}, {100 * found['above_900']:.0f}% above 900"
    )
