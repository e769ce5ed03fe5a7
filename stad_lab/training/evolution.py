"""CMA-ES over C: ask for a population, let it drive, tell the returns, validate, log.

The log is the state. CMA-ES is deterministic: its mean, covariance, step size and random state
follow from the seed and the fitnesses that it was told. A resumed run tells a new strategy every
logged generation again, which takes seconds and no driving, and is then exactly where the old one
was, on the same machine and with the same versions. All of it runs on one thread, because the last
bits of an eigendecomposition depend on the number of threads.
"""

import dataclasses
import math
import zlib
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from stad_lab.agent import Agent, drive
from stad_lab.config import STREAMS, Config, EvolutionConfig, check_same, track_seeds
from stad_lab.io.files import load_json, locked, save_json
from stad_lab.io.weights import (
    CONTROLLER_FILE,
    WorldModel,
    check_belongs,
    load_controller,
    load_world_model,
    save_controller,
)
from stad_lab.io.workers import run_in_order, single_thread, worker_processes
from stad_lab.training.subspace import SearchSpace, search_space

if TYPE_CHECKING:
    import cma

LOG = "evolution.json"
# A hard track may be replayed from the last so many generations, without the very last ones.
REMEMBERED, RESTING = 20, 4
MAY_CHANGE = ("generations",)  # between a run and its continuation

Watch = Callable[[list[dict]], None]


@dataclass
class Evolution:
    """A CMA-ES run: its configuration, its log, and the state that follows from the log."""

    config: Config
    folder: Path
    world_model: WorldModel
    space: SearchSpace
    log: dict
    strategy: "cma.CMAEvolutionStrategy"
    means: list[np.ndarray]
    """The mean after every generation, float64 (dimensions,)."""

    def controller(self) -> np.ndarray:
        """C as found so far, float64 (parameters,)."""
        return self.space.expand(averaged_mean(self.means, self.config.evolution))


def evolve(
    config: Config, folder: Path, executor: Executor | None = None, watch: Watch | None = None
) -> bool:
    """Evolve C for the V and M in `folder`; writes the log after every generation, and the best C.

    All agents of a generation drive the same tracks; their fitness is their mean return. Every few
    generations the averaged mean of CMA-ES drives the validation tracks, and the best one so far is
    kept: to keep the best *candidate* would be to keep the one with the easiest tracks.

    Args:
        executor: who drives; None for `config.processes` processes of this machine.
        watch: called with the log's generations after each of them, and with those of an earlier
            call.

    Returns:
        False if the run was complete already.

    Raises:
        ValueError: a file in `folder` is damaged or of another run, or an action is not finite.
        OSError: another process works in the folder, or a file cannot be read or written.
        TaskError: an episode failed, or no worker answers.
    """
    folder, settings = Path(folder), config.evolution
    world_model = load_world_model(folder)
    log = read_log(config, folder, world_model)
    kept, done = kept_generation(folder, log), len(log["generations"])
    if watch and done:
        watch(log["generations"])
    if log["best"] and kept == log["best"]["generation"] and done >= settings.generations:
        return False
    with locked(folder), threadpool_limits(1):
        run = resume(config, folder, world_model, log)
        if log["best"] and kept != log["best"]["generation"]:
            best = averaged_mean(run.means[: log["best"]["generation"]], settings)
            keep_controller(run, run.space.expand(best))
        with worker_processes(config.processes, executor) as executor:
            source = hand_out(executor, folder)
            label = f"evolve C ({config.variant})"
            bar = tqdm(range(done, settings.generations), label, settings.generations, initial=done)
            for _ in bar:
                run_generation(run, executor, source)
                worst, mean, best = fitness_curves(log["generations"][-1:])[:, 0]
                bar.set_postfix_str(f"worst {worst:.0f}, mean {mean:.0f}, best {best:.0f}")
                if watch:
                    watch(log["generations"])
    return True


def run_generation(run: Evolution, executor: Executor, source: Any) -> None:
    """Ask, drive, tell, validate if it is time, and write the log and a better C."""
    settings, generations = run.config.evolution, run.log["generations"]
    population = ask(run.strategy, settings, len(generations))
    candidates = run.space.expand(population)
    entry = drive_generation(executor, source, run.config, generations, candidates)
    tell(run.strategy, population, entry["returns"], run.means)
    entry |= {"sigma": float(run.strategy.sigma), "mean_checksum": crc(run.strategy.mean)}
    if entry["generation"] % settings.validate_every == 0:
        entry["validation"] = validate(executor, source, run.config, run.controller())
    generations.append(entry)
    better = note_best(run.log)
    save_json(run.folder / LOG, run.log)
    if better:  # after the log, so that every kept C is in the log
        keep_controller(run, run.controller())


def read_log(config: Config, folder: Path, world_model: WorldModel) -> dict:
    """The log of the run in `folder`, or a new one.

    Raises:
        ValueError: it is damaged, of another run, or longer than asked for.
    """
    path, seed = folder / LOG, config.evolution.seed
    new = {
        "kind": "evolution",
        "variant": config.variant,
        "seed": config.seed,
        "evolution": dataclasses.asdict(config.evolution),
        "random": {"entropy": config.seed, "spawn_key": [STREAMS.index("evolution"), seed]},
        **world_model.checksums,
        "best": None,
    }
    if not path.exists():
        return new | {"generations": []}
    log = load_json(path, "move it and the controller away to evolve C again", kind="evolution")
    asked = {name: new[name] for name in ("variant", "seed", "evolution")}
    asked["evolution"] = {
        name: value for name, value in asked["evolution"].items() if name not in MAY_CHANGE
    }
    check_same(path, log, asked)
    check_belongs(path, log, **world_model.checksums)
    if len(log["generations"]) > config.evolution.generations:
        raise ValueError(
            f"{path} holds {len(log['generations'])} generations, and now evolution.generations="
            f"{config.evolution.generations}: ask for at least as many, or choose another folder"
        )
    return log | {"evolution": new["evolution"]}


def resume(config: Config, folder: Path, world_model: WorldModel, log: dict) -> Evolution:
    """The run as its log left it.

    Raises:
        ValueError: the log was changed, comes from another machine, or the search space is not
            that of the log.
    """
    space = search_space(config, world_model, folder)
    strategy, means = replay(space.first, config.evolution, log)
    check_space(folder, config.evolution, space, log["generations"], means)
    return Evolution(config, folder, world_model, space, log, strategy, means)


def make_strategy(
    start: np.ndarray, settings: EvolutionConfig, random: dict
) -> "cma.CMAEvolutionStrategy":
    """pycma's strategy from `start`, float64 (dimensions,).

    The rule that adapts the step size is set explicitly: pycma's default has changed between its
    versions, and depends on the number of dimensions. CSA compares the length of the mean's path
    with that of a random walk; TPA compares two candidates ahead of the mean and behind it.

    Args:
        random: entropy and spawn key of the strategy's own random numbers.
    """
    import cma  # here, because it takes two seconds and workers do not need it
    from cma import sigma_adaptation

    rules = {"CSA": sigma_adaptation.CMAAdaptSigmaCSA, "TPA": sigma_adaptation.CMAAdaptSigmaTPA}
    rng = np.random.default_rng(np.random.SeedSequence(**random))
    options = {
        "popsize": settings.population,
        "randn": lambda *shape: rng.standard_normal(shape),
        "seed": np.nan,  # "do nothing": leave NumPy's global generator alone
        "AdaptSigma": rules[settings.step_size_rule],
        "verbose": -9,
        "verb_log": 0,
    }
    return cma.CMAEvolutionStrategy(start, settings.sigma, options)


def ask(
    strategy: "cma.CMAEvolutionStrategy", settings: EvolutionConfig, generation: int
) -> np.ndarray:
    """The population of a generation, float64 (agents, dimensions).

    With `sigma_decay` the step size follows a schedule: in hundreds of dimensions CMA-ES takes
    dozens of generations to adapt it.
    """
    if settings.sigma_decay:
        strategy.sigma = settings.sigma * settings.sigma_decay**generation
    return np.array(strategy.ask())


def tell(
    strategy: "cma.CMAEvolutionStrategy", population: np.ndarray, returns: list, means: list
) -> None:
    """Tell CMA-ES, which minimises, each agent's returns on its tracks; appends to the means."""
    strategy.tell(population, [-np.mean(own) for own in returns])
    means.append(strategy.mean.copy())


@threadpool_limits.wrap(limits=1)
def replay(
    start: np.ndarray, settings: EvolutionConfig, log: dict
) -> tuple["cma.CMAEvolutionStrategy", list[np.ndarray]]:
    """A strategy that was told every logged generation, and its mean after each.

    Raises:
        ValueError: a mean is not the logged one.
    """
    strategy, means = make_strategy(start, settings, log["random"]), []
    for number, entry in enumerate(log["generations"]):
        population = ask(strategy, settings, number)
        tell(strategy, population, entry["returns"], means)
        if crc(strategy.mean) != entry["mean_checksum"]:
            raise ValueError(
                f"replaying the log gives another mean in generation {number + 1}: the log was"
                " changed, or made on another machine or by other versions of cma and numpy. Start"
                " in a new folder"
            )
    return strategy, means


def check_space(
    folder: Path,
    settings: EvolutionConfig,
    space: SearchSpace,
    generations: list[dict],
    means: list[np.ndarray],
) -> None:
    """Raise ValueError if the last validated C does not follow from this search space."""
    last = max((n for n, entry in enumerate(generations, 1) if "validation" in entry), default=0)
    if not last:
        return
    with threadpool_limits(1):
        found = crc(space.expand(averaged_mean(means[:last], settings)))
    if found != generations[last - 1]["validation"]["controller_checksum"]:
        raise ValueError(
            f"{folder} holds other components, or another first C, than the run in {folder / LOG}"
            " had: restore the right files, or start in a new folder"
        )


def averaged_mean(means: list[np.ndarray], settings: EvolutionConfig) -> np.ndarray:
    """The average of the last `averaged_share` of the means, float64 (dimensions,).

    The noise of the returns moves the mean around; averaging removes it (Polyak averaging).
    """
    return np.mean(means[-max(1, round(settings.averaged_share * len(means))) :], axis=0)


def kept_generation(folder: Path, log: dict) -> int | None:
    """The generation of the kept C, by the log; None if none is kept.

    Raises:
        ValueError: it is damaged, or not in the log.
    """
    path = folder / CONTROLLER_FILE
    if not path.exists():
        return None
    parameters, metadata = load_controller(path)
    validated = {
        entry["generation"]: entry["validation"]["controller_checksum"]
        for entry in log["generations"]
        if "validation" in entry
    }
    generation = metadata.get("generation")
    if crc(parameters) != validated.get(generation):
        raise ValueError(
            f"{path} does not come from the run in {folder / LOG}: move it away, and the same"
            " command writes the right one"
        )
    return generation


def note_best(log: dict) -> bool:
    """Note the generation with the best validation; True if it is the last one."""
    last = log["generations"][-1]
    best = log["best"]["validation"] if log["best"] else -math.inf
    if "validation" not in last or last["validation"]["mean"] <= best:
        return False
    mean = last["validation"]["mean"]
    log["best"] = {"generation": last["generation"], "validation": mean}
    return True


def keep_controller(run: Evolution, controller: np.ndarray) -> None:
    """Write C, float64 (parameters,), with its generation and the checksums of V and M."""
    metadata = {"variant": run.config.variant, **run.log["best"], **run.world_model.checksums}
    save_controller(run.folder / CONTROLLER_FILE, controller, **metadata)


def crc(vector: np.ndarray) -> int:
    """CRC-32 of the bytes of a float64 vector: vectors that agree in it are bit-identical."""
    return zlib.crc32(np.ascontiguousarray(vector).tobytes())


def generation_tracks(config: Config, earlier: list[dict]) -> list[int]:
    """The tracks of the generation after the `earlier` ones: new ones, and some hard ones again.

    Ranks do not say by how much an agent is better: on an easy track the fastest agents win, even
    if they lose hundreds of points elsewhere. So a share `replay_share` of the tracks is replayed:
    those on which the mean agent did worst when it last drove them, among the last REMEMBERED
    generations without the last RESTING ones. It is a simple form of prioritized level replay
    (Jiang, Grefenstette and Rocktaschel, 2021).
    """
    settings, number = config.evolution, len(earlier)
    new = track_seeds("evolve", settings.tracks, config.seed, number, settings.seed)
    share = settings.tracks * settings.replay_share
    replayed = int((number + 1) * share) - int(number * share)
    if not replayed:
        return new
    last_mean = {}
    for entry in earlier[-REMEMBERED:]:
        last_mean |= dict(zip(entry["tracks"], np.mean(entry["returns"], axis=0), strict=True))
    resting = {track for entry in earlier[-RESTING:] for track in entry["tracks"]}
    hard = sorted(last_mean.keys() - resting, key=last_mean.get)
    return (hard[:replayed] + new)[: settings.tracks]


def drive_generation(
    executor: Executor, source: Any, config: Config, earlier: list[dict], population: np.ndarray
) -> dict:
    """Let every agent drive the next generation's tracks; returns its entry of the log.

    Args:
        source: what `hand_out` returned.
        population: of controllers, float64 (agents, parameters).

    Returns:
        "generation", "tracks", "returns" [agent][track] and "frames".
    """
    tracks = generation_tracks(config, earlier)
    agents = np.repeat(population, len(tracks), axis=0)
    repeated = tracks * len(population)
    returns, lengths = drive_parallel(executor, source, config.evolution, agents, repeated)
    return {
        "generation": len(earlier) + 1,
        "tracks": tracks,
        "returns": returns.reshape(len(population), len(tracks)).tolist(),
        "frames": int(lengths.sum()),
    }


def validate(executor: Executor, source: Any, config: Config, controller: np.ndarray) -> dict:
    """Drive a controller, float64 (parameters,), on the validation tracks."""
    tracks = track_seeds("validate", config.evolution.validation_tracks)  # for every seed the same
    copies = np.repeat(controller[None], len(tracks), axis=0)
    settings = dataclasses.replace(config.evolution, patience=0)  # as in the evaluation
    returns, lengths = drive_parallel(executor, source, settings, copies, tracks)
    return {
        "mean": float(returns.mean()),
        "returns": returns.tolist(),
        "frames": int(lengths.sum()),
        "controller_checksum": crc(controller),
    }


def drive_parallel(
    executor: Executor,
    source: Any,
    settings: EvolutionConfig,
    parameters: np.ndarray,
    tracks: list[int],
) -> tuple[np.ndarray, np.ndarray]:
    """Drive one episode for each row of `parameters`, in groups of at most `settings.cars`.

    The groups do not depend on the number of processes, so neither do the numbers.

    Returns:
        The returns and the lengths in frames, (episodes,).
    """
    size = min(settings.cars, math.ceil(len(tracks) / 2))  # so that two cores have work
    groups = [slice(start, start + size) for start in range(0, len(tracks), size)]
    limits = {"max_frames": settings.max_frames, "patience": settings.patience}
    tasks = [(source, parameters[group], tracks[group], True, limits) for group in groups]
    found = run_in_order(executor, drive_group, tasks)
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))


def drive_group(
    source: Path | WorldModel,
    parameters: np.ndarray,
    tracks: list[int],
    fast: bool = True,
    limits: dict | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Drive a group of cars: (returns, lengths). Runs in a worker process."""
    single_thread()
    episodes = drive(make_agent(source, parameters), tracks, fast, **limits or {})
    return episodes.returns, episodes.lengths


def hand_out(executor: Executor, folder: Path) -> Any:
    """What tells a worker which V and M to drive with.

    On this machine that is their folder. On a cluster, which may share no disk, V and M themselves
    are brought once to every worker by the executor's `share`.
    """
    share = getattr(executor, "share", None)
    return share(load_world_model(folder)) if share else Path(folder)


def make_agent(source: Path | WorldModel, parameters: np.ndarray) -> Agent:
    """An agent of the V and M that `hand_out` names, and of C."""
    world_model = source if isinstance(source, WorldModel) else load_world_model(source)
    return Agent(world_model, parameters)


def fitness_curves(generations: list[dict]) -> np.ndarray:
    """Worst, mean and best fitness of every generation, (3, generations): the paper's figures.

    A fitness is an agent's mean return over its tracks.
    """
    fitness = [np.mean(entry["returns"], axis=1) for entry in generations]
    return np.array([[own.min(), own.mean(), own.max()] for own in fitness]).T
