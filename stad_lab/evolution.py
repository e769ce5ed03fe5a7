"""CMA-ES over C: ask for a population, let it drive in parallel, tell the returns, log, and go on.

The log is the state. CMA-ES is deterministic: its mean, step size, covariance, paths and random state follow from the
seed and the fitnesses it was told. So a resumed run tells a new strategy every logged generation again (no car drives
for that, it takes seconds) and then stands exactly where the old one stood, on the same machine and with the same
versions of cma and numpy. Nothing has to be unpickled. All this runs on one thread, because the last bits of an
eigendecomposition depend on the number of threads.
"""

import dataclasses
import math
import zlib
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path

import cma
import numpy as np
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from stad_lab.agent import Agent, drive, load_controller, load_world_model, save_controller
from stad_lab.checkpoints import load_json, save_json
from stad_lab.controller import initial_parameters
from stad_lab.parallel import return_freed_memory, worker_processes
from stad_lab.rollouts import track_seeds
from stad_lab.settings import Settings, check_same_run

LOG = "evolution.json"
CONTROLLER = "controller.safetensors"


def evolve(variant: str, settings: Settings, folder: Path, watch: Callable[[list[dict]], None] | None = None) -> bool:
    """Evolve C for the V and M in `folder`; writes `evolution.json` after every generation and the best C found.

    Every agent of a generation drives the same few tracks; its fitness is its mean return. From time to time the mean
    of the search distribution drives the validation tracks, and the best such mean is kept as `controller.safetensors`:
    choosing the best *agent* instead would choose the luckiest.

    Args:
        watch: called with the log's generations after each of them is on the disk, and with those of an earlier call.

    Returns:
        False if the run was complete already, True if generations were driven.

    Raises:
        ValueError: the log in `folder` was made with other settings.
        KeyboardInterrupt: passed on; the log holds every finished generation.
    """
    folder = Path(folder)
    log = read_log(variant, settings, folder)
    if watch and log["generations"]:
        watch(log["generations"])
    if (folder / CONTROLLER).exists():
        load_controller(folder / CONTROLLER, variant)
        if len(log["generations"]) >= settings.generations:
            return False
    with threadpool_limits(1), worker_processes(settings.processes) as executor:
        strategy = resume(variant, settings, folder, log)
        done = len(log["generations"])
        progress = tqdm(range(done, settings.generations), f"evolve C ({variant})", settings.generations, initial=done)
        for generation in progress:
            population = np.array(strategy.ask())
            entry = drive_generation(executor, folder, variant, settings, generation, population)
            strategy.tell(population, [-np.mean(returns) for returns in entry["returns"]])
            entry |= {"sigma": float(strategy.sigma), "mean_checksum": mean_checksum(strategy)}
            if (generation + 1) % settings.validate_every == 0:
                validate(executor, folder, variant, settings, strategy.mean, entry, log)
            log["generations"].append(entry)
            save_json(folder / LOG, log)
            worst, average, best = fitness_curves([entry])[:, 0]
            progress.set_postfix_str(f"worst {worst:.0f}, average {average:.0f}, best {best:.0f}")
            if watch:
                watch(log["generations"])
    return True


def resume(variant: str, settings: Settings, folder: Path, log: dict) -> cma.CMAEvolutionStrategy:
    """The strategy as the log left it; makes `controller.safetensors` again if it was lost."""
    autoencoder, mdn_rnn, *_ = load_world_model(folder, variant)
    start = initial_parameters(autoencoder.latent_size, mdn_rnn.hidden_size, settings.initial_gas)
    if log["best"] and not (folder / CONTROLLER).exists():
        best = replay(start, settings, log["generations"][: log["best"]["generation"]])
        save_controller(folder / CONTROLLER, best.mean, variant=variant, **log["best"])
    return replay(start, settings, log["generations"])


def read_log(variant: str, settings: Settings, folder: Path) -> dict:
    """The log of the run in `folder`, or a new one. Raises ValueError if it was made with other settings."""
    new = {"variant": variant, "settings": settings.as_dict(), "best": None, "generations": []}
    if not (folder / LOG).exists():
        return new
    log = load_json(folder / LOG)
    check_same_run(folder, {"variant": log["variant"], **log["settings"]}, {"variant": variant, **new["settings"]})
    return log | {"settings": new["settings"]}


def make_strategy(start: np.ndarray, settings: Settings) -> cma.CMAEvolutionStrategy:
    """pycma's strategy with a random source of its own, so that nothing else can disturb it."""
    rng = np.random.default_rng([settings.seed, 3])
    options = {
        "popsize": settings.population,
        "randn": lambda *shape: rng.standard_normal(shape),
        "seed": np.nan,  # "do nothing": leave NumPy's global generator alone
        "verbose": -9,
        "verb_log": 0,
    }
    return cma.CMAEvolutionStrategy(start, settings.sigma, options)


def replay(start: np.ndarray, settings: Settings, generations: list[dict]) -> cma.CMAEvolutionStrategy:
    """A strategy that has been told all logged generations: the full state of the interrupted run.

    Raises:
        ValueError: the state is not the logged one, because the log was changed or comes from another machine.
    """
    strategy = make_strategy(start, settings)
    for number, entry in enumerate(generations):
        population = strategy.ask()
        strategy.tell(population, [-np.mean(returns) for returns in entry["returns"]])
        if mean_checksum(strategy) != entry["mean_checksum"]:
            raise ValueError(
                f"replaying the log gives another mean in generation {number + 1} than the run had: the log was"
                " changed, or made on another machine or by other versions of cma and numpy. Start in a new folder"
            )
    return strategy


def mean_checksum(strategy: cma.CMAEvolutionStrategy) -> int:
    """CRC-32 of the mean's bytes: two strategies that agree in it agree to the last bit."""
    return zlib.crc32(np.ascontiguousarray(strategy.mean).tobytes())


def drive_generation(
    executor: Executor, folder: Path, variant: str, settings: Settings, generation: int, population: np.ndarray
) -> dict:
    """Let every agent drive the generation's tracks; returns the log's entry with "returns" [agent][track]."""
    tracks = track_seeds("evolve", settings.tracks, settings.seed, generation)
    agents = np.repeat(population, len(tracks), axis=0)
    returns, lengths = drive_parallel(executor, folder, variant, agents, tracks * len(population), settings)
    shape = (len(population), len(tracks))
    return {
        "generation": generation + 1,
        "tracks": tracks,
        "returns": returns.reshape(shape).tolist(),
        "frames": int(lengths.sum()),
    }


def validate(
    executor: Executor, folder: Path, variant: str, settings: Settings, mean: np.ndarray, entry: dict, log: dict
) -> None:
    """Drive the CMA mean on the validation tracks; notes it in `entry`, and keeps it as C if it is the best so far."""
    tracks = track_seeds("validate", settings.validation_tracks)  # the same ones for every seed
    means = np.repeat(mean[None], len(tracks), axis=0)
    patient = dataclasses.replace(settings, patience=0)  # as in the final evaluation: nobody is given up on
    returns, lengths = drive_parallel(executor, folder, variant, means, tracks, patient)
    entry["validation"] = {"mean": float(returns.mean()), "returns": returns.tolist(), "frames": int(lengths.sum())}
    if log["best"] is None or returns.mean() > log["best"]["validation"]:
        log["best"] = {"generation": entry["generation"], "validation": float(returns.mean())}
        save_controller(folder / CONTROLLER, mean, variant=variant, **log["best"])


def drive_parallel(
    executor: Executor, folder: Path, variant: str, parameters: np.ndarray, tracks: list[int], settings: Settings
) -> tuple[np.ndarray, np.ndarray]:
    """Drive one episode for each row of `parameters` (episodes, parameters): (returns, lengths in frames).

    They drive in groups of at most `settings.cars`, under its max_frames and patience, and in two at least, so that two
    cores have work. The groups do not depend on how many processes share them, so neither do the numbers.
    """
    size = min(settings.cars, math.ceil(len(tracks) / 2))
    groups = [slice(start, start + size) for start in range(0, len(tracks), size)]
    futures = [
        executor.submit(drive_group, folder, variant, parameters[group], tracks[group], True, settings)
        for group in groups
    ]
    results = [future.result() for future in futures]
    returns, lengths = (np.concatenate(part) for part in zip(*results, strict=True))
    return returns, lengths


def drive_group(
    folder: Path, variant: str, parameters: np.ndarray, tracks: list[int], fast: bool, limits: Settings | None
) -> tuple[np.ndarray, np.ndarray]:
    """What a worker process does: load V and M once, drive a group of cars in step."""
    autoencoder, mdn_rnn, stride, crop_bar = load_world_model(folder, variant)
    agent = Agent(autoencoder, mdn_rnn, parameters, stride, crop_bar)
    rules = {"max_frames": limits.max_frames, "patience": limits.patience} if limits else {}
    return_freed_memory()
    return drive(agent, tracks, fast, **rules)


def fitness_curves(generations: list[dict]) -> np.ndarray:
    """Worst, average and best fitness of every generation, (3, generations): the paper's three figures.

    A fitness is an agent's mean return over its tracks.
    """
    fitness = [np.mean(entry["returns"], axis=1) for entry in generations]
    return np.array([[f.min(), f.mean(), f.max()] for f in fitness]).T
