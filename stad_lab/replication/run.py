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
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

from stad_lab.agent import rollout
from stad_lab.config import Config, random_stream
from stad_lab.envs.car_racing import MAX_FRAMES, make_env
from stad_lab.evaluation.evaluate import KIND, evaluate, load_evaluation, report
from stad_lab.evaluation.statistics import summarise
from stad_lab.io.files import checksum_of_arrays, copy_file, save_json
from stad_lab.io.weights import (
    CONTROLLER_FILE,
    MDN_RNN_FILE,
    VAE_FILE,
    load_controller,
)
from stad_lab.io.workers import run_in_order, single_thread, worker_processes
from stad_lab.models.controller import squash
from stad_lab.replication import tables
from stad_lab.replication.experiments import (
    BASELINE_DRIVERS,
    EXPERIMENTS,
    Experiment,
    find_experiment,
)
from stad_lab.replication.tables import TRACKS
from stad_lab.training.dataset import RandomDriver
from stad_lab.training.fine_tuning import fine_tune
from stad_lab.training.pipeline import RECORD, provenance, train
from stad_lab.training.subspace import COMPONENTS_FILE, START_FILE

EVALUATION = "evaluation.json"


def replicate(
    name: str,
    folder: str | Path,
    executor: Executor | None = None,
    seeds: Sequence[int] | None = None,
) -> dict:
    """Run an experiment, or what is missing of it; call it again to continue.

    Args:
        name: one of EXPERIMENTS or BASELINE_DRIVERS.
        folder: of all experiments; this one goes into `folder/name`.
        executor: who drives; None for processes of this machine.
        seeds: some of the experiment's seeds; None for all. A baseline driver has none.

    Returns:
        The summary of the returns of these seeds.

    Raises:
        ValueError: an unknown experiment or seed, or a folder with something else in it.
        OSError, TaskError, FloatingPointError: as `train` and `evaluate`.
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


def is_baseline(name: str, seeds: Sequence[int] | None = None) -> bool:
    """Whether an experiment is a driver that does not look; ValueError if it is given seeds."""
    if name in BASELINE_DRIVERS and seeds:
        raise ValueError(f"{name!r} is no training and has no seeds: leave them out")
    return name in BASELINE_DRIVERS


def drive_baseline(name: str, folder: Path, executor: Executor | None) -> None:
    """Drive the tracks of the evaluation without looking; writes the evaluation and a record."""
    if (folder / EVALUATION).exists():
        return
    begin, tracks = time.perf_counter(), list(range(TRACKS))
    with worker_processes(Config().processes, executor) as executor:
        tasks = [(name, track) for track in tracks]
        returns, lengths = zip(*run_in_order(executor, drive_blindly, tasks, name), strict=True)
    found = {"kind": KIND, "variant": name, "renderer": "none"}
    found |= report(tracks, np.array(returns), np.array(lengths))
    made_with = provenance(f"python -m stad_lab replicate --experiment {name} --out ...")
    record = {"kind": "record", "variant": name, "made_with": made_with, "budget": {}}
    save_json(folder / RECORD, record)
    save_json(folder / EVALUATION, found | {"seconds": time.perf_counter() - begin})


class ConstantDriver:
    """Drives straight on with the gas of the first controller of CMA-ES."""

    def reset(self) -> None:
        """Begin an episode."""

    def act_batch(self, observations: Sequence[np.ndarray]) -> np.ndarray:
        """The action of every car, float32 (cars, 3)."""
        action = squash(np.array([0.0, Config().evolution.initial_gas, 0.0]))
        return np.tile(action.astype(np.float32), (len(observations), 1))

    def keep(self, cars: np.ndarray) -> None:
        """All cars are alike."""


def drive_blindly(name: str, track: int) -> tuple[float, int]:
    """Drive a track as a baseline driver: (return, frames). Runs in a worker process.

    Rewards do not depend on the renderer, so the fast one serves.
    """
    single_thread()
    driver = ConstantDriver()
    if name == "random_driver":
        driver = RandomDriver(random_stream("random driver", 0, track))
    env = make_env(fast=True)
    episodes = rollout(driver, [env], [env.reset(seed=track)[0]])
    return float(episodes.returns[0]), int(episodes.lengths[0])


def train_world_model(
    experiment: Experiment, folder: Path, executor: Executor | None
) -> tuple[Path | None, Path]:
    """Make an experiment's dataset, V and M, and before them its first run: both folders."""
    first, world = folder / "first" if experiment.first else None, folder / "world"
    if experiment.first:
        train(experiment.first, first, executor=executor)
    train(experiment.config, world, until="mdn_rnn", executor=executor, earlier=first)
    return first, world


def share_world_model(config: Config, run: Path, world: Path) -> None:
    """Copy V and M into a run, and the components and first C that another seed has computed.

    Those depend on V and M alone.
    """
    run.mkdir(parents=True, exist_ok=True)
    names = (VAE_FILE, MDN_RNN_FILE) if config.mdn_rnn.steps else (VAE_FILE,)
    sources = [world / name for name in names]
    for other in sorted(run.parent.glob("seed*")):
        if all(same_file(other / source.name, source) for source in sources[: len(names)]):
            computed = (other / name for name in (COMPONENTS_FILE, START_FILE))
            sources += [file for file in computed if file.exists()]
    for source in sources:
        if not (run / source.name).exists():
            copy_file(source, run)


def same_file(one: Path, other: Path) -> bool:
    """Whether both files exist and hold the same bytes."""
    return one.exists() and other.exists() and filecmp.cmp(one, other, shallow=False)


def evaluate_run(folder: Path, executor: Executor | None) -> None:
    """Evaluate a run's C with Gymnasium's renderer, unless its evaluation is of this C."""
    path, (parameters, _) = folder / EVALUATION, load_controller(folder / CONTROLLER_FILE)
    own = checksum_of_arrays(parameters=parameters)
    if path.exists() and load_evaluation(path)["controller"] == own:
        return
    unfinished = folder / f"unfinished-{EVALUATION}"
    save_json(path, evaluate(folder, TRACKS, executor=executor, unfinished=unfinished))
    unfinished.unlink(missing_ok=True)


def keep(
    name: str,
    folder: str | Path,
    seeds: Sequence[int] | None = None,
    to: Path = tables.DATA,
) -> list[str]:
    """Add the finished seeds of an experiment to the tables; returns their names.

    With them go its first run and its world model, under the lowest of these seeds.
    """
    own, kept = Path(folder) / name, []
    wanted = [0] if is_baseline(name, seeds) else find_experiment(name, seeds).seeds
    finished = [seed for seed in wanted if (own / f"seed{seed}" / EVALUATION).exists()]
    for part, role in (("first", "first_iteration"), ("world", "world_model")):
        if finished and (own / part / RECORD).exists():
            tables.add_run(own / part, name, min(finished), to, role)
    for seed in finished:
        tables.add_run(own / f"seed{seed}", name, seed, to)
        kept.append(tables.key(name, seed))
    return kept


def time_needed(name: str, seeds: Sequence[int] | None = None) -> dict[str, float]:
    """How long an experiment takes on this machine at most, in seconds: stage -> time.

    It makes a short run with the sizes of the experiment, for about half a minute.
    """
    if is_baseline(name, seeds):
        begin = time.perf_counter()
        _, frames = drive_blindly(name, 0)
        frame = (time.perf_counter() - begin) / frames / Config().processes
        return {"evaluations": TRACKS * MAX_FRAMES * frame}
    experiment = find_experiment(name, seeds)
    if experiment.base:
        times = time_needed(experiment.base, experiment.seeds)
        longer = most_frames(experiment.config) / most_frames(EXPERIMENTS[experiment.base].config)
        evaluations = 2 * times["evaluations"]
        return times | {"fine-tuning": times["CMA-ES"] * longer, "evaluations": evaluations}
    with tempfile.TemporaryDirectory() as folder:
        cost = costs(experiment.config, Path(folder))
    made, runs = experiment, len(experiment.seeds)
    if experiment.world_model:
        made = EXPERIMENTS[experiment.world_model]
    iterations = [made.first, made.config] if made.first else [made.config]
    iterations *= runs if experiment.retrained else 1
    first = most_frames(made.first) if made.first else 0
    return {
        "dataset": cost["frame"] * sum(map(dataset_frames, iterations)),
        "V": cost["vae"] * sum(one.vae.steps for one in iterations),
        "M": cost["mdn_rnn"] * sum(one.mdn_rnn.steps for one in iterations),
        "CMA-ES": cost["frame"] * (first + runs * most_frames(experiment.config)),
        "evaluations": cost["official frame"] * runs * TRACKS * MAX_FRAMES,
    }


def dataset_frames(config: Config) -> int:
    """How many frames a dataset has at most."""
    data = config.data
    return data.episodes * data.episode_frames + data.agent_episodes * data.agent_frames


def most_frames(config: Config) -> int:
    """How many frames CMA-ES drives at most, with its validations."""
    one = config.evolution
    validations = one.generations // one.validate_every * one.validation_tracks
    return (one.generations * one.population * one.tracks + validations) * one.max_frames


def costs(config: Config, folder: Path) -> dict[str, float]:
    """Seconds of a step of V and of M, and of a frame with the fast and with Gymnasium's renderer.

    They are those of a short run of the same sizes, which it makes.
    """
    seconds = {}
    brief = config.replace(
        data={"episodes": 20, "agent_episodes": 0},
        vae={"steps": 6},
        mdn_rnn={"steps": min(4, config.mdn_rnn.steps)},
        evolution={"generations": 2, "validate_every": 2, "validation_tracks": 1, "components": 0},
    ).replace(evolution={"max_frames": 60})
    for stage in ("dataset", "vae", "mdn_rnn", "controller"):
        begin = time.perf_counter()
        train(brief, folder, until=stage)
        seconds[stage] = time.perf_counter() - begin
    env = make_env(fast=False)
    env.reset(seed=0)
    begin = time.perf_counter()
    for _ in range(60):
        env.step(np.array([0.0, 0.1, 0.0], np.float32))
    official = (time.perf_counter() - begin) / 60 / config.processes
    env.close()
    return {
        "vae": seconds["vae"] / brief.vae.steps,
        "mdn_rnn": seconds["mdn_rnn"] / max(1, brief.mdn_rnn.steps),
        "frame": seconds["controller"] / most_frames(brief),
        "official frame": official,
    }


def describe_time(name: str, times: dict[str, float]) -> str:
    """One line that says how long an experiment takes."""
    parts = ", ".join(
        f"{part} {seconds / 60:.0f} min" for part, seconds in times.items() if seconds
    )
    hours = sum(times.values()) / 3600
    return f"{name}: at most {hours:.1f} hours on this machine, if nothing of it is there ({parts})"


def describe(name: str, found: dict) -> str:
    """One line on an experiment that was run."""
    low, high = found["interval"]
    return (
        f"{name}: {found['mean']:.1f} on {TRACKS} tracks, {found['seeds']} seeds, 95% interval of"
        f" the mean {low:.0f} to {high:.0f}, {100 * found['above_900']:.0f}% above 900"
    )
